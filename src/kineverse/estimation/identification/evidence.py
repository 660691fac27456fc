"""Marginal likelihood of a joint family (Laplace approximation).

Joint values have a Gaussian prior whose width s is that of the motion, see :mod:`.range_prior`. Each
observation contributes

    ∫ N(â_k; a, C_k) N(a; μ, s²) da = N(â_k; μ, s² + C_k)

A motion that is short compared with the noise costs next to nothing. A longer one pays for every joint value
that is known better than s. The mean μ and the parameters are integrated by Laplace's method. All families
have a mean pose with the same improper uniform prior. The other parameters have proper priors: directions are
uniform on the sphere, levers are Gaussian. The sliding point of the child has a proper prior, too, see
:mod:`.ambiguities`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kineverse.estimation.linear_algebra import invert_matrices, multiply_vectors, sum_log_determinants
from kineverse.lie import Array

from .ambiguities import sliding_point_twists
from .motion_model import FamilyMember
from .optimise import Solution
from .range_prior import JointRanges, PerObservation, fit_joint_ranges, solve_per_observation


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
    """Return the evidence of a family, by the quadratic approximation around its most likely member.

    Each observation's log likelihood counts with the weight. It is below 1 if errors are correlated.
    """
    motion, size = solution.motion, solution.motion.size
    per_observation = solve_per_observation(solution)
    ranges = (
        fit_joint_ranges(motion, per_observation, weight)
        if motion.joints
        else JointRanges(np.zeros(0), np.zeros(0), 0.0)
    )
    values, covariances = _posterior_joint_values(per_observation, ranges)
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
    predicted = -0.5 * float(
        np.sum(off * multiply_vectors(invert_matrices(total), off))
    ) - 0.5 * sum_log_determinants(math.tau * total)
    prior = solution.motion.prior().residuals
    reached = -0.5 * (solution.cost - float(prior @ prior)) - 0.5 * solution.residuals.size * math.log(
        math.tau
    )
    return max(0.0, predicted + per_observation.log_likelihood - reached)


def _posterior_joint_values(per_observation: PerObservation, ranges: JointRanges) -> tuple[Array, Array]:
    """Return the posterior joint values and their covariances under the range prior."""
    if not len(ranges.mean):
        return per_observation.values, per_observation.covariances
    variance = np.diag(ranges.deviations**2)
    shrink = variance @ invert_matrices(per_observation.covariances + variance)
    values: Array = ranges.mean + (shrink @ (per_observation.values - ranges.mean)[:, :, None])[:, :, 0]
    return values, shrink @ per_observation.covariances


def _information(solution: Solution[FamilyMember], ranges: JointRanges, values: Array) -> Array:
    """Return the information matrix of the parameters, μ and the sliding point."""
    linear = solution.motion.linearise(values)
    by_joints = linear.by_joints
    moved = (by_joints * ranges.deviations**2) @ np.swapaxes(by_joints, 1, 2)
    weights = invert_matrices(solution.covariance + moved)
    both = np.concatenate(
        [linear.by_parameters, by_joints, sliding_point_twists(solution.motion, values)], axis=2
    )
    result: Array = (np.swapaxes(both, 1, 2) @ weights @ both).sum(axis=0)
    return result
