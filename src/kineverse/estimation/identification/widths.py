"""How wide a motion is, from joint values that are known so and so well.

Joint values are drawn from Gaussians of a mean μ and a width s of their own, one width for all slides and one
for all turns. With the maximum â_k of the likelihood of each observation and its covariance C_k, which know
nothing of each other, â_k is from N(μ, s² + C_k).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .library import library
from .matrices import inverted, log_determinants, times
from .motion import Member
from .rigid import Array
from .solving import Solution

# From hardly anything to more than there is [m], [rad].
GRID = np.geomspace(1e-5, 10.0, 61)
LITTLE = 1e-6
# Joint values that C has room for.
MOST = 6
_STEP = math.log(float(GRID[1] / GRID[0]))


@dataclass(frozen=True)
class Alone:
    """Joint values of each observation by itself, whatever was believed of them when they were found.

    Attributes
    ----------
    values, covariances
        (N, k) and (N, k, k).
    log_likelihood
        Of all observations, with the joint values integrated over all there is.
    """

    values: Array
    covariances: Array
    log_likelihood: float


def alone(solution: Solution[Member], native: bool = True) -> Alone:
    """Return joint values by the observations alone, by the quadratic at the solution.

    It is done in C where it can be and ``native`` is true.
    """
    by_joints = solution.linear.by_joints
    if native and library.is_native and by_joints.shape[2] <= MOST:
        return _alone(solution)
    weights = inverted(solution.covariance)
    weighted = np.swapaxes(by_joints, 1, 2) @ weights
    # A turn that moves nothing is known as little as can be, and so little that it does not matter.
    covariances = inverted(weighted @ by_joints + LITTLE * np.eye(by_joints.shape[2]))
    change = times(covariances, times(weighted, solution.residuals))
    left = solution.residuals - times(by_joints, change)
    log = -0.5 * float(np.sum(left * times(weights, left))) + 0.5 * log_determinants(math.tau * covariances)
    return Alone(
        solution.values + change, covariances, log - 0.5 * log_determinants(math.tau * solution.covariance)
    )


def _alone(solution: Solution[Member]) -> Alone:
    count, rows, joints = solution.linear.by_joints.shape
    given = [
        np.ascontiguousarray(x) for x in (solution.covariance, solution.linear.by_joints, solution.residuals)
    ]
    values, covariances = np.array(solution.values, order="C"), np.empty((count, joints, joints))
    pointers = (x.ctypes.data for x in (*given, values, covariances))
    log: float = library.code.alone(count, rows, joints, LITTLE, *pointers)
    return Alone(values, covariances, log)


@dataclass(frozen=True)
class Widths:
    """How wide a motion is.

    Attributes
    ----------
    deviations, mean
        s and μ for each joint value, (k,).
    log_density
        log ∫ Π N(â_k; μ, s² + C_k) ds at this μ, with s anywhere between hardly anything and metres or whole
        turns, all orders of magnitude alike.
    """

    deviations: Array
    mean: Array
    log_density: float


def widths(motion: Member, seen: Alone, native: bool = True) -> Widths:
    """Return the most likely widths of the motion; in C like :func:`alone`."""
    if native and library.is_native and motion.joints <= MOST:
        return _widths(motion, seen)
    kinds = np.array(motion.kinds)
    deviations, occam = np.zeros(len(kinds)), 0.0
    variances = np.einsum("nii->ni", seen.covariances)
    for kind in sorted(set(motion.kinds)):
        block = kinds == kind
        deviations[block], part = _width(seen.values[:, block], variances[:, block])
        occam += part
    total = seen.covariances + np.diag(deviations**2)
    weights = inverted(total)
    mean: Array = np.linalg.solve(weights.sum(axis=0), times(weights, seen.values).sum(axis=0))
    off = seen.values - mean
    log = -0.5 * float(np.sum(off * times(weights, off))) - 0.5 * log_determinants(math.tau * total)
    return Widths(deviations, mean, log + occam)


def _widths(motion: Member, seen: Alone) -> Widths:
    kinds, deviations, mean = (
        np.array(motion.kinds, dtype=np.int64),
        np.empty(motion.joints),
        np.empty(motion.joints),
    )
    values, covariances = np.ascontiguousarray(seen.values), np.ascontiguousarray(seen.covariances)
    log: float = library.code.widths(
        len(values),
        motion.joints,
        kinds.ctypes.data,
        values.ctypes.data,
        covariances.ctypes.data,
        len(GRID),
        GRID.ctypes.data,
        deviations.ctypes.data,
        mean.ctypes.data,
    )
    if math.isnan(log) and np.isfinite(values).all():
        raise MemoryError("There is no memory for so many observations.")
    return Widths(deviations, mean, log)


def _width(values: Array, variances: Array) -> tuple[float, float]:
    """Return the best s, and the logarithm of the mean over all s relative to the best."""
    total = variances + GRID[:, None, None] ** 2
    weights = 1.0 / total
    mean = (weights * values).sum(axis=1) / weights.sum(axis=1)
    squares = (values - mean[:, None, :]) ** 2 * weights
    # With the mean integrated out, or a few values would seem narrower than they are.
    logs = -0.5 * (np.log(total) + squares).sum(axis=(1, 2)) - 0.5 * np.log(weights.sum(axis=1)).sum(axis=1)
    top = int(np.argmax(logs))
    best = math.log(float(GRID[top]))
    if 0 < top < len(logs) - 1:
        before, here, after = logs[top - 1 : top + 2]
        best += 0.5 * _STEP * float((after - before) / (2.0 * here - before - after))
    return math.exp(best), math.log(float(np.mean(np.exp(logs - logs[top]))))
