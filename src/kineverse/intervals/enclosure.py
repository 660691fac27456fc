"""Taylor enclosures of univariate expressions, with Krawczyk's operator for implicit functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import pairwise, product
from typing import TypeAlias

import casadi as ca
import numpy as np

from kineverse.expressions.expression import Expression
from kineverse.expressions.graph import expand_nodes
from kineverse.expressions.implicit import ImplicitFunction
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .arithmetic import (
    REALS,
    ZERO_INTERVAL,
    RealInterval,
    interval_add,
    interval_hull,
    interval_multiply,
    interval_negate,
    interval_unary,
    round_outwards,
)
from .graph import SATURATED, Term, TermGraph
from .taylor import (
    TaylorSeries,
    taylor_add,
    taylor_arctan2,
    taylor_constant,
    taylor_divide,
    taylor_hull,
    taylor_maximum,
    taylor_minimum,
    taylor_multiply,
    taylor_negate,
    taylor_polynomial,
    taylor_power,
    taylor_subtract,
    taylor_unary,
)

_Box: TypeAlias = tuple[list[RealInterval], Array, float]

_UNKNOWN: TaylorSeries = (REALS,)
_REGULAR = 1e12
_CONTRACTS = 0.9
_ATTEMPTS = 4


class Enclosures:
    """Evaluation of terms over intervals.

    See Also
    --------
    kineverse.intervals.enclose_bound
    """

    def __init__(self, terms: TermGraph) -> None:
        self._terms = terms
        self._orders: dict[tuple[int, ...], list[Term]] = {}
        self._constants: dict[int, TaylorSeries] = {}
        self._solvers: dict[ImplicitFunction, _Solver] = {}

    def enclose(self, roots: list[Term], values: Mapping[Symbol, TaylorSeries]) -> list[TaylorSeries]:
        """Return the series of terms, from those of their symbols."""
        key = tuple(term.index for term in roots)
        if key not in self._orders:
            self._orders[key] = self._order(roots)
        known = self._constants.copy()
        solved: dict[object, list[TaylorSeries]] = {}
        for term in self._orders[key]:
            if term.op == ca.OP_PARAMETER:
                known[term.index] = values[term.data]
            elif term.op == "implicit":
                node, element = term.data
                if node not in solved:
                    solved[node] = self.enclose_implicit(node.function, [known[a.index] for a in term.args])
                known[term.index] = solved[node][element]
            else:
                known[term.index] = _step(term, [known[a.index] for a in term.args])
        return [known[term.index] for term in roots]

    def _order(self, roots: list[Term]) -> list[Term]:
        """Sort the terms that others depend on, arguments first, and evaluate the constants."""
        order: list[Term] = []
        seen = set(self._constants)
        waiting = list(roots)
        while waiting:
            term = waiting[-1]
            missing = [a for a in term.args if a.index not in seen]
            if missing:
                waiting += missing
                continue
            waiting.pop()
            if term.index in seen:
                continue
            seen.add(term.index)
            if term.op == ca.OP_CONST:
                finite = math.isfinite(term.data)
                self._constants[term.index] = (
                    taylor_constant(term.data) if finite else ((term.data, term.data),)
                )
            else:
                order.append(term)
        return order

    def enclose_implicit(self, function: ImplicitFunction, inputs: list[TaylorSeries]) -> list[TaylorSeries]:
        """Return the series of the unknowns of an implicit function, from those of its inputs."""
        if function not in self._solvers:
            self._solvers[function] = _Solver(function, self._terms, self)
        return self._solvers[function].enclose(inputs)


class _Solver:
    """Enclosure of the unknowns of one implicit function.

    Over a box U of inputs, with an approximate solution x and Y near the inverse of ∂r/∂x, Krawczyk's
    operator K(X) = x - Y r(x, U) + (1 - Y ∂r/∂x(X, U))(X - x) lies inside of X only if X contains exactly one
    solution for each u in U (A. Neumaier, Interval Methods for Systems of Equations, 5.2).
    """

    def __init__(self, function: ImplicitFunction, terms: TermGraph, enclosures: Enclosures) -> None:
        self._function, self._enclosures = function, enclosures
        self._equations = terms.elements(function.equations)
        # Evaluated together: they have most of their terms in common.
        self._slopes = [*terms.elements(function.by_unknowns), *terms.elements(function.by_inputs)]
        inputs = ca.vertcat(*(s.sx for s in function.inputs))
        solution = ca.densify(expand_nodes(function.apply(function.inputs)))
        self._solve = ca.Function("solve", [inputs], [solution])
        self._last: tuple[list[RealInterval], _Box | None] | None = None

    def enclose(self, inputs: list[TaylorSeries]) -> list[TaylorSeries]:
        n = len(self._function.unknowns)
        if not all(math.isfinite(low) and math.isfinite(high) for (low, high), *_ in inputs):
            return [_UNKNOWN] * n
        spans, last = [s[0] for s in inputs], self._last
        if last is None or last[0] != spans:  # slopes are asked for after values
            last = self._last = spans, self._find_box(spans)
        if last[1] is None:
            return [_UNKNOWN] * n
        box, inverse, slack = last[1]
        unknowns: list[list[RealInterval]] = [[r] for r in box]
        for k in range(1, min(len(s) for s in inputs)):
            trial = [(*u, ZERO_INTERVAL) for u in unknowns]
            rest = self._at(self._equations, trial, [s[: k + 1] for s in inputs])
            if any(len(r) <= k for r in rest):
                break
            applied = _multiply_column(inverse, [r[k] for r in rest])
            size = max(max(abs(a), abs(b)) for a, b in applied) * slack
            for unknown, (low, high) in zip(unknowns, applied, strict=True):
                unknown.append(interval_add((-high, -low), (-size, size)))
        return [tuple(u) for u in unknowns]

    def _find_box(self, inputs: list[RealInterval]) -> _Box | None:
        """Return a box with one solution for each input, Y, and β/(1 - β) with ``β = |1 - Y ∂r/∂x|``.

        The box is centred on the tangent D at the middle m, which is far closer to the solution than x is.
        The residual along it is r(x, m) + (∂r/∂u + ∂r/∂x D)(u - m).
        """
        middle = [_middle(u) for u in inputs]
        x = np.array(self._solve(np.array(middle))).ravel()
        if not np.isfinite(x).all():
            return None
        n, count = len(x), len(inputs)
        there: list[TaylorSeries] = [((float(v), float(v)),) for v in x]
        here: list[TaylorSeries] = [((u, u),) for u in middle]
        *slopes, residual = self._ranges([*self._slopes, *self._equations], there, here, n)
        middles = np.array([[_middle(s) for s in column] for column in slopes]).T
        slope, by_inputs = middles[:, :n], middles[:, n:]
        if not (np.isfinite(slopes).all() and np.linalg.cond(slope) < _REGULAR):
            return None
        inverse: Array = np.asarray(np.linalg.inv(slope), dtype=np.float64)
        tangent = -inverse @ by_inputs
        away = [round_outwards(u[0] - m, u[1] - m) for u, m in zip(inputs, middle, strict=True)]
        straight = _multiply_column(tangent, away)
        radius = [1e-14] * n
        for _ in range(_ATTEMPTS):
            around = (round_outwards(float(v) - r, float(v) + r) for v, r in zip(x, radius, strict=True))
            box = [interval_add(near, along) for near, along in zip(around, straight, strict=True)]
            points: list[TaylorSeries] = [(b,) for b in box]
            wide: list[TaylorSeries] = [(u,) for u in inputs]
            columns = self._ranges(self._slopes, points, wide, n)
            by_unknowns = columns[:n]
            along_tangent = list(residual)
            for j in range(count):
                turned = columns[n + j]
                for k in range(n):
                    scale = float(tangent[k, j])
                    turned = [
                        interval_add(t, interval_multiply((scale, scale), a))
                        for t, a in zip(turned, by_unknowns[k], strict=True)
                    ]
                along_tangent = [
                    interval_add(r, interval_multiply(t, away[j]))
                    for r, t in zip(along_tangent, turned, strict=True)
                ]
            shift = [interval_negate(s) for s in _multiply_column(inverse, along_tangent)]
            scaled = [_multiply_column(inverse, column) for column in by_unknowns]
            rest = [
                [interval_add((float(i == j),) * 2, interval_negate(scaled[j][i])) for j in range(n)]
                for i in range(n)
            ]
            norm = max(sum(max(-low, high) for low, high in row) for row in rest)
            if not norm < _CONTRACTS:
                return None
            left = []
            for i in range(n):
                total = shift[i]
                for j in range(n):
                    total = interval_add(total, interval_multiply(rest[i][j], (-radius[j], radius[j])))
                left.append(total)
            if all(-r < low and high < r for (low, high), r in zip(left, radius, strict=True)):
                return box, inverse, norm / (1 - norm)
            furthest = max(max(-low, high) for low, high in shift)
            radius = [1.2 * furthest / (1 - norm) + 1e-14] * n
        return None

    def _ranges(
        self, roots: list[Term], unknowns: list[TaylorSeries], inputs: list[TaylorSeries], rows: int
    ) -> list[list[RealInterval]]:
        ranges = [s[0] for s in self._at(roots, unknowns, inputs)]
        return [ranges[k : k + rows] for k in range(0, len(ranges), rows)]

    def _at(
        self, roots: list[Term], unknowns: list[TaylorSeries], inputs: list[TaylorSeries]
    ) -> list[TaylorSeries]:
        function = self._function
        values = dict(zip((*function.unknowns, *function.inputs), (*unknowns, *inputs), strict=True))
        return self._enclosures.enclose(roots, values)


def _middle(a: RealInterval) -> float:
    return (a[0] + a[1]) / 2


def _multiply_column(matrix: Array, column: list[RealInterval]) -> list[RealInterval]:
    result = []
    for row in matrix.tolist():
        total = ZERO_INTERVAL
        for entry, value in zip(row, column, strict=True):
            total = interval_add(total, interval_multiply((entry, entry), value))
        result.append(total)
    return result


_RATIONAL: dict[object, Callable[..., TaylorSeries]] = {
    ca.OP_ADD: taylor_add,
    ca.OP_SUB: taylor_subtract,
    ca.OP_MUL: taylor_multiply,
    ca.OP_DIV: taylor_divide,
    ca.OP_NEG: taylor_negate,
}


def _step(term: Term, args: list[TaylorSeries]) -> TaylorSeries:
    op = term.op
    if op in _RATIONAL:
        return _RATIONAL[op](*args)
    if op == ca.OP_POW:
        return taylor_power(args[0], args[1][0])
    if op == ca.OP_ATAN2:
        return taylor_arctan2(*args)
    if op == "piecewise":
        periodic, knots, pieces = term.data
        return _piecewise(periodic, knots, pieces, args[0])
    if op in (ca.OP_FMIN, ca.OP_FMAX):
        return taylor_minimum(*args) if op == ca.OP_FMIN else taylor_maximum(*args)
    if op == "select":
        truth, yes, no = args
        if truth[0][0] >= 0.5 or truth[0][1] < 0.5:
            return yes if truth[0][0] >= 0.5 else no
        return (interval_hull(yes[0], no[0]),)
    if op == "less":
        return (_enclose_truth(args[0][0], term.data),)
    if len(args) == 1 and isinstance(op, int):
        return taylor_unary(op, args[0])
    return _UNKNOWN


def _enclose_truth(excess: RealInterval, contrast: float) -> RealInterval:
    """Return the range of (1 + tanh(x·R))/2, which is 0 or 1 to the last bit from ``|x|·R = 20`` on."""
    low, high = interval_unary(ca.OP_TANH, (excess[0] * contrast, excess[1] * contrast))
    return (
        1.0 if excess[0] * contrast >= SATURATED else max(0.0, math.nextafter((1 + low) / 2, -math.inf)),
        0.0 if excess[1] * contrast <= -SATURATED else min(1.0, math.nextafter((1 + high) / 2, math.inf)),
    )


def _piecewise(
    periodic: bool, knots: tuple[float, ...], pieces: tuple[tuple[float, ...], ...], x: TaylorSeries
) -> TaylorSeries:
    low, high = x[0]
    if periodic:
        period = knots[-1] - knots[0]
        if not high - low < period:
            return _UNKNOWN
        turn = math.floor((low - knots[0]) / period) * period
        if high - turn > knots[-1]:
            # Across the end of a period: the parts before and after it.
            end = turn + knots[-1]
            left = _piecewise(periodic, knots, pieces, ((low, math.nextafter(end, low)), *x[1:]))
            return taylor_hull(left, _piecewise(periodic, knots, pieces, ((end, high), *x[1:])))
        x = taylor_subtract(x, taylor_constant(turn))
    low, high = x[0]
    starts = knots[:-1] if periodic else (knots[0], *knots)
    begins = knots[:-1] if periodic else (-math.inf, *knots)
    ends = knots[1:] if periodic else (*knots, math.inf)
    result: TaylorSeries | None = None
    for piece, start, begin, end in zip(pieces, starts, begins, ends, strict=True):
        if begin <= high and low <= end:
            inside: RealInterval = (max(low, begin), min(high, end))
            here = taylor_polynomial(piece, taylor_subtract((inside, *x[1:]), taylor_constant(start)))
            result = here if result is None else taylor_hull(result, here)
    return _UNKNOWN if result is None else result


_PIECES = {1: 64, 2: 8, 3: 4}
"""Pieces into which the range of each of so many symbols is divided: smooth bounds get tighter by it."""


def enclose_bound(bound: Expression, box: Mapping[Symbol, RealInterval]) -> RealInterval:
    """Return the range of a scalar where its symbols are in a box, to 14 digits and rather too wide.

    Symbols that the box lacks are anywhere. The range is infinite if nothing is known about it.

    Examples
    --------
    >>> x = kv.position("x")
    >>> kv.intervals.enclose_bound(x**2 - x, {x: (0.0, 1.0)})
    (-0.265625, 0.015625)
    """
    terms = TermGraph({s: s.value for s in bound.symbols if s.value is not None})
    root, enclosures = terms.term(bound), Enclosures(terms)
    symbols = [s for s in bound.symbols if s.value is None]
    sides = [box.get(s, REALS) for s in symbols]
    count = _PIECES.get(len(symbols), 1)
    result: RealInterval | None = None
    for piece in product(*(_divide(side, count) for side in sides)):
        values = {s: (x,) for s, x in zip(symbols, piece, strict=True)}
        (((low, high), *_),) = enclosures.enclose([root], values)
        here = -math.inf if math.isnan(low) else low, math.inf if math.isnan(high) else high
        result = here if result is None else interval_hull(result, here)
        if result == REALS:
            break
    assert result is not None
    # Enclosures are rounded outwards by single digits, which nobody wants to see.
    return float(f"{result[0]:.14g}"), float(f"{result[1]:.14g}")


def _divide(side: RealInterval, count: int) -> list[RealInterval]:
    low, high = side
    if not (math.isfinite(high - low) and high > low):
        return [side]
    ends = [low + (high - low) * k / count for k in range(count)] + [high]
    return list(pairwise(ends))
