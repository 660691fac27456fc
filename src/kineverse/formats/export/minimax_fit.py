"""Minimax polynomial fits (Remez exchange) with certified error bounds.

The polynomial is found by Remez' exchange on samples. Its error is then bounded without samples: over each
interval the series of the difference is known, by interval arithmetic, and intervals are halved where the
bound is not yet close to the largest error that occurs.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.formats.description import Coefficients
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

Matrix = npt.NDArray[np.float64]
SeriesCurve = Callable[[RealInterval], TaylorSeries]
"""The series of a function over an interval."""

SAMPLE_COUNT = 257
_CLOSE = 1.05
_NEGLIGIBLE = 1e-3
"""What part of the tolerance need not be made sure of any further."""
_MOST_INTERVALS = 1000
_HALVINGS = 4


@dataclass(frozen=True)
class MinimaxFit:
    """A polynomial in place of a curve over an interval.

    ``error`` is certain to be no less than the largest difference, ``sampled`` the largest that was met, and
    ``largest`` bounds the amount of the polynomial itself.
    """

    polynomial: Coefficients
    error: float
    sampled: float
    largest: float


def chebyshev_points(lower: float, upper: float) -> Matrix:
    """Return points that lie closer together towards the ends, where errors of polynomials are largest."""
    angles = np.linspace(np.pi, 0, SAMPLE_COUNT)
    return (lower + upper) / 2 + (upper - lower) / 2 * np.cos(angles)


def fit_polynomial(
    curve: SeriesCurve, values: Matrix, lower: float, upper: float, degree: int, enough: float
) -> MinimaxFit:
    """Return the best polynomial of a degree for a curve.

    Parameters
    ----------
    curve
        The curve, enclosed.
    values
        What it is worth at :func:`chebyshev_points`.
    lower, upper
        The interval.
    degree
        Of the polynomial.
    enough
        An error larger than this is not bounded from above any more: it is too large for certain.
    """
    x = chebyshev_points(lower, upper)
    polynomial = _remez(x, values, lower, upper, degree)
    found = np.polynomial.polynomial.polyval(x, polynomial)
    sampled = float(np.abs(found - values).max())
    largest = float(np.abs(values).max()) + sampled
    if sampled > enough:
        return MinimaxFit(polynomial, math.inf, sampled, largest)
    error = bound_error(curve, polynomial, lower, upper, sampled, _NEGLIGIBLE * enough)
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
    """Return a number that |curve - polynomial| exceeds nowhere in an interval, close to the least such."""

    def difference(where: RealInterval) -> TaylorSeries:
        return taylor_subtract(curve(where), taylor_polynomial(polynomial, taylor_variable(where)))

    def entry(low: float, high: float) -> tuple[float, float, float]:
        nonlocal sampled
        middle = (low + high) / 2
        here, around = difference((middle, middle)), difference((low, high))
        sampled = max(sampled, -here[0][1], here[0][0])
        return -_size(_evaluate_series(here, around, low, high)), low, high

    waiting = [entry(lower, upper)]
    while len(waiting) < _MOST_INTERVALS:
        worst, low, high = waiting[0]
        middle = (low + high) / 2
        if -worst <= max(_CLOSE * sampled, sampled + negligible) or not low < middle < high:
            break
        heapq.heapreplace(waiting, entry(low, middle))
        heapq.heappush(waiting, entry(middle, high))
    return -waiting[0][0]


def enclose_curve(curve: SeriesCurve, lower: float, upper: float, pieces: int = 32) -> RealInterval:
    """Return between which numbers a curve lies over an interval, in pieces as short as they have to be."""
    ends = np.linspace(lower, upper, pieces + 1).tolist()
    waiting = [(low, high, _HALVINGS) for low, high in itertools.pairwise(ends)]
    result: RealInterval | None = None
    while waiting:
        low, high, more = waiting.pop()
        middle = (low + high) / 2
        here = _evaluate_series(curve((middle, middle)), curve((low, high)), low, high)
        if more and not math.isfinite(here[1] - here[0]):
            waiting += [(low, middle, more - 1), (middle, high, more - 1)]
            continue
        result = here if result is None else interval_hull(result, here)
    assert result is not None
    return result


def _evaluate_series(here: TaylorSeries, around: TaylorSeries, low: float, high: float) -> RealInterval:
    """Return the range over an interval, by the series in its middle and the last coefficient all over it."""
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
    """Return the polynomial with the least largest error at points, by exchanging where that is reached."""
    t = (2 * x - lower - upper) / (upper - lower)
    basis = np.polynomial.chebyshev.chebvander(t, degree)
    chosen = np.linspace(0, len(x) - 1, degree + 2).round().astype(int)
    best, least = np.zeros(degree + 1), np.inf
    for _ in range(40):
        signs = (-1.0) ** np.arange(degree + 2)
        solution = np.linalg.solve(np.column_stack([basis[chosen], signs]), y[chosen])
        coefficients, level = solution[:-1], abs(solution[-1])
        error = y - basis @ coefficients
        if np.abs(error).max() < least:
            best, least = coefficients, float(np.abs(error).max())
        if np.abs(error).max() <= 1.0001 * level + 1e-15:
            break
        # One point of each stretch on which the error keeps its sign: that at which it is largest.
        turns = np.flatnonzero(np.diff(np.sign(error))) + 1
        peaks = np.array(
            [s[np.argmax(np.abs(error[s]))] for s in np.split(np.arange(len(x)), turns) if len(s)]
        )
        if len(peaks) < degree + 2:
            break
        largest = int(np.argmax(np.abs(error[peaks])))
        first = min(max(0, largest - (degree + 1) // 2), len(peaks) - degree - 2)
        chosen = peaks[first : first + degree + 2]
    whole = np.polynomial.Chebyshev(best, domain=[lower, upper]).convert(kind=np.polynomial.Polynomial)
    found = tuple(float(c) for c in whole.coef)
    return (*found, *(0.0,) * (degree + 1 - len(found)))
