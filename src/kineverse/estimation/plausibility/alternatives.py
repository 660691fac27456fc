"""Comparison of the served joint with its alternatives.

As in :mod:`kineverse.estimation.identification.evidence`, joint values are drawn from a Gaussian of unknown
mean and width, here cut off at the limits: so a door that only moved a little is not compared with one that
moved all the way. What is identified instead has a mean pose of which nothing is known beforehand; here it is
somewhere within a cube of 2 m and turned in any way, so that both densities have the same unit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from kineverse.errors import KineverseError
from kineverse.estimation.identification.kinematic_graph.pairwise import (
    LOG_ANYWHERE,
    FamilyChoice,
    identify_observations,
)
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.identification.outlier_rejection import RowIndices, is_inlier
from kineverse.estimation.identification.result import SURE, IdentificationResult
from kineverse.estimation.linear_algebra import invert_matrices, multiply_vectors, sum_log_determinants
from kineverse.estimation.robust import Outliers
from kineverse.lie import Stack
from kineverse.model.model import Model
from kineverse.model.operation import Operation

from .known_motion import KnownJoint
from .known_residuals import SIZES, KnownResiduals, compute_residuals
from .replacement import build_replacement, extend_fit, follows_another
from .report import JointVerdict
from .testability import TestableJoint


def reject_outliers(left: KnownResiduals, outliers: Outliers | None) -> RowIndices:
    """Return the numbers of the observations that are right if the articulation is as served."""
    everything = np.arange(len(left))
    if outliers is None or not len(left):
        return everything
    squares = np.sum(left.normal**2, axis=1)
    if left.against.size:
        squares = squares + np.fmax(left.against, 0.0).max(axis=1) ** 2
    log_scale = left.log_scale + 0.5 * np.linalg.slogdet(2.0 * np.pi * left.covariances)[1]
    right = everything[is_inlier(squares, log_scale, outliers)]
    # More than chance makes of their fraction are no outliers, but something that is not understood.
    expected = outliers.fraction * len(left)
    usual = len(left) - len(right) <= expected + 2.0 * math.sqrt(expected)
    return right if usual else everything


_WIDTHS = np.geomspace(1e-5, 10.0, 43)
_STILL = np.array([1e-9])
_erf = np.vectorize(math.erf, otypes=[np.float64])


def log_evidence(served: KnownJoint, seen: KnownResiduals, still: bool = False) -> float:
    """Return the logarithm of the density of the observed relative poses, with joint values integrated out.

    Limits cut off what is drawn only where there is one joint value. What is beyond those of several, or
    beyond ties, is less probable by its distance.

    Parameters
    ----------
    served, seen
        The articulation and what it leaves unexplained.
    still
        Whether it is taken as not moving, somewhere within its limits.
    """
    log = -float(np.sum(0.5 * np.sum(seen.normal**2, axis=1) + seen.log_scale))
    log -= 0.5 * float(np.nansum(np.maximum(seen.tied, 0.0) ** 2))
    # What others say of a coordinate differs by 1 on average if the model is right.
    told = np.isfinite(seen.apart)
    log -= 0.5 * float(np.maximum(np.nansum(seen.apart**2, axis=0) - told.sum(axis=0), 0.0).sum())
    widths = _STILL if still else _WIDTHS
    if served.joints == 1:
        lower, upper = float(served.lower[0]), float(served.upper[0])
        density = float(_log_density(served)[0])
        values, variances = seen.values[:, 0], seen.covariances[:, 0, 0]
        return log + _log_mean(_log_evidence_by_width(values, variances, lower, upper, widths, density))
    # Of several joint values the prior is not cut off, but the nearest that is inside the limits counts.
    log -= 0.5 * float(np.sum(np.maximum(seen.beyond, 0.0) ** 2))
    return log + (_several(served, seen, widths) if served.joints else 0.0)


def log_displacement_gain(seen: KnownResiduals) -> float:
    """Return by how much the density is larger if the articulation, or the child on it, sits elsewhere.

    With ρ = G δ + noise and δ ~ N(0, s² I), where it sits integrated out, on average over some sizes s. As a
    logarithm.
    """
    transposed = np.swapaxes(seen.by_place, 1, 2)
    information = np.sum(transposed @ seen.by_place, axis=0)
    pull = np.sum(transposed @ seen.normal[:, :, None], axis=0)[:, 0]
    logs = []
    for size in SIZES:
        total = information + np.eye(len(pull)) / size**2
        log_volume = np.linalg.slogdet(size**2 * total)[1]
        logs.append(0.5 * (pull @ np.linalg.solve(total, pull) - log_volume))
    return _log_mean(np.array(logs))


def _several(served: KnownJoint, seen: KnownResiduals, widths: Stack) -> float:
    """Return log ∫ Π_k ∫ N(â_k; a, C_k) p(a; μ, s) da dμ at the best widths s, on average."""
    best, log = np.zeros(served.joints), 0.0
    for j in range(served.joints):
        variances = seen.covariances[:, j, j]
        logs = _log_evidence_by_width(seen.values[:, j], variances, -math.inf, math.inf, widths, 0.0)
        best[j] = widths[int(np.argmax(logs))]
        log += _log_mean(logs - float(np.max(logs)))
    total = seen.covariances + np.diag(best**2)
    weights = invert_matrices(total)
    information = weights.sum(axis=0)
    mean = np.linalg.solve(information, multiply_vectors(weights, seen.values).sum(axis=0))
    off = seen.values - mean
    log -= 0.5 * (
        float(np.sum(off * multiply_vectors(weights, off))) + sum_log_determinants(math.tau * total)
    )
    volume = 0.5 * sum_log_determinants(math.tau * invert_matrices(information)[None])
    return log + min(volume + float(_log_density(served).sum()), 0.0)


def _log_density(served: KnownJoint) -> Stack:
    """Return the logarithm of the density of the mean of each joint value: anywhere within its limits."""
    width = served.upper - served.lower
    free = np.where(served.turning, 2.0 * math.pi, 20.0)
    density: Stack = -np.log(np.where(np.isfinite(width), np.maximum(width, 1e-6), free))
    return density


def _log_mean(logs: Stack) -> float:
    return float(np.logaddexp.reduce(logs)) - math.log(len(logs))


def _log_evidence_by_width(
    values: Stack, variances: Stack, lower: float, upper: float, widths: Stack, density: float
) -> Stack:
    """Return log ∫ dμ p(μ) Π_k ∫ N(â_k; a, C_k) p(a; μ, s) da for each width s."""
    s2 = widths[:, None] ** 2
    total = variances + s2
    weights = 1.0 / total
    sums = weights.sum(axis=1)
    mean = np.clip((weights @ values) / sums, lower, upper)
    off = values - mean[:, None]
    logs: Stack = -0.5 * np.sum(np.log(2.0 * math.pi * total) + off**2 * weights, axis=1)
    logs += np.minimum(0.5 * np.log(2.0 * math.pi / sums) + density, 0.0)
    if math.isfinite(lower) or math.isfinite(upper):
        spread = np.sqrt(variances * s2 * weights)
        place = (values * s2 + mean[:, None] * variances) * weights
        logs += np.sum(_log_mass(place, spread, lower, upper), axis=1)
        logs -= len(values) * _log_mass(mean, widths, lower, upper)
    return logs


def _log_mass(mean: Stack, deviation: Stack, lower: float, upper: float) -> Stack:
    """Return the logarithm of the part of a Gaussian that is inside limits."""
    scale = math.sqrt(2.0) * deviation
    mass = 0.5 * (_erf((upper - mean) / scale) - _erf((lower - mean) / scale))
    result: Stack = np.log(np.maximum(mass, 1e-300))
    return result


BELIEFS: Mapping[str, float] = MappingProxyType(
    {"served": 0.8, "elsewhere": 0.05, "rigid": 0.1, "other": 0.05}
)
"""How probable it is beforehand that an articulation is as served, that it or what is on it sits a bit
elsewhere, that it does not move, or that it is something else."""

# Fewer observations do not show how something moves.
_ENOUGH = 5


@dataclass(frozen=True)
class JointObservations:
    """A link and how it was seen.

    Attributes
    ----------
    observations
        Of both frames.
    misfit
        What of them the articulation does not explain.
    times
        The numbers of the observations, (N,).
    """

    link: TestableJoint
    served: KnownJoint
    observations: Observations
    misfit: KnownResiduals
    times: npt.NDArray[np.int_]

    def at(self, rows: slice | npt.NDArray[np.int_]) -> JointObservations:
        """Return some of the times at which it was seen."""
        return JointObservations(
            self.link, self.served, self.observations.select(rows), self.misfit.at(rows), self.times[rows]
        )


def judge_joint(
    model: Model,
    seen: JointObservations,
    stopped: int | None,
    families: FamilyChoice,
    outliers: Outliers | None,
) -> JointVerdict:
    """Return the rating of an articulation, given since when it does not explain what is seen."""
    if stopped is None:
        since = seen
        right = reject_outliers(seen.misfit, outliers)
    else:
        since = seen.at(slice(int(np.searchsorted(seen.times, stopped)), None))
        right = np.arange(len(since.times))
        if outliers is not None and len(right) >= 2:
            right = identify_observations(since.observations, families, outliers).best.inliers
    good = since.at(right)
    instead = identify_observations(good.observations, families) if len(right) >= 2 else None
    probabilities = _probabilities(good, instead)
    operation, reason = None, ""
    if stopped is not None:
        operation, reason = _propose_replacement(model, seen, good, instead)
    else:
        reason = _doubt(probabilities, len(right))
    squares = np.mean(good.misfit.residuals**2, axis=0)
    rms = math.sqrt(float(squares[:3].sum())), math.sqrt(float(squares[3:].sum()))
    wrong = tuple(np.setdiff1d(since.times, good.times).tolist())
    return JointVerdict(
        seen.link, probabilities, rms, len(seen.times), stopped, instead, operation, reason, wrong
    )


def _probabilities(seen: JointObservations, instead: IdentificationResult | None) -> dict[str, float]:
    served, left = seen.served, seen.misfit
    as_served = log_evidence(served, left)
    logs = {
        "served": math.log(BELIEFS["served"]) + as_served,
        "elsewhere": math.log(BELIEFS["elsewhere"]) + as_served + log_displacement_gain(left),
        "rigid": -math.inf,
    }
    if served.joints:
        logs["rigid"] = math.log(BELIEFS["rigid"]) + log_evidence(served, left, still=True)
    # A family's probability is its evidence times its belief beforehand, up to what is common to all.
    for fit in instead or ():
        if fit.probability > 0.0 and instead is not None:
            odds = math.log(BELIEFS["other"]) + math.log(fit.probability / instead.best.probability)
            log = odds + instead.best.log_evidence + LOG_ANYWHERE
            logs[fit.family] = float(np.logaddexp(logs.get(fit.family, -math.inf), log))
    total = float(np.logaddexp.reduce(list(logs.values())))
    return {"free": 0.0, **{name: math.exp(log - total) for name, log in logs.items()}}


def _doubt(probabilities: Mapping[str, float], count: int) -> str:
    """Return what speaks against an articulation that explains what is seen."""
    if probabilities["served"] >= SURE:
        return ""
    if count < _ENOUGH:
        return f"both were seen {count} time{'s' if count > 1 else ''} only"
    other = max((name for name in probabilities if name != "served"), key=lambda name: probabilities[name])
    if other == "elsewhere":
        return "it may sit a bit elsewhere as well"
    return "it hardly moved" if other == "rigid" else f"it may be {other} as well"


def _propose_replacement(
    model: Model, seen: JointObservations, since: JointObservations, instead: IdentificationResult | None
) -> tuple[Operation | None, str]:
    if instead is None or len(since.times) < _ENOUGH:
        return None, "it was seen too seldom since to say what it is instead"
    if not instead.best.is_determined:
        return None, f"what it is instead is not known yet, {instead}"
    if not follows_another(model, seen.link) and _stands_alone(model, since, instead):
        # Another joint in its place would not help.
        return None, "by itself it explains what is seen, but not together with what limits or moves it"
    try:
        used = np.searchsorted(seen.times, since.times)
        rows, fit = extend_fit(instead.best, seen.observations, used)
        coordinates = seen.served.beyond_limits(seen.observations, seen.misfit.coordinates)[rows]
        operation = build_replacement(
            model, seen.link, seen.served, coordinates, seen.misfit.others[rows], fit
        )
    except KineverseError as error:
        return None, f"what it is instead is no operation. {error}"
    try:
        with model.copy().edit() as edit:
            edit.replace(seen.link.tag, operation)
    except KineverseError as error:
        return None, f"what it is instead cannot take its place. {error}"
    return operation, ""


def _stands_alone(model: Model, seen: JointObservations, instead: IdentificationResult) -> bool:
    """Whether an articulation explains what is seen without its ties to others, and with loops opened."""
    if not (seen.misfit.tied.size or seen.misfit.apart.size):
        return False
    served = KnownJoint(model, seen.link.child, seen.link.parent, opened=True)
    left = compute_residuals(served, seen.observations)
    alone = _probabilities(JointObservations(seen.link, served, seen.observations, left, seen.times), instead)
    return alone["served"] >= SURE
