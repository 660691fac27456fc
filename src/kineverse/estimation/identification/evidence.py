"""How probable observations are under a family, with all that is unknown about it integrated out.

Joint values are drawn from a Gaussian whose width s is that of the motion; s itself is anything between
hardly anything and metres or whole turns, all orders of magnitude alike. With the maximum â_k of the
likelihood of each observation and its covariance C_k, a joint value contributes

    ∫ N(â_k; a, C_k) N(a; μ, s²) da = N(â_k; μ, s² + C_k)

so a motion that is short beside the noise costs next to nothing, and one that is long pays for every joint
value by how much better than s it is known. The mean μ and the parameters follow by Laplace's method. All
families have a mean pose, of which nothing is known beforehand, and it is measured alike in all of them; what
a family has beyond that has a proper prior: directions are anywhere on the sphere, levers within reach.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .groups import REACH, VX, VY, WX, GroupMotion
from .matrices import inverted
from .rigid import Array
from .solving import Solution

# The widths of a motion, from hardly anything to more than there is [m], [rad].
_WIDTHS = np.geomspace(1e-5, 10.0, 43)


@dataclass(frozen=True)
class Evidence:
    """What integrating over everything gives.

    Attributes
    ----------
    log_evidence
        Natural logarithm of the density of the observed relative poses; its unit is common to all families.
    covariance
        Of the parameters, (n, n).
    widths
        Standard deviations of the joint values as estimated, for slides and turns, (k,).
    value_covariances
        C_k, of each joint value by itself, (N, k, k).
    """

    log_evidence: float
    covariance: Array
    widths: Array
    value_covariances: Array


def evidence(solution: Solution[GroupMotion]) -> Evidence:
    """Return the evidence of a family of joints around its most likely member."""
    motion, linear = solution.motion, solution.linear
    count = len(solution.residuals)
    weights = inverted(solution.covariance)
    chi2 = float(np.einsum("nr,nrs,ns->", solution.residuals, weights, solution.residuals))
    log = -0.5 * chi2 - 0.5 * float(np.sum(np.linalg.slogdet(2.0 * math.pi * solution.covariance)[1]))
    joints = motion.joints
    widths, mean = np.zeros(joints), np.zeros(joints)
    spread = np.zeros((count, 0, 0))
    if joints:
        transposed = np.swapaxes(linear.by_joints, 1, 2)
        spread = inverted(transposed @ weights @ linear.by_joints)
        blocks = [
            [i for i, j in enumerate(motion.freedom.joints) if (j >= WX) == turning] for turning in (0, 1)
        ]
        gain, widths, mean = _width(solution.values, spread, [b for b in blocks if b])
        log += 0.5 * float(np.sum(np.linalg.slogdet(2.0 * math.pi * spread)[1])) + gain
    information = _information(solution, widths, mean, spread)
    prior = motion.prior().by_parameters
    size = motion.size
    information[:size, :size] += prior.T @ prior
    # As wide as half a sphere is, and with its density: a direction that nothing tells stays finite.
    turned = [i for i, j in enumerate(motion.freedom.left) if j >= WX]
    information[turned, turned] += 1.0
    log += log_prior(motion)
    log += 0.5 * (size + joints) * math.log(2.0 * math.pi) - 0.5 * float(np.linalg.slogdet(information)[1])
    log += _volume(solution, mean)
    covariance = inverted(information)[:size, :size]
    return Evidence(log, covariance, widths, spread)


def log_prior(motion: GroupMotion) -> float:
    """Return the logarithm of the density of what a family has beyond a mean pose."""
    freedom, reach = motion.freedom, motion.group.reach
    result = 0.0
    if WX in freedom.left:
        result -= math.log(2.0 * math.pi)
    if VX in freedom.left and VY in freedom.left and reach:
        lever = motion.right[:reach, 3] / REACH
        result -= 0.5 * float(lever @ lever) + 0.5 * reach * math.log(2.0 * math.pi * REACH**2)
    return result


def _width(values: Array, spread: Array, blocks: Sequence[Sequence[int]]) -> tuple[float, Array, Array]:
    """Return log ∫ Π N(â_k; μ, s² + C_k) ds at the best μ, the best s, and μ."""
    joints = values.shape[1]
    variances = np.zeros(joints)
    best = [float(np.var(values[:, b])) for b in blocks]
    for b, v in zip(blocks, best, strict=True):
        variances[b] = v
    logs = np.zeros(len(_WIDTHS))
    total, peak = 0.0, 0.0
    for _ in range(1 if len(blocks) == 1 else 2):
        total = 0.0
        for block in blocks:
            logs = _logs(values, spread, variances, block)
            top = int(np.argmax(logs))
            variances[block] = _WIDTHS[top] ** 2
            peak = float(logs[top])
            total += math.log(float(np.mean(np.exp(logs - peak))))
    mean = _mean(values, spread + np.diag(variances))
    return total + peak, np.sqrt(variances), mean


def _logs(values: Array, spread: Array, variances: Array, block: Sequence[int]) -> Array:
    joints = values.shape[1]
    if joints == 1:
        total = spread[:, 0, 0] + _WIDTHS[:, None] ** 2
        weights = 1.0 / total
        mean = (weights @ values[:, 0]) / weights.sum(axis=1)
        off = values[:, 0] - mean[:, None]
        result: Array = -0.5 * np.sum(np.log(2.0 * math.pi * total) + off**2 * weights, axis=1)
        return result
    logs = np.empty(len(_WIDTHS))
    for i, width in enumerate(_WIDTHS):
        tried = variances.copy()
        tried[list(block)] = width**2
        total = spread + np.diag(tried)
        off = values - _mean(values, total)
        squares = float(np.sum(off * np.linalg.solve(total, off[:, :, None])[:, :, 0]))
        logs[i] = -0.5 * squares - 0.5 * float(np.sum(np.linalg.slogdet(2.0 * math.pi * total)[1]))
    return logs


def _mean(values: Array, total: Array) -> Array:
    weights = inverted(total)
    result: Array = np.linalg.solve(weights.sum(axis=0), np.einsum("nij,nj->i", weights, values))
    return result


def _information(solution: Solution[GroupMotion], widths: Array, mean: Array, spread: Array) -> Array:
    """Return the information about parameters and μ, when joint values are believed within their widths."""
    motion = solution.motion
    if not motion.joints:
        weights = inverted(solution.covariance)
        both = solution.linear.by_parameters
    else:
        variance = np.diag(widths**2)
        shrunk = np.linalg.solve(spread + variance, (solution.values - mean)[:, :, None])
        linear = motion.at(mean + (variance @ shrunk)[:, :, 0])
        by_joints = linear.by_joints
        weights = inverted(solution.covariance + by_joints @ variance @ np.swapaxes(by_joints, 1, 2))
        both = np.concatenate([linear.by_parameters, by_joints], axis=2)
    result: Array = np.einsum("nri,nrs,nsj->ij", both, weights, both)
    return result


def _volume(solution: Solution[GroupMotion], mean: Array) -> float:
    """Return the logarithm of the volume of mean poses per unit of the parameters that move it."""
    motion = solution.motion
    linear = motion.at(mean[None, :])
    start = len(motion.freedom.left)
    moved = linear.by_parameters[0, :, start : start + len(motion.freedom.right)]
    matrix = np.concatenate([moved, linear.by_joints[0]], axis=1)
    return float(np.linalg.slogdet(matrix)[1])
