"""Planned pushes: starts that a path leads to, pushes of what no grasp moves, and presses of buttons."""

from __future__ import annotations

import math

from kineverse.errors import InvalidValueError
from kineverse.geometry import Scene
from kineverse.manipulation.outcome import SkillError
from kineverse.manipulation.pushing.base_placement import find_push_start
from kineverse.manipulation.pushing.push_controller import Pushing
from kineverse.manipulation.pushing.push_skill import push
from kineverse.manipulation.session import Belief, Session
from kineverse.manipulation.skill_run import choose_tolerance
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Observation

from .contact_phases import ContactPhase
from .hand_motion import HandMotion

_STARTS = 960  # most sampled starts; a limit of time would let results depend on other processes
LEAST_PUSH = 0.2  # least share of the rest that a push is for
_LONGER, _AFTER = 1.5, 2.0  # share of the time in the roll-out that a partial push lasts, and rest [s]
_PLANNING, _PUSHING = 1.0, 10.0  # largest time to plan the path to a push, and least time for it [s]
_PRESSING = 20.0  # longest time of a press [s]
_HALVINGS = 16  # steps in which the place of a pressed part is found
_NEAR = 0.01  # distance of a pusher that may displace a part [m]


class PlannedPush:
    """Push of an object by the bodies of a gripper, from a start to which a path of the robot was planned."""

    def __init__(
        self, motion: HandMotion, coordinate: Symbol, target: float, seed: int, least: float = LEAST_PUSH
    ) -> None:
        """Find a push that goes through, or leads over a share of the way, or raise SkillError."""
        self._motion, session = motion, motion.session
        session.phase = "place"
        with session.search(f"starts of a push of '{coordinate}'"):
            state = session.state
            try:
                self._pushing = Pushing(
                    motion.model,
                    motion.search.robot,
                    coordinate,
                    motion.gripper.bodies,
                    state,
                    target=target,
                    dt=session.dt,
                    fixed=motion.gripper.joints,
                )
                result = find_push_start(
                    self._pushing,
                    state,
                    samples=_STARTS,
                    seconds=math.inf,
                    seed=seed,
                    least=least,
                    accept=self._plan,
                    report=session.report_search,
                )
            except InvalidValueError as error:
                raise SkillError("reach", f"It cannot be pushed: {error}") from error
        if result.state is None:
            raise SkillError(result.failure, f"No push leads on: {result.why}")
        self.seconds = math.inf if result.whole else _LONGER * result.steps * session.dt + _AFTER
        """Longest time of the push [s]."""

    def make(self, tolerance: float, seconds: float = math.inf, *, returns: bool = False) -> None:
        """Go to the start, push, and take the hand away, or raise SkillError."""
        motion, pushing = self._motion, self._pushing
        motion.drive()
        motion.follow_planned()
        outcome = push(
            motion.session,
            pushing.coordinate,
            target=pushing.target,
            tolerance=tolerance,
            seconds=min(seconds, self.seconds, motion.run.left),
            pushing=pushing,
            plan=False,
            retreat=True,
            returns=returns,
        )
        if motion.session.fault or not outcome:
            raise SkillError(outcome.measures.get("failure", "other"), outcome.reason)

    def _plan(self, start: State) -> str:
        """Plan the path to the start of a push, and return why there is none."""
        motion = self._motion
        motion.planned = planned = motion.approaches.plan(motion.session.state, start, seconds=_PLANNING)
        if planned.trajectory is None:
            return "no path to the start"
        return "far away" if planned.trajectory.duration > motion.run.left - _PUSHING else ""


def press(motion: HandMotion, phase: ContactPhase, seed: int) -> None:
    """Press a part without a handle, such as a button, as a phase says, or raise SkillError.

    It may move back afterwards. The way of a button is less than the noise of what cameras see, so where it
    is follows from the hand.
    """
    session, coordinate = motion.session, phase.coordinate
    tolerance = choose_tolerance(motion.model, coordinate, session.state, phase.target, phase.tolerance)
    belief = session.belief
    if session.deviation(coordinate) > tolerance / 4:
        belief = DisplacedBelief(session, motion, coordinate, phase.target)
    with session.believing(belief):
        PlannedPush(motion, coordinate, phase.target, seed, least=1.0).make(
            tolerance, _PRESSING, returns=True
        )


class DisplacedBelief:
    """Belief in which a part rests at its default value unless a hand is where it would be.

    Then it is displaced as little as possible in the direction of a target. All else is believed as before.
    """

    def __init__(self, session: Session, motion: HandMotion, coordinate: Symbol, target: float) -> None:
        self._inner: Belief = session.belief
        self._coordinate, self._target = coordinate, target
        self._rest = float(motion.model.default_state()[coordinate])
        self._scene = scene = Scene.of(motion.model)
        part = [b for b in scene.bodies_moved_by([coordinate]) if b not in motion.search.robot_bodies]
        self._near = scene.watch(motion.gripper.bodies, part, _NEAR)

    def update(self, observation: Observation, time: float, commands: State | None = None) -> State:
        """Return the believed state, with the part where the hand lets it be."""
        state = self._inner.update(observation, time, commands)
        free, beyond = self._rest, self._target + (self._target - self._rest)
        if self._touches(state, free):
            low, high = free, beyond
            for _ in range(_HALVINGS):
                middle = (low + high) / 2
                low, high = (middle, high) if self._touches(state, middle) else (low, middle)
            free = high
        lower, upper = self._scene.model.limits(self._coordinate)
        return state.updated({self._coordinate: min(max(free, lower), upper)})

    def deviation(self, coordinate: Symbol) -> float:
        """Return the standard deviation of a coordinate [m], [rad]; 0 of the part."""
        return 0.0 if coordinate == self._coordinate else self._inner.deviation(coordinate)

    def _touches(self, state: State, value: float) -> bool:
        self._scene.update(state.updated({self._coordinate: value}))
        return bool((self._near(0.0).distances < 0.0).any())
