"""Intervals, boxes, and regions: unions of boxes with set operations and short covers."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction

from kineverse.expressions.expression import Expression
from kineverse.expressions.functions import floor
from kineverse.symbols import Symbol

Number = float | Fraction


@dataclass(frozen=True)
class Interval:
    """Interval of real numbers with open or closed ends; infinite ends are open.

    ``x in interval`` tests whether a number lies in the interval.

    Examples
    --------
    >>> narrow = kv.reasoning.Interval(0.0, 0.3, upper_closed=True)
    >>> 0.3 in narrow, 0.0 in narrow
    (True, False)
    >>> narrow.describe("bolt")
    '0 < bolt <= 0.3'
    """

    lower: Number = -math.inf
    upper: Number = math.inf
    lower_closed: bool = False
    upper_closed: bool = False

    @property
    def is_empty(self) -> bool:
        """True if the interval contains no number."""
        if self.lower == self.upper:
            return not (self.lower_closed and self.upper_closed)
        return self.lower > self.upper

    @property
    def is_everything(self) -> bool:
        """True if the interval contains every number."""
        return self.lower == -math.inf and self.upper == math.inf

    def __contains__(self, number: Number) -> bool:
        above = number > self.lower or (self.lower_closed and number == self.lower)
        return above and (number < self.upper or (self.upper_closed and number == self.upper))

    def intersection(self, other: Interval) -> Interval:
        """Return the intersection with another interval, which may be empty."""
        low, low_open = max((self.lower, not self.lower_closed), (other.lower, not other.lower_closed))
        high, high_closed = min((self.upper, self.upper_closed), (other.upper, other.upper_closed))
        return Interval(low, high, not low_open, high_closed)

    def covers(self, other: Interval) -> bool:
        """Return True if this interval contains another one, which is not empty."""
        if self.lower > other.lower or self.upper < other.upper:
            return False
        starts = self.lower_closed or not other.lower_closed or self.lower < other.lower
        return starts and (self.upper_closed or not other.upper_closed or self.upper > other.upper)

    def join(self, other: Interval) -> Interval | None:
        """Return the union with another interval if it is an interval, else None; neither is empty."""
        first, second = sorted((self, other), key=lambda i: (i.lower, not i.lower_closed))
        touch = second.lower == first.upper and (second.lower_closed or first.upper_closed)
        if second.lower >= first.upper and not touch:
            return None
        high, closed = max((self.upper, self.upper_closed), (other.upper, other.upper_closed))
        return Interval(first.lower, high, first.lower_closed, closed)

    def complement(self) -> Iterator[Interval]:
        """Yield the interval below this one and the interval above it, as far as they exist."""
        if self.lower > -math.inf:
            yield Interval(upper=self.lower, upper_closed=not self.lower_closed)
        if self.upper < math.inf:
            yield Interval(lower=self.upper, lower_closed=not self.upper_closed)

    def to_floats(self) -> Interval:
        """Return the interval with its ends as floats."""
        return Interval(float(self.lower), float(self.upper), self.lower_closed, self.upper_closed)

    def describe(self, name: str) -> str:
        """Format the condition that a quantity of this name lies in the interval, as ``0 < b <= 0.3``."""
        if self.lower == self.upper:
            return f"{name} = {float(self.lower):.12g}"
        below = f"{float(self.lower):.12g} <{'=' if self.lower_closed else ''} "
        above = f" <{'=' if self.upper_closed else ''} {float(self.upper):.12g}"
        if self.upper == math.inf:
            return f"{name} >{'=' if self.lower_closed else ''} {float(self.lower):.12g}"
        return f"{below if self.lower > -math.inf else ''}{name}{above}"

    def __str__(self) -> str:
        ends = f"{float(self.lower):.12g}, {float(self.upper):.12g}"
        return f"{'[' if self.lower_closed else '('}{ends}{']' if self.upper_closed else ')'}"


EVERYTHING = Interval()


class IntervalBox(Mapping[Expression, Interval]):
    """Conjunction of conditions: intervals of coordinates, or of sums of coordinates; all others are free.

    The box without conditions covers the whole space.

    Examples
    --------
    >>> bolt = kv.position("bolt")
    >>> ajar = kv.reasoning.IntervalBox({bolt: kv.reasoning.Interval(0.0, 0.3)})
    >>> ajar.covers(kv.reasoning.IntervalBox({bolt: kv.reasoning.Interval(0.1, 0.2)}))
    True
    """

    __slots__ = ("_sides",)

    def __init__(self, sides: Mapping[Expression, Interval]) -> None:
        limited = [(axis, side) for axis, side in sides.items() if not side.is_everything]
        limited.sort(key=lambda item: (not isinstance(item[0], Symbol), axis_name(item[0])))
        self._sides = dict(limited)

    def __getitem__(self, axis: Expression) -> Interval:
        return self._sides[axis]

    def __iter__(self) -> Iterator[Expression]:
        return iter(self._sides)

    def __len__(self) -> int:
        return len(self._sides)

    def __eq__(self, other: object) -> bool:
        return self._sides == other._sides if isinstance(other, IntervalBox) else NotImplemented

    def __hash__(self) -> int:
        return hash(tuple(self._sides.items()))

    def __str__(self) -> str:
        return " and ".join(side.describe(axis_name(axis)) for axis, side in self._sides.items()) or "always"

    def __repr__(self) -> str:
        return f"<IntervalBox: {self}>"

    def intersection(self, other: IntervalBox) -> IntervalBox | None:
        """Return the intersection with another box, or None if it is empty."""
        sides = dict(self._sides)
        for axis, side in other.items():
            sides[axis] = sides[axis].intersection(side) if axis in sides else side
            if sides[axis].is_empty:
                return None
        return IntervalBox(sides)

    def covers(self, other: IntervalBox) -> bool:
        """Return True if this box contains another one."""
        sides = other._sides
        if len(self._sides) > len(sides):
            return False
        for axis, side in self._sides.items():
            own = sides.get(axis)
            if own is None or not side.covers(own):
                return False
        return True

    def subtract(self, other: IntervalBox) -> list[IntervalBox]:
        """Return the difference of this box and another one, as boxes that do not overlap."""
        if self.intersection(other) is None:
            return [self]
        rest, parts = dict(self._sides), []
        for axis, side in other.items():
            own = rest.get(axis, EVERYTHING)
            for beyond in side.complement():
                part = own.intersection(beyond)
                if not part.is_empty:
                    parts.append(IntervalBox({**rest, axis: part}))
            rest[axis] = own.intersection(side)
        return parts

    def to_floats(self) -> IntervalBox:
        """Return the box with the ends of its intervals as floats."""
        return IntervalBox({axis: side.to_floats() for axis, side in self._sides.items()})


def axis_name(axis: Expression) -> str:
    """Return the name of an axis: that of a symbol, a sum, or ``angle mod 2π``."""
    if not isinstance(axis, Symbol) and len(axis.symbols) == 1 and axis == wrap_to_turn(axis.symbols[0]):
        return f"{axis.symbols[0]} mod 2π"
    return str(axis)


def wrap_to_turn(angle: Symbol) -> Expression:
    """Return an angle modulo 2π, in [0, 2π)."""
    return angle - math.tau * floor(angle / math.tau)


_JOINED_AT_MOST = 60
_PRIMES_AT_MOST = 200


@dataclass
class Region:
    """Union of boxes, and the part of it that is reported.

    At equality, a comparison has the value 0.5. A condition that holds only there is not reported. But a
    condition that holds there and on both sides gives one box, and not two.
    """

    boxes: list[IntervalBox] = field(default_factory=list)
    reported: list[IntervalBox] = field(default_factory=list)

    def add(self, box: IntervalBox, reported: bool) -> None:
        """Add a box to the region, and to its reported part if ``reported``."""
        self.boxes.append(box)
        if reported:
            self.reported.append(box)

    def __and__(self, other: Region) -> Region:
        return Region(
            intersect_boxes(self.boxes, other.boxes), intersect_boxes(self.reported, other.reported)
        )

    def __or__(self, other: Region) -> Region:
        return Region(self.boxes + other.boxes, self.reported + other.reported)

    def __sub__(self, other: Region) -> Region:
        left = ((box, part) for box in self.reported for part in subtract_boxes([box], other.boxes))
        reported = [part for box, part in left if not _is_sliver(part, box)]
        return Region(subtract_boxes(self.boxes, other.boxes), reported)

    def cover(self) -> tuple[IntervalBox, ...]:
        """Return a cover of the region by few large boxes; none if no part of it is reported."""
        return merge_boxes(self.boxes, self.reported)


def _is_sliver(part: IntervalBox, box: IntervalBox) -> bool:
    """Return True if a part has a single value on an axis where its box has an interval."""
    flat = (axis for axis, side in part.items() if side.lower == side.upper)
    return any(box.get(axis, EVERYTHING).lower != box.get(axis, EVERYTHING).upper for axis in flat)


def subtract_boxes(boxes: Iterable[IntervalBox], others: Iterable[IntervalBox]) -> list[IntervalBox]:
    """Return the difference of two unions of boxes."""
    rest = list(boxes)
    for other in others:
        rest = [part for box in rest for part in box.subtract(other)]
    return rest


def intersect_boxes(boxes: Iterable[IntervalBox], others: Iterable[IntervalBox]) -> list[IntervalBox]:
    """Return the intersection of two unions of boxes."""
    second = list(others)
    pairs = (box.intersection(other) for box in boxes for other in second)
    return _maximal_boxes([box for box in pairs if box is not None])


def merge_boxes(
    boxes: Iterable[IntervalBox], wanted: Iterable[IntervalBox] | None = None
) -> tuple[IntervalBox, ...]:
    """Return a cover of a union of boxes by few large boxes, in an order that depends on the set only.

    The cover consists of maximal boxes within the set, which correspond to the prime implicants in the
    minimisation of truth tables; boxes that the others cover are removed. If there are too many maximal
    boxes, smaller ones remain. If only a part of the set is ``wanted``, boxes that do not contribute to that
    part are removed.
    """
    result = _join_adjacent(list(boxes))
    matter = result if wanted is None else _join_adjacent(list(wanted))
    if len(result) <= _JOINED_AT_MOST:
        result = _prime_boxes(result)
    result.sort(key=lambda b: (-len(b), str(b)))
    for box in list(result):
        others = [other for other in result if other is not box]
        if not subtract_boxes(intersect_boxes([box], matter), others):
            result = others
    return tuple(sorted((box.to_floats() for box in result), key=lambda b: (len(b), str(b))))


def _join_adjacent(boxes: list[IntervalBox]) -> list[IntervalBox]:
    """Join boxes that differ in one axis only, until none are left."""
    while True:
        before = len(boxes)
        for axis in sorted({axis for box in boxes for axis in box}, key=axis_name):
            rows: dict[IntervalBox, list[Interval]] = {}
            for box in boxes:
                rest = IntervalBox({a: side for a, side in box.items() if a != axis})
                rows.setdefault(rest, []).append(box.get(axis, EVERYTHING))
            boxes = [
                IntervalBox({**rest, axis: side}) for rest, sides in rows.items() for side in _unite(sides)
            ]
        if len(boxes) == before:
            return _maximal_boxes(boxes)


def _unite(sides: list[Interval]) -> list[Interval]:
    united: list[Interval] = []
    for side in sorted(sides, key=lambda i: (i.lower, not i.lower_closed)):
        joined = united[-1].join(side) if united else None
        if joined is None:
            united.append(side)
        else:
            united[-1] = joined
    return united


def _prime_boxes(boxes: list[IntervalBox]) -> list[IntervalBox]:
    """Return all maximal boxes within the set, by joining pairs along an axis until there are no new ones."""
    primes = boxes
    while True:
        new: list[IntervalBox] = []
        for a, b in itertools.combinations(primes, 2):
            for joined in _joined_boxes(a, b):
                if not any(known.covers(joined) for known in itertools.chain(primes, new)):
                    new.append(joined)
        if not new:
            return primes
        larger = _maximal_boxes(primes + new)
        if len(larger) > _PRIMES_AT_MOST:
            return boxes
        primes = larger


def _joined_boxes(a: IntervalBox, b: IntervalBox) -> Iterator[IntervalBox]:
    axes = {**dict.fromkeys(a), **dict.fromkeys(b)}
    both = {axis: a.get(axis, EVERYTHING).intersection(b.get(axis, EVERYTHING)) for axis in axes}
    empty = [axis for axis, side in both.items() if side.is_empty]
    if len(empty) > 1:
        return
    for axis in empty or axes:
        joined = a.get(axis, EVERYTHING).join(b.get(axis, EVERYTHING))
        if joined is not None:
            yield IntervalBox({**both, axis: joined})


def _maximal_boxes(boxes: list[IntervalBox]) -> list[IntervalBox]:
    kept: list[IntervalBox] = []
    for box in sorted(dict.fromkeys(boxes), key=len):
        if not any(other.covers(box) for other in kept):
            kept = [other for other in kept if not box.covers(other)]
            kept.append(box)
    return kept
