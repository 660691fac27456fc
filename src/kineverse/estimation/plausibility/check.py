"""Plausibility of a served model, against recorded poses or online (2020 paper, III-D)."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_tolerance
from kineverse.errors import InvalidValueError, KineverseError, ShapeError, UnknownNameError, suggest
from kineverse.estimation.correlation import CorrelationSettings
from kineverse.estimation.identification.kinematic_graph.pairwise import FamilyChoice
from kineverse.estimation.identification.observations import (
    Observations,
    PosesLike,
    PoseTrack,
    check_tracks,
    concatenate_tracks,
    exact_track,
    pair_tracks,
)
from kineverse.estimation.linear_algebra import singularity_named
from kineverse.estimation.noise import CHI_SQUARED_6, Outliers, as_outliers
from kineverse.estimation.tracking import Tracker
from kineverse.estimation.tracking.measurements import require_time
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.model import Model, Snapshot

from .alternatives import JointObservations, judge_joint
from .consistency import ConsistencyTests, TimedResiduals
from .e_process import CorrelatedTest, SequentialTest
from .report import JointVerdict, Plausibility, TestableJoint, TestableJoints, find_testable_joints
from .residuals import KnownJoint, KnownResiduals, compute_residuals

FALSE_ALARMS = 1e-3  # default probability of rejecting a joint that is as served
_COMPARED = 50  # number of observations that are compared
_OBSERVED = np.ones(1, dtype=bool)
_RIGID, _FAR = 1e-6, 1e6  # tolerance of a rotation, and the farthest coordinate, that need no further check


def _find_exchanged_frames(
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
    _check_test_settings(false_alarms, decorrelation_time)
    outlier_model = as_outliers(outliers)
    checked: object = model.model if isinstance(model, Tracker) else model
    checked = checked.model() if isinstance(checked, Snapshot) else checked
    if not isinstance(checked, Model):
        raise InvalidValueError(f"A model or a tracker is checked, not {checked!r:.80}.")
    if isinstance(model, Tracker) and observations is None:
        recent = model.recent
        pairs = {name: (recent.poses[name], noise) for name, noise in recent.covariances.items()}
        observations, times, relative_to = {**recent.poses, **pairs}, recent.times, recent.relative_to
    observations = {} if observations is None else observations
    tracks = check_tracks(observations, noise)
    count = max((len(track.poses) for track in tracks.values()), default=0)
    stamps = _check_times(times, count)
    correlation = CorrelationSettings(decorrelation_time, times is not None)
    testable = find_testable_joints(checked, observations, relative_to)
    if relative_to is not None:
        tracks[relative_to] = exact_track(count)
    residuals: dict[TestableJoint, TimedResiduals] = {}
    reasons: dict[TestableJoint, JointVerdict] = {}
    served_joints: dict[TestableJoint, KnownJoint] = {}
    for joint in testable.joints:
        parent, child = tracks[joint.parent], tracks[joint.child]
        rows = np.flatnonzero(parent.observed & child.observed)
        if not len(rows):
            never = f"'{joint.parent}' and '{joint.child}' were never observed together"
            reasons[joint] = _undetermined_verdict(joint, 0, never)
            continue
        try:
            served = KnownJoint(checked, joint.child, joint.parent)
            known = compute_residuals(served, pair_tracks(parent, child, rows))
        except KineverseError as error:
            reasons[joint] = _undetermined_verdict(joint, len(rows), f"its pose cannot be computed. {error}")
            continue
        served_joints[joint], residuals[joint] = served, TimedResiduals(rows, known)
    tested = ConsistencyTests(checked, served_joints, relative_to).apply(residuals)
    data: dict[TestableJoint, JointObservations] = {}
    implausible_since: dict[TestableJoint, int] = {}
    for joint, served in served_joints.items():
        rows = residuals[joint].times
        poses = pair_tracks(tracks[joint.parent], tracks[joint.child], rows)
        data[joint] = JointObservations(joint, served, poses, tested[joint], rows, stamps[rows])
        fitting = _pair_outliers(outlier_model, joint, relative_to)
        if (since := _test(data[joint], false_alarms, fitting, correlation)) is not None:
            implausible_since[joint] = since
    exchanged = _find_exchanged_frames(implausible_since, served_joints, tracks, relative_to)
    verdicts = []
    for joint in testable.joints:
        if joint in reasons:
            verdicts.append(reasons[joint])
        elif joint in exchanged:
            since, count = implausible_since[joint], len(data[joint].times)
            verdicts.append(_undetermined_verdict(joint, count, exchanged[joint], since))
        else:
            fitting = _pair_outliers(outlier_model, joint, relative_to)
            since = implausible_since.get(joint)
            verdicts.append(judge_joint(checked, data[joint], since, families, fitting, correlation))
    result = Plausibility(tuple(verdicts), testable.untested, false_alarms)
    if strict:
        result.raise_if_implausible()
    return result


def _check_test_settings(false_alarms: float, decorrelation_time: float | None) -> None:
    if not 0.0 < false_alarms < 1.0:
        raise InvalidValueError(f"The probability of a false alarm is between 0 and 1, not {false_alarms}.")
    if decorrelation_time is not None:
        as_tolerance(decorrelation_time, "The decorrelation time [s]")


def _undetermined_verdict(
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


def _pair_outliers(
    outliers: Outliers | None, joint: TestableJoint, relative_to: str | None
) -> Outliers | None:
    """Return the outlier model of a pair of poses: an outlier of either is one of the pair."""
    if outliers is None or joint.parent == relative_to:
        return outliers
    return replace(outliers, fraction=1.0 - (1.0 - outliers.fraction) ** 2)


def _check_time(at: object, last: float) -> float:
    if (time := require_time(at)) <= last:
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
        _check_time(at, before)
    return stamps


@dataclass
class _MonitoredJoint:
    """Tested joint with its sequential test."""

    joint: TestableJoint
    served: KnownJoint | None
    reason: str
    test: CorrelatedTest | None = None  # begins with the first observation
    numbers: list[int] = field(default_factory=list)  # of the observations in the test

    @property
    def implausible_since(self) -> int | None:
        return None if self.test is None else self.test.implausible_since


class PlausibilityMonitor:
    """Online plausibility test of a model.

    The probability of ever rejecting a joint that is as served is at most ``false_alarms``, for any duration.
    After an edit of the model, the tests of the joints that it changed start again.

    Parameters
    ----------
    frames
        Names of the frames that may be observed.
    noise, relative_to, families, false_alarms, outliers, decorrelation_time
        As in :func:`~kineverse.estimation.check_plausibility`.
    keep
        Number of recent observations that reports use.
    """

    def __init__(
        self,
        model: Model,
        frames: Iterable[str],
        *,
        noise: npt.ArrayLike | None = None,
        relative_to: str | None = WORLD,
        families: FamilyChoice = None,
        false_alarms: float = FALSE_ALARMS,
        outliers: Outliers | bool | None = True,
        decorrelation_time: float | None = None,
        keep: int = 500,
    ) -> None:
        _check_test_settings(false_alarms, decorrelation_time)
        self.model = model
        self.frames = tuple(dict.fromkeys(frames))
        self.false_alarms = false_alarms
        self.count = 0
        self._outliers = as_outliers(outliers)
        self._decorrelation_time = decorrelation_time
        self._last: float | None = None
        self._stamped = False
        # Checked covariance of a pose without its own, (1, 6, 6).
        self._covariances: Array | None = None
        self._noise, self._relative_to, self._families = noise, relative_to, families
        self._recent: deque[dict[str, PoseTrack]] = deque(maxlen=keep)
        self._stamps: deque[float] = deque(maxlen=keep)
        self._monitored: list[_MonitoredJoint] = []
        self._testable = TestableJoints((), {})
        self._consistency = ConsistencyTests(model, {}, relative_to)
        self._find_joints()

    @property
    def implausible_since(self) -> dict[str, int]:
        """First observation that each rejected joint does not explain, by tag."""
        result: dict[str, int] = {}
        for monitored in self._monitored:
            if (number := monitored.implausible_since) is not None:
                result[monitored.joint.tag] = min(number, result.get(monitored.joint.tag, number))
        return result

    @singularity_named()
    def update(self, observations: Mapping[str, PosesLike], at: float | None = None) -> tuple[str, ...]:
        """Add one observation; return the tags of newly rejected joints.

        Parameters
        ----------
        observations
            Pose by name of the frame, (4, 4), or pair of a pose and its covariance, (6, 6). Absent names are
            missing.
        at
            Time of the observation [s], later than the one before; without times, observations are one step
            apart.

        Raises
        ------
        UnknownNameError, ShapeError, InvalidValueError
            For invalid frames, poses, covariances and times; the monitor does not change then.
        """
        for name in observations:
            if name not in self.frames:
                hint = suggest(str(name), self.frames, "frame")
                raise UnknownNameError(f"The frame {name!r} is not watched. {hint}")
        tracks = {name: self._check(pose, name) for name, pose in observations.items()}
        time = self._next_time(at)
        if self.model.version != self._version:
            self._find_joints()
        if self._relative_to is not None:
            tracks[self._relative_to] = exact_track(1)
        before = set(self.implausible_since)
        self._last, self._stamped = time, at is not None
        self._add(tracks, time)
        self._recent.append(tracks)
        self._stamps.append(time)
        self.count += 1
        return tuple(tag for tag in self.implausible_since if tag not in before)

    @singularity_named()
    def report(self) -> Plausibility:
        """Return the verdicts on all joints from the recent observations."""
        if self.model.version != self._version:
            self._find_joints()
        first = self.count - len(self._recent)
        residuals: dict[TestableJoint, TimedResiduals] = {}
        for one in self._monitored:
            times = self._times(one, first)
            if one.served is not None and times:
                known = compute_residuals(one.served, self._poses(one.joint, times, first))
                residuals[one.joint] = TimedResiduals(np.array(times), known)
        tested = self._consistency.apply(residuals)
        since = {m.joint: m.implausible_since for m in self._monitored if m.implausible_since is not None}
        served = {m.joint: m.served for m in self._monitored if m.served is not None}
        tracks = self._recent_tracks() if since else {}
        exchanged = _find_exchanged_frames(since, served, tracks, self._relative_to, first)
        pairs = [(one, exchanged.get(one.joint, "")) for one in self._monitored]
        verdicts = tuple(self._verdict(one, tested.get(one.joint), first, reason) for one, reason in pairs)
        return Plausibility(verdicts, self._testable.untested, self.false_alarms)

    def _find_joints(self) -> None:
        """Find the testable joints, and keep the tests of unchanged ones."""
        known = {monitored.joint: monitored for monitored in self._monitored}
        before = self._consistency
        self._version = self.model.version
        self._testable = find_testable_joints(self.model, self.frames, self._relative_to)
        served_joints: dict[TestableJoint, KnownJoint] = {}
        reasons = dict.fromkeys(self._testable.joints, "")
        for joint in self._testable.joints:
            try:
                served_joints[joint] = KnownJoint(self.model, joint.child, joint.parent)
            except KineverseError as error:
                reasons[joint] = f"its pose cannot be computed. {error}"
        self._consistency = ConsistencyTests(self.model, served_joints, self._relative_to)
        self._monitored = []
        for joint, reason in reasons.items():
            old, served = known.get(joint), served_joints.get(joint)
            new = _MonitoredJoint(joint, served, reason)
            if old is not None and old.served is not None and served is not None:
                if served.is_equal(old.served) and self._consistency.is_equal(joint, before):
                    new = old
            self._monitored.append(new)

    def _check(self, observed: PosesLike, name: str) -> PoseTrack:
        pose, *covariance = observed if isinstance(observed, tuple) and len(observed) == 2 else (observed,)
        try:
            matrix: Array = np.asarray(pose, dtype=np.float64)
        except (TypeError, ValueError):
            raise ShapeError(f"The pose of '{name}' is no array of numbers.") from None
        if matrix.shape != (4, 4):
            raise ShapeError(f"The pose of '{name}' is a 4×4 transform, not of shape {matrix.shape}.")
        if not covariance and self._covariances is not None and _is_rigid(matrix):
            # The usual case in a fraction of the time.
            return PoseTrack(matrix[None].copy(), self._covariances, _OBSERVED)
        poses = (matrix[None], covariance[0]) if covariance else matrix[None]
        track = check_tracks({name: poses}, self._noise)[name]
        if not covariance:
            self._covariances = track.covariances
        return track

    @property
    def _correlation(self) -> CorrelationSettings:
        return CorrelationSettings(self._decorrelation_time, self._stamped)

    def _next_time(self, at: float | None) -> float:
        if self._last is None:
            return 0.0 if at is None else _check_time(at, -math.inf)
        if (at is not None) != self._stamped:
            first = "had one" if self._stamped else "had none"
            raise InvalidValueError(f"Either all observations have a time (at=), or none: the first {first}.")
        return self._last + 1.0 if at is None else _check_time(at, self._last)

    def _add(self, tracks: Mapping[str, PoseTrack], at: float) -> None:
        residuals: dict[TestableJoint, TimedResiduals] = {}
        for monitored in self._monitored:
            joint = monitored.joint
            if monitored.served is None or not {joint.parent, joint.child} <= tracks.keys():
                continue
            parent, child, now = tracks[joint.parent], tracks[joint.child], np.array([0])
            if parent.observed[0] and child.observed[0]:
                known = compute_residuals(monitored.served, pair_tracks(parent, child, now))
                residuals[joint] = TimedResiduals(now, known)
        tested = self._consistency.apply(residuals)
        for monitored in self._monitored:
            if monitored.joint in tested:
                monitored.numbers.append(self.count)
                if monitored.test is None:
                    outliers = _pair_outliers(self._outliers, monitored.joint, self._relative_to)
                    fraction = outliers.fraction if outliers else 0.0
                    monitored.test = CorrelatedTest(self.false_alarms, fraction, self._correlation)
                monitored.test.add(tested[monitored.joint], self.count, at)

    def _recent_tracks(self) -> dict[str, PoseTrack]:
        result = {}
        for name, any_track in {name: t for tracks in self._recent for name, t in tracks.items()}.items():
            gap = replace(any_track, observed=np.zeros(1, dtype=bool))
            result[name] = concatenate_tracks([tracks.get(name, gap) for tracks in self._recent])
        return result

    def _times(self, monitored: _MonitoredJoint, first: int) -> list[int]:
        return [number for number in monitored.numbers if number >= first]

    def _poses(self, joint: TestableJoint, times: Iterable[int], first: int) -> Observations:
        kept = [self._recent[number - first] for number in times]
        names = (joint.parent, joint.child)
        parent, child = (concatenate_tracks([one[name] for one in kept]) for name in names)
        return pair_tracks(parent, child, np.arange(len(kept)))

    def _verdict(
        self, monitored: _MonitoredJoint, residuals: KnownResiduals | None, first: int, exchanged: str
    ) -> JointVerdict:
        joint = monitored.joint
        if monitored.served is None or residuals is None:
            never = f"'{joint.parent}' and '{joint.child}' were not observed together"
            return _undetermined_verdict(joint, 0, monitored.reason or never)
        times, since = self._times(monitored, first), monitored.implausible_since
        if exchanged:
            return _undetermined_verdict(joint, len(times), exchanged, since)
        poses = self._poses(joint, times, first)
        stamps = np.array([self._stamps[number - first] for number in times])
        data = JointObservations(joint, monitored.served, poses, residuals, np.array(times), stamps)
        outliers = _pair_outliers(self._outliers, joint, self._relative_to)
        return judge_joint(self.model, data, since, self._families, outliers, self._correlation)


def _is_rigid(pose: Array) -> bool:
    """Return True for a pose (4, 4) that is certainly valid."""
    rotation = pose[:3, :3]
    off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    is_rotation = off < _RIGID and float(np.linalg.det(rotation)) > 0.0
    return is_rotation and pose[3].tolist() == [0.0, 0.0, 0.0, 1.0] and max(map(abs, pose[:3, 3])) < _FAR
