"""Correlation of errors in time: autocorrelation time, effective sample size, and their online estimate.

N observations with the integrated autocorrelation time τ are worth N / τ independent ones,

    τ = 1 + 2 Σ ρ_k

cut off at a lag of 3 τ (Sokal 1997), as correlations at larger lags are noise. With M lags, τ has a relative
standard deviation of √((4 M + 2) / N).

Online, a whitened error is x = c + s + w: a constant c of unknown size, a stationary process s with the
correlation e^(-Δt/τ) and the variance σ², and white noise w with the variance 1 - σ². A Kalman filter for
each point (σ², τ) of a grid yields their posterior. The variance of the mean of N errors is m/N, with the
posterior mean of

    m = 1 + 2 σ² Σ_l e^(-l Δt/τ) = 1 + 2 σ² / (e^(Δt/τ) - 1)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kineverse.lie import Array

from .noise import CHI_SQUARED_6

LEAST_EFFECTIVE = 8
"""Least effective sample size; residuals of a joint that is slightly wrong are one long wave."""

_LEAST_COUNT = 20  # least number of rows to estimate a correlation from
_SHARE = 0.2  # least size of a component relative to the largest
_WINDOW = 3  # cut-off of the sum, in autocorrelation times
# Number of first lags, and their mean correlation in standard deviations, below which errors are independent.
_FIRST, _CHANCE = 5, 2.5


def correlation_time(residuals: Array, deviations: float = 0.0) -> float:
    """Return the autocorrelation time of residuals (N, m) in order, in rows, those of positions first.

    The component with the largest one counts, among those that are not small compared with the others of
    positions or orientations. Outliers are clipped. Twenty rows or fewer have the time 1. For an upper
    confidence bound, some standard deviations are added to each estimate.
    """
    if len(residuals) <= _LEAST_COUNT:
        return 1.0
    kept = []
    for block in (residuals[:, :3], residuals[:, 3:]):
        sizes = np.median(np.abs(block), axis=0)
        least = max(_SHARE * float(sizes.max(initial=0.0)), np.finfo(float).tiny)
        kept += list(block[:, sizes >= least].T)
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


LONGEST_TIME, LONGEST_LOOKS = 1.0, 30.0
"""Longest correlation time that is considered, with time stamps [s] and without [looks]."""

_SHARES = np.array([0.03, 0.1, 0.25, 0.5, 0.75, 0.95])
_FRACTIONS = np.array([1.0 / 30.0, 0.1, 1.0 / 3.0, 1.0])
_OFFSET, _DRIFT = 30.0**2, 0.01  # variance of the offset, and its growth per longest correlation time
# Prior probability of independent errors, and the number of looks after which the past is forgotten.
_INDEPENDENT, _MEMORY = 0.8, 600.0
_JUMP = 5  # successive outliers after which the offset is taken as new


@dataclass(frozen=True)
class CorrelationSettings:
    """Stated or unknown correlation of errors in time."""

    time: float | None  # correlation time of the errors [s], or in looks if there are no time stamps
    stamped: bool  # True if the looks have time stamps

    def measure(self, residuals: Array, size: int, stamps: Array) -> float:
        """Return the number of looks that are worth one, from residuals (N, 6) at times (N,)."""
        correlation = ErrorCorrelation(self)
        for residual, at in zip(residuals, stamps.tolist(), strict=True):
            correlation.add(residual, size, at)
        return correlation.looks


class ErrorCorrelation:
    """Number of looks that are worth one with independent errors."""

    def __init__(self, settings: CorrelationSettings) -> None:
        self._stated = settings.time
        longest = LONGEST_TIME if settings.stamped else LONGEST_LOOKS
        shares, times = np.meshgrid(_SHARES, longest * _FRACTIONS, indexing="ij")
        self._shares = np.append(shares.ravel(), 0.0)
        self._times = np.append(times.ravel(), longest)
        self._longest = longest
        count = len(self._shares)
        self._slow, self._offset = np.zeros((count, 6)), np.zeros((count, 6))
        # Variances of both, and their covariance.
        self._variances = self._shares.copy(), np.full(count, _OFFSET), np.zeros(count)
        self._log = np.zeros(count)
        self._log_prior = np.full(count, math.log((1.0 - _INDEPENDENT) / (count - 1)))
        self._log_prior[-1] = math.log(_INDEPENDENT)
        self._last: float | None = None
        self._gap = 1.0 / LONGEST_LOOKS * longest
        self._outliers = 0
        self.looks = self._count_looks()

    def add(self, residual: Array, size: int, at: float) -> float:
        """Add the whitened residual (6,) with ``size`` degrees of freedom at a time; return ``looks``."""
        gap = math.inf if self._last is None else at - self._last
        if self._last is not None:
            # One long gap does not make the looks after it independent.
            self._gap += 0.05 * (min(gap, 2.0 * self._gap + self._longest) - self._gap)
        self._last = at
        if self._stated is None and size:
            self._filter(residual, size, gap)
        self.looks = self._count_looks()
        return self.looks

    def _count_looks(self) -> float:
        if self._stated is not None:
            return 1.0 + 2.0 / math.expm1(min(self._gap / self._stated, 700.0)) if self._stated else 1.0
        inflation = 2.0 * self._shares / np.expm1(np.minimum(self._gap / self._times, 700.0))
        weights = np.exp(self._log + self._log_prior - self._log.max())
        return 1.0 + float(weights @ inflation) / float(weights.sum())

    def _filter(self, residual: Array, size: int, gap: float) -> None:
        decay = np.exp(-gap / self._times)
        slow = self._slow * decay[:, None]
        a, b, ab = self._variances
        a = decay**2 * a + (1.0 - decay**2) * self._shares
        b, ab = b + _DRIFT * min(gap / self._longest, 1.0), decay * ab
        error = residual - slow - self._offset
        variance = a + b + 2.0 * ab + 1.0 - self._shares
        squares = np.einsum("ij,ij->i", error, error) / variance
        self._log *= 1.0 - 1.0 / _MEMORY
        # An outlier has no information about the correlation.
        self._log -= 0.5 * np.minimum(size * np.log(variance) + squares, CHI_SQUARED_6)
        inlier = squares < CHI_SQUARED_6
        self._outliers = 0 if inlier.any() else self._outliers + 1
        if self._outliers >= _JUMP:
            self._outliers = 0
            b, ab = np.full_like(b, _OFFSET), np.zeros_like(ab)
        with_slow, with_offset = a + ab, b + ab
        gain, other = inlier * with_slow / variance, inlier * with_offset / variance
        self._slow, self._offset = slow + gain[:, None] * error, self._offset + other[:, None] * error
        self._variances = a - gain * with_slow, b - other * with_offset, ab - gain * with_offset
