"""Comparison of joint families by their evidence."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
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
from .nested_families import bound_log_evidences
from .observations import Observations
from .optimise import InitialGuess
from .outlier_rejection import RowIndices, find_inliers, log_inlier_prior
from .projection import complete_fit
from .result import Fit, IdentificationResult, LazyFit, build_fit
from .scale import convert_to_metres, convert_to_unit, length_scale, log_density
from .solver import solver
from .unknown_noise import (
    STATED_NOISE,
    NoisePosterior,
    NoiseSolution,
    adapt_noise,
    median_factor,
    scale_noise,
    solve_unknown_noise,
    weigh_observations,
)
from .unwrapping import log_unwrapping_gain, unwrap_screw, unwrap_solution

# A family is not refined if its log evidence is below that of the best by more than a constant and a term for
# each observation. With noise that is large beside the motion, the unrefined evidence is this inaccurate.
_NEGLIGIBLE, _NEGLIGIBLE_EACH = 15.0, 0.5
SAME_RATIO = 2.0
"""Factor by which the ratio of an estimated noise may differ from that of a solution that is kept."""


@dataclass(frozen=True)
class IdentificationData:
    """Observations and the assumptions under which families are compared."""

    observations: Observations  # observations, with lengths in the unit
    unit: float  # length scale [m], see scale
    stated: bool  # True if the noise is known. Else the observations have the medians of unknown_noise
    outliers: Outliers | None  # outlier model, with lengths in the unit; None if all observations are inliers
    sequential: bool  # True if the observations are in temporal order
    noise_factor: float = 1.0
    observation_weight: float = 1.0


@dataclass(frozen=True)
class FamilySolution:
    """Solution of a family by its inliers."""

    scored: Scored  # solution and the logarithm of its evidence
    noise: NoisePosterior  # posterior of the noise; STATED_NOISE if it is stated
    inliers: RowIndices  # indices of the inliers
    count: int  # number of all observations
    log_prior: float

    @property
    def log_evidence(self) -> float:
        """Logarithm of the evidence, with an unknown noise integrated out."""
        return self.scored.log_evidence + self.noise.log_weight


def prepare_data(
    observations: Observations,
    stated: bool,
    outliers: Outliers | None,
    sequential: bool,
    unit: float | None = None,
    observation_weight: float = 1.0,
) -> IdentificationData:
    """Return observations in a unit of length [m], by default their own length scale."""
    unit = length_scale(observations) if unit is None else unit
    if outliers is not None and outliers != Outliers():
        outliers = replace(outliers, reach=outliers.reach / unit)
    scaled = convert_to_unit(observations, unit)
    if not stated:
        scaled = scale_noise(scaled, np.array([median_factor(unit), 1.0]))
    return IdentificationData(
        scaled, unit, stated, outliers, sequential, observation_weight=observation_weight
    )


def solve_with_inliers(
    data: IdentificationData, weights: Mapping[str | Family, float]
) -> dict[str | Family, FamilySolution]:
    """Return the solution of each family by its inliers."""
    everything = np.arange(len(data.observations))
    inliers: Mapping[str | Family, RowIndices] = dict.fromkeys(weights, everything)
    if data.outliers is not None:
        inliers = _classify(data, weights, data.observations)
    solutions = _solve_inliers(data, inliers)
    if data.outliers is not None and not data.stated:
        # Where the noise is of another ratio, other observations are outliers.
        best = max(solutions, key=lambda name: solutions[name].log_evidence + math.log(weights[name]))
        factors = solutions[best].noise.factors
        if not 1.0 / SAME_RATIO < factors[0] / factors[1] < SAME_RATIO:
            inliers = _classify(data, weights, scale_noise(data.observations, factors))
            solutions = _solve_inliers(data, inliers)
    return score_solutions(data, solutions, inliers, weights)


def _classify(
    data: IdentificationData, families: Iterable[str | Family], observations: Observations
) -> dict[str | Family, RowIndices]:
    """Return the indices of the inliers under each family, for observations with some noise."""
    assert data.outliers is not None  # else there is nothing to classify

    def solve(some: Observations, name: str | Family) -> Scored:
        return solve_families(some, [name], data.unit)[name]

    solutions = solve_families(observations, families, data.unit)
    return find_inliers(observations, solutions, data.outliers, data.stated, solve)


def _solve_inliers(
    data: IdentificationData, inliers: Mapping[str | Family, RowIndices]
) -> dict[str | Family, NoiseSolution]:
    """Return the most likely member of each family by its inliers, at the most probable noise."""
    found: dict[str | Family, NoiseSolution] = {}
    for rows in {rows.tobytes(): rows for rows in inliers.values()}.values():
        observations = data.observations.select(rows)
        names = [name for name, own in inliers.items() if np.array_equal(own, rows)]
        found |= _solve_noise(data, observations, names)
    return {name: found[name] for name in inliers}


def _solve_noise(
    data: IdentificationData, observations: Observations, families: Iterable[str | Family]
) -> dict[str | Family, NoiseSolution]:
    statistics = MotionStatistics(observations)

    def solve(name: str | Family, some: Observations) -> Scored:
        scored = solver.maximum_likelihood(some, _starts(some, name, statistics, data.unit))
        return _unwrap(some, scored) if data.sequential else scored

    solver.prepare()
    if data.stated:
        return {name: NoiseSolution(solve(name, observations), STATED_NOISE) for name in families}
    return {name: solve_unknown_noise(observations, partial(solve, name)) for name in families}


def score_solutions(
    data: IdentificationData,
    solutions: Mapping[str | Family, NoiseSolution],
    inliers: Mapping[str | Family, RowIndices],
    weights: Mapping[str | Family, float],
    renew: bool = True,
) -> dict[str | Family, FamilySolution]:
    """Return the solutions of families, scored against each other, from solutions of their inliers.

    An unknown noise is estimated again if ``renew``.
    """
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
            name: log_priors[name] + log_unwrapping_gain(one.scored.solution)
            for name, one in solutions.items()
        }
    refine = adapt_noise if renew and not data.stated else _integrate_joint_values
    # The threshold is on evidence in which each observation has its weight.
    logs = {name: math.log(weights[name]) / data.observation_weight + log_priors[name] for name in solutions}
    compared = compare_families(observations_of, solutions, logs, refine, data.observation_weight)
    return {
        name: FamilySolution(*one, inliers[name], count, log_priors[name]) for name, one in compared.items()
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
    solutions: Mapping[str | Family, NoiseSolution],
    log_priors: Mapping[str | Family, float],
    refine: Callable[[Observations, NoiseSolution], NoiseSolution],
    observation_weight: float = 1.0,
) -> dict[str | Family, NoiseSolution]:
    """Return the solutions, those of competitive families refined.

    Each family has its own observations and a log prior.
    """
    logs = {name: one.log_evidence + log_priors[name] for name, one in solutions.items()}
    threshold = (
        max(logs.values())
        - _NEGLIGIBLE / observation_weight
        - _NEGLIGIBLE_EACH * max(len(some) for some in observations.values())
    )
    return {
        name: refine(observations[name], one) if logs[name] >= threshold else one
        for name, one in solutions.items()
    }


def _integrate_joint_values(observations: Observations, one: NoiseSolution) -> NoiseSolution:
    """Return the solution with its joint values integrated out; as it is, if they are."""
    solution = one.scored.solution
    if solution.joint_prior.marginal or not (solution.motion.joints and solution.motion.size):
        return one
    observations = scale_noise(observations, one.noise.factors)
    return one._replace(scored=solver.maximise_marginal_likelihood(observations, solution))


def weigh_families(
    data: IdentificationData,
    solutions: Mapping[str | Family, FamilySolution],
    weights: Mapping[str | Family, float],
) -> IdentificationResult:
    """Return the fits of all families with their posterior probabilities."""
    solutions = {name: _weigh_observations(data, one) for name, one in solutions.items()}
    logs = bound_log_evidences(
        {name: one.log_evidence + one.log_prior for name, one in solutions.items()},
        {name: one.scored.solution for name, one in solutions.items()},
    )
    total: Array = np.array([logs[name] + math.log(weights[name]) for name in solutions])
    probabilities = np.exp(total - np.logaddexp.reduce(total)).tolist()
    lazy_fits = [
        LazyFit(one.scored.solution.motion.name, p, partial(_fit, data, one, logs[name], p))
        for (name, one), p in zip(solutions.items(), probabilities, strict=True)
    ]
    best = list(solutions.values())[int(np.argmax(total))]
    return IdentificationResult(
        tuple(sorted(lazy_fits, key=lambda lazy_fit: -lazy_fit.probability)), best.noise.deviations(data.unit)
    )


def _weigh_observations(data: IdentificationData, one: FamilySolution) -> FamilySolution:
    """Return a solution in which each observation has its weight."""
    if data.observation_weight == 1.0:
        return one
    observations = data.observations.select(one.inliers)
    scored, noise = weigh_observations(
        observations, NoiseSolution(one.scored, one.noise), data.observation_weight
    )
    return replace(one, scored=scored, noise=noise, log_prior=data.observation_weight * one.log_prior)


def _fit(data: IdentificationData, one: FamilySolution, log_evidence: float, probability: float) -> Fit:
    solution = fix_gauge(unwrap_solution(one.scored.solution) if data.sequential else one.scored.solution)
    weight = data.observation_weight
    log_evidence += log_density(weight * len(data.observations), data.unit)
    fit = build_fit(solution, solver.evidence(solution, weight), log_evidence, probability)
    fit = replace(fit, misfit=data.noise_factor * measure_fit(solution).factor)
    observations = scale_noise(data.observations, one.noise.factors)
    fit = complete_fit(fit, observations, one.inliers, sequential=data.sequential)
    if data.outliers is not None and fit.motion.joints == fit.rows:
        fit = replace(fit, is_determined=False, reason="outliers alone would look the same")
    return convert_to_metres(fit, data.unit)
