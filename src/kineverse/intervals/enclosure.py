"""Taylor enclosures of univariate expressions, with Krawczyk's operator for implicit functions."""

from __future__ import annotations

import math
from collections.abc import Mapping

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.expressions.graph import expand_nodes
from kineverse.expressions.implicit import ImplicitFunction
from kineverse.symbols import Symbol

from . import arithmetic, taylor
from .arithmetic import REALS, RealInterval
from .graph import Term, TermGraph
from .taylor import TaylorSeries

RealMatrix = npt.NDArray[np.float64]
_UNKNOWN: TaylorSeries = (REALS,)
_REGULAR = 1e12
_CONTRACTS = 0.9
_ATTEMPTS = 4


class Enclosures:
    """Evaluates terms over intervals.

    Parameters
    ----------
    terms
        Where the terms are from.
    """

    def __init__(self, terms: TermGraph) -> None:
        self._terms = terms
        self._solvers: dict[ImplicitFunction, _Solver] = {}

    def of(self, roots: list[Term], values: Mapping[Symbol, TaylorSeries]) -> list[TaylorSeries]:
        """Return the series of terms, from those of the symbols that they are about."""
        known: dict[int, TaylorSeries] = {}
        solved: dict[object, list[TaylorSeries]] = {}
        waiting = list(roots)
        while waiting:
            term = waiting[-1]
            missing = [a for a in term.args if a.index not in known]
            if missing:
                waiting += missing
                continue
            waiting.pop()
            if term.index in known:
                continue
            if term.op == ca.OP_PARAMETER:
                known[term.index] = values[term.data]
            elif term.op == "implicit":
                node, element = term.data
                if node not in solved:
                    solved[node] = self.solved(node.function, [known[a.index] for a in term.args])
                known[term.index] = solved[node][element]
            else:
                known[term.index] = _step(term, [known[a.index] for a in term.args])
        return [known[term.index] for term in roots]

    def solved(self, function: ImplicitFunction, inputs: list[TaylorSeries]) -> list[TaylorSeries]:
        """Return the series of the unknowns of an implicit function, from those of its inputs."""
        if function not in self._solvers:
            self._solvers[function] = _Solver(function, self._terms, self)
        return self._solvers[function].over(inputs)


class _Solver:
    """Encloses the unknowns of one implicit function.

    Over a box U of inputs, with an approximate solution x and Y near the inverse of ∂r/∂x, the operator of
    Krawczyk K(X) = x - Y r(x, U) + (1 - Y ∂r/∂x(X, U))(X - x) lies inside of X only if X has just one
    solution for each u in U (A. Neumaier, Interval Methods for Systems of Equations, 5.2).
    """

    def __init__(self, function: ImplicitFunction, terms: TermGraph, enclosures: Enclosures) -> None:
        self._function, self._enclosures = function, enclosures
        self._chosen = terms.elements(function.chosen)
        self._by_unknowns = terms.elements(function.by_unknowns)
        self._by_inputs = terms.elements(function.by_inputs)
        inputs = ca.vertcat(*(s._sx for s in function.inputs))
        solution = ca.densify(expand_nodes(function.of(function.inputs)))
        self._solve = ca.Function("solve", [inputs], [solution])

    def over(self, inputs: list[TaylorSeries]) -> list[TaylorSeries]:
        """Return the series of the unknowns, from those of the inputs."""
        n = len(self._function.unknowns)
        if not all(math.isfinite(low) and math.isfinite(high) for (low, high), *_ in inputs):
            return [_UNKNOWN] * n
        middle = [_middle(s[0]) for s in inputs]
        x = np.array(self._solve(np.array(middle))).ravel()
        if not np.isfinite(x).all():
            return [_UNKNOWN] * n
        found = self._krawczyk(x, middle, [s[0] for s in inputs])
        if found is None:
            return [_UNKNOWN] * n
        box, inverse, slack = found
        unknowns: list[list[RealInterval]] = [[r] for r in box]
        for k in range(1, min(len(s) for s in inputs)):
            trial = [(*u, arithmetic.ZERO_INTERVAL) for u in unknowns]
            rest = self._at(self._chosen, trial, [s[: k + 1] for s in inputs])
            if any(len(r) <= k for r in rest):
                break
            applied = _multiply_column(inverse, [r[k] for r in rest])
            size = max(max(abs(a), abs(b)) for a, b in applied) * slack
            for unknown, (low, high) in zip(unknowns, applied, strict=True):
                unknown.append(arithmetic.interval_add((-high, -low), (-size, size)))
        return [tuple(u) for u in unknowns]

    def _krawczyk(
        self, x: RealMatrix, middle: list[float], inputs: list[RealInterval]
    ) -> tuple[list[RealInterval], RealMatrix, float] | None:
        """Return a box with one solution for each input, Y, and β/(1 - β) with β = |1 - Y ∂r/∂x|.

        It is made around the tangent D at the middle m, from which the solution departs by far less than from
        x: r along it is r(x, m) + (∂r/∂u + ∂r/∂x D)(u - m).
        """
        n, count = len(x), len(inputs)
        there: list[TaylorSeries] = [((float(v), float(v)),) for v in x]
        here: list[TaylorSeries] = [((u, u),) for u in middle]
        slope = self._matrix(self._by_unknowns, there, here)
        by_inputs = self._matrix(self._by_inputs, there, here)
        if slope is None or by_inputs is None or not np.linalg.cond(slope) < _REGULAR:
            return None
        inverse: RealMatrix = np.asarray(np.linalg.inv(slope), dtype=np.float64)
        tangent = -inverse @ by_inputs
        away = [arithmetic.round_outwards(u[0] - m, u[1] - m) for u, m in zip(inputs, middle, strict=True)]
        straight = _multiply_column(tangent, away)
        residual = [s[0] for s in self._at(self._chosen, there, here)]
        radius = [1e-14] * n
        for _ in range(_ATTEMPTS):
            box = [
                arithmetic.interval_add(arithmetic.round_outwards(float(v) - r, float(v) + r), along)
                for v, r, along in zip(x, radius, straight, strict=True)
            ]
            points: list[TaylorSeries] = [(b,) for b in box]
            wide: list[TaylorSeries] = [(u,) for u in inputs]
            a = [s[0] for s in self._at(self._by_unknowns, points, wide)]
            b = [s[0] for s in self._at(self._by_inputs, points, wide)]
            along_tangent = list(residual)
            for j in range(count):
                turned = [b[i + n * j] for i in range(n)]
                for k in range(n):
                    scale = float(tangent[k, j])
                    turned = [
                        arithmetic.interval_add(t, arithmetic.interval_multiply((scale, scale), a[i + n * k]))
                        for i, t in enumerate(turned)
                    ]
                along_tangent = [
                    arithmetic.interval_add(r, arithmetic.interval_multiply(t, away[j]))
                    for r, t in zip(along_tangent, turned, strict=True)
                ]
            shift = [arithmetic.interval_negate(s) for s in _multiply_column(inverse, along_tangent)]
            columns = [_multiply_column(inverse, a[n * j : n * (j + 1)]) for j in range(n)]
            rest = [
                [
                    arithmetic.interval_add((float(i == j),) * 2, arithmetic.interval_negate(columns[j][i]))
                    for j in range(n)
                ]
                for i in range(n)
            ]
            norm = max(sum(max(-low, high) for low, high in row) for row in rest)
            if not norm < _CONTRACTS:
                return None
            left = []
            for i in range(n):
                total = shift[i]
                for j in range(n):
                    total = arithmetic.interval_add(
                        total, arithmetic.interval_multiply(rest[i][j], (-radius[j], radius[j]))
                    )
                left.append(total)
            if all(-r < low and high < r for (low, high), r in zip(left, radius, strict=True)):
                return box, inverse, norm / (1 - norm)
            furthest = max(max(-low, high) for low, high in shift)
            radius = [1.2 * furthest / (1 - norm) + 1e-14] * n
        return None

    def _matrix(
        self, roots: list[Term], unknowns: list[TaylorSeries], inputs: list[TaylorSeries]
    ) -> RealMatrix | None:
        entries = [_middle(s[0]) for s in self._at(roots, unknowns, inputs)]
        matrix = np.reshape(entries, (-1, len(unknowns))).T
        return matrix if np.isfinite(matrix).all() else None

    def _at(
        self, roots: list[Term], unknowns: list[TaylorSeries], inputs: list[TaylorSeries]
    ) -> list[TaylorSeries]:
        function = self._function
        values = dict(zip((*function.unknowns, *function.inputs), (*unknowns, *inputs), strict=True))
        return self._enclosures.of(roots, values)


def _middle(a: RealInterval) -> float:
    return (a[0] + a[1]) / 2


def _multiply_column(matrix: RealMatrix, column: list[RealInterval]) -> list[RealInterval]:
    result = []
    for row in matrix.tolist():
        total = arithmetic.ZERO_INTERVAL
        for entry, value in zip(row, column, strict=True):
            total = arithmetic.interval_add(total, arithmetic.interval_multiply((entry, entry), value))
        result.append(total)
    return result


def _step(term: Term, args: list[TaylorSeries]) -> TaylorSeries:
    """Return the series of a step from those of its arguments."""
    op = term.op
    if op == ca.OP_CONST:
        return taylor.taylor_constant(term.data) if math.isfinite(term.data) else _UNKNOWN
    if op == ca.OP_ADD:
        return taylor.taylor_add(*args)
    if op == ca.OP_SUB:
        return taylor.taylor_subtract(*args)
    if op == ca.OP_MUL:
        return taylor.taylor_multiply(*args)
    if op == ca.OP_DIV:
        return taylor.taylor_divide(*args)
    if op == ca.OP_NEG:
        return taylor.taylor_negate(args[0])
    if op == ca.OP_POW:
        return taylor.taylor_power(args[0], args[1][0])
    if op == ca.OP_ATAN2:
        return taylor.taylor_arctan2(*args)
    if op == "piecewise":
        periodic, knots, pieces = term.data
        return _piecewise(periodic, knots, pieces, args[0])
    if op in (ca.OP_FMIN, ca.OP_FMAX):
        a, b = args if op == ca.OP_FMIN else args[::-1]
        return a if a[0][1] <= b[0][0] else b if b[0][1] <= a[0][0] else taylor.taylor_hull(a, b)
    if op == "select":
        truth, yes, no = args
        if truth[0][0] >= 0.5 or truth[0][1] < 0.5:
            return yes if truth[0][0] >= 0.5 else no
        return (arithmetic.interval_hull(yes[0], no[0]),)
    if len(args) == 1 and isinstance(op, int):
        return taylor.taylor_unary(op, args[0])
    return (arithmetic.round_outwards(0.0, 1.0),) if op == "less" else _UNKNOWN


def _piecewise(
    periodic: bool, knots: tuple[float, ...], pieces: tuple[tuple[float, ...], ...], x: TaylorSeries
) -> TaylorSeries:
    """Return the series of a piecewise polynomial, of all pieces that the argument may be in."""
    low, high = x[0]
    if periodic:
        period = knots[-1] - knots[0]
        if not high - low < period:
            return _UNKNOWN
        turn = math.floor((low - knots[0]) / period) * period
        if high - turn > knots[-1]:
            # Across the end of a period: what is left of it, and what is right of it.
            end = turn + knots[-1]
            left = _piecewise(periodic, knots, pieces, ((low, math.nextafter(end, low)), *x[1:]))
            return taylor.taylor_hull(left, _piecewise(periodic, knots, pieces, ((end, high), *x[1:])))
        x = taylor.taylor_subtract(x, taylor.taylor_constant(turn))
    low, high = x[0]
    starts = knots[:-1] if periodic else (knots[0], *knots)
    begins = knots[:-1] if periodic else (-math.inf, *knots)
    ends = knots[1:] if periodic else (*knots, math.inf)
    found: TaylorSeries | None = None
    for piece, start, begin, end in zip(pieces, starts, begins, ends, strict=True):
        if begin <= high and low <= end:
            inside: RealInterval = (max(low, begin), min(high, end))
            here = taylor.taylor_polynomial(
                piece, taylor.taylor_subtract((inside, *x[1:]), taylor.taylor_constant(start))
            )
            found = here if found is None else taylor.taylor_hull(found, here)
    return _UNKNOWN if found is None else found
