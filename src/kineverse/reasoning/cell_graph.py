"""Cells of positions between the thresholds of interlocks, and the moves between them.

A state is one cell of each coordinate. It is an integer with one bit set for each coordinate; the bits of a
coordinate are its cells from the lowest to the highest one.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, TypeAlias

from kineverse.symbols import Symbol

from .boxes import Interval
from .move_rules import MoveRule

Move: TypeAlias = tuple[int, int]
"""Number of a coordinate, and the cell to which it moves."""


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

    def step(self, coordinate: int, cell: int, way: int) -> CellStep | None:
        """Return the step from a cell, upward for ``way = 1`` and downward for -1."""
        return self.steps[coordinate][way < 0][cell]

    def sweep(self, state: int, coordinate: int, way: int) -> Iterator[tuple[int, int]]:
        """Yield the cells in which a move in one direction may end, and the states there."""
        steps, first = self.steps[coordinate][way < 0], self.first[coordinate]
        cell = self.cell_of(state, coordinate)
        while True:
            step = steps[cell]
            if step is None or not all(map(state.__and__, step.needs)):
                return
            state ^= (1 << (first + cell)) | (1 << (first + cell + way))
            cell += way
            if self.rests >> (first + cell) & 1:
                yield cell, state

    def path(self, state: int, move: Move) -> Iterator[tuple[int, CellStep | None]]:
        """Yield the states along a move, and the steps taken from them."""
        coordinate, target = move
        cell = self.cell_of(state, coordinate)
        way = 1 if target > cell else -1
        while cell != target:
            yield state, self.step(coordinate, cell, way)
            state ^= self.bit(coordinate, cell) | self.bit(coordinate, cell + way)
            cell += way

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
    still: Collection[Symbol] = (),
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
        if rule.way != "enter" and rule.coordinate is not None:
            held[rule.coordinate].append((rule, mask))
        elif rule.way == "enter":
            for symbol in rule.box.keys() - {rule.coordinate}:
                entered[symbol].append((rule, mask))
    steps = []
    for k, symbol in enumerate(coordinates):
        both = []
        for way, name in ((1, "up"), (-1, "down")):
            about = [(r, m) for r, m in held[symbol] if r.way == name]
            both.append(
                tuple(
                    None
                    if symbol in still
                    else _make_step(cells[k], n, way, whole[k], first[k], about, entered[symbol])
                    for n in range(len(cells[k]))
                )
            )
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
    way: int,
    whole: int,
    first: int,
    about: Iterable[tuple[MoveRule, int]],
    entry: Iterable[tuple[MoveRule, int]],
) -> CellStep | None:
    """Return the step of a coordinate from a cell to its neighbour, None at the end.

    Rules about the direction have to leave the coordinate free in its cell, and in the neighbour, unless that
    is a single position, at which the move ends.
    """
    following = cell + way
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
    inner_end = (cell.lower_closed and cell.lower != limit.lower) or (
        cell.upper_closed and cell.upper != limit.upper
    )
    return cell.lower < cell.upper and (inner_end or (start in cell and start != goal))


def _may_rest(cells: Sequence[Interval], n: int, sides: Sequence[Interval]) -> bool:
    """Return whether a cell is more than the threshold between its neighbours, on both sides at once."""
    if cells[n].lower < cells[n].upper or not 0 < n < len(cells) - 1:
        return True
    beside = (cells[n - 1], cells[n + 1])
    return any(not side.covers(cells[n]) and any(map(side.covers, beside)) for side in sides) or any(
        side.covers(cells[n]) and side.lower == side.upper for side in sides
    )


def _divide(limit: Interval, sides: Sequence[Interval]) -> tuple[Interval, ...]:
    """Return the cells of a range: within each one, every side holds everywhere or nowhere."""
    cuts = sorted(
        {float(x) for side in (limit, *sides) for x in (side.lower, side.upper) if abs(x) != float("inf")}
    )
    pieces = [Interval(upper=cuts[0])] if cuts else [Interval()]
    for low, high in pairwise([*cuts, float("inf")]):
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
