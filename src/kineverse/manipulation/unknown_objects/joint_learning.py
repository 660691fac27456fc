"""Learning of a joint while a hand moves its part, and the test of the joint that a model has for it."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np

from kineverse.errors import KineverseError
from kineverse.estimation import Fit, Identifier, PlausibilityMonitor, pose_covariance
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.worlds.run_metrics import measure_way

from .part_belief import PartBelief
from .unmodelled_joint import find_joint, place_frame, write_joint

CERTAIN = 0.97  # least probability: between nested families such as hinge and screw, .99 is hardly exceeded
_LOOKS = 3  # results in a row that a decision takes
_EVERY = 4  # number of new poses between two results
_VISIBLE = 0.005  # motion of the part before which no joint is fitted [m]
LEAST_DISTANCE, LEAST_TURN = 0.03, math.radians(4.0)  # before, noise alone looks like any joint [m], [rad]


_ARM = 0.3  # length of a lever at which the direction of an axis counts [m]


def axis_deviation(fit: Fit) -> float:
    """Return the standard deviation of an axis [m], of its place and of its direction at a short lever."""
    variance = 0.0
    for k, name in enumerate(fit.coordinates):
        if name.startswith(("axis", "point")):
            variance += fit.covariance[k, k] * (_ARM**2 if name.startswith("axis") else 1.0)
    return math.sqrt(variance)


@dataclass(frozen=True, slots=True, eq=False)
class LearnedJoint:
    """Decision for the family of a joint."""

    fit: Fit  # identified joint
    distance: float  # motion of the part until the decision [m], and its angle [rad]
    turn: float
    time: float  # time of the decision [s]


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
        self._thread: threading.Thread | None = None
        self._waiting: list[tuple[Array, Array | None]] = []

    @property
    def poses(self) -> int:
        """Number of poses so far."""
        return len(self._identifier) + len(self._waiting)

    def add(self, pose: Array, covariance: Array | None = None) -> None:
        """Add a pose (4, 4) of the part relative to what it moves in.

        All poses have a covariance (6, 6), or none has, and the noise is estimated.
        """
        self._waiting.append((pose, covariance))

    def update_beside(self, distance: float, turn: float, time: float) -> None:
        """Do :meth:`update` in a thread of its own, unless one is under way: no command waits for it."""
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self.update, args=(distance, turn, time), daemon=True)
            self._thread.start()

    def update(self, distance: float, turn: float, time: float) -> bool:
        """Return True if there is a new result of a decided family."""
        if self.poses < self._evaluated + _EVERY or distance < _VISIBLE:
            self.likely = None
            return False
        waiting, self._waiting = self._waiting, []
        for pose, covariance in waiting:
            self._identifier.add(None, pose, child_covariance=covariance)
        self._evaluated = len(self._identifier)
        result = self._identifier.result
        fit = result.best
        self.likely = fit if fit.joint_values.shape[1] == 1 and fit.is_determined else None
        if distance < LEAST_DISTANCE and turn < LEAST_TURN:
            return False
        certain = fit.probability >= CERTAIN and not result.is_ambiguous and fit.joint_values.shape[1] == 1
        self._looks = self._looks + 1 if certain and fit.family == self._family else int(certain)
        self._family = fit.family if certain else ""
        if self._looks >= _LOOKS and (self.learned is None or self.learned.fit.family != fit.family):
            self.learned = LearnedJoint(fit, distance, turn, time)
            return True
        if self.learned is None or not certain or fit.family != self.learned.fit.family:
            return False
        self.learned = LearnedJoint(fit, self.learned.distance, self.learned.turn, self.learned.time)
        return True


_DISTANCE, _FLOOR = 1.0, (1e-3, 2e-3)
"""Distance of the camera, and least standard deviations, for the test of a believed joint [m], [rad]."""
_MOVED, _TURNED = 0.01, math.radians(1.0)  # motion of furniture that is reported [m], [rad]


def watch_joint(model: Model, belief: PartBelief) -> PlausibilityMonitor | None:
    """Return a test of the joint that a model has for a part; None if it has none."""
    if find_joint(model, belief.unknown.frame) is None:
        return None
    sensors = belief.sensors
    noise = pose_covariance(*sensors.pose_noise(_DISTANCE, *_FLOOR))
    frames = [name for name in belief.seen if name in model.frames]
    return PlausibilityMonitor(model, frames, noise=noise, outliers=sensors.outliers > 0.0 or None)


def judge_believed_joint(model: Model, belief: PartBelief) -> str:
    """Return the verdict on a model's joint: nothing, explains, cannot tell or refuted."""
    if belief.monitor is None:
        return "nothing"
    tag = model.history.writers(f"frames/{belief.unknown.frame}")[-1]
    report = belief.monitor.report()
    if tag in {verdict.tag for verdict in report.implausible}:
        return "refuted"
    certain = any(verdict.explains for verdict in report.verdicts if verdict.tag == tag)
    return "explains" if certain else "cannot tell"


def revise_joint(model: Model, belief: PartBelief, learned: LearnedJoint) -> tuple[str, str]:
    """Write a learned joint into a model that had another one or none, and return the verdict and a text.

    Furniture that stands elsewhere than the model has it is put where it was seen.
    """
    words = f"Its joint is {learned.fit.family}, certain after {100 * learned.distance:.1f} cm and "
    words += f"{math.degrees(learned.turn):.1f}°."
    if belief.beside != WORLD:
        before = np.asarray(model.fk(belief.beside)({}))
        away, turned = measure_way(before, belief.reference_pose, np.zeros(3))
        if away > _MOVED or turned > _TURNED:
            place_frame(model, belief.beside, belief.reference_pose)
            words += f" '{belief.beside}' stands {100 * away:.0f} cm from where it was believed."
    verdict = judge_believed_joint(model, belief)
    if verdict == "explains":
        return verdict, f"{words} The model's joint explains what was seen, and stays."
    if verdict == "cannot tell":
        return verdict, f"{words} What was seen does not refute the model's joint, which stays."
    if verdict == "refuted":
        words += " It is not as the model had it."
    try:
        write_joint(model, belief.unknown.frame, learned.fit, belief.beside)
    except KineverseError as error:
        return verdict, f"{words} It could not be written: {error}"
    return verdict, f"{words} It is in the model now."
