"""How probable observations are under an articulation as served, beside what else could be there.

As in :mod:`kineverse.estimation.identification.evidence`, joint values are drawn from a Gaussian of unknown
mean and width, here cut off at the limits: so a door that only moved a little is not compared with one that
moved all the way. What is identified instead has a mean pose of which nothing is known beforehand; here it is
somewhere within a cube of 2 m and turned in any way, so that both densities have the same unit.
"""

from __future__ import annotations

import math

import numpy as np

from kineverse.estimation.identification.matrices import inverted, log_determinants, times
from kineverse.estimation.identification.rigid import Array

from .misfit import SIZES, Misfit
from .served import Served

_WIDTHS = np.geomspace(1e-5, 10.0, 43)
_STILL = np.array([1e-9])
_erf = np.vectorize(math.erf, otypes=[np.float64])


def log_evidence(served: Served, seen: Misfit, still: bool = False) -> float:
    """Return the logarithm of the density of the observed relative poses, with joint values integrated out.

    Limits cut off what is drawn only where there is one joint value. What is beyond those of several, or
    beyond ties, is less probable by its distance.

    Parameters
    ----------
    served, seen
        The articulation and what it leaves unexplained.
    still
        Whether it is taken as not moving, somewhere within its limits.
    """
    log = -float(np.sum(0.5 * np.sum(seen.normal**2, axis=1) + seen.log_scale))
    log -= 0.5 * float(np.nansum(np.maximum(seen.tied, 0.0) ** 2))
    # What others say of a coordinate differs by 1 on average if the model is right.
    told = np.isfinite(seen.apart)
    log -= 0.5 * float(np.maximum(np.nansum(seen.apart**2, axis=0) - told.sum(axis=0), 0.0).sum())
    widths = _STILL if still else _WIDTHS
    if served.joints == 1:
        lower, upper = float(served.lower[0]), float(served.upper[0])
        density = float(_log_density(served)[0])
        values, variances = seen.values[:, 0], seen.covariances[:, 0, 0]
        return log + _log_mean(_log_widths(values, variances, lower, upper, widths, density))
    # Of several joint values the prior is not cut off, but the nearest that is inside the limits counts.
    log -= 0.5 * float(np.sum(np.maximum(seen.beyond, 0.0) ** 2))
    return log + (_several(served, seen, widths) if served.joints else 0.0)


def log_elsewhere(seen: Misfit) -> float:
    """Return by how much the density is larger if the articulation, or the child on it, sits elsewhere.

    With ρ = G δ + noise and δ ~ N(0, s² I), where it sits integrated out, on average over some sizes s. As a
    logarithm.
    """
    transposed = np.swapaxes(seen.by_place, 1, 2)
    information = np.sum(transposed @ seen.by_place, axis=0)
    pull = np.sum(transposed @ seen.normal[:, :, None], axis=0)[:, 0]
    logs = []
    for size in SIZES:
        total = information + np.eye(len(pull)) / size**2
        log_volume = np.linalg.slogdet(size**2 * total)[1]
        logs.append(0.5 * (pull @ np.linalg.solve(total, pull) - log_volume))
    return _log_mean(np.array(logs))


def _several(served: Served, seen: Misfit, widths: Array) -> float:
    """Return log ∫ Π_k ∫ N(â_k; a, C_k) p(a; μ, s) da dμ at the best widths s, on average."""
    best, log = np.zeros(served.joints), 0.0
    for j in range(served.joints):
        variances = seen.covariances[:, j, j]
        logs = _log_widths(seen.values[:, j], variances, -math.inf, math.inf, widths, 0.0)
        best[j] = widths[int(np.argmax(logs))]
        log += _log_mean(logs - float(np.max(logs)))
    total = seen.covariances + np.diag(best**2)
    weights = inverted(total)
    information = weights.sum(axis=0)
    mean = np.linalg.solve(information, times(weights, seen.values).sum(axis=0))
    off = seen.values - mean
    log -= 0.5 * (float(np.sum(off * times(weights, off))) + log_determinants(math.tau * total))
    volume = 0.5 * log_determinants(math.tau * inverted(information)[None])
    return log + min(volume + float(_log_density(served).sum()), 0.0)


def _log_density(served: Served) -> Array:
    """Return the logarithm of the density of the mean of each joint value: anywhere within its limits."""
    width = served.upper - served.lower
    free = np.where(served.turning, 2.0 * math.pi, 20.0)
    density: Array = -np.log(np.where(np.isfinite(width), np.maximum(width, 1e-6), free))
    return density


def _log_mean(logs: Array) -> float:
    return float(np.logaddexp.reduce(logs)) - math.log(len(logs))


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
