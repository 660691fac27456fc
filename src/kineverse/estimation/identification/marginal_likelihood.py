"""Marginal likelihood of a joint family (Laplace approximation), and its staged maximisation.

With Gaussian joint values as wide as the motion (:class:`.JointRanges`), each observation contributes

    ∫ N(â_k; a, C_k) N(a; μ, s²) da = N(â_k; μ, s² + C_k)

so a motion that is short compared with the noise costs next to nothing. μ and the parameters are integrated
by Laplace's method. The mean pose has the same improper uniform prior in all families; the other parameters
have proper ones: directions are uniform on the sphere, levers are Gaussian.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kineverse.estimation.linear_algebra import invert_matrices, multiply_vectors, sum_log_determinants
from kineverse.lie import Array

from .joint_values import (
    JointRanges,
    choose_mirrored_values,
    fit_joint_ranges,
    optimise_sliding_point,
    sliding_point_twists,
    solve_per_observation,
)
from .least_squares import InitialGuess, JointValuePrior, Solution, levenberg_marquardt, solve_from_best_start
from .motion_model import FamilyMember, FixedMotion
from .observations import Observations


@dataclass(frozen=True)
class Evidence:
    """Evidence of a family and the posterior of its unknowns."""

    log_evidence: float
    covariance: Array  # posterior covariance of the parameters, (n, n)
    joint_values: Array  # posterior joint values and their covariances, (N, k) and (N, k, k)
    joint_covariances: Array

    @staticmethod
    def from_information(
        log: float, information: Array, size: int, values: Array, covariances: Array
    ) -> Evidence:
        """Return the evidence from the information matrix of all unknowns, the parameters first."""
        return Evidence(log, invert_matrices(information)[:size, :size], values, covariances)


def laplace_evidence(solution: Solution[FamilyMember], weight: float = 1.0) -> Evidence:
    """Return the evidence by the quadratic approximation, for a weight of each observation's likelihood."""
    motion, size = solution.motion, solution.motion.size
    per_observation = solve_per_observation(solution)
    values, covariances = per_observation.values, per_observation.covariances
    ranges = JointRanges(np.zeros(0), np.zeros(0), 0.0)
    if motion.joints:
        ranges = fit_joint_ranges(motion, per_observation, weight)
        # The posterior under the prior of the range.
        variance = np.diag(ranges.deviations**2)
        shrink = variance @ invert_matrices(covariances + variance)
        values = ranges.mean + (shrink @ (values - ranges.mean)[:, :, None])[:, :, 0]
        covariances = shrink @ covariances
    information = weight * _information(solution, ranges, values)
    prior = motion.prior().by_parameters
    information[:size, :size] += prior.T @ prior
    log_prior, precision = motion.log_prior(ranges.mean)
    information[np.diag_indices_from(information)] += precision
    log = weight * per_observation.log_likelihood + ranges.log_density + log_prior
    log += 0.5 * len(information) * math.log(math.tau) - 0.5 * float(np.linalg.slogdet(information)[1])
    return Evidence.from_information(log, information, size, values, covariances)


def evidence_excess(solution: Solution[FamilyMember]) -> float:
    """Return the excess of the Laplace evidence over the value reached, if the steps did not converge.

    The quadratic approximation assumes a maximum. Without convergence it predicts a higher likelihood than
    was reached, and the difference of the logarithms is the correction.
    """
    joint_prior = solution.joint_prior
    if solution.converged or not joint_prior.marginal:
        return 0.0
    per_observation = solve_per_observation(solution)
    total = per_observation.covariances + np.diag(1.0 / joint_prior.precision)
    off = per_observation.values - joint_prior.mean
    predicted = per_observation.log_likelihood - 0.5 * sum_log_determinants(math.tau * total)
    predicted -= 0.5 * float(np.sum(off * multiply_vectors(invert_matrices(total), off)))
    prior = solution.motion.prior().residuals
    reached = -0.5 * (solution.cost - float(prior @ prior) + solution.residuals.size * math.log(math.tau))
    return max(0.0, predicted - reached)


def _information(solution: Solution[FamilyMember], ranges: JointRanges, values: Array) -> Array:
    """Return the information matrix of the parameters, μ and the sliding point."""
    linear = solution.motion.linearise(values)
    by_joints = linear.by_joints
    moved = (by_joints * ranges.deviations**2) @ np.swapaxes(by_joints, 1, 2)
    weights = invert_matrices(solution.covariance + moved)
    sliding = sliding_point_twists(solution.motion, values)
    slopes = np.concatenate([linear.by_parameters, by_joints, sliding], axis=2)
    return np.asarray((np.swapaxes(slopes, 1, 2) @ weights @ slopes).sum(axis=0))


TURNS = 8
# Relative change of a width at convergence.
SETTLED = 0.01
NARROWEST = 1e-4


class Scored(NamedTuple):
    """Solution of a family and the logarithm of the evidence of the family."""

    solution: Solution[FamilyMember]
    log_evidence: float


def maximum_likelihood(observations: Observations, starts: Sequence[InitialGuess]) -> Scored:
    """Return the maximum of the likelihood in a family, from the best of several starts."""
    first, *softer = [*observations.softened, observations]
    best = solve_from_best_start(first, starts)
    for narrower in softer:
        best = levenberg_marquardt(narrower, best.motion, best.values, best.parent)
    return _score(optimise_sliding_point(choose_mirrored_values(observations, best)))


def maximise_marginal_likelihood(observations: Observations, solution: Solution[FamilyMember]) -> Scored:
    """Return the maximum of the marginal likelihood, in which the joint values are integrated out."""
    if not solution.motion.joints or not solution.motion.size:
        return _score(solution)
    result = _iterate_ranges(observations, solution)
    softened = observations.softened
    if solution.joint_prior.marginal or not softened:
        return _score(result)
    # With positions this precise the maximum of the likelihood is a poor start: its motion is distorted to
    # fit each joint value. A prior on the ranges during the continuation prevents that.
    for softer in (*softened, observations):
        start = solution.motion, solution.values, solution.parent, solution.joint_prior
        solution = levenberg_marquardt(softer, *start)
        solution = _iterate_ranges(softer, choose_mirrored_values(softer, solution))
    return _score(max(result, solution, key=lambda each: laplace_evidence(each).log_evidence))


def continue_from(
    observations: Observations, start: InitialGuess, parent: Array, joint_prior: JointValuePrior, known: int
) -> Scored:
    """Return the solution of more observations than ``known``, continued from an earlier one."""
    motion, values, parent = start.motion, start.values.copy(), parent.copy()
    if known < len(observations):
        new, fixed = slice(known, None), FixedMotion(motion)
        some = observations.select(new)
        projected = levenberg_marquardt(some, fixed, values[new], parent[new], joint_prior)
        values[new], parent[new] = projected.values, projected.parent
    solution = levenberg_marquardt(observations, motion, values, parent, joint_prior)
    if joint_prior.marginal:
        return _score(_iterate_ranges(observations, solution))
    return _score(optimise_sliding_point(solution))


def _iterate_ranges(observations: Observations, solution: Solution[FamilyMember]) -> Solution[FamilyMember]:
    """Alternate between the ranges of the joint values and the other unknowns until the ranges converge."""
    prior = solution.joint_prior
    before: Array | None = prior.precision**-0.5 if prior.marginal else None
    for _ in range(TURNS):
        solution = optimise_sliding_point(solution)
        ranges = fit_joint_ranges(solution.motion, solve_per_observation(solution))
        widths = np.maximum(ranges.deviations, NARROWEST)
        if before is not None and np.all(np.abs(np.log(widths / before)) < SETTLED):
            break
        before = widths
        start = solution.motion, solution.values, solution.parent
        joint_prior = JointValuePrior(ranges.mean, widths**-2.0, marginal=True)
        solution = levenberg_marquardt(observations, *start, joint_prior)
        solution = choose_mirrored_values(observations, solution)
    return solution


def _score(solution: Solution[FamilyMember]) -> Scored:
    return Scored(solution, laplace_evidence(solution).log_evidence - evidence_excess(solution))
