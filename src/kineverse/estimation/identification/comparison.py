"""Comparison of joint families by their evidence."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from kineverse.estimation.robust import Outliers
from kineverse.lie import Array

from .custom_family import Family, family_starts
from .gauge import fix_gauge
from .goodness_of_fit import measure_fit
from .initial_guess import MotionStatistics, initial_guesses
from .maximum_likelihood import Scored
from .observations import Observations
from .optimise import InitialGuess
from .outlier_rejection import RowIndices, find_inliers, log_inlier_prior
from .projection import complete_fit
from .result import Fit, IdentificationResult, LazyFit, build_fit
from .scale import convert_to_metres, convert_to_unit, length_scale, log_density
from .solver import solver
from .unwrapping import log_unwrapping_gain, unwrap_screw, unwrap_solution

# A family is not refined if its log evidence is below that of the best by more than a constant and a term for
# each observation. With noise that is large beside the motion, the unrefined evidence is this inaccurate.
_NEGLIGIBLE, _NEGLIGIBLE_EACH = 15.0, 0.5
# Candidate scales of the unknown noise, and the standard deviation of their log-normal prior: a factor of 5.
_SCALES = np.geomspace(0.01, 100.0, 33)
_SCALE_SPREAD = math.log(5.0)


@dataclass(frozen=True)
class IdentificationData:
    """Observations and the assumptions under which families are compared.

    Attributes
    ----------
    observations
        The observations, with lengths in the unit.
    unit
        The length scale [m], see :mod:`.scale`.
    stated
        True if the size of the noise is known.
    outliers
        Outlier model, with lengths in the unit; None if all observations are inliers.
    sequential
        True if the observations are in temporal order.
    noise_factor
        Factor by which standard deviations are larger than those that were stated and refuted.
    """

    observations: Observations
    unit: float
    stated: bool
    outliers: Outliers | None
    sequential: bool
    noise_factor: float = 1.0


@dataclass(frozen=True)
class FamilySolution:
    """Solution of a family by its inliers.

    Attributes
    ----------
    scored
        The solution and the logarithm of its evidence.
    inliers
        Indices of the inliers.
    count
        Number of all observations.
    log_prior
        Sum of the log probability of these inliers, the log density of the outliers, and the gain by counted
        revolutions. It is added to the log evidence.
    """

    scored: Scored
    inliers: RowIndices
    count: int
    log_prior: float


def prepare_data(
    observations: Observations,
    stated: bool,
    outliers: Outliers | None,
    sequential: bool,
    unit: float | None = None,
) -> IdentificationData:
    """Return observations in a unit of length [m], by default their own length scale."""
    unit = length_scale(observations) if unit is None else unit
    if outliers is not None and outliers != Outliers():
        outliers = replace(outliers, reach=outliers.reach / unit)
    return IdentificationData(convert_to_unit(observations, unit), unit, stated, outliers, sequential)


def solve_with_inliers(
    data: IdentificationData, weights: Mapping[str | Family, float]
) -> dict[str | Family, FamilySolution]:
    """Return the solution of each family by its inliers."""
    observations, unit, count = data.observations, data.unit, len(data.observations)
    solutions = solve_families(observations, weights, unit)
    inliers = dict.fromkeys(solutions, np.arange(count))
    if data.outliers is not None:

        def solve(some: Observations, name: str | Family) -> Scored:
            return solve_families(some, [name], unit)[name]

        inliers = find_inliers(observations, solutions, data.outliers, data.stated, solve)
        some = {name: rows for name, rows in inliers.items() if len(rows) < count}
        solutions |= {name: solve(observations.select(rows), name) for name, rows in some.items()}
    if data.sequential:
        solutions = {
            name: _unwrap(observations.select(inliers[name]), scored) for name, scored in solutions.items()
        }
    return score_solutions(data, solutions, inliers, weights)


def score_solutions(
    data: IdentificationData,
    solutions: Mapping[str | Family, Scored],
    inliers: Mapping[str | Family, RowIndices],
    weights: Mapping[str | Family, float],
) -> dict[str | Family, FamilySolution]:
    """Return the solutions of families, scored against each other, from solutions of their inliers."""
    observations, outliers, count = data.observations, data.outliers, len(data.observations)
    observations_of = {
        name: observations if len(rows) == count else observations.select(rows)
        for name, rows in inliers.items()
    }
    log_priors = dict.fromkeys(solutions, 0.0)
    if outliers is not None:
        log_priors = {
            name: log_inlier_prior(outliers, count, len(some), observations.rows)
            for name, some in observations_of.items()
        }
    if data.sequential:
        log_priors = {
            name: log_priors[name] + log_unwrapping_gain(scored.solution)
            for name, scored in solutions.items()
        }
    compared = compare_families(
        observations_of, solutions, {name: math.log(weights[name]) + log_priors[name] for name in solutions}
    )
    return {
        name: FamilySolution(one, inliers[name], count, log_priors[name]) for name, one in compared.items()
    }


def _unwrap(observations: Observations, scored: Scored) -> Scored:
    """Return the solution; a screw is solved again with the revolutions of the observations."""
    start = unwrap_screw(observations, scored.solution)
    return scored if start is None else solver.maximum_likelihood(observations, [start])


def solve_families(
    observations: Observations, families: Iterable[str | Family], unit: float = 1.0
) -> dict[str | Family, Scored]:
    """Return the most likely member of each family, for observations in a unit of length [m]."""
    solver.prepare()
    statistics = MotionStatistics(observations)
    return {
        name: solver.maximum_likelihood(observations, _starts(observations, name, statistics, unit))
        for name in families
    }


def _starts(
    observations: Observations, family: str | Family, statistics: MotionStatistics, unit: float
) -> list[InitialGuess]:
    if isinstance(family, Family):
        return [InitialGuess(motion, values) for motion, values in family_starts(family, observations, unit)]
    return list(initial_guesses(family, statistics))


def compare_families(
    observations: Mapping[str | Family, Observations],
    solutions: Mapping[str | Family, Scored],
    log_priors: Mapping[str | Family, float],
) -> dict[str | Family, Scored]:
    """Return the solutions, those of competitive families with their joint values integrated out.

    Each family has its own observations and a log prior.
    """
    logs = {name: scored.log_evidence + log_priors[name] for name, scored in solutions.items()}
    threshold = (
        max(logs.values()) - _NEGLIGIBLE - _NEGLIGIBLE_EACH * max(len(some) for some in observations.values())
    )
    rough = [name for name, scored in solutions.items() if logs[name] >= threshold and _is_rough(scored)]
    return {
        **solutions,
        **{
            name: solver.maximise_marginal_likelihood(observations[name], solutions[name].solution)
            for name in rough
        },
    }


def _is_rough(scored: Scored) -> bool:
    """Return True if there are joint values that are not integrated out yet."""
    solution = scored.solution
    return bool(solution.motion.joints and solution.motion.size) and not solution.joint_prior.marginal


def weigh_families(
    data: IdentificationData,
    solutions: Mapping[str | Family, FamilySolution],
    weights: Mapping[str | Family, float],
) -> IdentificationResult:
    """Return the fits of all families with their posterior probabilities."""
    log_priors = {name: math.log(weights[name]) + one.log_prior for name, one in solutions.items()}
    if data.stated:
        logs = {name: one.scored.log_evidence for name, one in solutions.items()}
        scale = 1.0
    else:
        spread = -0.5 * (np.log(_SCALES) / _SCALE_SPREAD) ** 2
        spread -= np.logaddexp.reduce(spread)
        joint = {
            name: spread + solver.log_evidences(one.scored.solution, _SCALES)
            for name, one in solutions.items()
        }
        logs = {name: float(np.logaddexp.reduce(j)) for name, j in joint.items()}
        best = max(logs, key=lambda name: logs[name] + log_priors[name])
        scale = float(_SCALES[int(np.argmax(joint[best]))])
    total: Array = np.array([logs[name] + log_priors[name] for name in solutions])
    probabilities = np.exp(total - np.logaddexp.reduce(total)).tolist()
    lazy_fits = []
    for (name, one), p in zip(solutions.items(), probabilities, strict=True):
        log = logs[name] + one.log_prior + log_density(len(data.observations), data.unit)
        lazy_fits.append(LazyFit(one.scored.solution.motion.name, p, partial(_fit, data, one, scale, log, p)))
    return IdentificationResult(tuple(sorted(lazy_fits, key=lambda lazy_fit: -lazy_fit.probability)), scale)


def _fit(
    data: IdentificationData, one: FamilySolution, scale: float, log_evidence: float, probability: float
) -> Fit:
    solution = fix_gauge(unwrap_solution(one.scored.solution) if data.sequential else one.scored.solution)
    fit = build_fit(solution, solver.evidence(solution, scale), log_evidence, probability)
    goodness = measure_fit(solution, scale**2 * solution.covariance)
    fit = replace(fit, misfit=data.noise_factor * goodness.factor)
    return convert_to_metres(
        complete_fit(fit, data.observations, one.inliers, scale, sequential=data.sequential), data.unit
    )
