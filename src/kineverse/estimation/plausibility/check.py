"""Plausibility check of a served model against recorded poses (2020 paper, III-D)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_tolerance, finite_number
from kineverse.errors import InvalidValueError, KineverseError, ShapeError
from kineverse.estimation.correlation import CorrelationSettings
from kineverse.estimation.identification.kinematic_graph.pairwise import FamilyChoice
from kineverse.estimation.identification.observations import (
    PosesLike,
    PoseTrack,
    check_tracks,
    exact_track,
    pair_tracks,
)
from kineverse.estimation.linear_algebra import singularity_named
from kineverse.estimation.noise import CHI_SQUARED_6, Outliers, as_outliers
from kineverse.estimation.tracking import Tracker
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.model import Model, Snapshot

from .alternatives import JointObservations, judge_joint
from .consistency import ConsistencyTests, TimedResiduals
from .e_process import SequentialTest
from .report import JointVerdict, Plausibility, TestableJoint, find_testable_joints
from .residuals import KnownJoint, compute_residuals

_COMPARED = 50  # number of observations that are compared


def find_exchanged_frames(
    implausible_since: Mapping[TestableJoint, int],
    served_joints: Mapping[TestableJoint, KnownJoint],
    tracks: Mapping[str, PoseTrack],
    exact: str | None,
    first: int = 0,
) -> dict[TestableJoint, str]:
    """Return the joints that fit after two frames are exchanged, with that as the reason."""
    known = [joint for joint in served_joints if {joint.parent, joint.child} <= tracks.keys()]
    rejected = [joint for joint in known if joint in implausible_since]
    frames = dict.fromkeys(f for joint in rejected for f in (joint.parent, joint.child) if f != exact)
    since = min(implausible_since.values(), default=0) - first
    for a, b in combinations(frames, 2):
        exchanged = {**tracks, a: tracks[b], b: tracks[a]}
        involved = [joint for joint in known if {joint.parent, joint.child} & {a, b}]
        if any(_fits(served_joints[joint], tracks, joint, since) for joint in involved):
            continue
        if all(_fits(served_joints[joint], exchanged, joint, since) for joint in involved):
            reason = f"the poses of '{a}' and '{b}' seem to be exchanged: with each other's the joint fits"
            return dict.fromkeys([joint for joint in involved if joint in rejected], reason)
    return {}


def _fits(served: KnownJoint, tracks: Mapping[str, PoseTrack], joint: TestableJoint, since: int) -> bool:
    parent, child = tracks[joint.parent], tracks[joint.child]
    rows = np.flatnonzero(parent.observed & child.observed)
    rows = rows[rows >= since][:_COMPARED]
    if not len(rows):
        return False
    residuals = compute_residuals(served, pair_tracks(parent, child, rows))
    return float(np.median(np.sum(residuals.orthogonal**2, axis=1))) < CHI_SQUARED_6


FALSE_ALARMS = 1e-3  # default probability of rejecting a joint that is as served


@singularity_named()
def check_plausibility(
    model: Model | Snapshot | Tracker,
    observations: Mapping[str, PosesLike] | None = None,
    *,
    times: npt.ArrayLike | None = None,
    noise: npt.ArrayLike | None = None,
    relative_to: str | None = WORLD,
    families: FamilyChoice = None,
    false_alarms: float = FALSE_ALARMS,
    outliers: Outliers | bool | None = True,
    decorrelation_time: float | None = None,
    strict: bool = False,
) -> Plausibility:
    """Test whether the joints of a model explain observations, and propose replacements if not.

    Each joint between observed frames is tested as served, with its own parameters and limits and unknown
    joint values. It is compared with a rigid connection, with a free child, and with the result of
    :func:`~kineverse.estimation.identify`.

    Parameters
    ----------
    model
        The served model; or a tracker, with its model, recent poses and their covariances.
    observations
        Poses over time by name of the frame, (N, 4, 4), or pairs of poses and covariance, (6, 6) or (N, 6,
        6), in order of time; missing poses are NaN throughout.
    times
        Times of the observations (N,) [s]; without them, observations are one step apart.
    noise
        Default covariance of a pose, (6, 6), see :mod:`kineverse.estimation.noise`.
    relative_to
        Frame in which poses are expressed. Its pose is taken as exactly known. It is compared with other
        frames where nothing else on its part is observed. None for an observer that is no part of the model.
    families
        Joint families of the alternatives, see :func:`~kineverse.estimation.identify`.
    false_alarms
        Probability of rejecting a joint that is as served.
    outliers
        Outlier model, see :class:`~kineverse.estimation.Outliers`; False or None without outliers, which
        detects deviations sooner.
    decorrelation_time
        Correlation time of the errors [s], or in steps without times: their correlation falls to 1/e. 0 for
        independent errors; None to measure it, up to a second or 30 steps.
    strict
        True to raise if a joint is rejected.

    Raises
    ------
    ShapeError, InvalidValueError
        For invalid poses, covariances or times, and if a covariance is missing.
    ImplausibleError
        If ``strict``, and a joint does not explain the observations.
    """
    check_false_alarms(false_alarms)
    if decorrelation_time is not None:
        as_tolerance(decorrelation_time, "The decorrelation time [s]")
    outlier_model = as_outliers(outliers)
    checked: object = model.model if isinstance(model, Tracker) else model
    checked = checked.model() if isinstance(checked, Snapshot) else checked
    if not isinstance(checked, Model):
        raise InvalidValueError(f"A model or a tracker is checked, not {checked!r:.80}.")
    if isinstance(model, Tracker):
        if observations is None:
            recent = model.recent
            observations = {
                name: (poses, recent.covariances[name]) if name in recent.covariances else poses
                for name, poses in recent.poses.items()
            }
            times, relative_to = recent.times, recent.relative_to
    observations = {} if observations is None else observations
    tracks = check_tracks(observations, noise)
    stamps = _check_times(times, max((len(track.poses) for track in tracks.values()), default=0))
    correlation = CorrelationSettings(decorrelation_time, times is not None)
    testable = find_testable_joints(checked, observations, relative_to)
    if relative_to is not None:
        tracks[relative_to] = exact_track(max((len(track.poses) for track in tracks.values()), default=0))
    residuals: dict[TestableJoint, TimedResiduals] = {}
    reasons: dict[TestableJoint, JointVerdict] = {}
    served_joints: dict[TestableJoint, KnownJoint] = {}
    for joint in testable.joints:
        parent, child = tracks[joint.parent], tracks[joint.child]
        rows = np.flatnonzero(parent.observed & child.observed)
        if not len(rows):
            never = f"'{joint.parent}' and '{joint.child}' were never observed together"
            reasons[joint] = undetermined_verdict(joint, 0, never)
            continue
        try:
            served = KnownJoint(checked, joint.child, joint.parent)
            known = compute_residuals(served, pair_tracks(parent, child, rows))
        except KineverseError as error:
            reasons[joint] = undetermined_verdict(joint, len(rows), f"its pose cannot be computed. {error}")
            continue
        served_joints[joint], residuals[joint] = served, TimedResiduals(rows, known)
    tested = ConsistencyTests(checked, served_joints, relative_to).apply(residuals)
    data: dict[TestableJoint, JointObservations] = {}
    implausible_since: dict[TestableJoint, int] = {}
    for joint, served in served_joints.items():
        rows = residuals[joint].times
        poses = pair_tracks(tracks[joint.parent], tracks[joint.child], rows)
        data[joint] = JointObservations(joint, served, poses, tested[joint], rows, stamps[rows])
        fitting = pair_outliers(outlier_model, joint, relative_to)
        since = _test(data[joint], false_alarms, fitting, correlation)
        if since is not None:
            implausible_since[joint] = since
    exchanged = find_exchanged_frames(implausible_since, served_joints, tracks, relative_to)
    verdicts = []
    for joint in testable.joints:
        if joint in reasons:
            verdicts.append(reasons[joint])
        elif joint in exchanged:
            since, count = implausible_since[joint], len(data[joint].times)
            verdicts.append(undetermined_verdict(joint, count, exchanged[joint], since))
        else:
            fitting = pair_outliers(outlier_model, joint, relative_to)
            since = implausible_since.get(joint)
            verdicts.append(judge_joint(checked, data[joint], since, families, fitting, correlation))
    result = Plausibility(tuple(verdicts), testable.untested, false_alarms)
    if strict:
        result.raise_if_implausible()
    return result


def check_false_alarms(probability: float) -> None:
    """Check a probability of false alarms."""
    if not 0.0 < probability < 1.0:
        raise InvalidValueError(f"The probability of a false alarm is between 0 and 1, not {probability}.")


def undetermined_verdict(
    joint: TestableJoint, count: int, reason: str, implausible_since: int | None = None
) -> JointVerdict:
    """Return the verdict on a joint that cannot be tested, or compared with alternatives."""
    return JointVerdict(joint, {}, (math.nan, math.nan), count, implausible_since, reason=reason)


def _test(
    data: JointObservations, false_alarms: float, outliers: Outliers | None, correlation: CorrelationSettings
) -> int | None:
    residuals = data.residuals
    looks = correlation.measure(residuals.whitened, residuals.orthogonal.shape[1], data.stamps)
    test = SequentialTest(false_alarms, outliers.fraction if outliers else 0.0)
    for row in zip(residuals.orthogonal, residuals.displacement_jacobian, residuals.one_sided, strict=True):
        test.add(*row, looks)
    return None if test.implausible_since is None else int(data.times[test.implausible_since])


def pair_outliers(
    outliers: Outliers | None, joint: TestableJoint, relative_to: str | None
) -> Outliers | None:
    """Return the outlier model of a pair of poses: an outlier of either is one of the pair."""
    if outliers is None or joint.parent == relative_to:
        return outliers
    return replace(outliers, fraction=1.0 - (1.0 - outliers.fraction) ** 2)


def check_time(at: object, last: float) -> float:
    """Return a time stamp as a number."""
    if (time := finite_number(at)) is None:
        raise InvalidValueError(f"The time of an observation is a finite number of seconds, not {at!r}.")
    if time <= last:
        raise InvalidValueError(
            f"The time {time:.9g} is not later than {last:.9g}, that of the observation before. Sort the "
            "observations by time, and leave out repeated ones."
        )
    return time


def _check_times(times: npt.ArrayLike | None, count: int) -> Array:
    if times is None:
        return np.arange(float(count))
    try:
        stamps = np.array(times, dtype=np.float64)
    except (TypeError, ValueError):
        raise ShapeError("The times are no array of numbers.") from None
    if stamps.shape != (count,):
        raise ShapeError(
            f"There are {count} observations, and the times are of shape {stamps.shape}. Each observation "
            "has one time."
        )
    for before, at in zip([-math.inf, *stamps], stamps.tolist(), strict=False):
        check_time(at, before)
    return stamps
