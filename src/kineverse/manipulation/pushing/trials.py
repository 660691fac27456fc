"""Trials of pushes in a world: figures of one push from a given start, or from one that is searched."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from kineverse.geometry import Rule, Scene
from kineverse.geometry.objects import Exclusion
from kineverse.grasping import find_gripper
from kineverse.manipulation.outcome import Outcome
from kineverse.manipulation.session import Session
from kineverse.manipulation.skill_arguments import find_object_coordinate
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import World

from .base_placement import find_push_start
from .push_controller import Pushing
from .push_skill import push


@dataclass(frozen=True, slots=True, eq=False)
class PushTrial:
    """Figures of one push."""

    robot: str  # prefix of the robot
    what: str  # the coordinate
    outcome: Outcome  # result of the push
    placed: int  # number of samples of the base placement; 0 if the push began at the given state
    first: str  # why the push from the given state failed; empty if it did not
    penetration: tuple[float, str]  # [m]
    pressed: float  # deepest penetration of pusher and pushed object [m]
    violation: float  # largest violation of a limit on positions, in the unit of the coordinate
    median: float  # CPU time of a step of the controller, scene queries included [s]
    p99: float
    worst: float
    wall: float  # median wall time of a step [s]
    cpu: tuple[float, ...] = ()  # CPU and wall times of all steps [s]
    walls: tuple[float, ...] = ()

    def __str__(self) -> str:
        outcome, m = self.outcome, self.outcome.measures
        ms = 1e3
        return (
            f"{self.robot:8}{self.what:36}{'shut' if outcome else 'NOT ':5}{outcome.value:7.3f}"
            f"{outcome.steps:6d} steps, lost {m.get('losses', 0)}, points {m.get('contacts', 0)}, "
            f"deepest {ms * self.penetration[0]:.2f} mm, limits {self.violation:.1e}, "
            f"step {ms * self.median:.2f} {ms * self.p99:.2f} {ms * self.worst:.2f} ms, "
            f"jitter {m.get('jitter', 0.0):.3f}"
            f"{f', placed after {self.placed}' if self.placed else ''}"
            f"{'' if outcome else f'. {outcome.reason}'}"
        )


def try_push(
    world: World,
    state: State,
    what: Symbol | str,
    *,
    bodies: str | Iterable[str] | None = None,
    target: float = 0.0,
    steps: int = 1200,
    dt: float = 0.02,
    tolerance: float | None = None,
    place: bool = True,
    samples: int = 200,
    seed: int = 0,
    rules: Iterable[Rule] = (),
    leave_out: Iterable[Exclusion] = (),
    logic: str | None = "and",
    open_session: Callable[[World, Callable[[Session], object]], Session] | None = None,
    on_step: Callable[[Pushing], object] | None = None,
) -> PushTrial:
    """Push in a world from a state; if that fails, from a start that base placement finds."""
    model = world.model
    coordinate = find_object_coordinate(world, what)
    bodies = find_gripper(model, world.robot).bodies if bodies is None else bodies
    pushing = Pushing(
        model,
        coordinate,
        bodies,
        state,
        target=target,
        robot=world.robot,
        dt=dt,
        rules=rules,
        leave_out=leave_out,
        logic=logic,
    )

    def attempt(start: State) -> tuple[Outcome, _Judge, Session]:
        world.reset(start)
        judge = _Judge(pushing)
        if open_session is None:
            session = Session(world, dt=dt, on_step=judge.look)
        else:
            session = open_session(world, judge.look)
        outcome = push(
            session,
            coordinate,
            seconds=steps * dt,
            tolerance=tolerance,
            pushing=pushing,
            plan=not place,
            on_step=on_step,
        )
        return outcome, judge, session

    outcome, judge, session = attempt(state)
    placed, first = 0, ""
    if not outcome and place:
        first = outcome.reason
        start = find_push_start(pushing, state, samples=samples, seed=seed)
        placed = start.samples
        if start.state is not None:
            outcome, judge, session = attempt(start.state)
    cpu, wall = (np.array(times.get("push", [0.0])) for times in (session.cpu, session.wall))
    return PushTrial(
        world.robot,
        str(coordinate),
        outcome,
        placed,
        first,
        judge.deepest,
        judge.pressed,
        judge.violation,
        float(np.median(cpu)),
        float(np.percentile(cpu, 99)),
        float(cpu.max()),
        float(np.median(wall)),
        tuple(cpu.tolist()),
        tuple(wall.tolist()),
    )


class _Judge:
    """Judge of a push in a world's truth: penetration and limits."""

    def __init__(self, pushing: Pushing) -> None:
        model, robot = pushing.model, f"{pushing.robot}/*"
        self._pushing = pushing
        self._scene = Scene(model, rules=(*pushing.overlapping, *pushing.rules), leave_out=pushing.leave_out)
        allowed = [Rule(a, b, False, "pushed") for a in pushing.pusher for b in pushing.object_bodies]
        self._others = self._scene.watch(robot, "*", radius=0.0, moving=pushing.speeds, rules=allowed)
        self._pair = self._scene.watch(pushing.pusher, pushing.object_bodies, radius=0.0)
        self._limits = [(s, *model.limits(s)) for s in model.degrees_of_freedom]
        self.deepest: tuple[float, str] = (0.0, "")
        self.pressed = self.violation = 0.0

    def look(self, session: Session) -> None:
        """Judge the present state of a session's world."""
        state = session.world.state
        self._scene.update(state)
        found = self._others()
        if len(found) and -found.distances[0] > self.deepest[0]:
            self.deepest = -float(found.distances[0]), f"{found[0].a} and {found[0].b}"
        found = self._pair()
        if len(found):
            self.pressed = max(self.pressed, -float(found.distances[0]))
        for symbol, lower, upper in self._limits:
            value = state[symbol]
            self.violation = max(self.violation, lower - value, value - upper)
