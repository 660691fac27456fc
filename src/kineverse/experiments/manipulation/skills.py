"""Skills as the experiments call them: one module that knows the packages of worlds and skills."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from kineverse.errors import KineverseError
from kineverse.manipulation.outcome import Outcome
from kineverse.manipulation.session import Session
from kineverse.model.model import Model
from kineverse.model.registry import import_entry
from kineverse.state import StateLike
from kineverse.worlds import World

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
_PUSH = "kineverse.manipulation.pushing:push"


def make_world(kind: str, model: Model, robot: str, state: StateLike) -> World:
    """Return a world at a state, in which nothing is held."""
    world: World = import_entry(_WORLDS[kind])(model, robot)
    world.reset(state)
    return world


def open_in_world(world: World, what: str, target: float, **options: Any) -> tuple[Outcome, Session]:
    """Grasp an object and move it to a target, and return what came out and the session."""
    session = Session(world, dt=DT)
    return import_entry(_OPEN)(session, what, target=target, **options), session


def push_in_world(
    world: World, what: str, target: float = 0.0, *, dt: float = DT, **options: Any
) -> tuple[Outcome, Session]:
    """Push an object to a target, and return what came out and the session."""
    session = Session(world, dt=dt)
    return import_entry(_PUSH)(session, what, target=target, **options), session


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
        reason = f"{type(error).__name__}: {error}"
        return Trial(case, robot, what, skill, False, math.nan, "other", reason, 0.0, 0, measures=measures)
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
