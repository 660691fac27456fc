"""How probable observations are under a family, with all that is unknown about it integrated out.

Joint values are drawn from a Gaussian whose width s is that of the motion, see :mod:`.widths`. They
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

from .matrices import inverted, log_determinants, times
from .motion import Member
from .rigid import Array
from .sliding import by_point
from .solving import Solution
from .widths import Alone, Widths, alone, widths


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
    def of(log: float, information: Array, size: int, values: Array, covariances: Array) -> Evidence:
        """Return it with the covariance of the first unknowns, which are the parameters."""
        return Evidence(log, inverted(information)[:size, :size], values, covariances)


def evidence(solution: Solution[Member]) -> Evidence:
    """Return the evidence of a family of joints around its most likely member."""
    motion, size = solution.motion, solution.motion.size
    seen = alone(solution)
    width = widths(motion, seen) if motion.joints else Widths(np.zeros(0), np.zeros(0), 0.0)
    values, covariances = _together(seen, width)
    information = _information(solution, width, values)
    prior = motion.prior().by_parameters
    information[:size, :size] += prior.T @ prior
    beforehand, precision = motion.beforehand(width.mean)
    information[np.diag_indices_from(information)] += precision
    log = seen.log_likelihood + width.log_density + beforehand
    log += 0.5 * len(information) * math.log(math.tau) - 0.5 * float(np.linalg.slogdet(information)[1])
    return Evidence.of(log, information, size, values, covariances)


def overrated(solution: Solution[Member]) -> float:
    """Return by how much the quadratic promises more, as a logarithm, than is there where steps ended early.

    Evidence takes the quadratic at its word. Where it has not been followed to its end, what was reached is
    what counts.
    """
    belief = solution.belief
    if solution.converged or not belief.marginal:
        return 0.0
    seen = alone(solution)
    total = seen.covariances + np.diag(1.0 / belief.precision)
    off = seen.values - belief.mean
    promised = -0.5 * float(np.sum(off * times(inverted(total), off))) - 0.5 * log_determinants(
        math.tau * total
    )
    prior = solution.motion.prior().residuals
    reached = -0.5 * (solution.cost - float(prior @ prior)) - 0.5 * solution.residuals.size * math.log(
        math.tau
    )
    return max(0.0, promised + seen.log_likelihood - reached)


def _together(seen: Alone, width: Widths) -> tuple[Array, Array]:
    """Return joint values and their covariances if they are also believed within the width."""
    if not len(width.mean):
        return seen.values, seen.covariances
    variance = np.diag(width.deviations**2)
    shrink = variance @ inverted(seen.covariances + variance)
    values: Array = width.mean + (shrink @ (seen.values - width.mean)[:, :, None])[:, :, 0]
    return values, shrink @ seen.covariances


def _information(solution: Solution[Member], width: Widths, values: Array) -> Array:
    """Return the information about parameters, μ and the point that slides."""
    linear = solution.motion.at(values)
    by_joints = linear.by_joints
    moved = (by_joints * width.deviations**2) @ np.swapaxes(by_joints, 1, 2)
    weights = inverted(solution.covariance + moved)
    both = np.concatenate([linear.by_parameters, by_joints, by_point(solution.motion, values)], axis=2)
    result: Array = (np.swapaxes(both, 1, 2) @ weights @ both).sum(axis=0)
    return result
