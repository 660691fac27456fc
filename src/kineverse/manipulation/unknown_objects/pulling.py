"""Pulling of a part by its handle until it is open, with new grasps where the handle slips."""

from __future__ import annotations

import math
from typing import Any

from kineverse.grasping import Grasp
from kineverse.lie import inverse
from kineverse.manipulation.opening.hand_motion import HandMotion
from kineverse.manipulation.outcome import SkillError
from kineverse.model.model import Model

from .joint_learning import JointLearning
from .part import JointPath
from .part_belief import PartBelief, measure_way
from .pull_controllers import LearnedPull, StraightPull, learn_model

LEAST_OPENING = 0.08, math.radians(10.0)
"""Opening from which a part that goes no further counts as open [m], [rad]."""
LOOKING, _HELD_LOOKING = 0.6, 1.0
"""Times of looks at a part that stands, and with the hand closed [s]."""
_MOST_GRASPS = 3
_REFIT = 0.5
"""Time between two controllers for a learned joint [s]."""
_FOLLOWS, _STALLED, _PATIENCE = 0.01, 0.004, 1.5
"""Motion of a part that follows the hand, and its least progress [m] in a time [s]."""
_SLIPPED = 0.012
"""Distance of the handle from its place in the hand from which on it has slipped [m]."""
_LED = 0.06
"""Way of the handle before which the hand does not rely on a joint that was learned [m]."""


class PartPulling:
    """Pulling of a part until it is open.

    Parameters
    ----------
    motion
        Motions of the hand.
    belief
        Belief about the part.
    learning
        Identification of its joint.
    model
        What is known, which gets the learned joint in copies.
    wanted
        Wanted way of a part that slides [m], and angle of one that turns [rad].

    Attributes
    ----------
    part
        Frame of the part.
    point, frame_T_handle
        Middle (3,) of the handle, and pose (4, 4) of its body, in the frame of the part.
    start
        First pose (4, 4) of the part relative to what it moves in.
    begin
        Time of the first grasp [s].
    """

    def __init__(
        self,
        motion: HandMotion,
        belief: PartBelief,
        learning: JointLearning,
        model: Model,
        wanted: tuple[float, float],
    ) -> None:
        self.motion, self.belief, self.learning, self.model = motion, belief, learning, model
        self.session, self.wanted, self.part = motion.session, wanted, belief.unknown.frame
        self.point, self.frame_T_handle = belief.unknown.point, belief.unknown.frame_T_handle
        self.start, self.begin = belief.relative_pose, self.session.world.time
        self._measures: dict[str, Any] = {"grasps": 0}
        self._reached = self.begin

    @property
    def measures(self) -> dict[str, Any]:
        """Number of grasps, time since the first one, and that until the part moved no further [s]."""
        return {**self._measures, "pull_seconds": self.session.world.time - self.begin}

    def perform(self, grasp: Grasp) -> str:
        """Pull until the part is open or goes no further, and return how far that is, or raise SkillError.

        A handle that slips is grasped anew.

        Parameters
        ----------
        grasp
            Where the open hand is on the handle.
        """
        way = -math.inf
        for _ in range(_MOST_GRASPS):
            self._measures["grasps"] += 1
            if not self.motion.close(grasp):
                why = "The fingers closed beside the handle."
            else:
                if not self.learning.poses:
                    self.begin = self.session.world.time
                why = self._pull_once()
            if not why:
                return self._describe_opening("is open")
            self._let_go()
            last, way = way, self._opening()[0]
            if way - last < _FOLLOWS:
                break
            self._measures["opened_seconds"] = self._reached - self.begin
            pose = inverse(self.belief.pose @ self.frame_T_handle) @ self.belief.hand_pose
            self.motion.follow_line(pose, grasp.pose)
        opened, _ = self._opening()
        if opened < _FOLLOWS:
            raise SkillError(
                "other",
                f"'{self.part}' does not follow the hand: it moved by {1e3 * opened:.0f} mm. {why} It may "
                "be fixed, locked, or need more force than the grip holds.",
            )
        words = f"{self._describe_opening('goes no further')} {why}"
        if self._is_far_enough():
            return words
        raise SkillError("other", words)

    def _let_go(self) -> None:
        """Open the fingers, and look where the part is."""
        self.session.phase = "let go"
        self.belief.release()
        self.motion.move_fingers(self.motion.gripper.opened)
        self.motion.stand(LOOKING)

    def _pull_once(self) -> str:
        """Pull until the part is open, and return why it is not, empty if it is."""
        session, belief, motion, learning = self.session, self.belief, self.motion, self.learning
        session.phase = "pull"
        belief.hold()
        self.motion.stand(_HELD_LOOKING)
        part_T_hand = inverse(belief.pose) @ belief.hand_pose
        bar_T_hand = inverse(self.frame_T_handle) @ part_T_hand
        if not learning.poses:
            self.start = belief.relative_pose
        belief.begin_motion()
        pull: StraightPull | LearnedPull = StraightPull(motion, belief, bar_T_hand)
        fitted, known = -math.inf, learning.learned is not None
        best, since = self._opening()[0], self.session.world.time
        while True:
            motion.check_time()
            for look in belief.looks:
                learning.add(look.pose, look.covariance)
            belief.looks.clear()
            way, turn = self._opening()
            now = self.session.world.time
            with session.timed("learn"):
                if learning.update(way, turn, now - self.begin):
                    known = True
                if known and now - fitted >= _REFIT and way >= _LED and learning.learned is not None:
                    fit, fitted = learning.learned.fit, now
                    pull = LearnedPull(
                        motion, belief, learn_model(self.model, belief, fit), bar_T_hand, self.start,
                        self.wanted[fit.motion.kinds[0]],
                    )  # fmt: skip
                elif learning.likely is not None and isinstance(pull, StraightPull):
                    pull.likely = JointPath.of_fit(learning.likely, self.start)
            with session.timed("open"):
                command = pull.step(way)
            motion.act(command.speeds)
            way, turn = self._opening()
            if self._is_open(way, turn):
                self._measures["opened_seconds"] = now - self.begin
                return ""
            if belief.slip(part_T_hand, self.point) > _SLIPPED:
                session.stop()
                return "The handle slipped in the hand."
            if way > best + _STALLED:
                best, since = way, now
                self._reached = now
            elif now - since > _PATIENCE:
                return f"In the way: {', '.join(command.active[:3]) or 'nothing that the controller knows'}."

    def _opening(self) -> tuple[float, float]:
        """Return the believed way of the handle [m] and angle of the part [rad] since the first grasp."""
        return measure_way(self.start, self.belief.relative_pose, self.point)

    def _is_far_enough(self) -> bool:
        """Return whether a part that goes no further counts as open."""
        way, turn = self._opening()
        return way >= LEAST_OPENING[0] or turn >= LEAST_OPENING[1]

    def _is_open(self, way: float, turn: float) -> bool:
        learned = self.learning.learned
        if learned is not None and learned.fit.motion.kinds[0]:
            return turn >= self.wanted[1]
        return way >= self.wanted[0] or turn >= self.wanted[1]

    def _describe_opening(self, verb: str) -> str:
        way, turn = self._opening()
        return f"'{self.part}' {verb}, by {100 * way:.0f} cm and {math.degrees(turn):.0f}°."
