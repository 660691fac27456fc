"""Regions: unions of boxes with set operations and short covers."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from .boxes import EVERYTHING, Interval, IntervalBox, axis_name

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
    found = _join_adjacent(list(boxes))
    matter = found if wanted is None else _join_adjacent(list(wanted))
    if len(found) <= _JOINED_AT_MOST:
        found = _prime_boxes(found)
    found.sort(key=lambda b: (-len(b), str(b)))
    for box in list(found):
        others = [other for other in found if other is not box]
        if not subtract_boxes(intersect_boxes([box], matter), others):
            found = others
    return tuple(sorted((box.to_floats() for box in found), key=lambda b: (len(b), str(b))))


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
    """Return the boxes that no other box contains."""
    kept: list[IntervalBox] = []
    for box in sorted(dict.fromkeys(boxes), key=len):
        if not any(other.covers(box) for other in kept):
            kept = [other for other in kept if not box.covers(other)]
            kept.append(box)
    return kept
