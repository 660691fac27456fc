"""Learning of a joint while a hand moves its part: identification with a decision that does not flicker."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kineverse.estimation import Fit, Identifier
from kineverse.lie import Array

CERTAIN = 0.97  # least probability: between nested families such as hinge and screw, .99 is hardly exceeded
_LOOKS = 3  # results in a row that a decision takes
_EVERY = 4  # number of new poses between two results
_VISIBLE = 0.005  # motion of the part before which no joint is fitted [m]
LEAST_DISTANCE, LEAST_TURN = 0.03, math.radians(4.0)  # before, noise alone looks like any joint [m], [rad]


@dataclass(frozen=True, slots=True, eq=False)
class LearnedJoint:
    """Decision for the family of a joint."""

    fit: Fit  # identified joint
    distance: float  # motion of the part until the decision [m], and its angle [rad]
    turn: float
    time: float  # time of the decision [s]

    @property
    def family(self) -> str:
        """Name of the family."""
        return self.fit.family


class JointLearning:
    """Online identification of a joint with one degree of freedom.

    A family is decided on once it has the probability :data:`CERTAIN` in three results in a row, and the part
    has moved by 3 cm or 4°. Afterwards another family has to reach the same to replace it. So a probability
    that passes a threshold in both directions changes nothing.
    """

    def __init__(self) -> None:
        self._identifier = Identifier()
        self.learned: LearnedJoint | None = None
        self.likely: Fit | None = None
        self._family, self._looks, self._evaluated = "", 0, 0

    @property
    def poses(self) -> int:
        """Number of poses so far."""
        return len(self._identifier)

    def add(self, pose: Array, covariance: Array) -> None:
        """Add a pose (4, 4) of the part relative to what it moves in, with its covariance (6, 6)."""
        self._identifier.add(None, pose, child_covariance=covariance)

    def update(self, distance: float, turn: float, time: float) -> bool:
        """Return True if there is a new result of a decided family."""
        self.likely = None
        if self.poses < self._evaluated + _EVERY or distance < _VISIBLE:
            return False
        self._evaluated = self.poses
        result = self._identifier.result
        fit = result.best
        if fit.joint_values.shape[1] == 1 and fit.is_determined:
            self.likely = fit
        if distance < LEAST_DISTANCE and turn < LEAST_TURN:
            return False
        certain = fit.probability >= CERTAIN and not result.is_ambiguous and fit.joint_values.shape[1] == 1
        self._looks = self._looks + 1 if certain and fit.family == self._family else int(certain)
        self._family = fit.family if certain else ""
        if self._looks >= _LOOKS and (self.learned is None or self.learned.family != fit.family):
            self.learned = LearnedJoint(fit, distance, turn, time)
            return True
        if self.learned is None or not certain or fit.family != self.learned.family:
            return False
        self.learned = LearnedJoint(fit, self.learned.distance, self.learned.turn, self.learned.time)
        return True

    def explain(self) -> str:
        """Return the present result in words."""
        if self.poses < 2:
            return "it was not seen"
        return str(self._identifier.result)
