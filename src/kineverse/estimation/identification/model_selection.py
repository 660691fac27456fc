"""Selection of a joint family: evidence, its bounds for nested families, and goodness of fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from kineverse.estimation.linear_algebra import invert_matrices, multiply_vectors
from kineverse.estimation.noise import Outliers
from kineverse.lie import Array

from .families import REACH, Family, GroupMotion, family_starts
from .initial_guess import MotionStatistics, initial_guesses
from .joint_values import LITTLE, log_unwrapping_gain, unwrap_screw, unwrap_solution
from .least_squares import InitialGuess, Solution
from .marginal_likelihood import Scored
from .motion_model import FamilyMember
from .noise_estimation import (
    STATED_NOISE,
    NoisePosterior,
    NoiseSolution,
    adapt_noise,
    median_factor,
    scale_noise,
    solve_unknown_noise,
    weigh_observations,
)
from .normalisation import convert_to_metres, convert_to_unit, fix_gauge, length_scale, log_density
from .observations import Observations
from .outlier_rejection import RowIndices, find_inliers, log_inlier_prior
from .result import Fit, IdentificationResult, LazyFit, build_fit, complete_fit
from .solver import solver

# Number of slow cosines along a joint value: at most, and relative to the number of observations.
_COSINES, _DENSITY = 6, 0.25
# Size of residuals relative to the noise below which they are rounding errors.
_EXACT = 0.1


@dataclass(frozen=True)
class GoodnessOfFit:
    """Residuals of a family against the noise."""

    factor: float  # size of the residuals relative to the noise; NaN if the family leaves none
    p_value: float  # probability of a χ² at least as large if family and noise are right
    slow_p_value: float = 1.0
    slow_share: float = 0.0  # share of these slow residuals in χ²


def measure_fit(
    solution: Solution[FamilyMember], covariance: Array | None = None, observation_weight: float = 1.0
) -> GoodnessOfFit:
    """Return the goodness of fit of a solution."""
    motion, by_joints = solution.motion, solution.linear.by_joints
    weights = invert_matrices(solution.covariance if covariance is None else covariance)
    weights = np.broadcast_to(weights, solution.covariance.shape)
    weighted = np.swapaxes(by_joints, 1, 2) @ weights
    curvature = weighted @ by_joints + LITTLE * np.eye(motion.joints)
    projected = weights - np.swapaxes(weighted, 1, 2) @ invert_matrices(curvature) @ weighted
    residuals = solution.residuals
    left = residuals - multiply_vectors(
        by_joints, multiply_vectors(invert_matrices(curvature), multiply_vectors(weighted, residuals))
    )
    squares = float(np.sum(left * multiply_vectors(weights, left)))
    free = residuals.size - solution.values.size - _determined_parameters(solution, projected)
    if free < 0.5:
        return GoodnessOfFit(math.nan, 1.0)
    factor = math.sqrt(squares / free)
    p_value = chi_squared_tail(observation_weight * squares, observation_weight * free)
    if observation_weight < 1.0 or factor < _EXACT:
        return GoodnessOfFit(factor, p_value)
    components = residuals.shape[1] - 1
    cosines = min(_COSINES, int(_DENSITY * len(residuals)))
    slow_freedom = cosines * components
    if motion.joints != 1 or not cosines or free < slow_freedom + 0.5:
        return GoodnessOfFit(factor, p_value)
    whitened = multiply_vectors(np.swapaxes(np.linalg.cholesky(weights), 1, 2), left)
    slow = float(np.sum(_slow_parts(whitened, solution.values[:, 0], cosines) ** 2))
    rest = max(squares - slow, 1e-12 * squares, 1e-300)
    ratio = slow / slow_freedom / (rest / (free - slow_freedom))
    slow_p_value = f_distribution_tail(ratio, slow_freedom, free - slow_freedom)
    return GoodnessOfFit(factor, p_value, slow_p_value, slow / max(squares, 1e-300))


def chi_squared_tail(squares: float, freedom: float) -> float:
    """Return the probability that χ² with some degrees of freedom is larger (Wilson and Hilferty 1931)."""
    spread = 2.0 / (9.0 * freedom)
    return 0.5 * math.erfc(((squares / freedom) ** (1.0 / 3.0) - (1.0 - spread)) / math.sqrt(2.0 * spread))


def f_distribution_tail(ratio: float, above: float, below: float) -> float:
    """Return the probability that F with some degrees of freedom is larger (Paulson 1942)."""
    a, b, root = 2.0 / (9.0 * above), 2.0 / (9.0 * below), ratio ** (1.0 / 3.0)
    return 0.5 * math.erfc(((1.0 - b) * root - (1.0 - a)) / math.sqrt(2.0 * (b * root**2 + a)))


def _determined_parameters(solution: Solution[FamilyMember], projected: Array) -> float:
    """Return the effective number of parameters that the observations determine rather than the prior."""
    by_parameters, prior = solution.linear.by_parameters, solution.motion.prior().by_parameters
    information = (np.swapaxes(by_parameters, 1, 2) @ projected @ by_parameters).sum(axis=0)
    # The pseudoinverse leaves out directions that neither determines.
    inverse = np.linalg.pinv(information + prior.T @ prior, hermitian=True)
    return float(np.sum(inverse * information))


def _slow_parts(whitened: Array, values: Array, cosines: int) -> Array:
    """Return the projections of residuals (N, m) onto normalised slow cosines of the rank of a value."""
    count = len(values)
    rank = np.argsort(np.argsort(values, kind="stable"), kind="stable")
    phases = math.pi * (rank[:, None] + 0.5) / count * np.arange(1, cosines + 1)
    result: Array = math.sqrt(2.0 / count) * np.cos(phases).T @ whitened
    return result


Name = TypeVar("Name")

UNSEEN = 0.05
"""Prior probability that a prismatic or revolute joint hardly moves while it is observed."""


def bound_log_evidences(
    logs: Mapping[Name, float], solutions: Mapping[Name, Solution[FamilyMember]]
) -> dict[Name, float]:
    """Return log evidences, raised to the bounds by the families that are contained in others."""
    result = dict(logs)
    by_family = {
        solution.motion.name: (name, solution)
        for name, solution in solutions.items()
        if isinstance(solution.motion, GroupMotion)
    }
    rigid, line = by_family.get("rigid"), by_family.get("prismatic")
    for family in ("prismatic", "revolute"):
        if rigid is not None and family in by_family:
            name = by_family[family][0]
            result[name] = max(result[name], logs[rigid[0]] + math.log(UNSEEN))
    if line is not None and "revolute" in by_family and line[1].motion.rows == 3:
        name = by_family["revolute"][0]
        result[name] = max(result[name], logs[line[0]] + log_probability_straight(line[1]))
    return result


def log_probability_straight(line: Solution[FamilyMember]) -> float:
    """Return the log prior probability of levers that bend a line by less than a standard deviation.

    The positions of an arc with radius r are off a line by x²/2r. Their regression on x² gives the deviation
    of the curvature. The lever has a Gaussian prior in two components. An arc within one deviation has at
    least exp(-½) times the likelihood of the line.
    """
    assert isinstance(line.motion, GroupMotion)  # only lines of the library have levers
    along = line.values[:, 0]
    if len(along) < 3:
        return -0.5  # any arc goes through two points
    terms = np.column_stack([np.ones_like(along), along, along**2])
    # The residual of x² after regression on 1 and x.
    triangle: Array = np.linalg.qr(terms)[1]
    bend = abs(float(triangle[2, 2]))
    axis = line.motion.left[:3, 2]
    across = np.trace(line.covariance, axis1=1, axis2=2) - axis @ line.covariance @ axis
    curvature = 2.0 * math.sqrt(0.5 * float(across.mean())) / max(bend, 1e-12)
    return -0.5 - 0.5 / (REACH * curvature) ** 2


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
