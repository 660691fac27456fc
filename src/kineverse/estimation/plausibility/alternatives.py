"""Comparison of the served joint with its alternatives.

As in :mod:`kineverse.estimation.identification.marginal_likelihood`, the prior of joint values is a Gaussian
of unknown mean and width, here truncated at the limits. So the amplitude of a motion is no evidence: a door
that moved a little is not compared with one that moved all the way. Identified joints have an improper prior
of their mean pose. Here the pose is uniform in a cube of 2 m and over all rotations, so that both densities
have the same unit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from kineverse._checks import as_tolerance
from kineverse.errors import InvalidValueError, KineverseError
from kineverse.estimation.correlation import CorrelationSettings
from kineverse.estimation.identification.kinematic_graph import (
    LOG_ANYWHERE,
    FamilyChoice,
    identify_observations,
)
from kineverse.estimation.identification.marginal_likelihood import GRID
from kineverse.estimation.identification.outlier_rejection import RowIndices, is_inlier
from kineverse.estimation.identification.result import (
    SURE,
    Fit,
    IdentificationResult,
    complete_fit,
    project_observations,
)
from kineverse.estimation.linear_algebra import (
    invert_matrices,
    log_determinants,
    multiply_vectors,
    sum_log_determinants,
)
from kineverse.estimation.noise import Outliers
from kineverse.lie import Array
from kineverse.model.model import Model
from kineverse.model.operation import Operation

from .replacement import build_replacement, follows_another
from .report import JointVerdict, TestableJoint
from .residuals import (
    SIZES,
    JointObservations,
    KnownJoint,
    KnownResiduals,
    compute_residuals,
    displacement_jacobian,
    orthogonal_residuals,
)


def reject_outliers(residuals: KnownResiduals, outliers: Outliers | None) -> RowIndices:
    """Return the numbers of the inliers under the served joint."""
    all_rows = np.arange(len(residuals))
    if outliers is None or not len(residuals):
        return all_rows
    squares = np.sum(residuals.orthogonal**2, axis=1)
    if residuals.one_sided.size:
        squares = squares + np.fmax(residuals.one_sided, 0.0).max(axis=1) ** 2
    log_scale = residuals.log_scale + 0.5 * log_determinants(math.tau * residuals.covariances)
    inliers = all_rows[is_inlier(squares, log_scale, outliers)]
    # More outliers than chance explains indicate a wrong model instead.
    expected = outliers.fraction * len(residuals)
    is_usual = len(residuals) - len(inliers) <= expected + 2.0 * math.sqrt(expected)
    return inliers if is_usual else all_rows


_STATIC_WIDTH = np.array([1e-9])
_erf = np.vectorize(math.erf, otypes=[np.float64])


def log_evidence(served: KnownJoint, residuals: KnownResiduals, is_static: bool = False) -> float:
    """Return the log density of the observed relative poses, with joint values integrated out."""
    log = -float(np.sum(0.5 * np.sum(residuals.orthogonal**2, axis=1) + residuals.log_scale))
    log -= 0.5 * float(np.nansum(np.maximum(residuals.limit_excess, 0.0) ** 2))
    # The expected squared disagreement under a correct model is 1.
    excess = np.nansum(residuals.disagreement**2, axis=0) - np.isfinite(residuals.disagreement).sum(axis=0)
    log -= 0.5 * float(np.maximum(excess, 0.0).sum())
    best = np.zeros(len(served.lower))
    for j, (lower, upper) in enumerate(zip(served.lower, served.upper, strict=True)):
        values, variances = residuals.values[:, j], residuals.covariances[:, j, j]
        widths = _STATIC_WIDTH if is_static else GRID
        logs = _log_evidence_by_width(values, variances, lower, upper, widths, _log_density(served)[j])
        best[j] = widths[int(np.argmax(logs))]
        log += _log_mean(logs)
    if len(best) > 1:
        # The correlation of joint values, without limits and at the most likely widths.
        apart = residuals.covariances * np.eye(len(best))
        log += _log_joint_evidence(residuals.values, residuals.covariances, best)
        log -= _log_joint_evidence(residuals.values, apart, best)
    return log


def log_displacement_gain(residuals: KnownResiduals, covariances: Iterable[Array]) -> float:
    """Return the log density ratio of ρ = G δ + noise to noise alone, on average over N(0, Σ) of δ."""
    transposed = np.swapaxes(residuals.displacement_jacobian, 1, 2)
    information = np.sum(transposed @ residuals.displacement_jacobian, axis=0)
    pull = np.sum(transposed @ residuals.orthogonal[:, :, None], axis=0)[:, 0]
    logs = []
    for covariance in covariances:
        total = np.eye(len(pull)) + covariance @ information
        logs.append(0.5 * (pull @ np.linalg.solve(total, covariance @ pull) - np.linalg.slogdet(total)[1]))
    return _log_mean(np.array(logs))


def _log_joint_evidence(values: Array, covariances: Array, widths: Array) -> float:
    """Return log ∫ Π_k ∫ N(â_k; a, C_k) N(a; μ, s²) da dμ of several joint values."""
    total = covariances + np.diag(widths**2)
    weights = invert_matrices(total)
    information = weights.sum(axis=0)
    off = values - np.linalg.solve(information, multiply_vectors(weights, values).sum(axis=0))
    log = -0.5 * float(np.sum(off * multiply_vectors(weights, off)))
    return log - 0.5 * (sum_log_determinants(math.tau * total) + sum_log_determinants(information / math.tau))


def _log_density(served: KnownJoint) -> Array:
    width = served.upper - served.lower
    free = np.where(served.is_angle, 2.0 * math.pi, 20.0)
    return np.asarray(-np.log(np.where(np.isfinite(width), np.maximum(width, 1e-6), free)))


def _log_mean(logs: Array) -> float:
    return float(np.logaddexp.reduce(logs)) - math.log(len(logs))


def _log_evidence_by_width(
    values: Array, variances: Array, lower: float, upper: float, widths: Array, density: float
) -> Array:
    """Return log ∫ dμ p(μ) Π_k ∫ N(â_k; a, C_k) p(a; μ, s) da for each width s."""
    s2 = widths[:, None] ** 2
    total = variances + s2
    weights = 1.0 / total
    sums = weights.sum(axis=1)
    mean = np.clip((weights @ values) / sums, lower, upper)
    off = values - mean[:, None]
    logs: Array = -0.5 * np.sum(np.log(2.0 * math.pi * total) + off**2 * weights, axis=1)
    logs += np.minimum(0.5 * np.log(2.0 * math.pi / sums) + density, 0.0)
    if math.isfinite(lower) or math.isfinite(upper):
        spread = np.sqrt(variances * s2 * weights)
        place = (values * s2 + mean[:, None] * variances) * weights
        logs += np.sum(_log_mass(place, spread, lower, upper), axis=1)
        logs -= len(values) * _log_mass(mean, widths, lower, upper)
    return logs


def _log_mass(mean: Array, deviation: Array, lower: float, upper: float) -> Array:
    scale = math.sqrt(2.0) * deviation
    mass = 0.5 * (_erf((upper - mean) / scale) - _erf((lower - mean) / scale))
    return np.asarray(np.log(np.maximum(mass, 1e-300)))


PRIOR: Mapping[str, float] = MappingProxyType({"served": 0.8, "elsewhere": 0.05, "rigid": 0.1, "other": 0.05})
"""Prior probabilities: joint as served, joint or child displaced, rigid, another joint."""

_LEAST_COUNT = 5  # least number of observations for a statement about the motion
_UNRELATED = 0.5  # ratio of successive to other distances from which on poses are unrelated
_LEAST_INDEPENDENT = 1.5  # least number of independent observations for a certain verdict
_CORRELATED = 2.0  # number of looks that are worth one, from which on this is worth saying


@dataclass(frozen=True)
class TestSettings:
    """Settings of the tests of all joints."""

    false_alarms: float
    outliers: Outliers | None
    relative_to: str | None
    families: FamilyChoice
    correlation: CorrelationSettings

    def __post_init__(self) -> None:
        if not 0.0 < self.false_alarms < 1.0:
            raise InvalidValueError(
                f"The probability of a false alarm is between 0 and 1, not {self.false_alarms}."
            )
        if self.correlation.time is not None:
            as_tolerance(self.correlation.time, "The decorrelation time [s]")

    def pair_outliers(self, joint: TestableJoint) -> Outliers | None:
        """Return the outlier model of a pair of poses: an outlier of either is one of the pair."""
        if self.outliers is None or joint.parent == self.relative_to:
            return self.outliers
        return replace(self.outliers, fraction=1.0 - (1.0 - self.outliers.fraction) ** 2)


def judge_joint(
    model: Model, data: JointObservations, implausible_since: int | None, settings: TestSettings
) -> JointVerdict:
    """Compare a joint with its alternatives, given the change point of the sequential test."""
    families, correlation, outliers = (
        settings.families,
        settings.correlation,
        settings.pair_outliers(data.joint),
    )
    if implausible_since is None:
        recent = data
        rows = reject_outliers(data.residuals, outliers)
    else:
        recent = data.select(slice(int(np.searchsorted(data.numbers, implausible_since)), None))
        rows = np.arange(len(recent.numbers))
        if outliers is not None and len(rows) >= 2:
            rows = identify_observations(recent.observations, families, outliers).best.inliers
    inliers = recent.select(rows)
    alternative = None
    if len(rows) >= 2 and implausible_since is not None:
        # The residuals under the rejected joint are no errors.
        alternative = identify_observations(inliers.observations, families)
        fit = alternative.best
        solution = project_observations(fit.motion, fit.joint_values, inliers.observations)
        size = inliers.observations.rows - fit.joint_values.shape[1]
        looks = correlation.measure(orthogonal_residuals(solution), size, inliers.stamps)
    else:
        whitened, size = data.residuals.whitened, data.residuals.orthogonal.shape[1]
        looks = correlation.measure(whitened, size, data.stamps)
    independent = inliers.decorrelate(looks)
    if len(rows) >= 2 and (alternative is None or independent is not inliers):
        alternative = identify_observations(independent.observations, families)
    probabilities = _probabilities(independent, alternative)
    operation, reason = None, ""
    if implausible_since is not None and _is_unrelated(recent, alternative):
        alternative, probabilities = None, {}
        reason = "successive poses are unrelated, as if all were outliers; check how the frames are observed"
    elif implausible_since is not None:
        static = alternative is not None and alternative.best.family == "rigid"
        if data.joint.moves and static and probabilities["rigid"] < SURE:
            reason = "it has hardly moved since, so its replacement is not known yet"
        else:
            operation, reason = _propose_replacement(model, data, independent, alternative)
    else:
        reason = _ambiguity_reason(probabilities, len(rows), looks)
    squares = np.mean(inliers.residuals.pose_residuals**2, axis=0)
    rms = math.sqrt(float(squares[:3].sum())), math.sqrt(float(squares[3:].sum()))
    left_out = tuple(np.setdiff1d(recent.numbers, inliers.numbers).tolist())
    verdict = JointVerdict(data.joint, probabilities, rms, len(data.numbers), implausible_since, alternative)
    return replace(verdict, replacement=operation, reason=reason, outliers=left_out)


def displacement_covariance(fit: Fit, middle: Array) -> Array:
    """Return the covariance of the displacements of a joint and its child (12, 12) by that of a fit."""
    linear = fit.motion.linearise(fit.joint_values)
    places = displacement_jacobian(linear.pose, middle).reshape(-1, 12)
    scale = np.array([1.0 / math.tau if name == "pitch" else 1.0 for name in fit.coordinates])
    moved = np.linalg.lstsq(places, linear.by_parameters.reshape(len(places), -1) * scale)[0]
    return np.asarray(moved @ fit.covariance @ moved.T)


def _probabilities(data: JointObservations, alternative: IdentificationResult | None) -> dict[str, float]:
    served, residuals = data.served, data.residuals
    known = np.zeros((12, 12)) if data.displacement is None else data.displacement
    exact, gain = log_evidence(served, residuals), log_displacement_gain(residuals, [known])
    elsewhere = log_displacement_gain(residuals, [known + size**2 * np.eye(12) for size in SIZES])
    logs = {
        "served": math.log(PRIOR["served"]) + exact + gain,
        "elsewhere": math.log(PRIOR["elsewhere"]) + exact + elsewhere,
        "rigid": -math.inf,
    }
    if served.joints:
        logs["rigid"] = math.log(PRIOR["rigid"]) + log_evidence(served, residuals, is_static=True) + gain
    # A family's probability is its evidence times its prior, up to a common factor.
    for fit in alternative or ():
        if fit.probability > 0.0 and alternative is not None:
            odds = math.log(PRIOR["other"]) + math.log(fit.probability / alternative.best.probability)
            log = odds + alternative.best.log_evidence + LOG_ANYWHERE
            logs[fit.family] = float(np.logaddexp(logs.get(fit.family, -math.inf), log))
    total = float(np.logaddexp.reduce(list(logs.values())))
    return {"free": 0.0, **{name: math.exp(log - total) for name, log in logs.items()}}


def _ambiguity_reason(probabilities: Mapping[str, float], count: int, looks: float) -> str:
    correlated = f"errors are correlated, {count} observations are worth {count / looks:.1f}"
    if probabilities["served"] >= SURE and count > 1:
        return "" if count >= _LEAST_INDEPENDENT * looks else correlated
    if count < _LEAST_COUNT:
        return f"both were observed only {count} time{'s' if count > 1 else ''}"
    other = max((name for name in probabilities if name != "served"), key=lambda name: probabilities[name])
    special = {"elsewhere": "it may sit a bit elsewhere as well", "rigid": "it hardly moved"}
    reason = special.get(other, f"it may be {other} as well")
    if looks >= _CORRELATED:
        reason += f"; {correlated}"
    return reason


def _propose_replacement(
    model: Model, data: JointObservations, recent: JointObservations, alternative: IdentificationResult | None
) -> tuple[Operation | None, str]:
    if alternative is None or len(recent.numbers) < _LEAST_COUNT:
        return None, "there are too few observations since for a replacement"
    if alternative.best.family == "free":
        return None, "no joint explains the poses since; the part is loose, or errors are larger than stated"
    if not alternative.best.is_determined or not alternative.best.probability >= SURE:
        return None, f"its replacement is not known yet, {alternative}"
    probabilities = _probabilities(recent, alternative)
    if probabilities["served"] == max(probabilities.values()):
        return None, "no other joint explains the poses better; the errors are larger than stated"
    if not follows_another(model, data.joint) and _explains_alone(model, recent, alternative):
        # Another joint would not resolve the contradiction.
        return None, "it explains the poses alone, but not together with the limits or joints it depends on"
    try:
        # The observations before that the new joint explains show its range, too.
        used = np.searchsorted(data.numbers, recent.numbers)
        fit = complete_fit(alternative.best, data.observations, used, Outliers())
        operation = build_replacement(model, data, fit)
    except KineverseError as error:
        return None, f"its replacement is no operation. {error}"
    try:
        with model.copy().edit() as edit:
            edit.replace(data.joint.tag, operation)
    except KineverseError as error:
        return None, f"its replacement does not fit into the model. {error}"
    return operation, ""


def _is_unrelated(data: JointObservations, alternative: IdentificationResult | None) -> bool:
    """Return True if nothing connects the poses: neither a joint, nor that successive ones are near."""
    if alternative is None or alternative.best.family != "free":
        return False
    positions = data.observations.relative[:, :3, 3]
    later = np.roll(positions, len(positions) // 2, axis=0)
    step = np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1))
    return bool(step > _UNRELATED * np.median(np.linalg.norm(positions - later, axis=1)))


def _explains_alone(model: Model, data: JointObservations, alternative: IdentificationResult) -> bool:
    """Return True if a joint fits without consistency tests and with loops opened."""
    if not (data.residuals.limit_excess.size or data.residuals.disagreement.size):
        return False
    served = KnownJoint(model, data.joint.child, data.joint.parent, open_loops=True)
    residuals = compute_residuals(served, data.observations)
    return _probabilities(replace(data, served=served, residuals=residuals), alternative)["served"] >= SURE
