"""Autocorrelation time and effective sample size of residuals.

Successive errors of poses are often correlated: cameras are filtered, markers are bent, hands slip. With the
integrated autocorrelation time

    τ = 1 + 2 Σ ρ_k

N observations are worth N / τ independent ones. The sum is cut off at a lag of 3 τ (Sokal 1997), because
correlations at larger lags are noise. With M lags, τ has a relative standard deviation of √((4 M + 2) / N).
"""

from __future__ import annotations

import math

import numpy as np

from kineverse.lie import Array

LEAST_EFFECTIVE = 8
"""Least effective sample size; residuals of a joint that is slightly wrong are one long wave."""

# Least number of rows to estimate a correlation from.
_LEAST_COUNT = 20
# Least size of a component relative to the largest.
_SHARE = 0.2
# Cut-off of the sum, in autocorrelation times.
_WINDOW = 3
# Number of first lags, and their mean correlation in standard deviations, below which errors are independent.
_FIRST, _CHANCE = 5, 2.5


def effective_sample_size(residuals: Array) -> int:
    """Return the effective sample size of residuals (N, m) in order.

    It is N / τ for the component with the largest autocorrelation time τ, and at least 8.
    """
    count = len(residuals)
    return min(count, max(LEAST_EFFECTIVE, round(count / correlation_time(residuals))))


def correlation_time(residuals: Array, deviations: float = 0.0) -> float:
    """Return the autocorrelation time of residuals (N, m) in order, in rows.

    The component with the largest one counts, among those that are not small beside the others of positions
    or orientations.
    Outliers are clipped. Twenty rows or fewer cannot show a correlation, and have the time 1.

    Parameters
    ----------
    residuals
        Residuals of neighbours next to each other, the three of positions first.
    deviations
        Number of standard deviations that are added to each estimate, for an upper confidence bound.
    """
    if len(residuals) <= _LEAST_COUNT:
        return 1.0
    sizes = np.median(np.abs(residuals), axis=0)
    kept = [
        residuals[:, k]
        for block in (range(3), range(3, residuals.shape[1]))
        for k in block
        if k < len(sizes)
        and sizes[k] > 0.0
        and sizes[k] >= _SHARE * max(sizes[i] for i in block if i < len(sizes))
    ]
    return max((_component_time(column, deviations) for column in kept), default=1.0)


def _component_time(errors: Array, deviations: float) -> float:
    middle, count = float(np.median(np.abs(errors))), len(errors)
    # Clip at three standard deviations.
    spectrum = np.fft.rfft(np.clip(errors, -4.5 * middle, 4.5 * middle), 2 * count)
    correlations = np.fft.irfft(np.abs(spectrum) ** 2)[: count // 2]
    correlations /= correlations[0]
    if correlations[1 : 1 + _FIRST].mean() < _CHANCE / math.sqrt(_FIRST * count):
        return 1.0
    times = 1.0 + 2.0 * np.cumsum(correlations[1:])
    lags = np.arange(1, len(correlations))
    beyond = np.flatnonzero(lags >= _WINDOW * times)
    last = int(beyond[0]) if len(beyond) else len(times) - 1
    uncertainty = math.sqrt((4.0 * lags[last] + 2.0) / count)
    return max(1.0, float(times[last]) * (1.0 + deviations * uncertainty))
