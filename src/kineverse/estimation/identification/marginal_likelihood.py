"""Marginal likelihood of a joint family by Laplace's approximation.

With Gaussian joint values as wide as the motion (:class:`.JointRanges`), each observation contributes

    ∫ N(â_k; a, C_k) N(a; μ, s²) da = N(â_k; μ, s² + C_k)

so a motion that is short compared with the noise costs next to nothing. μ and the parameters are integrated
by Laplace's method. The mean pose has the same improper uniform prior in all families; the other parameters
have proper ones: directions are uniform on the sphere, levers are Gaussian.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kineverse.estimation.linear_algebra import invert_matrices, multiply_vectors, sum_log_determinants
from kineverse.lie import Array

from .joint_values import JointRanges, PerObservation, fit_joint_ranges, solve_per_observation
from .least_squares import Solution
from .motion_model import FamilyMember


class Scored(NamedTuple):
    """Solution of a family and the logarithm of the evidence of the family."""

    solution: Solution[FamilyMember]
    log_evidence: float


@dataclass(frozen=True)
class Evidence:
    """Evidence of a family and the posterior of its unknowns."""

    log_evidence: float
    covariance: Array  # posterior covariance of the parameters, (n, n)
    joint_values: Array  # posterior joint values and their covariances, (N, k) and (N, k, k)
    joint_covariances: Array


class IntegratedValues(NamedTuple):
    """Evidence with the joint values integrated out, for M sizes of the noise; the rest is for the last."""

    logs: Array  # log evidences, (M,)
    deviations: Array  # widths and means of the ranges, (k,)
    mean: Array
    information: Array  # information matrix of the parameters and means, (n + k, n + k)
    alone: PerObservation
    values: Array  # posterior joint values and their covariances, (N, k) and (N, k, k)
    covariances: Array


def integrate_joint_values(solution: Solution[FamilyMember], weight: float = 1.0) -> IntegratedValues:
    """Integrate the joint values out, for a weight of each observation's log likelihood."""
    motion, size = solution.motion, solution.motion.size
    alone = solve_per_observation(solution)
    values, covariances = alone.values, alone.covariances
    ranges = JointRanges(np.zeros(0), np.zeros(0), 0.0)
    if motion.joints:
        ranges = fit_joint_ranges(motion, alone, weight)
        variance = np.diag(ranges.deviations**2)
        shrink = variance @ invert_matrices(covariances + variance)
        values = ranges.mean + multiply_vectors(shrink, values - ranges.mean)
        covariances = shrink @ covariances
    linear = motion.linearise(values)
    by_joints = linear.by_joints
    moved = (by_joints * ranges.deviations**2) @ np.swapaxes(by_joints, 1, 2)
    slopes = np.concatenate([linear.by_parameters, by_joints], axis=2)
    weighted = np.swapaxes(slopes, 1, 2) @ invert_matrices(solution.covariance + moved)
    log_prior, precision = motion.log_prior(ranges.mean)
    information = weight * (weighted @ slopes).sum(axis=0) + np.diag(precision)
    prior = motion.prior().by_parameters
    information[:size, :size] += prior.T @ prior
    log = weight * alone.log_likelihood + ranges.log_density + log_prior
    log += 0.5 * len(information) * math.log(math.tau) - 0.5 * float(np.linalg.slogdet(information)[1])
    rest = ranges.deviations, ranges.mean, information, alone, values, covariances
    return IntegratedValues(np.array([log]), *rest)


def evidence_of(motion: FamilyMember, integrated: IntegratedValues) -> Evidence:
    """Return the evidence and the posterior of the unknowns."""
    covariance = invert_matrices(integrated.information)[: motion.size, : motion.size]
    return Evidence(float(integrated.logs[-1]), covariance, integrated.values, integrated.covariances)


def laplace_evidence(solution: Solution[FamilyMember], weight: float = 1.0) -> Evidence:
    """Return the evidence by the quadratic approximation, for a weight of each observation's likelihood."""
    return evidence_of(solution.motion, integrate_joint_values(solution, weight))


def evidence_excess(solution: Solution[FamilyMember], alone: PerObservation | None = None) -> float:
    """Return the excess of the Laplace evidence over the value reached, if the steps did not converge.

    The quadratic approximation assumes a maximum. Without convergence it predicts a higher likelihood than
    was reached, and the difference of the logarithms is the correction.
    """
    joint_prior = solution.joint_prior
    if solution.converged or not joint_prior.marginal:
        return 0.0
    alone = alone or solve_per_observation(solution)
    total = alone.covariances + np.diag(1.0 / joint_prior.precision)
    off = alone.values - joint_prior.mean
    predicted = alone.log_likelihood - 0.5 * sum_log_determinants(math.tau * total)
    predicted -= 0.5 * float(np.sum(off * multiply_vectors(invert_matrices(total), off)))
    prior = solution.motion.prior().residuals
    reached = -0.5 * (solution.cost - float(prior @ prior) + solution.residuals.size * math.log(math.tau))
    return max(0.0, predicted - reached)
