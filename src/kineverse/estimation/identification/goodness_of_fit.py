"""Goodness of fit: residuals of a family against the noise.

Let e be the residuals with the joint values of each observation by itself, W the inverse of their covariance,
and ν the number of residuals less the numbers of joint values and of determined parameters. If the family and
the noise are right, χ² = Σ eᵀ W e has the mean ν, and √(χ²/ν) estimates the noise relative to the stated one.

A joint of the wrong kind leaves residuals that vary slowly along its joint value. Their projections onto slow
cosines of the rank of the joint value are compared with the rest by an F-test.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kineverse.estimation.linear_algebra import invert_matrices, multiply_vectors
from kineverse.lie import Array

from .motion_model import FamilyMember
from .optimise import Solution
from .range_prior import LITTLE

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
