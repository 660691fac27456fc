"""Rules of moves from interlocks: conditions under which a coordinate cannot increase or decrease."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from kineverse.expressions.expression import Expression
from kineverse.model.model_view import ModelView
from kineverse.model.rate_nodes import to_plain
from kineverse.symbols import Symbol

from .boxes import Interval, IntervalBox
from .find_interlocks import constant_limits
from .interlock import Interlock, Interlocks, Undecided

Way: TypeAlias = Literal["up", "down", "enter"]
Box: TypeAlias = Mapping[Symbol, Interval]


@dataclass(frozen=True)
class MoveRule:
    """Restriction of moves within a box of positions."""

    way: Way  # "up", "down": within the box, the coordinate cannot increase, or decrease
    coordinate: Symbol | None  # restricted coordinate; for "enter" the one that is exempt, or None
    box: Box  # intervals of positions
    lock: Interlock | Undecided  # interlock that says so, or the constraint that could not be read
    is_exact: bool = True

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """Coordinates of the box, and the restricted one."""
        return tuple(dict.fromkeys((*self.box, *(() if self.coordinate is None else (self.coordinate,)))))


def make_rules(model: ModelView, found: Interlocks) -> list[MoveRule]:
    """Return the rules of the interlocks of a model.

    Locks that cannot be read count as shut. A coordinate exactly at a threshold counts as on both sides of
    it, so no move ends there, unless its limit is there.
    """
    rules: list[MoveRule] = []
    moved = frozenset({*model.rates.dependent, *model.rates})
    reader = _BoxReader(moved, constant_limits(dict(model.constraints.items())))
    for lock in found:
        rules += _lock_rules(lock, reader)
    for unknown in found.undecided:
        held = _positions(to_plain(model.constraints[unknown.constraint].expression))
        for where in unknown.where:
            box, _ = reader.read(where)
            rules += _shut(held, box, unknown)
    return rules


@dataclass(frozen=True)
class _BoxReader:
    """Reader of conditions: coordinates that others move, and limits of the others."""

    moved: frozenset[Symbol]
    limits: Mapping[Symbol, Interval]

    def read(self, where: IntervalBox) -> tuple[Box, bool]:
        """Return the conditions on independent positions, and whether these are all."""
        box = {
            axis: self._close(axis, side)
            for axis, side in where.items()
            if isinstance(axis, Symbol) and not axis.order and axis.has_derivative and axis not in self.moved
        }
        return box, len(box) == len(where)

    def _close(self, symbol: Symbol, side: Interval) -> Interval:
        limit = self.limits.get(symbol, Interval())
        lower = side.lower_closed or (math.isfinite(side.lower) and side.lower != limit.upper)
        upper = side.upper_closed or (math.isfinite(side.upper) and side.upper != limit.lower)
        return Interval(side.lower, side.upper, lower, upper)


def relevant_rules(rules: Iterable[MoveRule], goals: Iterable[Symbol]) -> tuple[list[Symbol], list[MoveRule]]:
    """Return the coordinates on which the way to goals depends, sorted, and the rules about them."""
    about: dict[Symbol, list[MoveRule]] = {}
    for rule in rules:
        for symbol in rule.symbols if rule.way == "enter" else (rule.coordinate,):
            if symbol is not None:
                about.setdefault(symbol, []).append(rule)
    found, waiting = set[Symbol](), list(goals)
    while waiting:
        symbol = waiting.pop()
        if symbol not in found:
            found.add(symbol)
            waiting += [other for rule in about.get(symbol, ()) for other in rule.symbols]
    chosen = {id(rule): rule for symbol in found for rule in about.get(symbol, ())}
    return sorted(found, key=lambda s: s.sort_key), [r for r in rules if id(r) in chosen]


def _lock_rules(lock: Interlock, reader: _BoxReader) -> Iterator[MoveRule]:
    held = _positions(lock.held)
    for where in lock.when:
        box, exact = reader.read(where)
        symbol = lock.held if isinstance(lock.held, Symbol) else None
        if lock.hold == "has no value":
            yield MoveRule("enter", None, box, lock, exact)
        elif symbol is None or symbol.order > 1 or reader.moved.intersection(held):
            yield from _shut(held, box, lock)
        elif symbol.order == 1:
            if lock.hold in ("stands still", "cannot increase"):
                yield MoveRule("up", held[0], box, lock, exact)
            if lock.hold in ("stands still", "cannot decrease"):
                yield MoveRule("down", held[0], box, lock, exact)
        else:
            yield from _range_rules(lock, symbol, box, exact)


def _range_rules(lock: Interlock, symbol: Symbol, box: Box, exact: bool) -> Iterator[MoveRule]:
    """Yield the rules of a range of a position: no way out, and no way to leave it outside."""
    bounds = [bound for bound in (lock.lower, lock.upper) if bound is not None]
    others = [s for bound in bounds for s in _positions(bound)]
    if others:
        yield from _shut([symbol, *others], box, lock)
        return
    low = -math.inf if lock.lower is None else float(lock.lower)
    high = math.inf if lock.upper is None else float(lock.upper)
    sides: tuple[tuple[Way, Interval, Interval, float], ...] = (
        ("up", Interval(lower=high, lower_closed=True), Interval(lower=high), high),
        ("down", Interval(upper=low, upper_closed=True), Interval(upper=low), low),
    )
    for way, at_bound, beyond, bound in sides:
        if math.isinf(bound):
            continue
        inner = _narrow(box, symbol, at_bound)
        if inner is not None:
            yield MoveRule(way, symbol, inner, lock, exact)
        outer = _narrow(box, symbol, beyond)
        if outer is not None:
            yield MoveRule("enter", symbol, outer, lock, exact)


def _shut(held: Iterable[Symbol], box: Box, lock: Interlock | Undecided) -> Iterator[MoveRule]:
    ways: tuple[Way, Way] = ("up", "down")
    for symbol in held:
        for way in ways:
            yield MoveRule(way, symbol, box, lock, False)


def _narrow(box: Box, symbol: Symbol, side: Interval) -> Box | None:
    own = box[symbol].intersection(side) if symbol in box else side
    return None if own.is_empty else {**box, symbol: own}


def _positions(expression: Expression) -> list[Symbol]:
    symbols = (s.position if s.order else s for s in expression.symbols)
    return list(dict.fromkeys(s for s in symbols if s.has_derivative))
