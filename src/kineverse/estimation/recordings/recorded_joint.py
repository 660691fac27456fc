"""Joint of a recorded pair: its identification, the sensitivity to assumptions, and its model.

Errors of neighbouring rows are correlated. N rows with an autocorrelation time τ count as N / τ, see
:mod:`kineverse.estimation.correlation`. The residuals of each family have their own time, because they
contain the misfit of the family. The time of the most probable family is used, and the comparison is repeated
until it agrees with the family that it makes most probable.

The answer is compared with those under other assumptions: the times of other families, twice the noise, and
the noise of the residuals if another one is stated. An assumption about the noise counts if the
observations are not much less probable under it than under the best of these.

A joint with several joint values explains noise that is larger in one direction, such as a camera's depth,
as motion. But the motion of parts is smooth, and noise is not. If the residuals of a family with fewer joint
values are no smoother than noise, the noise may be as large as these.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from kineverse.articulations.mechanisms.mechanism import BLUE, RED, box_shape, rod_shape, shift
from kineverse.errors import InvalidValueError
from kineverse.estimation.correlation import LEAST_EFFECTIVE, correlation_time
from kineverse.estimation.identification import Fit, IdentificationResult, identify
from kineverse.estimation.identification.curve import CURVE
from kineverse.estimation.identification.joint_identification import WEIGHTS
from kineverse.estimation.identification.joint_operations import joint_operation
from kineverse.estimation.identification.model_check import CALIBRATED
from kineverse.estimation.identification.observations import check_observations
from kineverse.estimation.identification.result import complete_fit
from kineverse.estimation.noise import Outliers, pose_covariance
from kineverse.lie import Array
from kineverse.model.basic_operations import SetBody
from kineverse.model.body import Body, Rgba, Shape, Sphere
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.spatial import translation

from .recording import Indices, RecordedPair, spaced_indices

MAX_ROTATION_STEP = 2.0
"""Largest rotation between successive poses for which revolutions are counted reliably [rad]."""

_CAUTION = 1.0  # standard deviations of the autocorrelation time that are added to its estimate
_ROWS_PER_TIME, _ENOUGH_ROWS = 8, 100  # rows within one autocorrelation time, and in total, that suffice
# Log ratio of the probability of the observations at which one noise is refuted by another.
_REFUTED = math.log(20.0)
_TINY = 1e-12  # size of residuals that avoids a division by zero [m], [rad]
_AMPLE = 1.5  # factor on the size of residuals at which the noise explains them amply
_LONGER = 1.1  # relative difference of autocorrelation times that matters
# Ratio of autocorrelation times below which residuals are as smooth as others, and above which motion is not
# noise.
_AS_SMOOTH, _SMOOTHER = 1.5, 3.0


@dataclass(frozen=True)
class ObservationNoise:
    """Assumed noise of the observations.

    See Also
    --------
    kineverse.estimation.recordings.identify_recorded_joint
    """

    position: float  # standard deviation of each coordinate [m]
    orientation: float | None  # and about each axis [rad]; None if only positions are observed
    given: bool  # True if they are stated, False if estimated

    def scaled(self, factor: float) -> ObservationNoise:
        """Return the noise with standard deviations that are larger by a factor."""
        orientation = None if self.orientation is None else factor * self.orientation
        return ObservationNoise(factor * self.position, orientation, self.given)

    @property
    def covariance(self) -> Array:
        """Covariance of poses, (6, 6); for positions alone its orientation block is unused."""
        return pose_covariance(self.position, self.orientation or 1.0)


@dataclass(frozen=True, eq=False)
class Assumption:
    """Noise and autocorrelation time of the errors, and the joint that is identified with these.

    See Also
    --------
    kineverse.estimation.recordings.identify_recorded_joint
    """

    noise: ObservationNoise  # of single observations
    correlation_time: float  # autocorrelation time of their errors, in rows
    found: IdentificationResult  # all families, with their probabilities


@dataclass(frozen=True, eq=False)
class RecordedJoint(Assumption):
    """Joint identified from a recorded pair, with the assumption under which the answer was found.

    See Also
    --------
    kineverse.estimation.recordings.identify_recorded_joint
    """

    repeated: int  # number of rows that equal the one before; they do not count
    judged: int  # effective sample size by which the families were compared
    fit: Fit  # of the most probable family to all poses, outliers marked
    objections: tuple[Assumption, ...] = ()  # under which the answer is different, and which are possible

    @property
    def is_ambiguous(self) -> bool:
        """True if the data do not determine a joint, or only under some of the assumptions."""
        return self.found.is_ambiguous or self.is_free or bool(self.objections)

    @property
    def is_free(self) -> bool:
        """True if no joint explains the motion."""
        return self.found.best.family == "free"


def identify_recorded_joint(
    pair: RecordedPair,
    noise: ObservationNoise | None = None,
    families: list[str] | None = None,
    independent: bool = False,
) -> RecordedJoint:
    """Identify the joint of a recorded pair by the noise of its poses; without one, estimate it.

    Independent errors have no autocorrelation, which is else estimated.

    Examples
    --------
    >>> table = np.zeros((20, 3))
    >>> table[:, 0] = np.linspace(0, 0.4, 20)  # x of a drawer
    >>> table += np.random.default_rng(0).normal(0, 0.002, table.shape)
    >>> recording = kv.estimation.recordings.read_recording(table, columns="x,y,z")
    >>> noise = kv.estimation.recordings.ObservationNoise(position=0.002, orientation=None, given=True)
    >>> joint = kv.estimation.recordings.identify_recorded_joint(
    ...     recording.pair(), noise, families=["prismatic", "revolute"]
    ... )
    >>> joint.fit.family, joint.is_ambiguous
    ('prismatic', False)
    """
    comparison = _Comparison(pair, families, independent)
    if noise is None and pair.is_in_plane:
        what = "roll and pitch" if pair.relative.ndim == 3 else "z"
        raise InvalidValueError(
            f"All poses have the same {what}, so the noise cannot be estimated: a joint "
            "in the plane explains all of these poses without any. State it (--noise 3mm,1deg on the command "
            "line)."
        )
    first = comparison.assume(noise, 1.0, comparison.distinct)
    fits = {}
    if not independent:
        # If the stated noise is too small, most observations are outliers.
        as_stated = noise is None or pair.is_in_plane
        estimated = first if as_stated else comparison.assume(None, 1.0, comparison.distinct)
        fits = {fit.family: fit for fit in estimated.found if fit.family not in ("free", CURVE)}
    times = {name: comparison.correlation_time(fit) for name, fit in fits.items()}
    best, rows = first, comparison.distinct
    for _ in times:
        name = best.found.best.family
        if times.get(name, 1.0) <= _LONGER * best.correlation_time:
            break
        rows = comparison.sufficient_rows(times[name], first.found[name])
        best = comparison.assume(noise, times[name], rows)
    if comparison.joints != comparison.families:
        best = comparison.assume(noise, best.correlation_time, rows, comparison.families)
    others = comparison.alternatives(noise, best, fits, times, rows)
    count = len(comparison.distinct)
    return RecordedJoint(
        best.noise,
        best.correlation_time,
        best.found,
        repeated=len(pair.lines) - count,
        judged=max(1, round(count / best.correlation_time)),
        fit=comparison.complete(best, rows),
        objections=tuple(other for other in others if objects(other, best)),
    )


def objects(other: Assumption, made: Assumption) -> bool:
    """Return True if the answer under another assumption is not the one under the assumption made."""
    sure = [None if one.found.is_ambiguous else one.found.best.family for one in (other, made)]
    # A longer correlation time always leaves less information.
    is_longer = other.correlation_time != made.correlation_time
    return sure[0] != sure[1] and not (is_longer and other.found.best.family == made.found.best.family)


class _Comparison:
    """Comparison of families under several assumptions."""

    def __init__(self, pair: RecordedPair, families: list[str] | None, independent: bool) -> None:
        self.pair = pair
        self.families = [*WEIGHTS] if families is None else families
        # A curve follows correlated errors and takes long. So it is compared once, at the end.
        self.joints = [name for name in self.families if name != CURVE] or self.families
        repeats = pair.repeats
        self.distinct: Indices = np.flatnonzero(~repeats)
        if len(self.distinct) == 1 < len(repeats):
            raise InvalidValueError(
                f"All {len(repeats)} poses are the same in every digit. A part at rest shows no motion."
            )
        if independent:
            self.distinct = np.arange(len(repeats))

    def assume(
        self, noise: ObservationNoise | None, time: float, rows: Indices, families: list[str] | None = None
    ) -> Assumption:
        """Identify the joint from some rows, which stand for all distinct rows with a correlation time."""
        some = self.pair.select(rows)
        result = identify(
            some.parent_poses,
            some.child_poses,
            noise=None if noise is None else noise.covariance,
            families=families or self.joints,
            outliers=True,
            sequential=self.pair.is_timed,
            correlation_time=max(1.0, time * len(rows) / len(self.distinct)),
        )
        if result.noise is not None:  # it is not stated
            position, orientation = result.noise
            noise = ObservationNoise(position, orientation if self.pair.has_orientation else None, False)
        assert noise is not None
        return Assumption(noise, time, result)

    def correlation_time(self, fit: Fit) -> float:
        largest = max(1.0, len(self.distinct) / LEAST_EFFECTIVE)
        return min(largest, correlation_time(_residuals_across_motion(fit), _CAUTION))

    def sufficient_rows(self, time: float, fit: Fit) -> Indices:
        """Return evenly spaced rows; more of them hold little more about errors with this time."""
        count = len(self.distinct)
        size = min(count, max(_ENOUGH_ROWS, math.ceil(_ROWS_PER_TIME * count / time)))
        # The subset must be dense enough to count revolutions.
        while self.pair.is_timed and size < count:
            if fit.select(spaced_indices(count, size)).largest_turn <= MAX_ROTATION_STEP:
                break
            size += 1
        return self.distinct[spaced_indices(count, size)]

    def alternatives(
        self,
        stated: ObservationNoise | None,
        best: Assumption,
        fits: dict[str, Fit],
        times: dict[str, float],
        rows: Indices,
    ) -> Iterator[Assumption]:
        for time in sorted(set(times.values())):
            if time > _LONGER * best.correlation_time:
                other = self.assume(stated, time, rows)
                # Only a family whose residuals have this time explains it.
                if times.get(other.found.best.family, 0.0) == time:
                    yield other
        family = best.found.best.family
        for name, fit in fits.items():
            if family in fits and _is_noise(fit, fits[family], times[name], times[family]):
                other = self.assume(_largest_noise(fit).scaled(_AMPLE), best.correlation_time, rows)
                if other.found.best.family == name:
                    yield other
        noises = [best.noise.scaled(2.0)]
        if stated is not None and not self.pair.is_in_plane:
            noises.append(self.assume(None, best.correlation_time, rows).noise)
        others = [self.assume(noise, best.correlation_time, rows) for noise in noises]
        known = self.assume(best.noise, best.correlation_time, rows) if stated is None else best
        largest = max(log_probability(one.found) for one in (known, *others))
        for other in others:
            # The families of a noise that the residuals refute are compared for a larger one.
            if not other.found.misfit > CALIBRATED and log_probability(other.found) > largest - _REFUTED:
                yield other

    def complete(self, best: Assumption, rows: Indices) -> Fit:
        """Return the fit of the most probable family, extended to all rows."""
        pair, noise = self.pair, best.noise
        if len(rows) == len(pair.lines):
            return best.found.best
        covariance = noise.covariance
        observations = check_observations(pair.parent_poses, pair.child_poses, covariance, covariance)
        return complete_fit(best.found.best, observations, rows, Outliers(), noise.given, pair.is_timed)


def _residuals_across_motion(fit: Fit) -> Array:
    """Return the residuals of inliers without the part along the motion, which joint values follow slowly."""
    by_joints = fit.motion.linearise(fit.joint_values[fit.inliers]).by_joints[:, : fit.rows]
    sizes = np.repeat(fit.rms, 3)[: fit.rows] + _TINY
    across, along = fit.residuals[fit.inliers] / sizes, np.linalg.qr(by_joints / sizes[:, None])[0]
    return np.asarray(across - np.einsum("nik,njk,nj->ni", along, along, across)) * sizes


def _is_noise(fit: Fit, best: Fit, time: float, best_time: float) -> bool:
    """Return True if a fit with fewer joint values has residuals as little smooth as the best ones."""
    if fit.motion.joints >= best.motion.joints or time > _AS_SMOOTH * best_time:
        return False
    values = best.joint_values[best.inliers]
    if LEAST_EFFECTIVE * time >= len(values):
        return False  # the time is at its bound, and may be longer
    return correlation_time(values - values.mean(axis=0)) > _SMOOTHER * time


def _largest_noise(fit: Fit) -> ObservationNoise:
    """Return noise as large in all directions as the residuals are in the worst one."""
    deviations = np.sqrt(np.mean(fit.residuals[fit.inliers] ** 2, axis=0))
    orientation = float(deviations[3:].max()) if fit.rows == 6 else None
    return ObservationNoise(float(deviations[:3].max()), orientation, True)


def log_probability(result: IdentificationResult) -> float:
    """Return the log probability density of the observations, families weighed by their priors."""
    best = result.best
    return best.log_evidence + math.log(WEIGHTS[best.family] / best.probability)


_ORANGE: Rgba = (0.93, 0.56, 0.17, 1.0)
_DOTS = 60  # largest number of observed positions drawn in the model


def make_joint_model(pair: RecordedPair, fit: Fit) -> Model:
    """Return a model with the joint, and shapes of its axis, the child and the observed positions.

    If only positions are observed, the child's axes are those of its parent at joint value 0. Such a part
    that moves freely has no joint.

    Examples
    --------
    >>> angles = np.linspace(0, 1.2, 20)
    >>> table = np.stack([0.5 * np.cos(angles), 0.5 * np.sin(angles), 0 * angles], axis=1)
    >>> recording = kv.estimation.recordings.read_recording(table, columns="x,y,z")
    >>> noise = kv.estimation.recordings.ObservationNoise(position=0.002, orientation=None, given=True)
    >>> joint = kv.estimation.recordings.identify_recorded_joint(
    ...     recording.pair(), noise, families=["prismatic", "revolute"]
    ... )
    >>> kv.estimation.recordings.make_joint_model(recording.pair(), joint.fit)
    <Model: 1 frame, 1 DoF, 1 constraint (version 1)>
    """
    motion, names = fit.motion, (pair.child, pair.parent, pair.child)
    if motion.rows == 6 or fit.family == CURVE:
        operation = fit.operation(*names, as_point=True)
    elif fit.family == "free":
        raise InvalidValueError(f"'{pair.child}' moves freely: there is no joint to write.")
    else:
        right = motion.right.copy()
        right[:3, :3] = motion.left[:3, :3].T
        limits = [(float(low), float(high)) for low, high in fit.range]
        operation = joint_operation(replace(motion, right=right), limits, *names)
    positions = pair.relative[:, :3, 3] if pair.relative.ndim == 3 else pair.relative
    size = max(float(np.ptp(positions, axis=0).max()), 0.01)
    known = {name: np.asarray(value) for name, value in fit.parameters.items()}

    def nearest(position: Array) -> Array:
        """Return the point of the axis closest to a position; the position itself of a slider."""
        point = known.get("point", position)
        return np.asarray(point + (known["axis"] @ (position - point)) * known["axis"])

    def rod(start: Array, end: Array, color: Rgba) -> Shape:
        (a, b, c), (x, y, z) = start.tolist(), end.tolist()
        return rod_shape((a, b, c), (x, y, z), 0.012 * size, color)

    dots = positions[spaced_indices(len(positions), _DOTS)].tolist()
    fixed = [Shape(Sphere(0.008 * size), shift(*dot), color=_ORANGE) for dot in dots]
    moved = [box_shape((0.06 * size,) * 3, (0.0, 0.0, 0.0), BLUE)]
    if "axis" in known:
        half, middle = 0.5 * size * known["axis"], nearest(positions.mean(axis=0))
        fixed.append(rod(middle - half, middle + half, RED))
    if "point" in known:
        reference = known["reference"]
        rotation = reference[:3, :3] if motion.rows == 6 else np.eye(3)
        arm = rotation.T @ (nearest(reference[:3, 3]) - reference[:3, 3])
        if np.linalg.norm(arm) > 0.01 * size:
            moved.append(rod(np.zeros(3), arm, BLUE))
    model = Model()
    with model.edit() as edit:
        if pair.parent != WORLD:
            edit.add_frame(pair.parent, WORLD, translation(0, 0, 0))
        edit.apply(operation, tag=pair.child)
        edit.apply(SetBody(pair.parent, Body(tuple(fixed))))
        edit.apply(SetBody(pair.child, Body(tuple(moved))))
    return model
