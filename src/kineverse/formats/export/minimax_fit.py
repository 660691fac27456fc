"""Minimax polynomial fits (Remez exchange) with certified error bounds.

Remez' exchange algorithm finds the polynomial on samples. Interval arithmetic then bounds its error
everywhere: the Taylor series of the difference encloses it on each interval, and intervals are halved until
the bound is close to the largest error at a point.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kineverse.formats.description import Coefficients, Matrix
from kineverse.intervals.arithmetic import (
    ZERO_INTERVAL,
    RealInterval,
    interval_add,
    interval_hull,
    interval_multiply,
    interval_power,
    round_outwards,
)
from kineverse.intervals.taylor import TaylorSeries, taylor_polynomial, taylor_subtract, taylor_variable

SeriesCurve = Callable[[RealInterval], TaylorSeries]
"""Function that returns the Taylor series of a curve over an interval."""

SAMPLE_COUNT = 257
_CLOSE = 1.05
"""Ratio of the error bound to the largest sampled error at which the bound is close enough."""
_NEGLIGIBLE = 1e-3
"""Part of the tolerance within which the bound is close enough."""
_MAX_INTERVALS = 1000
_MAX_HALVINGS = 4
_MAX_EXCHANGES = 40


@dataclass(frozen=True)
class MinimaxFit:
    """Polynomial approximation of a curve over an interval.

    ``error`` is a certified upper bound of the largest difference, ``sampled`` the largest difference at a
    sampled point. ``largest`` bounds the magnitude of the polynomial.
    """

    polynomial: Coefficients
    error: float
    sampled: float
    largest: float


def chebyshev_points(lower: float, upper: float) -> Matrix:
    """Return the Chebyshev points of an interval, which are closer together towards its ends."""
    angles = np.linspace(np.pi, 0, SAMPLE_COUNT)
    return (lower + upper) / 2 + (upper - lower) / 2 * np.cos(angles)


def fit_polynomial(
    curve: SeriesCurve, values: Matrix, lower: float, upper: float, degree: int, tolerance: float
) -> MinimaxFit:
    """Return the minimax polynomial of a curve."""
    x = chebyshev_points(lower, upper)
    polynomial = _remez(x, values, lower, upper, degree)
    found = np.polynomial.polynomial.polyval(x, polynomial)
    sampled = float(np.abs(found - values).max())
    largest = float(np.abs(values).max()) + sampled
    if sampled > tolerance:
        return MinimaxFit(polynomial, math.inf, sampled, largest)
    error = bound_error(curve, polynomial, lower, upper, sampled, _NEGLIGIBLE * tolerance)
    extent = enclose_curve(lambda where: taylor_polynomial(polynomial, taylor_variable(where)), lower, upper)
    return MinimaxFit(polynomial, error, sampled, max(abs(extent[0]), abs(extent[1])))


def bound_error(
    curve: SeriesCurve,
    polynomial: Coefficients,
    lower: float,
    upper: float,
    sampled: float,
    negligible: float,
) -> float:
    """Return an upper bound of |curve - polynomial| over an interval, close to the least one."""

    def difference(where: RealInterval) -> TaylorSeries:
        return taylor_subtract(curve(where), taylor_polynomial(polynomial, taylor_variable(where)))

    def entry(low: float, high: float) -> tuple[float, float, float]:
        nonlocal sampled
        middle = (low + high) / 2
        here, around = difference((middle, middle)), difference((low, high))
        sampled = max(sampled, -here[0][1], here[0][0])
        return -_size(_evaluate_series(here, around, low, high)), low, high

    heap = [entry(lower, upper)]
    while len(heap) < _MAX_INTERVALS:
        worst, low, high = heap[0]
        middle = (low + high) / 2
        if -worst <= max(_CLOSE * sampled, sampled + negligible) or not low < middle < high:
            break
        heapq.heapreplace(heap, entry(low, middle))
        heapq.heappush(heap, entry(middle, high))
    return -heap[0][0]


def enclose_curve(curve: SeriesCurve, lower: float, upper: float, pieces: int = 32) -> RealInterval:
    """Return a range that contains a curve over an interval, from pieces that are halved if need be."""
    ends = np.linspace(lower, upper, pieces + 1).tolist()
    stack = [(low, high, _MAX_HALVINGS) for low, high in itertools.pairwise(ends)]
    result: RealInterval | None = None
    while stack:
        low, high, halvings = stack.pop()
        middle = (low + high) / 2
        here = _evaluate_series(curve((middle, middle)), curve((low, high)), low, high)
        if halvings and not math.isfinite(here[1] - here[0]):
            stack += [(low, middle, halvings - 1), (middle, high, halvings - 1)]
            continue
        result = here if result is None else interval_hull(result, here)
    assert result is not None
    return result


def _evaluate_series(here: TaylorSeries, around: TaylorSeries, low: float, high: float) -> RealInterval:
    """Return a range of a function over an interval by Taylor's theorem.

    ``here`` is the series at the midpoint, ``around`` that over the interval, whose last coefficient bounds
    the remainder.
    """
    value, count = around[0], min(len(here), len(around))
    if count == 1:
        return value
    middle = (low + high) / 2
    away = round_outwards(low - middle, high - middle)
    total = ZERO_INTERVAL
    for k in range(count):
        coefficient = around[k] if k == count - 1 else here[k]
        total = interval_add(
            total,
            interval_multiply(coefficient, interval_power(away, (k, k)) if k else (1.0, 1.0)),
        )
    return max(total[0], value[0]), min(total[1], value[1])


def _size(a: RealInterval) -> float:
    size = max(-a[0], a[1])
    return math.inf if math.isnan(size) else size


def _remez(x: Matrix, y: Matrix, lower: float, upper: float, degree: int) -> Coefficients:
    """Return the minimax polynomial on points by Remez' exchange of the reference points."""
    t = (2 * x - lower - upper) / (upper - lower)
    basis = np.polynomial.chebyshev.chebvander(t, degree)
    chosen = np.linspace(0, len(x) - 1, degree + 2).round().astype(int)
    best, least = np.zeros(degree + 1), np.inf
    for _ in range(_MAX_EXCHANGES):
        signs = (-1.0) ** np.arange(degree + 2)
        solution = np.linalg.solve(np.column_stack([basis[chosen], signs]), y[chosen])
        coefficients, level = solution[:-1], abs(solution[-1])
        error = y - basis @ coefficients
        if np.abs(error).max() < least:
            best, least = coefficients, float(np.abs(error).max())
        if np.abs(error).max() <= 1.0001 * level + 1e-15:
            break
        # The largest error of each stretch on which the error keeps its sign.
        sign_changes = np.flatnonzero(np.diff(np.sign(error))) + 1
        peaks = np.array(
            [s[np.argmax(np.abs(error[s]))] for s in np.split(np.arange(len(x)), sign_changes) if len(s)]
        )
        if len(peaks) < degree + 2:
            break
        largest = int(np.argmax(np.abs(error[peaks])))
        first = min(max(0, largest - (degree + 1) // 2), len(peaks) - degree - 2)
        chosen = peaks[first : first + degree + 2]
    whole = np.polynomial.Chebyshev(best, domain=[lower, upper]).convert(kind=np.polynomial.Polynomial)
    found = tuple(float(c) for c in whole.coef)
    return (*found, *(0.0,) * (degree + 1 - len(found)))
