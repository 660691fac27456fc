"""Plausibility of a served model, against recorded poses or online (2020 paper, III-D)."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse._names import match_names
from kineverse.errors import InvalidValueError, KineverseError, ShapeError, UnknownNameError, suggest
from kineverse.estimation.correlation import CorrelationSettings, ErrorCorrelation
from kineverse.estimation.identification import native
from kineverse.estimation.identification.kinematic_graph import FamilyChoice
from kineverse.estimation.identification.observations import (
    PosesLike,
    PoseTrack,
    check_tracks,
    concatenate_tracks,
    exact_track,
    pair_tracks,
)
from kineverse.estimation.linear_algebra import singularity_named
from kineverse.estimation.noise import Outliers, as_numbers, as_outliers
from kineverse.estimation.tracking import Tracker
from kineverse.estimation.tracking.measurements import require_time
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.model import Model, Snapshot

from .alternatives import TestSettings, displacement_covariance, judge_joint
from .consistency import ConsistencyTests, find_exchanged_frames
from .e_process import SequentialTest
from .report import JointVerdict, Plausibility, TestableJoint, find_testable_joints
from .residuals import JointObservations, KnownJoint, compute_residuals

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
    repaired: Iterable[JointVerdict] = (),
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
        detects deviations sooner. The bound on false alarms holds up to four times the stated fraction.
    decorrelation_time
        Correlation time of the errors [s], or in steps without times: their correlation falls to 1/e. 0 for
        independent errors; None to measure it, up to a second or 30 steps.
    repaired
        Earlier report, or some of its verdicts. Where the model has its replacement, that joint is tested as
        known with the covariance of its fit.
    strict
        True to raise if a joint is rejected.

    Raises
    ------
    ShapeError, InvalidValueError
        For invalid poses, covariances or times, and if a covariance is missing.
    ImplausibleError
        If ``strict``, and a joint does not explain the observations.

    Examples
    --------
    >>> model = kv.load("shelf_door")
    >>> slide = np.stack([kv.translation(0, 0.02 * k, 0)() for k in range(30)])  # it is a drawer
    >>> report = kv.estimation.check_plausibility(model, {"shelf_door/door": slide}, noise=(0.002, 0.01))
    >>> [verdict.tag for verdict in report.implausible]
    ['joint shelf_door/door']
    >>> report.repair(model)
    ('joint shelf_door/door',)
    """
    checked: object = model.model if isinstance(model, Tracker) else model
    checked = checked.model() if isinstance(checked, Snapshot) else checked
    if not isinstance(checked, Model):
        raise InvalidValueError(f"A model or a tracker is checked, not {checked!r:.80}.")
    if isinstance(model, Tracker) and observations is None:
        recent = model.recent
        pairs = {name: (recent.poses[name], noise) for name, noise in recent.covariances.items()}
        observations, times, relative_to = {**recent.poses, **pairs}, recent.times, recent.relative_to
    observations = {} if observations is None else observations
    correlation = CorrelationSettings(decorrelation_time, times is not None)
    settings = TestSettings(false_alarms, as_outliers(outliers), relative_to, families, correlation)
    tracks = check_tracks(observations, noise)
    count = max((len(track.poses) for track in tracks.values()), default=0)
    stamps = _check_times(times, count)
    tested = _TestedModel(checked, observations, settings, repaired)
    if relative_to is not None:
        tracks[relative_to] = exact_track(count)
    data = tested.observe(tracks, stamps)
    result = tested.report(tracks, data, {joint: tested.test(each) for joint, each in data.items()})
    if strict:
        result.raise_if_implausible()
    return result


class _TestedModel:
    """Testable joints of one version of a model."""

    def __init__(
        self,
        model: Model,
        frames: Iterable[str],
        settings: TestSettings,
        repaired: Iterable[JointVerdict] = (),
    ) -> None:
        self.model, self.settings = model, settings
        self.testable = find_testable_joints(model, frames, settings.relative_to)
        self.served: dict[TestableJoint, KnownJoint] = {}
        self._reasons: dict[TestableJoint, str] = {}
        for joint in self.testable.joints:
            try:
                self.served[joint] = KnownJoint(model, joint.child, joint.parent)
            except KineverseError as error:
                self._reasons[joint] = f"its pose cannot be computed. {error}"
        self.consistency = ConsistencyTests(model, self.served, settings.relative_to)
        # Covariances of the displacements of joints that are replacements.
        self._known: dict[TestableJoint, Array] = {}
        for verdict in repaired:
            for joint in self.served:
                same = (verdict.tag, verdict.joint.child) == (joint.tag, joint.child)
                if same and verdict.joint.parent == joint.parent and verdict.result is not None:
                    if verdict.replacement == model.history.operation(joint.tag):
                        fit, middle = verdict.result.best, self.served[joint].middle
                        self._known[joint] = displacement_covariance(fit, middle)

    def is_equal(self, joint: TestableJoint, other: _TestedModel) -> bool:
        """Return True if a joint is the same in another version."""
        if not (joint in self.served and joint in other.served):
            return False
        return self.served[joint].is_equal(other.served[joint]) and self.consistency.is_equal(
            joint, other.consistency
        )

    def observe(
        self,
        tracks: Mapping[str, PoseTrack],
        stamps: Array,
        first: int = 0,
        begun: Mapping[TestableJoint, int] | None = None,
    ) -> dict[TestableJoint, JointObservations]:
        """Return the observations of each joint, numbered from ``first``, without those before it began."""
        data: dict[TestableJoint, JointObservations] = {}
        for joint, served in self.served.items():
            if not {joint.parent, joint.child} <= tracks.keys():
                continue
            parent, child = tracks[joint.parent], tracks[joint.child]
            rows = np.flatnonzero(parent.observed & child.observed)
            if begun is not None:
                rows = rows[rows + first >= begun.get(joint, 0)]
            if not len(rows):
                continue
            poses = pair_tracks(parent, child, rows)
            try:
                residuals = compute_residuals(served, poses)
            except KineverseError as error:
                self._reasons[joint] = f"its pose cannot be computed. {error}"
                continue
            when = rows + first, stamps[rows], self._known.get(joint)
            data[joint] = JointObservations(joint, served, poses, residuals, *when)
        return self.consistency.apply(data)

    def begin_test(self, data: JointObservations) -> SequentialTest:
        """Return a new test of a joint."""
        outliers = self.settings.pair_outliers(data.joint)
        fraction = outliers.fraction if outliers else 0.0
        return SequentialTest(self.settings.false_alarms, fraction, data.displacement)

    def test(self, data: JointObservations) -> int | None:
        """Return the first observation that a joint does not explain; None if it explains all."""
        residuals, test = data.residuals, self.begin_test(data)
        size = residuals.orthogonal.shape[1]
        looks = self.settings.correlation.measure(residuals.whitened, size, data.stamps)
        for row, number in enumerate(data.numbers.tolist()):
            test.observe(residuals, row, number, looks)
        return test.implausible_since

    def report(
        self,
        tracks: Mapping[str, PoseTrack],
        data: Mapping[TestableJoint, JointObservations],
        since: Mapping[TestableJoint, int | None],
        first: int = 0,
    ) -> Plausibility:
        """Return the verdicts on all joints, given the first observations that they do not explain."""
        rejected = {joint: number - first for joint, number in since.items() if number is not None}
        exchanged = find_exchanged_frames(rejected, self.served, tracks, self.settings.relative_to)
        verdicts = []
        for joint in self.testable.joints:
            reason, count = self._reasons.get(joint) or exchanged.get(joint, ""), 0
            if joint in data:
                count = len(data[joint].numbers)
            else:
                reason = reason or f"'{joint.parent}' and '{joint.child}' were never observed together"
            if reason:
                nothing = math.nan, math.nan
                verdicts.append(JointVerdict(joint, {}, nothing, count, since.get(joint), reason=reason))
            else:
                verdicts.append(judge_joint(self.model, data[joint], since[joint], self.settings))
        return Plausibility(tuple(verdicts), self.testable.untested, self.settings.false_alarms)


def _check_times(times: npt.ArrayLike | None, count: int, last: float = -math.inf) -> Array:
    if times is None:
        return np.arange(float(count))
    stamps = as_numbers(times, "The times")
    if stamps.shape != (count,):
        raise ShapeError(
            f"There are {count} observations, and the times are of shape {stamps.shape}. Each observation "
            "has one time."
        )
    for before, at in zip([last, *stamps], stamps.tolist(), strict=False):
        if require_time(at) <= before:
            raise InvalidValueError(
                f"The time {at:.9g} is not later than {before:.9g}, that of the observation before. Sort the "
                "observations by time, and leave out repeated ones."
            )
    return stamps


class PlausibilityMonitor:
    """Online plausibility test of a model.

    The probability of ever rejecting a joint that is as served is at most ``false_alarms``, for any duration.
    After an edit of the model, the tests of the joints that it changed start again. Replacements of its own
    reports are then known with the covariance of their fits.

    Parameters
    ----------
    frames
        Names of the frames that may be observed, or patterns.
    noise, relative_to, families, false_alarms, outliers, decorrelation_time, repaired
        As in :func:`~kineverse.estimation.check_plausibility`.
    keep
        Number of recent observations that reports use.

    Examples
    --------
    >>> model = kv.load("shelf_door")
    >>> monitor = kv.estimation.PlausibilityMonitor(model, ["shelf_door/door"], noise=(0.002, 0.01))
    >>> door = model.fk("shelf_door/door")
    >>> for q in np.linspace(0, 1, 10):
    ...     rejected = monitor.update({"shelf_door/door": door({"shelf_door/door": q})})
    >>> rejected
    ()
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
        repaired: Iterable[JointVerdict] = (),
        keep: int = 500,
    ) -> None:
        self.model = model
        self.frames = match_names(frames, [*model.frames, WORLD], "frame", "frames=")
        self.count, self.false_alarms = 0, false_alarms
        correlation = CorrelationSettings(decorrelation_time, False)
        self._settings = TestSettings(false_alarms, as_outliers(outliers), relative_to, families, correlation)
        self._noise = noise
        self._last: float | None = None
        self._recent: deque[dict[str, PoseTrack]] = deque(maxlen=keep)
        self._stamps: deque[float] = deque(maxlen=keep)
        self._repairs = {verdict.tag: verdict for verdict in repaired if verdict.replacement is not None}
        self._tests: dict[TestableJoint, _OnlineTest] = {}
        native.prepare()
        self._version = model.version
        self._tested = _TestedModel(model, self.frames, self._settings, self._repairs.values())

    @property
    def implausible_since(self) -> dict[str, int]:
        """First observation that each rejected joint does not explain, by tag."""
        result: dict[str, int] = {}
        for joint, number in self._since().items():
            if number is not None:
                result[joint.tag] = min(number, result.get(joint.tag, number))
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
        self._follow_model()
        if self._settings.relative_to is not None:
            tracks[self._settings.relative_to] = exact_track(1)
        before = set(self.implausible_since)
        if self._last is None:
            correlation = replace(self._settings.correlation, stamped=at is not None)
            self._settings = self._tested.settings = replace(self._settings, correlation=correlation)
        self._last = time
        for joint, data in self._tested.observe(tracks, np.array([time]), self.count).items():
            if joint not in self._tests:
                errors = ErrorCorrelation(self._settings.correlation)
                self._tests[joint] = _OnlineTest(self._tested.begin_test(data), errors, self.count)
            begun = self._tests[joint]
            residuals = data.residuals
            looks = begun.errors.add(residuals.whitened[0], residuals.orthogonal.shape[1], time)
            begun.test.observe(residuals, 0, self.count, looks)
        self._recent.append(tracks)
        self._stamps.append(time)
        self.count += 1
        return tuple(tag for tag in self.implausible_since if tag not in before)

    @singularity_named()
    def report(self) -> Plausibility:
        """Return the verdicts on all joints from the recent observations."""
        self._follow_model()
        first, tracks = self.count - len(self._recent), {}
        for name, any_track in {name: t for tracks in self._recent for name, t in tracks.items()}.items():
            gap = replace(any_track, observed=np.zeros(1, dtype=bool))
            tracks[name] = concatenate_tracks([each.get(name, gap) for each in self._recent])
        begun = dict.fromkeys(self._tested.served, self.count)
        begun |= {joint: test.begun for joint, test in self._tests.items()}
        data = self._tested.observe(tracks, np.array(self._stamps), first, begun)
        result = self._tested.report(tracks, data, self._since(), first)
        self._repairs |= {verdict.tag: verdict for verdict in result if verdict.replacement is not None}
        return result

    def _since(self) -> dict[TestableJoint, int | None]:
        return {joint: each.test.implausible_since for joint, each in self._tests.items()}

    def _follow_model(self) -> None:
        """After an edit, find the testable joints, and keep the tests of unchanged ones."""
        if self.model.version == self._version:
            return
        self._version, before = self.model.version, self._tested
        self._tested = _TestedModel(self.model, self.frames, self._settings, self._repairs.values())
        unchanged = [joint for joint in self._tests if self._tested.is_equal(joint, before)]
        self._tests = {joint: self._tests[joint] for joint in unchanged}

    def _check(self, observed: PosesLike, name: str) -> PoseTrack:
        pose, *covariance = observed if isinstance(observed, tuple) and len(observed) == 2 else (observed,)
        matrix = as_numbers(pose, f"The pose of '{name}'")
        if matrix.shape != (4, 4):
            raise ShapeError(f"The pose of '{name}' is a 4×4 transform, not of shape {matrix.shape}.")
        given: PosesLike = (matrix[None], covariance[0]) if covariance else matrix[None]
        return check_tracks({name: given}, self._noise)[name]

    def _next_time(self, at: float | None) -> float:
        if self._last is not None and (at is not None) != self._settings.correlation.stamped:
            first = "had none" if at is not None else "had one"
            raise InvalidValueError(f"Either all observations have a time (at=), or none: the first {first}.")
        last = -1.0 if self._last is None else self._last
        if at is None:
            return last + 1.0
        return float(_check_times([at], 1, -math.inf if self._last is None else last)[0])


class _OnlineTest(NamedTuple):
    """Test of one joint, and the correlation of its errors so far."""

    test: SequentialTest
    errors: ErrorCorrelation
    begun: int  # number of the first observation
