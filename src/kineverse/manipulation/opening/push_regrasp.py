"""Push of an object when no grasp can continue its motion, such as a flap whose handle faces the floor."""

from __future__ import annotations

import math

from kineverse.errors import InvalidValueError
from kineverse.manipulation.outcome import SkillError
from kineverse.manipulation.pushing.base_placement import find_push_start
from kineverse.manipulation.pushing.push_controller import Pushing
from kineverse.manipulation.pushing.push_skill import push
from kineverse.state import State

from .approach_planner import Approach
from .hand_motion import HandMotion

_SAMPLES = 960  # most sampled starts; a limit of time would let results depend on other processes
_LEAST_SHARE = 0.2  # least share of the motion that a push is for
_LONGER, _SETTLING = 1.5, 2.0  # share of the time in the roll-out that a partial push lasts, and rest [s]
_PLANNING = 1.0  # largest time to plan the path to a start [s]
_PUSHING = 10.0  # time in the world that a push is given at least [s]


class PushRegrasp:
    """Push that moves an object on."""

    def __init__(self, motion: HandMotion, target: float, tolerance: float) -> None:
        self.motion, self.target, self.tolerance = motion, target, tolerance
        self.samples, self.begun = 0, False
        self._seconds = math.inf
        self.approach = Approach()

    def find_start(self, seed: int) -> None:
        """Find a state of the robot from which the push goes through, or far, and to which a path leads."""
        motion, session = self.motion, self.motion.session
        session.phase = "place"
        session.report_search("starts of a push, as no grasp leads on")
        with session.timed("place"):
            state = session.state
            try:
                self.pushing = Pushing(
                    motion.model,
                    motion.handle.coordinate,
                    motion.gripper.bodies,
                    state,
                    target=self.target,
                    robot=session.world.robot,
                    dt=session.dt,
                    fixed=motion.gripper.joints,
                )
                result = find_push_start(
                    self.pushing,
                    state,
                    samples=_SAMPLES,
                    seconds=math.inf,
                    seed=seed,
                    least=_LEAST_SHARE,
                    accept=self._plan,
                    report=session.report_search,
                )
            except InvalidValueError as error:
                raise SkillError("reach", f"It cannot be pushed: {error}") from error
        self.samples += result.samples
        if result.state is None:
            raise SkillError(result.failure, f"Nor does a push: {result.why}")
        if not result.whole:
            self._seconds = _LONGER * result.steps * session.dt + _SETTLING

    def _plan(self, start: State) -> str:
        """Plan the path to a start, and return why there is none."""
        motion, state = self.motion, self.motion.session.state
        self.approach = motion.approaches.plan(state, start, seconds=_PLANNING)
        if self.approach.trajectory is None:
            return "no path to the start"
        left = motion.until - motion.session.world.time
        return "far away" if self.approach.trajectory.duration > left - _PUSHING else ""

    def perform(self) -> None:
        """Go to the start that was found, push, and take the hand away."""
        motion, session = self.motion, self.motion.session
        assert self.approach.trajectory is not None
        session.phase = "approach"
        motion.follow(self.approach.trajectory)
        self.begun = True
        before = abs(session.state[motion.handle.coordinate] - self.target)

        outcome = push(
            session,
            motion.handle.coordinate,
            target=self.target,
            tolerance=self.tolerance,
            seconds=min(self._seconds, motion.until - session.world.time),
            pushing=self.pushing,
            plan=False,
            retreat=True,
            judge=motion.judge,
        )
        left = abs(session.state[motion.handle.coordinate] - self.target)
        if not outcome and left > (1.0 - _LEAST_SHARE / 2) * before:
            raise SkillError(outcome.measures["failure"], outcome.reason)
