"""Plausibility check of a served model against recorded poses (2020 paper, III-D)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, KineverseError
from kineverse.estimation.identification.kinematic_graph.pairwise import FamilyChoice
from kineverse.estimation.identification.observations import PosesLike, check_tracks, exact_track, pair_tracks
from kineverse.estimation.robust import Outliers, as_outliers
from kineverse.model.frame import WORLD
from kineverse.model.model import Model, Snapshot

from .alternatives import JointObservations, judge_joint
from .consistency import ConsistencyTests, TimedResiduals
from .known_motion import KnownJoint
from .known_residuals import compute_residuals
from .report import JointVerdict, Plausibility
from .sequential_test import SequentialTest
from .testability import TestableJoint, find_testable_joints

FALSE_ALARMS = 1e-3
"""Default probability of rejecting a joint that is as served."""


def check_plausibility(
    model: Model | Snapshot,
    observations: Mapping[str, PosesLike],
    *,
    noise: npt.ArrayLike | None = None,
    relative_to: str | None = WORLD,
    families: FamilyChoice = None,
    false_alarms: float = FALSE_ALARMS,
    outliers: Outliers | bool | None = True,
    strict: bool = False,
) -> Plausibility:
    """Test whether the joints of a model explain observations, and propose replacements if not.

    Each joint between observed frames is tested as served, with its own parameters and limits and unknown
    joint values. It is compared with a rigid connection, with a free child, and with the result of
    :func:`~kineverse.estimation.identify`.

    Parameters
    ----------
    model
        The served model.
    observations
        Poses over time by name of the frame, (N, 4, 4), or pairs of poses and covariance, (6, 6) or (N, 6,
        6); missing poses are NaN throughout.
    noise
        Default covariance of a pose, (6, 6), see :mod:`kineverse.estimation.noise`.
    relative_to
        Frame in which poses are given. Its pose is taken as exactly known. It is compared with other frames
        where nothing else on its part is observed. None for an observer that is no part of the model.
    families
        Joint families of the alternatives, see :func:`~kineverse.estimation.identify`.
    false_alarms
        Probability of rejecting a joint that is as served.
    outliers
        Outlier model, see :class:`~kineverse.estimation.Outliers`; False or None without outliers, which
        detects deviations sooner.
    strict
        True to raise if a joint is rejected.

    Raises
    ------
    UnknownNameError
        For a frame or a family that does not exist.
    ShapeError, InvalidValueError
        For invalid poses or covariances, and if a covariance is missing.
    ImplausibleError
        If ``strict``, and a joint does not explain the observations.
    """
    check_false_alarms(false_alarms)
    outlier_model = as_outliers(outliers)
    if isinstance(model, Snapshot):
        model = model.model()
    tracks = check_tracks(observations, noise)
    testable = find_testable_joints(model, observations, relative_to)
    if relative_to is not None:
        tracks[relative_to] = exact_track(max((len(track.poses) for track in tracks.values()), default=0))
    residuals: dict[TestableJoint, TimedResiduals] = {}
    reasons: dict[TestableJoint, JointVerdict] = {}
    served_joints: dict[TestableJoint, KnownJoint] = {}
    for joint in testable.joints:
        parent, child = tracks[joint.parent], tracks[joint.child]
        times = np.flatnonzero(parent.seen & child.seen)
        if not len(times):
            reasons[joint] = undetermined_verdict(
                joint, 0, f"'{joint.parent}' and '{joint.child}' were never seen together"
            )
            continue
        try:
            served = KnownJoint(model, joint.child, joint.parent)
            residuals[joint] = TimedResiduals(
                times, compute_residuals(served, pair_tracks(parent, child, times))
            )
            served_joints[joint] = served
        except KineverseError as error:
            reasons[joint] = undetermined_verdict(joint, len(times), f"its pose cannot be computed. {error}")
    tested = ConsistencyTests(model, served_joints, relative_to).apply(residuals)
    verdicts = []
    for joint in testable.joints:
        if joint in reasons:
            verdicts.append(reasons[joint])
            continue
        times = residuals[joint].times
        poses = pair_tracks(tracks[joint.parent], tracks[joint.child], times)
        verdicts.append(
            _test_joint(
                model,
                JointObservations(joint, served_joints[joint], poses, tested[joint], times),
                families,
                false_alarms,
                outlier_model,
            )
        )
    result = Plausibility(tuple(verdicts), testable.untested, false_alarms)
    if strict:
        result.raise_if_implausible()
    return result


def check_false_alarms(probability: float) -> None:
    """Check a probability of false alarms.

    Raises
    ------
    InvalidValueError
        If it is not between 0 and 1.
    """
    if not 0.0 < probability < 1.0:
        raise InvalidValueError(
            f"The probability of a false alarm is between 0 and 1, and not {probability}."
        )


def undetermined_verdict(joint: TestableJoint, count: int, reason: str) -> JointVerdict:
    """Return the verdict on a joint that cannot be tested."""
    return JointVerdict(joint, {}, (math.nan, math.nan), count, reason=reason)


def _test_joint(
    model: Model,
    data: JointObservations,
    families: FamilyChoice,
    false_alarms: float,
    outliers: Outliers | None,
) -> JointVerdict:
    test = SequentialTest(false_alarms, outliers.fraction if outliers else 0.0)
    residuals = data.residuals
    for row in zip(residuals.orthogonal, residuals.displacement_jacobian, residuals.one_sided, strict=True):
        test.add(*row)
    implausible_since = None if test.implausible_since is None else int(data.times[test.implausible_since])
    return judge_joint(model, data, implausible_since, families, outliers)
