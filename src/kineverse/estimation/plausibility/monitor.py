"""Online plausibility monitor."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

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
from kineverse.estimation.noise import Outliers, as_outliers
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.model import Model

from .alternatives import JointObservations, judge_joint
from .check import (
    FALSE_ALARMS,
    check_false_alarms,
    check_time,
    find_exchanged_frames,
    pair_outliers,
    undetermined_verdict,
)
from .consistency import ConsistencyTests, TimedResiduals
from .e_process import CorrelatedTest
from .report import JointVerdict, Plausibility, TestableJoint, TestableJoints, find_testable_joints
from .residuals import KnownJoint, KnownResiduals, compute_residuals


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
        check_false_alarms(false_alarms)
        if decorrelation_time is not None:
            as_tolerance(decorrelation_time, "The decorrelation time [s]")
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
        time = self._check_time(at)
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
        exchanged = find_exchanged_frames(since, served, tracks, self._relative_to, first)
        verdicts = (
            self._verdict(one, tested.get(one.joint), first, exchanged.get(one.joint, ""))
            for one in self._monitored
        )
        return Plausibility(tuple(verdicts), self._testable.untested, self.false_alarms)

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

    def _check_time(self, at: float | None) -> float:
        if self._last is None:
            return 0.0 if at is None else check_time(at, -math.inf)
        if (at is not None) != self._stamped:
            first = "had one" if self._stamped else "had none"
            raise InvalidValueError(f"Either all observations have a time (at=), or none: the first {first}.")
        return self._last + 1.0 if at is None else check_time(at, self._last)

    def _add(self, tracks: Mapping[str, PoseTrack], at: float) -> None:
        residuals: dict[TestableJoint, TimedResiduals] = {}
        for monitored in self._monitored:
            joint = monitored.joint
            if monitored.served is None or not {joint.parent, joint.child} <= tracks.keys():
                continue
            parent, child = tracks[joint.parent], tracks[joint.child]
            if parent.observed[0] and child.observed[0]:
                now = np.array([0])
                known = compute_residuals(monitored.served, pair_tracks(parent, child, now))
                residuals[joint] = TimedResiduals(now, known)
        tested = self._consistency.apply(residuals)
        for monitored in self._monitored:
            if monitored.joint in tested:
                monitored.numbers.append(self.count)
                if monitored.test is None:
                    outliers = self._pair_outliers(monitored.joint)
                    fraction = outliers.fraction if outliers else 0.0
                    monitored.test = CorrelatedTest(self.false_alarms, fraction, self._correlation)
                monitored.test.add(tested[monitored.joint], self.count, at)

    def _pair_outliers(self, joint: TestableJoint) -> Outliers | None:
        return pair_outliers(self._outliers, joint, self._relative_to)

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
            return undetermined_verdict(joint, 0, monitored.reason or never)
        times, since = self._times(monitored, first), monitored.implausible_since
        if exchanged:
            return undetermined_verdict(joint, len(times), exchanged, since)
        poses = self._poses(joint, times, first)
        stamps = np.array([self._stamps[number - first] for number in times])
        data = JointObservations(joint, monitored.served, poses, residuals, np.array(times), stamps)
        outliers = self._pair_outliers(joint)
        return judge_joint(self.model, data, since, self._families, outliers, self._correlation)


_OBSERVED = np.ones(1, dtype=bool)


def _is_rigid(pose: Array) -> bool:
    """Return True for a pose (4, 4) that is certainly valid."""
    rotation = pose[:3, :3]
    off = rotation.T @ rotation
    off[_DIAGONAL] -= 1.0
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    x, y, z = pose[:3, 3].tolist()
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    return (
        float(np.abs(off).max()) < _RIGID
        and determinant > 0.0
        and pose[3].tolist() == [0.0, 0.0, 0.0, 1.0]
        and abs(x) + abs(y) + abs(z) < _FAR
    )


_DIAGONAL = np.diag_indices(3)
_RIGID, _FAR = 1e-6, 1e6  # tolerance of a rotation, and the farthest position, that need no further check
