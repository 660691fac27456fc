"""Pulling of a part by its handle until it is open, with new grasps where the handle slips."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kineverse.control import Command
from kineverse.grasping import Grasp
from kineverse.lie import Array, inverse
from kineverse.manipulation.opening.hand_motion import HandMotion
from kineverse.manipulation.outcome import SkillError
from kineverse.manipulation.session import Session
from kineverse.manipulation.slip_detection import PULLED_OUT
from kineverse.manipulation.swept_volume import BlockedError
from kineverse.model.frame import is_of_robot
from kineverse.model.model import Model

from .joint_learning import JointLearning
from .part_belief import PartBelief, measure_way
from .pull_controllers import LearnedPull, StraightPull, learn_model, point_speed
from .unmodelled_joint import JointPath

LEAST_OPENING = 0.08, math.radians(10.0)  # from which a part at its own stop is open [m], [rad]
LOOKING, _HELD_LOOKING = 0.6, 1.0  # times of looks at a part that stands, and with the hand closed [s]
_MOST_GRASPS = 3
_DIRECTIONS = (
    (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0),
)  # fmt: skip
"""Directions in which a part is pulled one after the other until it follows, in the axes of its handle: along
its outward normal, to both sides across the bar, and to both ends along it."""
_REFIT = 0.5  # time between two controllers for a learned joint [s]
_FOLLOWS, _STALLED, _PATIENCE = 0.01, 0.004, 1.5
"""Motion of a part that follows the hand, and its least progress [m] in a time [s]."""
_LED = 0.06  # distance of the handle before which the hand does not rely on a joint that was learned [m]
_ENDING = 0.5  # time without progress where the arm is expected to end [s]
_AHEAD, _AHEAD_STEPS = 0.03, 4  # distance that an arm must be able to go on [m], and number of poses


class ArmEndError(SkillError):
    """End of the arm's reach, or an obstacle, before the part is open."""


class PartPulling:
    """Pulling of a part until it is open."""

    def __init__(
        self,
        session: Session,
        belief: PartBelief,
        learning: JointLearning,
        model: Model,
        wanted: tuple[float, float],
    ) -> None:
        self.session, self.belief, self.learning, self.model = session, belief, learning, model
        self.wanted, self.part = wanted, belief.unknown.frame
        self.point, self.frame_T_handle = belief.unknown.point, belief.unknown.frame_T_handle
        self.start, self.begin = belief.relative_pose, self.session.world.time
        self._measures: dict[str, Any] = {"grasps": 0}
        self._reached = self.begin
        self._direction, *self._others = _DIRECTIONS
        self.motion: HandMotion

    @property
    def measures(self) -> dict[str, Any]:
        """Number of grasps, time since the first one, and that until the part moved no further [s]."""
        return {**self._measures, "pull_seconds": self.session.world.time - self.begin}

    def perform(self, motion: HandMotion, grasp: Grasp) -> str:
        """Pull until the part is open or at its own stop, and return how far that is.

        A handle that slips is grasped again.
        """
        self.motion = motion
        distance = self.opening[0] if self.learning.poses else -math.inf
        for _ in range(_MOST_GRASPS):
            self._measures["grasps"] += 1
            barrier = ""
            if not self.motion.close(grasp):
                why = "The fingers closed next to the handle."
            else:
                if not self.learning.poses:
                    self.begin = self.session.world.time
                why, barrier = self._pull_once()
            if not why:
                return self._describe_opening("is open")
            self._let_go()
            last, distance = distance, self.opening[0]
            if barrier and distance >= _FOLLOWS:
                kind = ArmEndError if self.learning.learned is not None else SkillError
                raise kind(barrier, f"{self._describe_opening('was pulled')} {why}")
            if distance - last < _FOLLOWS:
                break
            self._measures["opened_seconds"] = self._reached - self.begin
            pose = inverse(self.belief.pose @ self.frame_T_handle) @ self.belief.hand_pose
            self.motion.follow_line(pose, grasp.pose)
        opened, _ = self.opening
        if opened < _FOLLOWS:
            raise SkillError(
                "other",
                f"'{self.part}' does not follow the hand, pulled outwards, to both sides, and to both ends "
                f"of its handle: it moved by {1e3 * opened:.0f} mm. {why} It may be fixed, locked, or need "
                "more force than the grip holds.",
            )
        words = f"{self._describe_opening('goes no further')} {why}"
        if opened >= LEAST_OPENING[0] or self.opening[1] >= LEAST_OPENING[1]:
            self._measures["opened_seconds"] = self._reached - self.begin
            return f"{words} The arm could go on, so this is its stop."
        raise SkillError("other", words)

    def rebase(self, gone: float) -> None:
        """Count times from a reset of the world on, which was at a time [s]."""
        self.begin, self._reached = self.begin - gone, self._reached - gone

    def _let_go(self) -> None:
        self.session.phase = "let go"
        self.belief.release()
        self.motion.move_fingers(self.motion.gripper.opened)
        self.motion.stand(LOOKING)

    def _pull_once(self) -> tuple[str, str]:
        """Pull until the part is open.

        Return why it is not, empty if it is, and the kind of failure if the part could go on.
        """
        session, belief, motion, learning = self.session, self.belief, self.motion, self.learning
        session.phase = "pull"
        belief.hold()
        self.motion.stand(_HELD_LOOKING)
        part_T_hand = inverse(belief.pose) @ belief.hand_pose
        bar_T_hand = inverse(self.frame_T_handle) @ part_T_hand
        if not learning.poses:
            self.start = belief.relative_pose
        belief.begin_motion()
        pull: StraightPull | LearnedPull = StraightPull(motion, belief, bar_T_hand, self._direction)
        fitted, known = -math.inf, learning.learned is not None
        best, since = self.opening[0], self.session.world.time
        while True:
            motion.check_time()
            for look in belief.looks:
                learning.add(look.pose, look.covariance)
            belief.looks.clear()
            distance, turn = self.opening
            now = self.session.world.time
            with session.timed("learn"):
                if learning.update(distance, turn, now - self.begin):
                    known = True
                if known and now - fitted >= _REFIT and distance >= _LED and learning.learned is not None:
                    fit, fitted = learning.learned.fit, now
                    pull = LearnedPull(
                        motion, belief, learn_model(self.model, belief, fit), bar_T_hand, self.start,
                        self.wanted[fit.motion.kinds[0]],
                    )  # fmt: skip
                elif learning.likely is not None and isinstance(pull, StraightPull):
                    pull.likely = JointPath.of_fit(learning.likely, self.start)
            if isinstance(pull, LearnedPull) and pull.obstacle is not None and pull.is_blocked:
                self._let_go()
                raise BlockedError(pull.obstacle)
            with session.timed("open"):
                command = pull.step(distance)
            motion.act(command.speeds)
            distance, turn = self.opening
            if self._is_open(distance, turn):
                self._measures["opened_seconds"] = now - self.begin
                return "", ""
            if belief.slip(part_T_hand, self.point) > PULLED_OUT:
                session.stop()
                ends = isinstance(pull, LearnedPull) and not self._can_go_on(pull, part_T_hand)
                why = "The handle slipped in the hand"
                return (f"{why} where the arm ends.", "reach") if ends else (f"{why}.", "")
            if distance > best + _STALLED:
                best, since = distance, now
                self._reached = now
            elif now - since > (_ENDING if isinstance(pull, LearnedPull) and pull.ends else _PATIENCE):
                if isinstance(pull, StraightPull) and distance < _FOLLOWS and self._others:
                    # It may slide to a side.
                    self._direction, since = self._others.pop(0), now
                    pull = StraightPull(motion, belief, bar_T_hand, self._direction)
                    continue
                return self._explain_stall(pull, command, part_T_hand)

    def _explain_stall(
        self, pull: StraightPull | LearnedPull, command: Command, part_T_hand: Array
    ) -> tuple[str, str]:
        """Return what is in the way, and its kind if that is not the part itself."""
        words = f"In the way: {', '.join(command.active[:3]) or 'nothing that the controller knows'}."
        if any(name.startswith("contact of") for name in command.active[:3]):
            return words, "collision"
        robot = self.session.world.robot
        limited = any(is_of_robot(n, robot) and n.endswith("/position") for n in command.active)
        if limited or (isinstance(pull, LearnedPull) and not self._can_go_on(pull, part_T_hand)):
            return f"The arm ends there. {words}", "reach"
        return words, ""

    def _can_go_on(self, pull: LearnedPull, part_T_hand: Array) -> bool:
        """Return whether the arm reaches the next poses of the handle along a learned joint."""
        path, search, state = pull.path, self.motion.search, self.session.state
        step = path.direction * _AHEAD / point_speed(path.twist(), self.point) / _AHEAD_STEPS
        values = path.value + step * np.arange(_AHEAD_STEPS + 1)
        hands = [self.belief.reference_pose @ path.pose(v) @ part_T_hand for v in values.tolist()]
        arm, base = state.vector(search.moving)[None], state.vector(search.standing)[None]
        _, reached = search.paths.follow(arm, base, np.array(hands)[None])
        return int(reached[0]) == len(hands)

    @property
    def opening(self) -> tuple[float, float]:
        """Believed distance of the handle [m] and angle of the part [rad] since the first grasp."""
        return measure_way(self.start, self.belief.relative_pose, self.point)

    def _is_open(self, distance: float, turn: float) -> bool:
        learned = self.learning.learned
        if learned is not None and learned.fit.motion.kinds[0]:
            return turn >= self.wanted[1]
        return distance >= self.wanted[0] or turn >= self.wanted[1]

    def _describe_opening(self, verb: str) -> str:
        distance, turn = self.opening
        return f"'{self.part}' {verb}, by {100 * distance:.0f} cm and {math.degrees(turn):.0f}°."
