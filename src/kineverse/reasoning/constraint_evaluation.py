"""Evaluation of constraints: ranges over boxes by interval arithmetic, and values at points."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import casadi as ca

from kineverse.compilation import CompiledFunction, compile
from kineverse.errors import InvalidValueError, NoSolutionError
from kineverse.expressions.expression import Expression
from kineverse.expressions.substitution import apply_substitution
from kineverse.intervals.arithmetic import REALS, RealInterval
from kineverse.intervals.enclosure import Enclosures
from kineverse.intervals.graph import SATURATED, SHARP_CONTRAST, Term, TermGraph, reachable_terms
from kineverse.intervals.taylor import taylor_variable
from kineverse.model.constraint import Constraint
from kineverse.model.model_view import ModelView
from kineverse.model.rates import to_plain
from kineverse.state import StateLike, as_state
from kineverse.symbols import Symbol

from .boxes import IntervalBox

SLOW = 1e-6  # speed that constraints admit wherever a coordinate may move [m/s] or [rad/s]
NOTHING = 1e-9  # largest excess of a constraint that counts as satisfied; also a speed that is none
BESIDE = SATURATED / SHARP_CONTRAST  # distance at which a position is at a threshold [m] or [rad]
_MOST_PIECES = 4096

_NOT_MOVING: RealInterval = (0.0, 0.0)
Box = Mapping[Symbol, RealInterval]


@dataclass(frozen=True)
class _Row:
    """Terms of a constraint, and their symbols."""

    lower: Term | float
    value: Term
    upper: Term | float
    symbols: tuple[Symbol, ...]


class ConstraintRanges:
    """Excesses of the constraints of a model over boxes of positions."""

    def __init__(self, model: ModelView) -> None:
        self.rows: dict[str, Constraint] = {}
        self.limits: dict[Symbol, RealInterval] = {}
        for name, c in model.constraints.items():
            row = Constraint(to_plain(c.lower), to_plain(c.expression), to_plain(c.upper))
            self.rows[name] = row
            if isinstance(row.expression, Symbol) and not row.lower.symbols and not row.upper.symbols:
                low, high = self.limits.get(row.expression, REALS)
                self.limits[row.expression] = max(low, float(row.lower)), min(high, float(row.upper))
        self._dependent = dict(model.rates.dependent)
        every = {s for row in self.rows.values() for s in self._symbols_of(row)}
        self._graph = TermGraph({s: s.value for s in every if s.value is not None})
        self._enclosures = Enclosures(self._graph)
        self._known: dict[str, _Row] = {}
        self._excesses: dict[tuple[object, ...], tuple[RealInterval, RealInterval]] = {}
        self._cuts: dict[tuple[str, Symbol], list[float]] = {}
        self._about: dict[Symbol, list[str]] = {}
        for name, row in self.rows.items():
            for symbol in self._symbols_of(row):
                self._about.setdefault(symbol, []).append(name)

    def about(self, symbol: Symbol) -> Iterable[str]:
        """Return the names of the constraints that depend on a symbol."""
        return self._about.get(symbol, ())

    def refuses(self, speed: Symbol, forward: float, box: Box, start: Mapping[Symbol, float]) -> bool:
        """Return whether constraints admit no slow speed anywhere in a box, but next to thresholds.

        If intervals do not decide it at once, the box is divided at the thresholds of these constraints. At
        one of them, a coordinate is at most at the start.
        """
        names = [name for name in self.about(speed) if self.rows[name].order == 1]
        moving: Box = {**box, speed: (forward * SLOW, forward * SLOW)}
        if any(self.excess(name, moving)[0] > NOTHING for name in names):
            return True
        if all(self.excess(name, moving)[1] <= NOTHING for name in names):
            return False
        symbols = {s for name in names for s in self._row(name).symbols if not s.order}
        ordered = sorted(symbols, key=lambda s: s.sort_key)
        sides = {s: self._pieces(s, self._side(box, s), names, start.get(s)) for s in ordered}
        if math.prod(map(len, sides.values())) > _MOST_PIECES:
            return False
        return all(
            any(
                self.excess(name, {**moving, **dict(zip(sides, piece, strict=True))})[0] > NOTHING
                for name in names
            )
            for piece in product(*sides.values())
        )

    def _pieces(
        self, symbol: Symbol, side: RealInterval, names: Iterable[str], start: float | None
    ) -> list[RealInterval]:
        """Return the parts of an interval of positions between thresholds of constraints, and the start."""
        cuts = sorted({x for name in names for x in self._thresholds(name, symbol) if side[0] < x < side[1]})
        ends = [side[0], *(x + sign * BESIDE for x in cuts for sign in (-1, 1)), side[1]]
        pieces = [(low, high) for low, high in zip(ends[::2], ends[1::2], strict=True) if low <= high]
        if start is not None and any(abs(x - start) <= BESIDE for x in cuts):
            pieces.append((start, start))
        return pieces

    def _thresholds(self, name: str, symbol: Symbol) -> list[float]:
        """Return where comparisons in the bounds of a constraint change, as far as one position decides."""
        key = name, symbol
        if key not in self._cuts:
            row, result = self._row(name), list[float]()
            terms = reachable_terms(tuple(t for t in (row.lower, row.upper) if isinstance(t, Term)))
            for decider in dict.fromkeys(d for t in terms for d in t.deciders):
                own = {t.data for t in reachable_terms((decider,)) if t.op == ca.OP_PARAMETER}
                if own == {symbol}:
                    result += self._linear_root(decider, symbol)
            self._cuts[key] = result
        return self._cuts[key]

    def _linear_root(self, term: Term, symbol: Symbol) -> list[float]:
        """Return where a linear function of a symbol is 0; nothing for other functions."""
        ((_, *slopes),) = self._enclosures.enclose([term], {symbol: taylor_variable(REALS)})
        (((low, high), *_),) = self._enclosures.enclose([term], {symbol: taylor_variable((0.0, 0.0))})
        if not slopes or any(slope != (0.0, 0.0) for slope in slopes[1:]):
            return []
        slope = sum(slopes[0]) / 2
        return [-(low + high) / 2 / slope] if slope and math.isfinite(slope) else []

    def excess(self, name: str, box: Box) -> RealInterval:
        """Return the range of the excess of a constraint over a box, negative where it holds strictly.

        Positions that the box lacks are anywhere within their limits, and speeds are 0.
        """
        below, above = self.excesses(name, box)
        return max(below[0], above[0]), max(below[1], above[1])

    def excesses(self, name: str, box: Box) -> tuple[RealInterval, RealInterval]:
        """Return the ranges of lower bound - value and of value - upper bound over a box."""
        row = self._row(name)
        sides = tuple(self._side(box, s) for s in row.symbols)
        key = name, sides
        if key not in self._excesses:
            values = {s: (side,) for s, side in zip(row.symbols, sides, strict=True)}
            terms = [t for t in (row.value, row.lower, row.upper) if isinstance(t, Term)]
            ranges = dict(zip(terms, (s[0] for s in self._enclosures.enclose(terms, values)), strict=True))
            low, high = ranges[row.value]
            lower, upper = (
                (end, end) if isinstance(end, float) else ranges[end] for end in (row.lower, row.upper)
            )
            self._excesses[key] = _subtract(lower, (low, high)), _subtract((low, high), upper)
        return self._excesses[key]

    def _side(self, box: Box, symbol: Symbol) -> RealInterval:
        if symbol in box:
            return box[symbol]
        return _NOT_MOVING if symbol.order else self.limits.get(symbol, REALS)

    def _row(self, name: str) -> _Row:
        if name not in self._known:
            row = self.rows[name]
            ends = [
                float(end) if not end.symbols else self._graph.term(self._follow(end))
                for end in (row.lower, row.upper)
            ]
            value = self._graph.term(self._follow(row.expression))
            own = (s for s in self._symbols_of(row) if s.value is None)
            symbols = tuple(sorted(own, key=lambda s: s.sort_key))
            self._known[name] = _Row(ends[0], value, ends[1], symbols)
        return self._known[name]

    def _follow(self, expression: Expression) -> Expression:
        return apply_substitution(expression, self._dependent) if self._dependent else expression

    def _symbols_of(self, row: Constraint) -> set[Symbol]:
        own = {s for part in (row.lower, row.expression, row.upper) for s in part.symbols}
        for s in own & self._dependent.keys():
            own = (own - {s}) | set(self._dependent[s].symbols)
        return own


def _subtract(a: RealInterval, b: RealInterval) -> RealInterval:
    """Return the range of x - y; the difference of equal infinities is anything."""
    low, high = a[0] - b[1], a[1] - b[0]
    return -math.inf if math.isnan(low) else low, math.inf if math.isnan(high) else high


_ROUNDING = 1e-9


def value_at(expression: Expression, point: Mapping[Symbol, float]) -> float:
    """Return the value of a scalar at a point, which may contain further symbols."""
    function = _function(expression)
    return float(function({symbol: point[symbol] for symbol in function.inputs}))


def is_inside(box: IntervalBox, point: Mapping[Symbol, float]) -> bool:
    """Return True if a point satisfies the conditions of a box."""
    return all(value_at(axis, point) in side for axis, side in box.items())


def default_point(model: ModelView) -> dict[Symbol, float]:
    """Return the default state, completed by the dependent coordinates."""
    point = dict(model.default_state())
    settle_point(model, point)
    return point


def start_point(model: ModelView, state: StateLike | None) -> dict[Symbol, float]:
    """Return the positions at a start: those of a state, and the default ones of what it lacks."""
    point = dict(model.default_state())
    if state is None:
        return point
    given = as_state(state, model.symbols)
    for symbol, value in given.items():
        if symbol.value is not None and value != symbol.value:
            raise InvalidValueError(
                f"The parameter '{symbol}' is {symbol.value:g} in the model and {value:g} in the state. "
                "Locks are read with the value in the model: leave it out of the state, or edit the model."
            )
    return point | dict(given)


def settle_point(model: ModelView, point: dict[Symbol, float]) -> bool:
    """Project a point onto the configurations of the model in place; return False if that is impossible.

    Coordinates whose rates preserve their norm, such as those of a quaternion, are normalised. Dependent
    coordinates are computed from the independent ones.
    """
    rates = model.rates
    for speeds in {frozenset(rates[x]) for x in rates}:
        group = [x for x in rates if rates[x].keys() == speeds]
        growths = (sum(point[x] * value_at(rates[x][v], point) for x in group) for v in speeds)
        size = math.hypot(*(point[x] for x in group))
        if size and all(abs(growth) <= _ROUNDING * size**2 for growth in growths):
            point.update({x: point[x] / size for x in group})
    try:
        point.update({x: value_at(e, point) for x, e in rates.dependent.items()})
    except NoSolutionError:
        return False
    return True


@lru_cache(1024)
def _function(expression: Expression) -> CompiledFunction:
    return compile(expression, tier="interpreter")
