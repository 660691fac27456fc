"""Sets of positions that no move leaves, and an independent check that this is so.

The check evaluates the constraints over the boxes of the set, without code of the planner.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias

from kineverse.intervals.arithmetic import REALS, RealInterval
from kineverse.model.model_view import ModelView
from kineverse.state import StateLike
from kineverse.symbols import Symbol

from .boxes import Interval
from .constraint_ranges import BESIDE, NOTHING, ConstraintRanges
from .point_evaluation import start_point

if TYPE_CHECKING:
    from .unlocking_plan import UnlockingPlan

CellRange: TypeAlias = tuple[int, int]
Region: TypeAlias = tuple[CellRange, ...]
"""First and last cell of each coordinate."""
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
    model
        The model.
    plan
        The plan.
    state
        Positions at the start, as they were given to the planner.
    """
    known = plan.invariant
    if known is None:
        return ["there is no set of positions that no move leaves"]
    given = start_point(model, state)
    start = {s: given.get(s, 0.0) for s in known.coordinates}
    check = _InvarianceCheck(ConstraintRanges(model), known, frozenset(plan.still), start)
    return list(check.run(plan.goal))


@dataclass(frozen=True)
class _InvarianceCheck:
    """Check of one set."""

    ranges: ConstraintRanges
    known: InvariantSet
    still: frozenset[Symbol]
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
                for way in () if symbol in self.still else (1, -1):
                    into = self._neighbour(region, k, way)
                    if into is None or into in index:
                        continue
                    if any(_covers(known.regions[m], into) for m in following):
                        continue
                    if not self._is_blocked(region, into, k, way):
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

    def _neighbour(self, region: Region, k: int, way: int) -> Region | None:
        """Return the positions beside a region in one direction, None at the end of the range."""
        cell = region[k][way > 0] + way
        rests = self.known.rests[k]
        while 0 <= cell < len(rests) and not rests[cell]:
            cell += way
        return (*region[:k], (cell, cell), *region[k + 1 :]) if 0 <= cell < len(rests) else None

    def _is_blocked(self, region: Region, into: Region, k: int, way: int) -> bool:
        """Return whether constraints stop a coordinate at the end of a region, wherever the others are."""
        symbol, end = self.known.coordinates[k], region[k][way > 0]
        here = self._box((*region[:k], (end, end), *region[k + 1 :]))
        there = self._box(into)
        boxes = [here, there] if there[symbol][0] < there[symbol][1] else [here]
        if any(self.ranges.refuses(symbol.derivative(), way, box, self.start) for box in boxes):
            return True
        return any(
            self._is_left(name, k, way, here, there)
            for name in self.ranges.about(symbol)
            if not self.ranges.rows[name].order
        )

    def _is_left(self, name: str, k: int, way: int, here: _Box, there: _Box) -> bool:
        """Return whether a constraint on positions is violated by a move, or farther away with it."""
        symbol, row, ranges = self.known.coordinates[k], self.ranges.rows[name], self.ranges
        if symbol not in row.expression.symbols:
            return ranges.excess(name, there)[0] > NOTHING >= ranges.excess(name, here)[1]
        least, most = ranges.excesses(name, there)[way > 0]
        if row.expression != symbol or least <= NOTHING:
            return False
        # Its own position may change the bound, unless that is constant beside the region.
        room = there[symbol][1] - there[symbol][0] + NOTHING
        return symbol not in (row.upper if way > 0 else row.lower).symbols or most - least <= room < math.inf

    def _box(self, region: Region) -> _Box:
        """Return the positions of a region, without those beside thresholds but with the start."""
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
