"""Skills as the experiments call them: one module that knows the packages of worlds and skills."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from kineverse.errors import KineverseError
from kineverse.manipulation.outcome import Outcome
from kineverse.manipulation.push_trials import try_push
from kineverse.manipulation.session import Session
from kineverse.model.model import Model
from kineverse.model.registry import import_entry
from kineverse.state import StateLike
from kineverse.worlds import World

from .robots import RobotSource
from .trials import Trial, find_failure

DT = 0.02
"""Control period [s]."""
_PLANS = ("plan", "place", "placement")
"""Computations that are no control steps, by the first word of their names in a session."""

# Entries are texts until all of them exist, as in the registry of models.
_WORLDS: Mapping[str, str] = {
    "kinematic": "kineverse.worlds.kinematic_world:KinematicWorld",
    "mujoco": "kineverse.worlds.mujoco_world:MujocoWorld",
}
_OPEN = "kineverse.manipulation.opening:open_object"


def make_world(kind: str, model: Model, robot: str, state: StateLike) -> World:
    """Return a world at a state, in which nothing is held."""
    world: World = import_entry(_WORLDS[kind])(model, robot)
    world.reset(state)
    return world


def open_in_world(world: World, what: str, target: float, **options: Any) -> tuple[Outcome, Session]:
    """Grasp an object and move it to a target, and return what came out and the session."""
    session = Session(world, dt=DT)
    return import_entry(_OPEN)(session, what, target=target, **options), session


def run_push_trial(
    case: str,
    robot: RobotSource,
    model: Model,
    what: str,
    start: StateLike,
    skill: str,
    *,
    dt: float = DT,
    steps: int = 1200,
    seed: int = 0,
    logic: str | None = "and",
    kind: str = "kinematic",
    record: bool = False,
    **measures: Any,
) -> Trial:
    """Return the trial of a push in a world: from a start, or from one that base placement finds.

    Parameters
    ----------
    case, what, start, measures
        As for :func:`open_then_close`.
    robot, model
        The robot, and the model that contains it.
    skill
        Name of the push in tables.
    dt, steps
        Control period [s], and largest number of steps.
    seed, logic
        As for :func:`.try_push`.
    kind
        Name of the world.
    record
        Whether the trial has the commanded speeds as series.
    """
    world = CommandLog(make_world(kind, model, robot.prefix, start))
    try:
        found = try_push(world, world.state, what, dt=dt, steps=steps, seed=seed, logic=logic)
    except KineverseError as error:
        return _failed_trial(case, robot.name, what, skill, error, measures)
    outcome = found.outcome
    own = {
        "placed": found.placed,
        "first": found.first,
        "limits": found.violation,
        "penetration": 1e3 * found.penetration[0],
        "penetrating": found.penetration[1],
        "contact_losses": outcome.measures.get("losses", 0),
    }
    return Trial(
        case,
        robot.name,
        what,
        skill,
        outcome.done,
        float(outcome.value),
        find_failure(outcome),
        outcome.reason,
        float(outcome.seconds),
        int(outcome.steps),
        found.cpu,
        found.walls,
        {**measures, **outcome.measures, **own},
        world.commands if record else {},
    )


class CommandLog:
    """World that keeps the commanded speeds since the last reset.

    Attributes
    ----------
    commands
        Speeds by name, one for each command [m/s], [rad/s]; and ``time``, its time in the world [s].
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self.commands: dict[str, list[float]] = {"time": []}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)

    def reset(self, state: StateLike) -> None:
        """Start anew, and forget the commands."""
        self.commands = {"time": []}
        self._world.reset(state)

    def apply(self, speeds: StateLike, duration: float, *, stamp: float | None = None) -> None:
        """Advance the world, and keep the speeds."""
        count = len(self.commands["time"])
        self.commands["time"].append(self._world.time)
        given = {str(symbol): float(value) for symbol, value in dict(speeds).items()}
        for name in given:
            self.commands.setdefault(name, [0.0] * count)
        for name, values in self.commands.items():
            if name != "time":
                values.append(given.get(name, 0.0))
        self._world.apply(speeds, duration, stamp=stamp)


def open_then_close(
    case: str,
    robot: str,
    world: World,
    what: str,
    start: StateLike,
    targets: tuple[float, float],
    **measures: Any,
) -> list[Trial]:
    """Return the trials of opening an object in a world and, if that was done, of closing it.

    Parameters
    ----------
    case
        Name of the case.
    robot, world, what
        Name of the robot, its world, and the coordinate of the object.
    start
        State at the beginning.
    targets
        Value of the open and of the closed object [m], [rad].
    measures
        Further figures of the trials.
    """
    world.reset(start)
    trials: list[Trial] = []
    for skill, target in zip(("open", "close"), targets, strict=True):
        act = partial(open_in_world, world, what, target)
        trials.append(run_trial(case, robot, what, skill, act, **measures))
        if not trials[-1].done:
            break
    return trials


def run_trial(
    case: str,
    robot: str,
    what: str,
    skill: str,
    act: Callable[[], tuple[Outcome, Session]],
    **measures: Any,
) -> Trial:
    """Return the trial of a skill. An error of the library is a failure of the class ``other``."""
    try:
        outcome, session = act()
    except KineverseError as error:
        return _failed_trial(case, robot, what, skill, error, measures)
    names = [name for name in session.cpu if not name.startswith(_PLANS)]
    return Trial(
        case,
        robot,
        what,
        skill,
        outcome.done,
        float(outcome.value),
        find_failure(outcome),
        outcome.reason,
        float(outcome.seconds),
        int(outcome.steps),
        tuple(t for name in names for t in session.cpu[name]),
        tuple(t for name in names for t in session.wall[name]),
        {**measures, **outcome.measures},
    )


def _failed_trial(
    case: str, robot: str, what: str, skill: str, error: KineverseError, measures: Mapping[str, Any]
) -> Trial:
    """Return the trial of a skill that ended with an error."""
    reason = f"{type(error).__name__}: {error}"
    return Trial(case, robot, what, skill, False, math.nan, "other", reason, 0.0, 0, measures=measures)
