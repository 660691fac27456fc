"""Independent checks of unlocking plans, and of sets that no move leaves, without code of the planner."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias

from kineverse.intervals.arithmetic import REALS, RealInterval
from kineverse.model.constraint import Constraint
from kineverse.model.model_view import ModelView
from kineverse.state import StateLike
from kineverse.symbols import Symbol

from .boxes import Interval
from .constraint_evaluation import (
    BESIDE,
    NOTHING,
    SLOW,
    ConstraintRanges,
    settle_point,
    start_point,
    value_at,
)

if TYPE_CHECKING:
    from .unlocking_plan import UnlockingPlan, UnlockingStep

SAMPLES = 21  # positions along a move at which undecided constraints are evaluated
_NARROWEST = 1e-7  # width of an interval around a threshold that is not divided any further [m] or [rad]
_MOST_INTERVALS = 400

_Point = dict[Symbol, float]


def plan_violations(model: ModelView, plan: UnlockingPlan, state: StateLike | None = None) -> list[str]:
    """Return the violations of constraints along a plan, and the goals that it misses; none if it is right.

    Each move is enclosed in intervals from its start to its target, which are halved until they decide.
    Within each, constraints on speeds have to admit a small speed of the one coordinate, but for 0.1 µm
    around a threshold. Constraints on positions hold at the end of each move, and if they are violated
    meanwhile, the violation decreases.

    Parameters
    ----------
    state
        Positions at the start, as they were given to the planner.

    Examples
    --------
    >>> model = kv.load("articulations/garage_door")
    >>> plan = kv.reasoning.plan_unlocking(model, {"garage_door/garage/door": 1.0})
    >>> kv.reasoning.plan_violations(model, plan)
    []
    """
    ranges = ConstraintRanges(model)
    point = start_point(model, state)
    settle_point(model, point)
    for row in ranges.rows.values():
        point = {**{s: s.value or 0.0 for s in row.symbols if s not in point}, **point}
    result: list[str] = []
    for number, step in enumerate(plan.steps, 1):
        about = f"move {number}, {step.coordinate}"
        if abs(point[step.coordinate] - step.start) > NOTHING * (1 + abs(step.start)):
            result.append(f"{about}: it begins at {step.start:g}, and not at {point[step.coordinate]:g}")
        result += dict.fromkeys(f"{about}: {name}" for name in _check_step(model, ranges, point, step))
    if plan.verdict == "found":
        for symbol, value in plan.goal.items():
            if abs(point[symbol] - value) > NOTHING * (1 + abs(value)):
                result.append(f"{symbol} ends at {point[symbol]:g}, and not at {value:g}")
    return result


def _check_step(
    model: ModelView, ranges: ConstraintRanges, point: _Point, step: UnlockingStep
) -> Iterator[str]:
    """Yield the constraints that a move violates, and set the point to its end."""
    forward = SLOW if step.target > step.start else -SLOW
    speed = step.coordinate.derivative()
    names = {**dict.fromkeys(ranges.about(speed)), **dict.fromkeys(ranges.about(step.coordinate))}
    undecided = list[str]()
    for name in names:
        row = ranges.rows[name]
        if row.order == 0 or (row.order == 1 and speed in row.expression.symbols):
            answer = _is_violated(ranges, name, point, step, forward)
            if answer and row.order:
                yield name
            elif answer is not False:
                undecided.append(name)
    if not undecided:
        point[step.coordinate] = step.target
        settle_point(model, point)
    else:
        yield from _check_samples(model, ranges, undecided, point, step, forward)


def _is_violated(
    ranges: ConstraintRanges, name: str, point: _Point, step: UnlockingStep, forward: float
) -> bool | None:
    """Return whether a constraint is violated in a part of a move, None if intervals do not decide it."""
    coordinate = step.coordinate
    box: dict[Symbol, RealInterval] = {s: (x, x) for s, x in point.items() if not s.order}
    box[coordinate.derivative()] = forward, forward
    waiting, count = [(min(step.start, step.target), max(step.start, step.target))], 0
    while waiting:
        low, high = waiting.pop()
        box[coordinate] = low, high
        least, most = ranges.excess(name, box)
        count += 1
        if least > NOTHING:
            return True
        if most > NOTHING:
            if count > _MOST_INTERVALS:
                return None
            if high - low > _NARROWEST:
                middle = (low + high) / 2
                waiting += [(low, middle), (middle, high)]
            elif not ranges.rows[name].order:
                return None
    return False


def _check_samples(
    model: ModelView,
    ranges: ConstraintRanges,
    names: list[str],
    point: _Point,
    step: UnlockingStep,
    forward: float,
) -> Iterator[str]:
    """Yield the constraints that samples along a move violate, and set the point to its end."""
    speed, rows = step.coordinate.derivative(), {name: ranges.rows[name] for name in names}
    before = {name: _excess(row, point) for name, row in rows.items() if not row.order}
    last = dict(before)
    for n in range(SAMPLES):
        share = n / (SAMPLES - 1)
        point[step.coordinate] = step.start + share * (step.target - step.start)
        settle_point(model, point)
        moving = {**{s: 0.0 if s.order else x for s, x in point.items()}, speed: forward}
        for name, row in rows.items():
            if row.order == 1:
                if n < SAMPLES - 1 and _excess(row, moving) > NOTHING:
                    yield name
            else:
                now = _excess(row, point)
                # A coordinate that comes back from beyond a lock may pass its margin, see position_lock.
                entered = last[name] == 0 and step.coordinate in row.expression.symbols
                if now > last[name] + NOTHING and not entered:
                    yield name
                last[name] = now
    for name, most in before.items():
        if last[name] > most + NOTHING:
            yield name


def _excess(row: Constraint, point: _Point) -> float:
    value = value_at(row.expression, point)
    return max(value_at(row.lower, point) - value, value - value_at(row.upper, point), 0.0)


CellRange: TypeAlias = tuple[int, int]
Region: TypeAlias = tuple[CellRange, ...]  # first and last cell of each coordinate
_Box: TypeAlias = dict[Symbol, RealInterval]


@dataclass(frozen=True)
class InvariantSet:
    """Union of regions that no move of one coordinate at a time leaves.

    Attributes
    ----------
    coordinates
        Coordinates that keep each other in the set; others are anywhere.
    cells
        Intervals of positions of each coordinate, which together are its whole range.
    rests
        For each cell whether a move may end there; it may not on a single threshold.
    regions
        Products of cells, one range of them for each coordinate. The start is in one of them.
    following
        For each region the numbers of others to which moves lead from it.

    See Also
    --------
    kineverse.reasoning.refutation_gaps
    """

    coordinates: tuple[Symbol, ...]
    cells: tuple[tuple[Interval, ...], ...]
    rests: tuple[tuple[bool, ...], ...]
    regions: tuple[Region, ...]
    following: tuple[tuple[int, ...], ...] = ()


def refutation_gaps(model: ModelView, plan: UnlockingPlan, state: StateLike | None = None) -> list[str]:
    """Return what a refutation leaves open; nothing if no move leads from the start to the goal.

    From each region of :attr:`.UnlockingPlan.invariant`, a coordinate can only get into regions of the same
    set: otherwise a constraint admits no speed of it, or would be violated, everywhere in the region. That is
    found by interval arithmetic on the constraints. Positions within 2 µm of a threshold are not considered,
    but for those at the start.

    Parameters
    ----------
    state
        Positions at the start, as they were given to the planner.

    Examples
    --------
    >>> model = kv.load("articulations/garage_door")
    >>> bolt = "garage_door/garage/bolt"
    >>> goal = {"garage_door/garage/door": 1.0}
    >>> plan = kv.reasoning.plan_unlocking(model, goal, {bolt: 0.0}, fixed=[bolt])
    >>> plan.verdict, kv.reasoning.refutation_gaps(model, plan, {bolt: 0.0})
    ('refuted', [])
    """
    known = plan.invariant
    if known is None:
        return ["there is no set of positions that no move leaves"]
    given = start_point(model, state)
    start = {s: given.get(s, 0.0) for s in known.coordinates}
    check = _InvarianceCheck(ConstraintRanges(model), known, frozenset(plan.fixed), start)
    return list(check.run(plan.goal))


@dataclass(frozen=True)
class _InvarianceCheck:
    """Check of one set."""

    ranges: ConstraintRanges
    known: InvariantSet
    fixed: frozenset[Symbol]
    start: Mapping[Symbol, float]

    def run(self, goal: Mapping[Symbol, float]) -> Iterator[str]:
        known = self.known
        for k, symbol in enumerate(known.coordinates):
            if not self._is_whole_range(k):
                yield f"the intervals of {symbol} do not cover its range"
        if not any(self._contains(region, self.start) for region in known.regions):
            yield "the start is outside"
        if any(self._contains(region, goal) for region in known.regions):
            yield "the goal is inside"
        index = {region: n for n, region in enumerate(known.regions)}
        for n, region in enumerate(known.regions):
            following = known.following[n] if known.following else ()
            for k, symbol in enumerate(known.coordinates):
                for direction in () if symbol in self.fixed else (1, -1):
                    into = self._neighbour(region, k, direction)
                    if into is None or into in index:
                        continue
                    if any(_covers(known.regions[m], into) for m in following):
                        continue
                    if not self._is_blocked(region, into, k, direction):
                        cell = known.cells[k][into[k][0]]
                        yield f"{symbol} may get to {cell.describe(str(symbol))}"

    def _is_whole_range(self, k: int) -> bool:
        """Return whether the cells of a coordinate cover its range, and only thresholds are no rests."""
        cells, rests = self.known.cells[k], self.known.rests[k]
        low, high = self.ranges.limits.get(self.known.coordinates[k], REALS)
        joined = all(a.upper == b.lower and (a.upper_closed or b.lower_closed) for a, b in pairwise(cells))
        single = all(rest or cell.lower == cell.upper for rest, cell in zip(rests, cells, strict=True))
        return joined and single and cells[0].lower <= low and high <= cells[-1].upper

    def _contains(self, region: Region, point: Mapping[Symbol, float]) -> bool:
        """Return whether a point is in a region; beyond limits counts as at the limit."""
        for (first, last), symbol, cells in zip(
            region, self.known.coordinates, self.known.cells, strict=True
        ):
            if symbol in point:
                low, high = self.ranges.limits.get(symbol, REALS)
                value = min(max(point[symbol], low), high)
                if not any(value in cell for cell in cells[first : last + 1]):
                    return False
        return True

    def _neighbour(self, region: Region, k: int, direction: int) -> Region | None:
        """Return the positions next to a region in one direction, None at the end of the range."""
        cell = region[k][direction > 0] + direction
        rests = self.known.rests[k]
        while 0 <= cell < len(rests) and not rests[cell]:
            cell += direction
        return (*region[:k], (cell, cell), *region[k + 1 :]) if 0 <= cell < len(rests) else None

    def _is_blocked(self, region: Region, into: Region, k: int, direction: int) -> bool:
        """Return whether constraints stop a coordinate at the end of a region, wherever the others are."""
        symbol, end = self.known.coordinates[k], region[k][direction > 0]
        here = self._box((*region[:k], (end, end), *region[k + 1 :]))
        there = self._box(into)
        boxes = [here, there] if there[symbol][0] < there[symbol][1] else [here]
        if any(self.ranges.refuses(symbol.derivative(), direction, box, self.start) for box in boxes):
            return True
        return any(
            self._is_left(name, k, direction, here, there)
            for name in self.ranges.about(symbol)
            if not self.ranges.rows[name].order
        )

    def _is_left(self, name: str, k: int, direction: int, here: _Box, there: _Box) -> bool:
        """Return whether a constraint on positions is violated by a move, or farther away with it."""
        symbol, row, ranges = self.known.coordinates[k], self.ranges.rows[name], self.ranges
        if symbol not in row.expression.symbols:
            return ranges.excess(name, there)[0] > NOTHING >= ranges.excess(name, here)[1]
        least, most = ranges.excesses(name, there)[direction > 0]
        if row.expression != symbol or least <= NOTHING:
            return False
        # Its own position may change the bound, unless that is constant next to the region.
        room = there[symbol][1] - there[symbol][0] + NOTHING
        return (
            symbol not in (row.upper if direction > 0 else row.lower).symbols
            or most - least <= room < math.inf
        )

    def _box(self, region: Region) -> _Box:
        """Return the positions of a region, without those next to thresholds but with the start."""
        box = {}
        for (first, last), symbol, cells in zip(
            region, self.known.coordinates, self.known.cells, strict=True
        ):
            low, high = float(cells[first].lower), float(cells[last].upper)
            least, most = self.ranges.limits.get(symbol, REALS)
            margin, here = min(BESIDE, (high - low) / 4), self.start[symbol]
            at_low = (least == low and cells[first].lower_closed) or here == low
            at_high = (high == most and cells[last].upper_closed) or here == high
            box[symbol] = low if at_low else low + margin, high if at_high else high - margin
        return box


def _covers(region: Region, other: Region) -> bool:
    return all(a <= c and d <= b for (a, b), (c, d) in zip(region, other, strict=True))
