"""Empirical prior of the range of joint values.

Joint values are Gaussian with a mean μ and a width s, one width for all translations and one for all
rotations. Let â_k be the maximum of the likelihood of observation k alone and C_k its covariance. Then â_k is
distributed as N(μ, s² + C_k).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kineverse.estimation.linear_algebra import invert_matrices, multiply_vectors, sum_log_determinants
from kineverse.lie import Array

from .motion_model import FamilyMember
from .optimise import Solution

# Candidate widths [m], [rad].
GRID = np.geomspace(1e-5, 10.0, 61)
LITTLE = 1e-6
_STEP = math.log(float(GRID[1] / GRID[0]))


@dataclass(frozen=True)
class PerObservation:
    """Joint values of each observation by itself, without their prior."""

    values: Array  # joint values and their covariances, (N, k) and (N, k, k)
    covariances: Array
    log_likelihood: float


def solve_per_observation(solution: Solution[FamilyMember]) -> PerObservation:
    """Return the joint values by the observations alone, from the quadratic at the solution."""
    by_joints = solution.linear.by_joints
    weights = invert_matrices(solution.covariance)
    weighted = np.swapaxes(by_joints, 1, 2) @ weights
    # The small term keeps an angle without effect on the pose finite, and is too small to matter otherwise.
    covariances = invert_matrices(weighted @ by_joints + LITTLE * np.eye(by_joints.shape[2]))
    change = multiply_vectors(covariances, multiply_vectors(weighted, solution.residuals))
    left = solution.residuals - multiply_vectors(by_joints, change)
    log = -0.5 * float(np.sum(left * multiply_vectors(weights, left))) + 0.5 * sum_log_determinants(
        math.tau * covariances
    )
    return PerObservation(
        solution.values + change,
        covariances,
        log - 0.5 * sum_log_determinants(math.tau * solution.covariance),
    )


@dataclass(frozen=True)
class JointRanges:
    """Width and mean of the range of joint values."""

    deviations: Array  # s and μ of each joint value, (k,)
    mean: Array
    log_density: float  # [m], [rad]


def fit_joint_ranges(
    motion: FamilyMember, per_observation: PerObservation, weight: float = 1.0
) -> JointRanges:
    """Return the most likely widths and means of the joint values.

    Each observation's log likelihood counts with the weight.
    """
    kinds = np.array(motion.kinds)
    deviations, occam = np.zeros(len(kinds)), 0.0
    variances = np.einsum("nii->ni", per_observation.covariances)
    for kind in sorted(set(motion.kinds)):
        block = kinds == kind
        deviations[block], part = _width(per_observation.values[:, block], variances[:, block], weight)
        occam += part
    total = per_observation.covariances + np.diag(deviations**2)
    weights = invert_matrices(total)
    mean: Array = np.linalg.solve(
        weights.sum(axis=0), multiply_vectors(weights, per_observation.values).sum(axis=0)
    )
    off = per_observation.values - mean
    log = -0.5 * float(np.sum(off * multiply_vectors(weights, off))) - 0.5 * sum_log_determinants(
        math.tau * total
    )
    return JointRanges(deviations, mean, weight * log + occam)


def _width(values: Array, variances: Array, weight: float) -> tuple[float, float]:
    """Return the best s, and the log of the mean likelihood over all s relative to the best."""
    total = variances + GRID[:, None, None] ** 2
    weights = 1.0 / total
    mean = (weights * values).sum(axis=1) / weights.sum(axis=1)
    squares = (values - mean[:, None, :]) ** 2 * weights
    # The mean is integrated out. Else the width of a few values would be biased towards zero.
    logs = -0.5 * weight * (np.log(total) + squares).sum(axis=(1, 2))
    logs -= 0.5 * np.log(weights.sum(axis=1)).sum(axis=1)
    top = int(np.argmax(logs))
    best = math.log(float(GRID[top]))
    if 0 < top < len(logs) - 1:
        before, here, after = logs[top - 1 : top + 2]
        best += 0.5 * _STEP * float((after - before) / (2.0 * here - before - after))
    return math.exp(best), math.log(float(np.mean(np.exp(logs - logs[top]))))
