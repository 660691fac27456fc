"""Selection of a joint family: evidence, its bounds for nested families, and goodness of fit.

A joint that hardly moves looks rigid, and a point on a long lever seems to move along a line. So the evidence
of the wider family is at least that of the narrower one times the prior probability of members that look like
it. Laplace's method misses them: it knows only the surroundings of the most likely member, which follows the
noise.

Let e be the residuals with the joint values of each observation by itself, W the inverse of their covariance,
and ν their number less those of joint values and of determined parameters. If family and noise are right,
χ² = Σ eᵀ W e has the mean ν, and √(χ²/ν) is the ratio of the noise to the stated one.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias, TypeVar

import numpy as np

from kineverse.estimation.linear_algebra import invert_matrices, multiply_vectors
from kineverse.estimation.noise import Outliers
from kineverse.lie import Array, transform

from .families import REACH, Family, GroupMotion, family_starts
from .initial_guess import CONTAINED, MotionStatistics, initial_guesses, widened_guess
from .least_squares import InitialGuess, Solution
from .marginal_likelihood import (
    LITTLE,
    Scored,
    laplace_evidence,
    log_unwrapping_gain,
    unwrap_screw,
    unwrap_solution,
)
from .motion_functions import FamilyMember
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

FamilyName: TypeAlias = "str | Family"
FamilyWeights: TypeAlias = Mapping[FamilyName, float]  # prior weights

# Number of slow cosines along a joint value: at most, and relative to the number of observations.
_COSINES, _DENSITY = 6, 0.25
_EXACT = 0.1  # size of residuals relative to the noise below which they are rounding errors


@dataclass(frozen=True)
class GoodnessOfFit:
    """Residuals of a family against the noise."""

    factor: float  # size of the residuals relative to the noise; NaN if the family leaves none
    p_value: float  # probability of a χ² at least as large if family and noise are right
    slow_p_value: float = 1.0  # the same for residuals that vary slowly along the joint value
    slow_share: float = 0.0  # their share in χ²


def measure_fit(
    solution: Solution[FamilyMember], covariance: Array | None = None, observation_weight: float = 1.0
) -> GoodnessOfFit:
    """Return the goodness of fit of a solution."""
    motion, by_joints = solution.motion, solution.linear.by_joints
    weights = invert_matrices(solution.covariance if covariance is None else covariance)
    weights = np.broadcast_to(weights, solution.covariance.shape)
    weighted = np.swapaxes(by_joints, 1, 2) @ weights
    curvature = weighted @ by_joints + LITTLE * np.eye(motion.joints)
    gains = invert_matrices(curvature) @ weighted
    projected = weights - np.swapaxes(weighted, 1, 2) @ gains
    residuals = solution.residuals
    change = multiply_vectors(gains, residuals)
    left = residuals - multiply_vectors(by_joints, change)
    squares = float(np.sum(left * multiply_vectors(weights, left)))
    # The effective number of parameters that the observations determine rather than the prior. The
    # pseudoinverse leaves out directions that neither determines.
    by_parameters, prior = solution.linear.by_parameters, motion.prior().by_parameters
    information = (np.swapaxes(by_parameters, 1, 2) @ projected @ by_parameters).sum(axis=0)
    inverse = np.linalg.pinv(information + prior.T @ prior, hermitian=True)
    free = residuals.size - solution.values.size - float(np.sum(inverse * information))
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
    # Projections onto normalised slow cosines of the rank of the joint value.
    rank = np.argsort(np.argsort(solution.values[:, 0], kind="stable"), kind="stable")
    phases = math.pi * (rank[:, None] + 0.5) / len(rank) * np.arange(1, cosines + 1)
    slow = float(np.sum((math.sqrt(2.0 / len(rank)) * np.cos(phases).T @ whitened) ** 2))
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


Name = TypeVar("Name")

UNSEEN = 0.05  # prior probability that a prismatic or revolute joint hardly moves while it is observed


def bound_log_evidences(
    logs: Mapping[Name, float], solutions: Mapping[Name, Solution[FamilyMember]]
) -> dict[Name, float]:
    """Return log evidences, raised to the bounds by the families that are contained in others."""
    result = dict(logs)
    grouped = {name: one for name, one in solutions.items() if isinstance(one.motion, GroupMotion)}
    names = {one.motion.name: name for name, one in grouped.items()}
    for name in (names[family] for family in ("prismatic", "revolute") if family in names):
        if "rigid" in names:
            result[name] = max(result[name], logs[names["rigid"]] + math.log(UNSEEN))
    if "prismatic" in names and "revolute" in names:
        line, name = grouped[names["prismatic"]], names["revolute"]
        if line.motion.rows == 3:
            result[name] = max(result[name], logs[names["prismatic"]] + log_probability_straight(line))
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
    bend = abs(float(np.linalg.qr(terms)[1][2, 2]))
    axis = line.motion.left[:3, 2]
    across = np.trace(line.covariance, axis1=1, axis2=2) - axis @ line.covariance @ axis
    curvature = 2.0 * math.sqrt(0.5 * float(across.mean())) / max(bend, 1e-12)
    return -0.5 - 0.5 / (REACH * curvature) ** 2


def log_principal_widths_gain(solution: Solution[FamilyMember], weight: float = 1.0) -> float:
    """Return the gain in log evidence if each principal direction of joint values has its own width.

    Half of the motions in a plane, about a point or in space have one width for all directions. The others
    have principal directions, evenly distributed, with a width each. A direction without a motion beyond the
    noise is none of them: that is a joint with fewer joint values.
    """
    motion = solution.motion
    if not isinstance(motion, GroupMotion) or motion.joints == len(set(motion.kinds)):
        return 0.0
    by_joints, parts = solution.linear.by_joints, []
    precision = np.swapaxes(by_joints, 1, 2) @ invert_matrices(solution.covariance) @ by_joints
    covariance = invert_matrices(precision + LITTLE * np.eye(motion.joints)).sum(axis=0)
    for kind in sorted(set(motion.kinds)):
        block = np.array(motion.kinds) == kind
        centred = solution.values[:, block] - solution.values[:, block].mean(axis=0)
        squares, directions = np.linalg.eigh(centred.T @ centred)
        noise = np.einsum("ji,jk,ki->i", directions, covariance[np.ix_(block, block)], directions)
        if (squares < _USED**2 * noise).any():
            return 0.0
        parts.append((squares, directions))
    # A common frame has the principal directions of translations, or of rotations if there are no others.
    (squares, directions), turn, log_directions = parts[0], np.eye(3), 0.0
    axes = [joint % 3 for joint in motion.parametrisation.joints[: len(squares)]]
    turn[np.ix_(axes, axes)] = directions
    turn[:, axes[0]] *= np.linalg.det(turn)
    for one, other in itertools.combinations(np.maximum(squares, 1e-12), 2):
        information = weight * len(solution.values) * (math.sqrt(one / other) - math.sqrt(other / one)) ** 2
        # Principal directions have no order, so each of their angles is within a quarter of a revolution.
        angle = math.log(math.pi / 2) + 0.5 * math.log(max(information, 1e-9) / math.tau)
        log_directions -= max(0.0, angle)
    change, twist = transform(turn, np.zeros(3)), np.zeros((len(solution.values), 6))
    twist[:, motion.parametrisation.joints] = solution.values
    values = np.concatenate([twist[:, :3] @ turn, twist[:, 3:] @ turn], axis=1)
    turned = _PrincipalMotion(motion.group, motion.rows, motion.left @ change, change.T @ motion.right)
    values = values[:, motion.parametrisation.joints]
    other = replace(solution, motion=turned, values=values, linear=turned.linearise(values))
    gain = laplace_evidence(other, weight).log_evidence - solver.evidence(solution, weight).log_evidence
    return float(np.logaddexp(0.0, gain + log_directions)) - math.log(2.0)


class _PrincipalMotion(GroupMotion):
    """Motion along principal directions, in which each joint value has its own width."""

    __slots__ = ()

    @property
    def kinds(self) -> tuple[int, ...]:
        return tuple(range(self.joints))


# Least width of a motion along a principal direction, in standard deviations of its joint values.
_USED = 2.0
# A family is not refined if its log evidence is below that of the best by more than a constant and a term for
# each observation. With noise that is large compared with the motion, unrefined evidence is this inaccurate.
_NEGLIGIBLE, _NEGLIGIBLE_EACH = 15.0, 0.5
SAME_RATIO = 2.0
"""Factor by which the ratio of an estimated noise may differ from that of a solution that is kept."""


@dataclass(frozen=True)
class IdentificationData:
    """Observations and the assumptions under which families are compared."""

    observations: Observations  # with lengths in the unit
    unit: float  # length scale [m]
    stated: bool  # True if the noise is known; else the observations have the medians of noise_estimation
    outliers: Outliers | None  # with lengths in the unit; None if all observations are inliers
    sequential: bool  # True if the observations are in temporal order
    noise_factor: float = 1.0  # size of the noise relative to the stated one
    observation_weight: float = 1.0  # of the log likelihood of each observation


@dataclass(frozen=True)
class FamilySolution:
    """Solution of a family by its inliers."""

    scored: Scored
    noise: NoisePosterior  # STATED_NOISE if it is stated
    inliers: RowIndices
    count: int  # number of all observations
    log_prior: float  # of the inliers and the revolutions

    @property
    def log_evidence(self) -> float:
        """Logarithm of the evidence, with an unknown noise integrated out."""
        return self.scored.log_evidence + self.noise.log_weight


FamilySolutions: TypeAlias = dict[FamilyName, FamilySolution]
FamilyInliers: TypeAlias = Mapping[FamilyName, RowIndices]


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
    return IdentificationData(scaled, unit, stated, outliers, sequential, 1.0, observation_weight)


def solve_with_inliers(data: IdentificationData, weights: FamilyWeights) -> FamilySolutions:
    """Return the solution of each family by its inliers."""
    everything = np.arange(len(data.observations))
    inliers = dict.fromkeys(weights, everything)
    if data.outliers is None or data.stated:
        solutions = _solve_inliers(data, inliers)
        if data.outliers is not None:
            inliers = _classify(
                data, {name: one.scored for name, one in solutions.items()}, data.observations
            )
            fewer = {name: rows for name, rows in inliers.items() if len(rows) < len(everything)}
            solutions |= _solve_inliers(data, fewer)
        return score_solutions(data, solutions, inliers, weights)
    observations = data.observations
    inliers = _classify(data, solve_families(observations, weights, data.unit), observations)
    solutions = _solve_inliers(data, inliers)
    # Where the noise is of another ratio, other observations are outliers.
    best = max(solutions, key=lambda name: solutions[name].log_evidence + math.log(weights[name]))
    factors = solutions[best].noise.factors
    if not 1.0 / SAME_RATIO < factors[0] / factors[1] < SAME_RATIO:
        observations = scale_noise(observations, factors)
        inliers = _classify(data, solve_families(observations, weights, data.unit), observations)
        solutions = _solve_inliers(data, inliers)
    return score_solutions(data, solutions, inliers, weights)


def _classify(
    data: IdentificationData, solutions: Mapping[FamilyName, Scored], observations: Observations
) -> dict[FamilyName, RowIndices]:
    assert data.outliers is not None  # else there is nothing to classify

    def solve(some: Observations, name: FamilyName) -> Scored:
        return solve_families(some, [name], data.unit)[name]

    return find_inliers(observations, solutions, data.outliers, data.stated, solve)


def _solve_inliers(data: IdentificationData, inliers: FamilyInliers) -> dict[FamilyName, NoiseSolution]:
    def solve(starts: Sequence[InitialGuess], some: Observations) -> Scored:
        scored = solver.maximum_likelihood(some, starts)
        # A screw is solved again with the revolutions of the observations.
        start = unwrap_screw(some, scored.solution) if data.sequential else None
        return scored if start is None else solver.maximum_likelihood(some, [start])

    def attempt(observations: Observations, starts: Sequence[InitialGuess]) -> NoiseSolution:
        if data.stated:
            return NoiseSolution(solve(starts, observations), STATED_NOISE)
        return solve_unknown_noise(observations, partial(solve, starts))

    solver.prepare()
    solutions: dict[FamilyName, NoiseSolution] = {}
    names = sorted(inliers, key=lambda name: name in CONTAINED)  # those that others contain come first
    for rows in {rows.tobytes(): rows for rows in inliers.values()}.values():
        observations, solved = data.observations.select(rows), dict[FamilyName, NoiseSolution]()
        statistics = MotionStatistics(observations)
        for name in (name for name in names if np.array_equal(inliers[name], rows)):
            starts = _starts(observations, name, statistics, data.unit)
            # A family starts from those that it contains as well, so that its fit is at least as good.
            narrower = (solved[one].scored.solution for one in CONTAINED.get(name, ()) if one in solved)
            starts += [widened_guess(str(name), solution) for solution in narrower]
            solved[name] = attempt(observations, starts)
        solutions |= solved
    return {name: solutions[name] for name in inliers}


def score_solutions(
    data: IdentificationData,
    solutions: Mapping[FamilyName, NoiseSolution],
    inliers: FamilyInliers,
    weights: FamilyWeights,
    renew: bool = True,
) -> FamilySolutions:
    """Score solutions of families against each other; an unknown noise is estimated again if ``renew``."""
    count = len(data.observations)
    log_priors = dict.fromkeys(solutions, 0.0)
    for name, one in solutions.items():
        if data.outliers is not None:
            used = len(inliers[name])
            log_priors[name] += log_inlier_prior(data.outliers, count, used, data.observations.rows)
        if data.sequential:
            log_priors[name] += log_unwrapping_gain(one.scored.solution)
    # The threshold is on evidence in which each observation has its weight.
    weight, logs, result = data.observation_weight, {}, {}
    for name, one in solutions.items():
        logs[name] = one.log_evidence + math.log(weights[name]) / weight + log_priors[name]
    threshold = max(logs.values()) - _NEGLIGIBLE / weight
    threshold -= _NEGLIGIBLE_EACH * max(map(len, inliers.values()))
    refine = adapt_noise if renew and not data.stated else _integrate_joint_values
    for name, one in solutions.items():
        if logs[name] >= threshold:
            rows = inliers[name]
            one = refine(data.observations if len(rows) == count else data.observations.select(rows), one)
            log_priors[name] += log_principal_widths_gain(one.scored.solution, weight) / weight
        result[name] = FamilySolution(*one, inliers[name], count, log_priors[name])
    return result


def solve_families(
    observations: Observations, families: Iterable[FamilyName], unit: float = 1.0
) -> dict[FamilyName, Scored]:
    """Return the most likely member of each family, for observations in a unit of length [m]."""
    solver.prepare()
    statistics = MotionStatistics(observations)
    starts = {name: _starts(observations, name, statistics, unit) for name in families}
    return {name: solver.maximum_likelihood(observations, each) for name, each in starts.items()}


def _starts(
    observations: Observations, family: FamilyName, statistics: MotionStatistics, unit: float
) -> list[InitialGuess]:
    if isinstance(family, Family):
        return [InitialGuess(motion, values) for motion, values in family_starts(family, observations, unit)]
    return list(initial_guesses(family, statistics))


def _integrate_joint_values(observations: Observations, one: NoiseSolution) -> NoiseSolution:
    """Return the solution with its joint values integrated out; as it is, if they are."""
    solution = one.scored.solution
    if solution.joint_prior.marginal or not (solution.motion.joints and solution.motion.size):
        return one
    observations = scale_noise(observations, one.noise.factors)
    return one._replace(scored=solver.maximise_marginal_likelihood(observations, solution))


def weigh_families(
    data: IdentificationData, solutions: FamilySolutions, weights: FamilyWeights
) -> IdentificationResult:
    """Return the fits of all families with their posterior probabilities."""
    solutions = {name: _weigh_observations(data, one) for name, one in solutions.items()}
    evidences = {name: one.log_evidence + one.log_prior for name, one in solutions.items()}
    logs = bound_log_evidences(evidences, {name: one.scored.solution for name, one in solutions.items()})
    total: Array = np.array([logs[name] + math.log(weights[name]) for name in solutions])
    probabilities = np.exp(total - np.logaddexp.reduce(total)).tolist()
    lazy_fits = []
    for (name, one), p in zip(solutions.items(), probabilities, strict=True):
        compute = partial(_fit, data, one, logs[name], p)
        lazy_fits.append(LazyFit(one.scored.solution.motion.name, p, compute))
    lazy_fits.sort(key=lambda lazy_fit: -lazy_fit.probability)
    best = list(solutions.values())[int(np.argmax(total))]
    return IdentificationResult(tuple(lazy_fits), best.noise.deviations(data.unit))


def _weigh_observations(data: IdentificationData, one: FamilySolution) -> FamilySolution:
    if data.observation_weight == 1.0:
        return one
    weight, observations = data.observation_weight, data.observations.select(one.inliers)
    scored, noise = weigh_observations(observations, NoiseSolution(one.scored, one.noise), weight)
    return replace(one, scored=scored, noise=noise, log_prior=weight * one.log_prior)


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
