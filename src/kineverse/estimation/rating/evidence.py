"""How probable observations are under an articulation as served, beside what else could be there.

As in :mod:`kineverse.estimation.identification.evidence`, joint values are drawn from a Gaussian of unknown
mean and width, here cut off at the limits: so a door that only moved a little is not compared with one that
moved all the way. What is identified instead has a mean pose of which nothing is known beforehand; here it is
somewhere within a cube of 2 m and turned in any way, so that both densities have the same unit.
"""

from __future__ import annotations

import math

import numpy as np

from kineverse.estimation.identification.rigid import Array

from .misfit import Misfit
from .served import Served

_WIDTHS = np.geomspace(1e-5, 10.0, 43)
_STILL = np.array([1e-9])
_erf = np.vectorize(math.erf, otypes=[np.float64])


def log_evidence(served: Served, seen: Misfit, still: bool = False) -> float:
    """Return the logarithm of the density of the observed relative poses, with joint values integrated out.

    Several joint values are taken as independent of each other, and what turns a quaternion as anywhere.

    Parameters
    ----------
    served, seen
        The articulation and what it leaves unexplained.
    still
        Whether it is taken as not moving, somewhere within its limits.
    """
    log = -float(np.sum(0.5 * np.sum(seen.normal**2, axis=1) + seen.log_scale))
    for j in range(served.joints):
        values, variances = seen.values[:, j], seen.covariances[:, j, j]
        lower, upper = float(served.lower[j]), float(served.upper[j])
        if not np.isfinite(upper - lower):
            reach = math.pi if served.turning[j] else 10.0
            density = -math.log(2.0 * reach)
        else:
            density = -math.log(max(upper - lower, 1e-6))
        if served.own[j] is None:
            log += density * len(values)
            continue
        logs = _log_widths(values, variances, lower, upper, _STILL if still else _WIDTHS, density)
        log += float(np.logaddexp.reduce(logs)) - math.log(len(logs))
    return log


def _log_widths(
    values: Array, variances: Array, lower: float, upper: float, widths: Array, density: float
) -> Array:
    """Return log ∫ dμ p(μ) Π_k ∫ N(â_k; a, C_k) p(a; μ, s) da for each width s."""
    s2 = widths[:, None] ** 2
    total = variances + s2
    weights = 1.0 / total
    sums = weights.sum(axis=1)
    mean = np.clip((weights @ values) / sums, lower, upper)
    off = values - mean[:, None]
    logs: Array = -0.5 * np.sum(np.log(2.0 * math.pi * total) + off**2 * weights, axis=1)
    logs += np.minimum(0.5 * np.log(2.0 * math.pi / sums) + density, 0.0)
    if math.isfinite(lower) or math.isfinite(upper):
        spread = np.sqrt(variances * s2 * weights)
        place = (values * s2 + mean[:, None] * variances) * weights
        logs += np.sum(_log_mass(place, spread, lower, upper), axis=1)
        logs -= len(values) * _log_mass(mean, widths, lower, upper)
    return logs


def _log_mass(mean: Array, deviation: Array, lower: float, upper: float) -> Array:
    """Return the logarithm of the part of a Gaussian that is inside limits."""
    scale = math.sqrt(2.0) * deviation
    mass = 0.5 * (_erf((upper - mean) / scale) - _erf((lower - mean) / scale))
    result: Array = np.log(np.maximum(mass, 1e-300))
    return result
