"""Marginal likelihood of a joint family (Laplace approximation).

Joint values are drawn from a Gaussian whose width s is that of the motion, see :mod:`.fit_joint_ranges`. They
contribute

    ∫ N(â_k; a, C_k) N(a; μ, s²) da = N(â_k; μ, s² + C_k)

so a motion that is short beside the noise costs next to nothing, and one that is long pays for every joint
value by how much better than s it is known. The mean μ and the parameters follow by Laplace's method. All
families have a mean pose, of which nothing is known beforehand, and it is measured alike in all of them; what
a family has beyond that has a proper prior: directions are anywhere on the sphere, levers within reach. So
does the point of the child whose slides are meant, see :mod:`.sliding`.
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
    """What integrating over everything gives.

    Attributes
    ----------
    log_evidence
        Natural logarithm of the density of the observed relative poses; its unit is common to all families.
    covariance
        Of the parameters, (n, n).
    joint_values, joint_covariances
        As the observations and the width of the motion tell together, (N, k) and (N, k, k).
    """

    log_evidence: float
    covariance: Array
    joint_values: Array
    joint_covariances: Array

    @staticmethod
    def from_information(
        log: float, information: Array, size: int, values: Array, covariances: Array
    ) -> Evidence:
        """Return it with the covariance of the first unknowns, which are the parameters."""
        return Evidence(log, invert_matrices(information)[:size, :size], values, covariances)


def laplace_evidence(solution: Solution[FamilyMember]) -> Evidence:
    """Return the evidence of a family of joints around its most likely member."""
    motion, size = solution.motion, solution.motion.size
    per_observation = solve_per_observation(solution)
    width = (
        fit_joint_ranges(motion, per_observation)
        if motion.joints
        else JointRanges(np.zeros(0), np.zeros(0), 0.0)
    )
    values, covariances = _posterior_joint_values(per_observation, width)
    information = _information(solution, width, values)
    prior = motion.prior().by_parameters
    information[:size, :size] += prior.T @ prior
    beforehand, precision = motion.log_prior(width.mean)
    information[np.diag_indices_from(information)] += precision
    log = per_observation.log_likelihood + width.log_density + beforehand
    log += 0.5 * len(information) * math.log(math.tau) - 0.5 * float(np.linalg.slogdet(information)[1])
    return Evidence.from_information(log, information, size, values, covariances)


def evidence_excess(solution: Solution[FamilyMember]) -> float:
    """Return by how much the quadratic promises more, as a logarithm, than is there where steps ended early.

    Evidence takes the quadratic at its word. Where it has not been followed to its end, what was reached is
    what counts.
    """
    joint_prior = solution.joint_prior
    if solution.converged or not joint_prior.marginal:
        return 0.0
    per_observation = solve_per_observation(solution)
    total = per_observation.covariances + np.diag(1.0 / joint_prior.precision)
    off = per_observation.values - joint_prior.mean
    promised = -0.5 * float(
        np.sum(off * multiply_vectors(invert_matrices(total), off))
    ) - 0.5 * sum_log_determinants(math.tau * total)
    prior = solution.motion.prior().residuals
    reached = -0.5 * (solution.cost - float(prior @ prior)) - 0.5 * solution.residuals.size * math.log(
        math.tau
    )
    return max(0.0, promised + per_observation.log_likelihood - reached)


def _posterior_joint_values(per_observation: PerObservation, width: JointRanges) -> tuple[Array, Array]:
    """Return joint values and their covariances if they are also believed within the width."""
    if not len(width.mean):
        return per_observation.values, per_observation.covariances
    variance = np.diag(width.deviations**2)
    shrink = variance @ invert_matrices(per_observation.covariances + variance)
    values: Array = width.mean + (shrink @ (per_observation.values - width.mean)[:, :, None])[:, :, 0]
    return values, shrink @ per_observation.covariances


def _information(solution: Solution[FamilyMember], width: JointRanges, values: Array) -> Array:
    """Return the information about parameters, μ and the point that slides."""
    linear = solution.motion.linearise(values)
    by_joints = linear.by_joints
    moved = (by_joints * width.deviations**2) @ np.swapaxes(by_joints, 1, 2)
    weights = invert_matrices(solution.covariance + moved)
    both = np.concatenate(
        [linear.by_parameters, by_joints, sliding_point_twists(solution.motion, values)], axis=2
    )
    result: Array = (np.swapaxes(both, 1, 2) @ weights @ both).sum(axis=0)
    return result
