"""Check of the most probable family: curves that are no joint, and residuals that refute the noise.

The comparison of families assumes that one of them is right and that the noise is as stated. This module
tests both. A one-coordinate curve is a family, too. As it takes long to fit, it is fitted only if the best
family has several joint values, which may lie on one curve, or leaves residuals that the noise does not
explain.

**Stated noise.** If χ² of the best family refutes the noise, all families are compared again at the most
probable larger size. If the best family has several joint values or is a curve, it may only have won because
the noise is stated too small. So families are also compared for a noise of up to three times that size.

**Unknown noise.** Residuals that vary slowly along the joint value show a joint of the wrong kind.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.lie import Array

from .curve import CURVE, FEWEST_POSES, continue_curve, fit_curve, may_be_curve
from .families import FamilyMotion
from .least_squares import Solution
from .marginal_likelihood import laplace_evidence
from .model_selection import (
    FamilyName,
    FamilySolution,
    FamilySolutions,
    FamilyWeights,
    IdentificationData,
    measure_fit,
    solve_families,
    solve_with_inliers,
    weigh_families,
)
from .motion_functions import FamilyMember
from .noise_estimation import (
    STATED_NOISE,
    NoisePosterior,
    NoiseSolution,
    adapt_noise,
    estimate_noise,
    scale_noise,
)
from .observations import Observations
from .outlier_rejection import RowIndices, classify_inliers, densest_half, log_inlier_prior
from .result import SURE, Fit, IdentificationResult, LazyFit, project_observations
from .solver import solver

REFUTED = 1e-3  # largest probability of χ² at which the noise is refuted

CALIBRATED = 1.2
"""Largest size of the residuals relative to the stated noise that is no misfit, however many they are."""

# Probability of χ² at a stated noise, and of slow residuals, at which a curve is tried.
_DOUBTFUL, _SLOW = 5e-3, 5e-3
# Sizes of the noise relative to the stated one, of a noise that is refuted and of one that is not, and the
# standard deviation of the prior of their logarithms.
_REFUTED_SCALES, _DOUBTED_SCALES = np.geomspace(1.0, 100.0, 41), np.geomspace(1.0, 3.0, 9)
_SCALE_SPREAD = math.log(1.6)
# Size of a simple joint's residuals relative to those of a curve up to which correlated errors may explain
# them.
_CORRELATED = 2.0
# Largest distance between neighbours along a curve, relative to its length, across which it is known.
_GAP = 0.3
# Least probability of χ² of a curve, or its largest size of residuals relative to those of the best family,
# and least probability of the curve, at which the joint values of that family are said to lie on a curve.
_FITTING, _FITTING_FACTOR, _COMPETITIVE = 1e-3, 1.3, 1e-6
# Probability of slow residuals, and their share in χ², that refute a joint of unknown noise.
_SYSTEMATIC, _SYSTEMATIC_SHARE = 1e-3, 0.7
# Sizes of an unknown noise relative to its medians above which it may be motion: of one under a frequent
# family, and of one under a rare family or of both.
_LARGE, _STRANGE = 10.0, 4.0
_ROUNDS = 3  # largest number of classifications of outliers


def weigh_and_check(
    data: IdentificationData,
    solutions: FamilySolutions,
    weights: FamilyWeights,
    update: Callable[[], FamilySolutions] | None = None,
) -> IdentificationResult:
    """Return the fits of all families, with the reason if the best is not sure.

    If it is doubtful, solutions that are not up to date are replaced by those of ``update``.
    """
    result = weigh_families(data, solutions, weights) if solutions else None
    is_sure = result is not None and not is_doubtful(data, result, solutions)
    if not is_sure and update is not None:
        return weigh_and_check(data, update(), weights)
    if CURVE in weights and not is_sure:
        curve = solve_curve(data, solutions)
        if curve is not None and not _is_explained(curve, solutions):
            solutions = {**solutions, CURVE: curve}
            result = weigh_families(data, solutions, weights)
    if result is None:
        raise InvalidValueError(
            f"A curve takes at least {FEWEST_POSES} poses that are not equal, and there are "
            f"{len(data.observations)}. Give more poses or other families."
        )
    reason = ""
    if not is_sure and data.stated:
        name = _best_name(result, solutions)
        solution = solutions[name].scored.solution
        fit = measure_fit(solution, observation_weight=data.observation_weight)
        compare = partial(_compare_refuted, data, solutions, weights)
        if fit.p_value < REFUTED and fit.factor > CALIBRATED:
            factor = _best_scale(data, solutions, weights, _REFUTED_SCALES)[1]
            return compare(factor, "none of these joints")
        if solution.motion.joints > 1 or name == CURVE:
            other, factor, logs = _best_scale(data, solutions, weights, _DOUBTED_SCALES)
            if other != name and factor > CALIBRATED:
                if logs[other] - logs[name] > math.log(SURE / (1.0 - SURE)):
                    return compare(factor, solution.motion.name)
                family = solutions[other].scored.solution.motion.name
                reason = f"with {factor:.1f} times the stated noise it would be {family}"
    result = replace(result, reason=reason or next(_reasons(data, result, solutions, weights), ""))
    if CURVE not in result.probabilities and CURVE in weights and may_be_curve(data.observations):
        later = LazyFit(CURVE, 0.0, partial(fit_of_curve, data, solutions, weights))
        result = replace(result, lazy_fits=(*result.lazy_fits, later))
    return result


def without_curve(weights: FamilyWeights) -> dict[FamilyName, float]:
    """Return the families that are solved in any case."""
    return {name: weight for name, weight in weights.items() if name != CURVE}


def solve_joints(data: IdentificationData, weights: FamilyWeights) -> FamilySolutions:
    """Return the solutions of all families but the curve."""
    joints = without_curve(weights)
    return solve_with_inliers(data, joints) if joints else {}


def solve_curve(data: IdentificationData, solutions: FamilySolutions) -> FamilySolution | None:
    """Return the most probable curve by its inliers; None if there are too few for one, or equal."""
    observations, count = data.observations, len(data.observations)
    everything = np.arange(count)

    def solve(rows: RowIndices) -> NoiseSolution | None:
        some = observations if len(rows) == count else observations.select(rows)
        if not may_be_curve(some):
            return None
        others = [one.scored.solution for one in solutions.values() if np.array_equal(one.inliers, rows)]
        orders = [other.values[:, 0] for other in others if other.motion.joints == 1]
        return _fit_to_noise(data, some, orders)

    solution = solve(everything)
    if solution is None:
        return None
    best = FamilySolution(*solution, everything, count, 0.0)
    if data.outliers is None:
        return best
    best = replace(best, log_prior=log_inlier_prior(data.outliers, count, count, observations.rows))
    # A curve may pass through outliers that other families leave out.
    some = [one for one in solutions.values() if len(one.inliers) < count]
    if len(_classify(data, solution)) == count and not some:
        return best
    some.sort(key=lambda one: -one.log_evidence - one.log_prior)
    for rows in (*(one.inliers for one in some[:1]), densest_half(observations)):
        for _ in range(_ROUNDS):
            solution = solve(rows)
            if solution is None:
                break
            rows, used = _classify(data, solution), rows
            if np.array_equal(rows, used):
                break
        if solution is not None and 2 * len(used) > count:
            log_prior = log_inlier_prior(data.outliers, count, len(used), observations.rows)
            other = FamilySolution(*solution, used, count, log_prior)
            best = max(best, other, key=lambda one: one.log_evidence + one.log_prior)
    return best


def _fit_to_noise(
    data: IdentificationData, observations: Observations, orders: Sequence[Array]
) -> NoiseSolution:
    latest: NoisePosterior | None = None

    def log_evidence(solution: Solution[FamilyMember]) -> float:
        nonlocal latest
        if data.stated:
            return laplace_evidence(solution).log_evidence
        estimated = estimate_noise(observations, solution, latest)
        latest = estimated.noise
        return estimated.log_evidence

    free = solve_families(observations, ["free"])["free"].solution
    fitted = fit_curve(observations, free.covariance, orders, log_evidence)
    if data.stated:
        return NoiseSolution(fitted, STATED_NOISE)
    near = estimate_noise(observations, fitted.solution, latest)
    return adapt_noise(observations, near, continue_curve)


def is_doubtful(data: IdentificationData, result: IdentificationResult, solutions: FamilySolutions) -> bool:
    """Return True if a curve or a larger noise may explain the observations better than the best family."""
    solution = solutions[_best_name(result, solutions)].scored.solution
    if solution.motion.joints > 1:
        return True
    fit = measure_fit(solution, observation_weight=data.observation_weight)
    return fit.slow_p_value < _SLOW or (data.stated and fit.p_value < _DOUBTFUL)


def _compare_refuted(
    data: IdentificationData,
    solutions: FamilySolutions,
    weights: FamilyWeights,
    factor: float,
    otherwise: str,
) -> IdentificationResult:
    """Return the comparison at a larger size of the noise than was stated."""
    scaled = scale_noise(data.observations, np.full(2, factor))
    larger = replace(data, observations=scaled, noise_factor=factor)
    again = solve_joints(larger, weights)
    if CURVE in solutions:
        curve = solve_curve(larger, again)
        if curve is not None:
            again[CURVE] = curve
    result = weigh_families(larger, again, weights)
    misfit = factor * measure_fit(again[_best_name(result, again)].scored.solution).factor
    reason = (
        f"residuals are {factor if math.isnan(misfit) else misfit:.1f} times the stated noise: either the "
        f"noise is larger, or this is {otherwise}"
    )
    return replace(result, reason=reason)


def _reasons(
    data: IdentificationData,
    result: IdentificationResult,
    solutions: FamilySolutions,
    weights: FamilyWeights,
) -> Iterator[str]:
    name = _best_name(result, solutions)
    if result.lazy_fits[0].probability < SURE:
        return
    solution = solutions[name].scored.solution
    joints, curve = solution.motion.joints, solutions.get(CURVE)
    yield from _unjustified(data, result, solutions, weights)
    covariance = solution.covariance
    if name == CURVE:
        along = np.sort(solution.values[:, 0])
        if np.diff(along).max() > _GAP * np.ptp(along):
            yield "no pose is in its longest part, so these may be two motions, such as of swapped parts"
        of_curve = measure_fit(solution, covariance.mean(axis=0)).factor
        for one in solutions.values():
            joint = one.scored.solution
            if one is curve or joint.motion.joints > 1:
                continue
            ratio = measure_fit(joint, covariance.mean(axis=0)).factor / of_curve
            if ratio < _CORRELATED or (not data.stated and max(one.noise.factors) < _STRANGE):
                yield (
                    f"residuals of {joint.motion.name} are only {ratio:.1f} times as large, which correlated "
                    "errors would explain"
                    if ratio < _CORRELATED
                    else f"{joint.motion.name} would fit by usual errors: state the noise"
                )
    elif joints > 1 and curve is not None and not isinstance(solution.motion, FamilyMotion):
        fit = measure_fit(curve.scored.solution, covariance.mean(axis=0), data.observation_weight)
        explains = fit.p_value > _FITTING if data.stated else fit.factor < _FITTING_FACTOR
        if explains and result.probabilities[CURVE] > _COMPETITIVE:
            yield "its joint values lie on one curve"
    elif not data.stated and joints == 1 and curve is not None:
        fit = measure_fit(solution, observation_weight=data.observation_weight)
        if fit.slow_p_value < _SYSTEMATIC and fit.slow_share > _SYSTEMATIC_SHARE:
            yield "its residuals depend on the joint value, so this may be none of these joints"


def _unjustified(
    data: IdentificationData,
    result: IdentificationResult,
    solutions: FamilySolutions,
    weights: FamilyWeights,
) -> Iterator[str]:
    """Yield reasons why the best family is probable by its prior or a strange noise, not by the data."""
    name = _best_name(result, solutions)
    motion, (size, turn) = solutions[name].scored.solution.motion, solutions[name].noise.factors
    largest = _LARGE if motion.name in ("rigid", "prismatic", "revolute") else _STRANGE
    if not data.stated and (max(size, turn) > largest or min(size, turn) > _STRANGE):
        yield "the noise would be very large, so it may be a motion: state the noise"
    if data.stated and motion.rows == 6:
        return  # a stated noise and orientations bound the evidence of all families
    # From positions a tilt of the axis may stand for a pitch, so they have to exclude others by themselves.
    odds, rivals = SURE / (1.0 - SURE), result.probabilities.keys() - {motion.name}
    if motion.rows == 6:
        # By an unknown noise a free part may be any joint with large errors.
        odds, rivals = 1.0, rivals & {"screw", "cylindrical", *(() if data.stated else ("free",))}
    prior = {one.scored.solution.motion.name: weights[name] for name, one in solutions.items()}
    evidence = {family: p / prior[family] for family, p in result.probabilities.items()}
    for rival in sorted(rivals, key=evidence.__getitem__, reverse=True)[:1]:
        if evidence[motion.name] < odds * evidence[rival]:
            yield (
                f"{rival} explains the observations as well, and is only rarer; "
                "if it cannot be one, leave it out of the families"
            )


def _is_explained(curve: FamilySolution, solutions: FamilySolutions) -> bool:
    """Return True if a joint with one joint value leaves no more than the noise of a curve.

    Then the curve is that joint, and its evidence is no argument: its smoothness is estimated, so it pays
    less for an axis through the origin than the joint does.
    """
    covariance = curve.scored.solution.covariance.mean(axis=0)
    others = [one.scored.solution for one in solutions.values() if len(one.inliers) >= len(curve.inliers)]
    simple = [one for one in others if one.motion.joints == 1]
    return any(measure_fit(one, covariance).factor < 1.0 for one in simple)


def _best_scale(
    data: IdentificationData, solutions: FamilySolutions, weights: FamilyWeights, scales: Array
) -> tuple[FamilyName, float, dict[FamilyName, float]]:
    """Return the best family for a noise of unknown size, its size, and the log evidences with priors."""
    prior, factors = -0.5 * (np.log(scales) / _SCALE_SPREAD) ** 2, np.column_stack([scales, scales])
    weight, at_scales = data.observation_weight, {}
    for name, one in solutions.items():
        covariance = one.scored.solution.covariance
        parts = np.stack([covariance, 0.0 * covariance])
        at_scales[name] = prior + solver.log_evidences(one.scored.solution, factors, parts, weight)
        at_scales[name] += weight * one.log_prior + math.log(weights[name])
    logs = {name: float(np.logaddexp.reduce(each)) for name, each in at_scales.items()}
    best = max(logs, key=logs.__getitem__)
    return best, float(scales[int(np.argmax(at_scales[best]))]), logs


def _best_name(result: IdentificationResult, solutions: FamilySolutions) -> FamilyName:
    family = result.lazy_fits[0].family
    return next(name for name, one in solutions.items() if one.scored.solution.motion.name == family)


def _classify(data: IdentificationData, one: NoiseSolution) -> RowIndices:
    assert data.outliers is not None
    solution = one.scored.solution
    observations = scale_noise(data.observations, one.noise.factors)
    projected = project_observations(solution.motion, solution.values, observations)
    freedom = observations.rows - 1
    known = projected.residuals, projected.covariance, data.outliers, data.stated, freedom
    return np.flatnonzero(classify_inliers(*known))


def fit_of_curve(data: IdentificationData, solutions: FamilySolutions, weights: FamilyWeights) -> Fit:
    """Return the fit of a curve that is not probable."""
    curve = solve_curve(data, solutions)
    assert curve is not None  # there are enough observations
    return replace(weigh_families(data, {CURVE: curve}, weights).best, probability=0.0)
