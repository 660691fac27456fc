"""Approximation of couplings by polynomials: minimax fit with a certified bound of its error.

Remez' exchange algorithm finds the polynomial on samples. Interval arithmetic then bounds its error
everywhere: the Taylor series of the difference encloses it on each interval, and intervals are halved until
the bound is close to the largest error at a point.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from kineverse.expressions.expression import Expression
from kineverse.expressions.graph import expand_nodes
from kineverse.formats.description import Coefficients, Matrix
from kineverse.intervals.arithmetic import (
    REALS,
    ZERO_INTERVAL,
    RealInterval,
    interval_add,
    interval_hull,
    interval_multiply,
    interval_power,
    round_outwards,
)
from kineverse.intervals.enclosure import Enclosures
from kineverse.intervals.graph import Term, TermGraph, reachable_terms
from kineverse.intervals.taylor import TaylorSeries, taylor_polynomial, taylor_subtract, taylor_variable
from kineverse.model.frame import WORLD
from kineverse.model.registry import FrameDeviation
from kineverse.symbols import Symbol

from .joint_axes import JointMotion, MotionChain, QuaternionMotion

_ROUNDING = 1e-12
_UP = 1 + 1e-12  # factor by which sums of a few errors are rounded up


class CurveApproximation:
    """Polynomial approximation of motions by curves over one coordinate."""

    def __init__(
        self, terms: TermGraph, limits: Mapping[Symbol, RealInterval], degree: int, tolerance: float
    ) -> None:
        self._terms, self._limits, self._degree, self._tolerance = terms, limits, degree, tolerance
        self._enclosures = Enclosures(terms)
        self._fits: dict[tuple[int, tuple[float, ...]], MinimaxFit] = {}
        self._errors: dict[str, dict[int, float]] = {}

    def approximate(self, frame: str, found: MotionChain) -> MotionChain | str:
        """Return a chain with polynomials in place of its curves, or the reason why there are none."""
        motions = []
        for k, motion in enumerate(found.motions):
            if isinstance(motion, JointMotion) and (
                motion.is_curved or len(motion.coefficients) > self._degree + 1
            ):
                replaced = self._fit_motion(motion)
                if isinstance(replaced, str):
                    return replaced
                motion, error = replaced
                self._errors.setdefault(frame, {})[k] = error
            motions.append(motion)
        return replace(found, motions=tuple(motions))

    def _fit_motion(self, motion: JointMotion) -> tuple[JointMotion, float] | str:
        symbols = find_term_symbols(motion.variable)
        if len(symbols) != 1:
            names = ", ".join(map(str, symbols))
            return f"moves by a curve over several coordinates, {names}, and one of them is approximated"
        (symbol,) = symbols
        lower, upper = self._limits.get(symbol, REALS)
        if not (math.isfinite(lower) and math.isfinite(upper) and lower < upper):
            return f"moves by a curve over '{symbol}', which has no limits between which it is approximated"
        key = motion.variable.index, motion.coefficients
        if key not in self._fits:
            values = self._sample(motion, symbol, lower, upper)
            if not np.isfinite(values).all():
                return f"moves by a curve over '{symbol}' that is no number everywhere within its limits"
            enough = self._tolerance if motion.is_rotation else self._tolerance + _ROUNDING
            self._fits[key] = fit_polynomial(
                lambda where: self._series(motion, symbol, where), values, lower, upper, self._degree, enough
            )
        found = self._fits[key]
        if found.error > self._tolerance:
            unit = "rad" if motion.is_rotation else "m"
            least = found.error if math.isfinite(found.error) else found.sampled
            return (
                f"moves by a curve over '{symbol}', and the best polynomial of degree {self._degree} is "
                f"off by {least:.3g} {unit}"
            )
        variable = self._terms.term(symbol)
        return replace(motion, variable=variable, coefficients=found.polynomial, curve=None), found.error

    def _series(self, motion: JointMotion, symbol: Symbol, where: RealInterval) -> TaylorSeries:
        (inner,) = self._enclosures.enclose([motion.variable], {symbol: taylor_variable(where)})
        return taylor_polynomial(motion.coefficients, inner)

    def _sample(self, motion: JointMotion, symbol: Symbol, lower: float, upper: float) -> np.ndarray:
        x = chebyshev_points(lower, upper)
        if motion.curve is not None:
            function = ca.Function("curve", [symbol.sx], [expand_nodes(motion.curve)])
            inner = np.array([float(function(v)) for v in x])
            return np.asarray(np.polynomial.polynomial.polyval(inner, motion.coefficients))
        return np.array([sum(self._series(motion, symbol, (v, v))[0]) / 2 for v in x.tolist()])

    def is_implied(self, expression: Expression, lower: float, upper: float) -> bool:
        """Return True if the limits of its one coordinate and that one's speed keep an expression in bounds.

        The expression is a function of the coordinate, or the product of such a function and the speed.
        """
        positions = {s.position for s in expression.symbols}
        if len(positions) != 1 or any(s.order > 1 for s in expression.symbols):
            return False
        (symbol,) = positions
        ends = self._limits.get(symbol, REALS)
        if not (math.isfinite(ends[0]) and math.isfinite(ends[1]) and ends[0] < ends[1]):
            return False
        factor: RealInterval = (1.0, 1.0)
        speeds = [s for s in expression.symbols if s.order]
        if speeds:
            slope = expression.partial(speeds)[0]
            rest = expression({symbol: sum(ends) / 2, speeds[0]: 0.0})
            if any(s.order for s in slope.symbols) or abs(float(rest)) > 0:
                return False
            expression, factor = slope, self._limits.get(speeds[0], REALS)
        (term,) = self._terms.elements(expression)
        span = enclose_curve(
            lambda where: self._enclosures.enclose([term], {symbol: taylor_variable(where)})[0], *ends
        )
        low, high = interval_multiply(span, factor)
        return lower - _ROUNDING <= low and high <= upper + _ROUNDING

    def frame_deviations(
        self, placed: Mapping[str, MotionChain], parents: Mapping[str, str]
    ) -> dict[str, FrameDeviation]:
        """Return bounds of the pose errors of all frames that have one.

        An error ε of a rotation turns every frame behind it by at most ε, and displaces it by at most
        2 sin(ε/2) times its distance from the line. An error of a translation displaces it by that error. The
        errors of successive motions add up. Distances are the largest within the limits, with all errors.
        """
        result: dict[str, FrameDeviation] = {}
        # Errors of the rotations before each frame, with the distance to their lines, and of translations.
        before: dict[str, tuple[list[tuple[float, float]], float]] = {WORLD: ([], 0.0)}
        for name, found in placed.items():
            turns, shift = before[parents[name]]
            errors = self._errors.get(name, {})
            reaches = [self._max_offset(m, errors.get(k, 0.0)) for k, m in enumerate(found.motions)]
            whole = float(np.linalg.norm(found.pose[:3, 3])) + sum(reaches)
            turns = [(angle, distance + whole) for angle, distance in turns]
            for k, error in errors.items():
                motion = found.motions[k]
                if isinstance(motion, JointMotion) and not motion.is_rotation:
                    shift += error
                else:
                    turns.append((error, float(np.linalg.norm(motion.point)) + sum(reaches[k + 1 :])))
            before[name] = turns, shift
            if turns or shift:
                moved = sum(2 * math.sin(min(a, math.pi) / 2) * d for a, d in turns if d)
                result[name] = FrameDeviation((shift + moved) * _UP, sum(a for a, _ in turns) * _UP)
        return result

    def _max_offset(self, motion: JointMotion | QuaternionMotion, error: float) -> float:
        """Return the largest distance by which a motion and its error displace the origin of its frame."""
        if isinstance(motion, QuaternionMotion) or motion.is_rotation:
            return 2 * float(np.linalg.norm(motion.point))  # around a circle about the line
        lower, upper = self._limits.get(motion.variable.data, REALS)
        if not (math.isfinite(lower) and math.isfinite(upper)):
            return math.inf
        amount = motion.coefficients
        span = enclose_curve(lambda where: taylor_polynomial(amount, taylor_variable(where)), lower, upper)
        return max(abs(span[0]), abs(span[1])) + error


def find_term_symbols(term: Term) -> list[Symbol]:
    """Return the symbols that a term depends on, sorted."""
    found: set[Symbol] = set()
    for step in reachable_terms((term,)):
        if step.op == ca.OP_PARAMETER:
            found.add(step.data)
        elif step.op == "implicit":
            found.update(step.data[0].symbols)
    return sorted(found, key=lambda s: s.sort_key)


SeriesCurve = Callable[[RealInterval], TaylorSeries]
"""Function that returns the Taylor series of a curve over an interval."""

SAMPLE_COUNT = 257
_CLOSE = 1.05  # ratio of the error bound to the largest sampled error at which the bound is close enough
_NEGLIGIBLE = 1e-3  # part of the tolerance within which the bound is close enough
_MAX_INTERVALS = 1000
_MAX_HALVINGS = 4
_MAX_EXCHANGES = 40


@dataclass(frozen=True)
class MinimaxFit:
    """Polynomial approximation of a curve over an interval.

    ``error`` is a certified upper bound of the largest difference, ``sampled`` the largest difference at a
    sampled point.
    """

    polynomial: Coefficients
    error: float
    sampled: float


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
    if sampled > tolerance:
        return MinimaxFit(polynomial, math.inf, sampled)
    error = bound_error(curve, polynomial, lower, upper, sampled, _NEGLIGIBLE * tolerance)
    return MinimaxFit(polynomial, error, sampled)


def bound_error(
    curve: SeriesCurve,
    polynomial: Coefficients,
    lower: float,
    upper: float,
    sampled: float,
    negligible: float,
) -> float:
    """Return an upper bound of ``|curve - polynomial|`` over an interval, close to the least one."""

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
    for k, coefficient in enumerate((*here[: count - 1], around[count - 1])):
        power = interval_power(away, (k, k)) if k else (1.0, 1.0)
        total = interval_add(total, interval_multiply(coefficient, power))
    return max(total[0], value[0]), min(total[1], value[1])


def _size(a: RealInterval) -> float:
    size = max(-a[0], a[1])
    return math.inf if math.isnan(size) else size


def _remez(x: Matrix, y: Matrix, lower: float, upper: float, degree: int) -> Coefficients:
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
