"""Cells of positions between the thresholds of interlocks, and the moves between them.

A state is one cell of each coordinate. It is an integer with one bit set for each coordinate; the bits of a
coordinate are its cells from the lowest to the highest one.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple, TypeAlias

from kineverse.expressions.expression import Expression
from kineverse.model.model_view import ModelView
from kineverse.model.rates import to_plain
from kineverse.symbols import Symbol

from .boxes import Interval, IntervalBox
from .find_interlocks import constant_limits
from .interlock_records import Interlock, Interlocks, Undecided

Direction: TypeAlias = Literal["up", "down", "enter"]
Box: TypeAlias = Mapping[Symbol, Interval]


@dataclass(frozen=True)
class MoveRule:
    """Restriction of moves within a box of positions."""

    direction: Direction  # "up", "down": within the box, the coordinate cannot increase, or decrease
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
    """Return the coordinates on which goals depend, sorted, and the rules about them."""
    about: dict[Symbol, list[MoveRule]] = {}
    for rule in rules:
        for symbol in rule.symbols if rule.direction == "enter" else (rule.coordinate,):
            if symbol is not None:
                about.setdefault(symbol, []).append(rule)
    result, waiting = set[Symbol](), list(goals)
    while waiting:
        symbol = waiting.pop()
        if symbol not in result:
            result.add(symbol)
            waiting += [other for rule in about.get(symbol, ()) for other in rule.symbols]
    chosen = {id(rule): rule for symbol in result for rule in about.get(symbol, ())}
    return sorted(result, key=lambda s: s.sort_key), [r for r in rules if id(r) in chosen]


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
    """Yield the rules of a range of a position: no exit, and no return from outside."""
    bounds = [bound for bound in (lock.lower, lock.upper) if bound is not None]
    others = [s for bound in bounds for s in _positions(bound)]
    if others:
        yield from _shut([symbol, *others], box, lock)
        return
    low = -math.inf if lock.lower is None else float(lock.lower)
    high = math.inf if lock.upper is None else float(lock.upper)
    sides: tuple[tuple[Direction, Interval, Interval, float], ...] = (
        ("up", Interval(lower=high, lower_closed=True), Interval(lower=high), high),
        ("down", Interval(upper=low, upper_closed=True), Interval(upper=low), low),
    )
    for direction, at_bound, beyond, bound in sides:
        if math.isinf(bound):
            continue
        inner = _narrow(box, symbol, at_bound)
        if inner is not None:
            yield MoveRule(direction, symbol, inner, lock, exact)
        outer = _narrow(box, symbol, beyond)
        if outer is not None:
            yield MoveRule("enter", symbol, outer, lock, exact)


def _shut(held: Iterable[Symbol], box: Box, lock: Interlock | Undecided) -> Iterator[MoveRule]:
    directions: tuple[Direction, Direction] = ("up", "down")
    for symbol in held:
        for direction in directions:
            yield MoveRule(direction, symbol, box, lock, False)


def _narrow(box: Box, symbol: Symbol, side: Interval) -> Box | None:
    own = box[symbol].intersection(side) if symbol in box else side
    return None if own.is_empty else {**box, symbol: own}


def _positions(expression: Expression) -> list[Symbol]:
    symbols = (s.position if s.order else s for s in expression.symbols)
    return list(dict.fromkeys(s for s in symbols if s.has_derivative))


Move: TypeAlias = tuple[int, int]  # number of a coordinate, and the cell to which it moves


class CellStep(NamedTuple):
    """Step of a coordinate from one cell to the next.

    ``needs`` has a mask for each rule: at least one of its bits is set in states in which the rule does not
    block the step. A mask of 0 blocks it always.
    """

    needs: tuple[int, ...]
    rules: tuple[MoveRule, ...]


@dataclass(frozen=True)
class CellGraph:
    """Cells of coordinates and the steps between them."""

    coordinates: tuple[Symbol, ...]
    cells: tuple[tuple[Interval, ...], ...]  # their cells, from the lowest to the highest one
    first: tuple[int, ...]  # bit of the first cell of each coordinate
    steps: tuple[tuple[tuple[CellStep | None, ...], tuple[CellStep | None, ...]], ...]
    rests: int  # bits of the cells in which a move may end
    start: int  # state at the start
    goal: int  # the bits that are set at the goal

    def bit(self, coordinate: int, cell: int) -> int:
        """Return the bit of a cell."""
        return 1 << (self.first[coordinate] + cell)

    def field(self, coordinate: int) -> int:
        """Return the bits of all cells of a coordinate."""
        return ((1 << len(self.cells[coordinate])) - 1) << self.first[coordinate]

    def cell_of(self, state: int, coordinate: int) -> int:
        """Return the cell of a coordinate in a state."""
        return (state & self.field(coordinate)).bit_length() - 1 - self.first[coordinate]

    def step(self, coordinate: int, cell: int, direction: int) -> CellStep | None:
        """Return the step from a cell, upward for ``direction = 1`` and downward for -1."""
        return self.steps[coordinate][direction < 0][cell]

    def sweep(self, state: int, coordinate: int, direction: int) -> Iterator[tuple[int, int]]:
        """Yield the cells in which a move in one direction may end, and the states there."""
        steps, first = self.steps[coordinate][direction < 0], self.first[coordinate]
        cell = self.cell_of(state, coordinate)
        while True:
            step = steps[cell]
            if step is None or not all(map(state.__and__, step.needs)):
                return
            state ^= (1 << (first + cell)) | (1 << (first + cell + direction))
            cell += direction
            if self.rests >> (first + cell) & 1:
                yield cell, state

    def path(self, state: int, move: Move) -> Iterator[tuple[int, CellStep | None]]:
        """Yield the states along a move, and the steps taken from them."""
        coordinate, target = move
        cell = self.cell_of(state, coordinate)
        direction = 1 if target > cell else -1
        while cell != target:
            yield state, self.step(coordinate, cell, direction)
            state ^= self.bit(coordinate, cell) | self.bit(coordinate, cell + direction)
            cell += direction

    def apply(self, state: int, move: Move) -> int | None:
        """Return the state after a move, None if a rule blocks it."""
        for at, step in self.path(state, move):
            if step is None or not all(map(at.__and__, step.needs)):
                return None
        coordinate, target = move
        return state & ~self.field(coordinate) | self.bit(coordinate, target)

    def is_goal(self, state: int) -> bool:
        """Return whether a state fulfils the goal."""
        return not self.goal & ~state


def make_graph(
    coordinates: Sequence[Symbol],
    rules: Sequence[MoveRule],
    limits: Mapping[Symbol, Interval],
    start: Mapping[Symbol, float],
    goals: Mapping[Symbol, float],
    fixed: Collection[Symbol] = (),
) -> CellGraph:
    """Return the cells between the thresholds of rules, and the steps that the rules allow."""
    cells: list[tuple[Interval, ...]] = []
    first: list[int] = []
    rests = 0
    place = {symbol: k for k, symbol in enumerate(coordinates)}
    for symbol in coordinates:
        limit = limits.get(symbol, Interval())
        sides = list(dict.fromkeys(rule.box[symbol] for rule in rules if symbol in rule.box))
        own = _divide(limit, sides)
        if symbol in goals and _needs_cut(own, limit, start[symbol], goals[symbol]):
            sides.append(Interval(goals[symbol], goals[symbol], True, True))
            own = _divide(limit, sides)
        first.append(first[-1] + len(cells[-1]) if cells else 0)
        cells.append(own)
        rests += sum(
            1 << (first[-1] + n)
            for n, cell in enumerate(own)
            if _may_rest(own, n, sides) or (symbol in goals and goals[symbol] in cell)
        )

    def bits(symbol: Symbol, side: Interval) -> int:
        k = place[symbol]
        return sum(1 << (first[k] + n) for n, cell in enumerate(cells[k]) if side.covers(cell))

    def bit_at(symbol: Symbol, number: float) -> int:
        k = place[symbol]
        return next(1 << (first[k] + n) for n, cell in enumerate(cells[k]) if number in cell)

    whole = [((1 << len(own)) - 1) << begin for own, begin in zip(cells, first, strict=True)]
    masks = [(rule, sum(whole[place[s]] & ~bits(s, side) for s, side in rule.box.items())) for rule in rules]
    held: dict[Symbol, list[tuple[MoveRule, int]]] = {symbol: [] for symbol in coordinates}
    entered: dict[Symbol, list[tuple[MoveRule, int]]] = {symbol: [] for symbol in coordinates}
    for rule, mask in masks:
        if rule.direction != "enter" and rule.coordinate is not None:
            held[rule.coordinate].append((rule, mask))
        elif rule.direction == "enter":
            for symbol in rule.box.keys() - {rule.coordinate}:
                entered[symbol].append((rule, mask))
    steps = []
    for k, symbol in enumerate(coordinates):
        both = []
        for direction, name in ((1, "up"), (-1, "down")):
            about = [(r, m) for r, m in held[symbol] if r.direction == name]
            row: list[CellStep | None] = [None] * len(cells[k])
            if symbol not in fixed:
                for n in range(len(row)):
                    row[n] = _make_step(cells[k], n, direction, whole[k], first[k], about, entered[symbol])
            both.append(tuple(row))
        steps.append((both[0], both[1]))
    return CellGraph(
        tuple(coordinates),
        tuple(cells),
        tuple(first),
        tuple(steps),
        rests,
        sum(bit_at(symbol, start[symbol]) for symbol in coordinates),
        sum(bit_at(symbol, value) for symbol, value in goals.items()),
    )


def _make_step(
    cells: Sequence[Interval],
    cell: int,
    direction: int,
    whole: int,
    first: int,
    about: Iterable[tuple[MoveRule, int]],
    entry: Iterable[tuple[MoveRule, int]],
) -> CellStep | None:
    """Return the step of a coordinate from a cell to its neighbour, None at the end.

    Rules about the direction have to leave the coordinate free in its cell, and in the neighbour, unless that
    is a single position, at which the move ends.
    """
    following = cell + direction
    if not 0 <= following < len(cells):
        return None
    here, there = 1 << (first + cell), 1 << (first + following)
    ends = cells[following].lower == cells[following].upper
    needed: dict[int, MoveRule] = {}
    for rule, mask in about:
        if not mask & here or (not ends and not mask & there):
            needed.setdefault(mask & ~whole, rule)
    for rule, mask in entry:
        if mask & here and not mask & there:
            needed.setdefault(mask & ~whole, rule)
    return CellStep(tuple(needed), tuple(needed.values()))


def _needs_cut(cells: Sequence[Interval], limit: Interval, start: float, goal: float) -> bool:
    """Return whether being in the cell of a goal is less than being able to reach it."""
    cell = next(cell for cell in cells if goal in cell)
    inner_low = cell.lower_closed and cell.lower != limit.lower
    inner_high = cell.upper_closed and cell.upper != limit.upper
    return cell.lower < cell.upper and (inner_low or inner_high or (start in cell and start != goal))


def _may_rest(cells: Sequence[Interval], n: int, sides: Sequence[Interval]) -> bool:
    """Return whether a cell is more than the threshold between its neighbours, on both sides at once."""
    if cells[n].lower < cells[n].upper or not 0 < n < len(cells) - 1:
        return True
    beside = (cells[n - 1], cells[n + 1])
    return any(
        side.lower == side.upper if side.covers(cells[n]) else any(map(side.covers, beside)) for side in sides
    )


def _divide(limit: Interval, sides: Sequence[Interval]) -> tuple[Interval, ...]:
    """Return the cells of a range: within each one, every side holds everywhere or nowhere."""
    ends = {float(x) for side in (limit, *sides) for x in (side.lower, side.upper)}
    cuts = sorted(filter(math.isfinite, ends))
    pieces = [Interval(upper=cuts[0])] if cuts else [Interval()]
    for low, high in pairwise([*cuts, math.inf]):
        pieces += [Interval(low, low, True, True), Interval(low, high)]
    pieces = [piece for piece in pieces if limit.covers(piece)]
    joined: list[Interval] = []
    known: list[bool] | None = None
    for piece in pieces:
        inside = [side.covers(piece) for side in sides]
        united = joined[-1].join(piece) if inside == known else None
        if united is None:
            joined.append(piece)
        else:
            joined[-1] = united
        known = inside
    return tuple(joined)
