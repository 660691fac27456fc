"""Sets of configurations, as unions of boxes: what is common, what is left, and how to say it shortly."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from .boxes import EVERYTHING, Box, Interval, axis_name

_JOINED_AT_MOST = 60
_PRIMES_AT_MOST = 200


@dataclass
class Region:
    """A union of boxes, with those of it that are worth telling.

    At equality a comparison is half true. What holds only there is not worth telling; but what holds on both
    sides and there as well is one box, and not two.
    """

    boxes: list[Box] = field(default_factory=list)
    telling: list[Box] = field(default_factory=list)

    def add(self, box: Box, telling: bool) -> None:
        """Add a box."""
        self.boxes.append(box)
        if telling:
            self.telling.append(box)

    def __and__(self, other: Region) -> Region:
        return Region(common(self.boxes, other.boxes), common(self.telling, other.telling))

    def __or__(self, other: Region) -> Region:
        return Region(self.boxes + other.boxes, self.telling + other.telling)

    def __sub__(self, other: Region) -> Region:
        left = ((box, part) for box in self.telling for part in difference([box], other.boxes))
        telling = [part for box, part in left if not _is_sliver(part, box)]
        return Region(difference(self.boxes, other.boxes), telling)

    def short(self) -> tuple[Box, ...]:
        """Return few large boxes that are the region, none if nothing of it is worth telling."""
        return merged(self.boxes, self.telling)


def _is_sliver(part: Box, box: Box) -> bool:
    """Whether a part has a single value where the box has an interval: at the edge of what was taken away."""
    flat = (axis for axis, side in part.items() if side.lower == side.upper)
    return any(box.get(axis, EVERYTHING).lower != box.get(axis, EVERYTHING).upper for axis in flat)


def difference(boxes: Iterable[Box], others: Iterable[Box]) -> list[Box]:
    """Return what is in some of the boxes and in none of the others."""
    rest = list(boxes)
    for other in others:
        rest = [part for box in rest for part in box.without(other)]
    return rest


def common(boxes: Iterable[Box], others: Iterable[Box]) -> list[Box]:
    """Return what is in some of the boxes and in some of the others."""
    second = list(others)
    pairs = (box.intersection(other) for box in boxes for other in second)
    return _maximal([box for box in pairs if box is not None])


def merged(boxes: Iterable[Box], wanted: Iterable[Box] | None = None) -> tuple[Box, ...]:
    """Return the same set by few large boxes, in an order that only depends on the set.

    They are the largest boxes within the set, as prime implicants are in the minimisation of truth tables,
    without those that others cover together. Where that would be very many, some remain smaller. If only part
    of the set is wanted, boxes that have nothing of it, or only what others have as well, are left out.
    """
    found = _glued(list(boxes))
    matter = found if wanted is None else _glued(list(wanted))
    if len(found) <= _JOINED_AT_MOST:
        found = _primes(found)
    found.sort(key=lambda b: (-len(b), str(b)))
    for box in list(found):
        others = [other for other in found if other is not box]
        if not difference(common([box], matter), others):
            found = others
    return tuple(sorted((box.rounded() for box in found), key=lambda b: (len(b), str(b))))


def _glued(boxes: list[Box]) -> list[Box]:
    """Join boxes that differ in one axis only, until there are none."""
    while True:
        before = len(boxes)
        for axis in sorted({axis for box in boxes for axis in box}, key=axis_name):
            rows: dict[Box, list[Interval]] = {}
            for box in boxes:
                rest = Box({a: side for a, side in box.items() if a != axis})
                rows.setdefault(rest, []).append(box.get(axis, EVERYTHING))
            boxes = [Box({**rest, axis: side}) for rest, sides in rows.items() for side in _united(sides)]
        if len(boxes) == before:
            return _maximal(boxes)


def _united(sides: list[Interval]) -> list[Interval]:
    united: list[Interval] = []
    for side in sorted(sides, key=lambda i: (i.lower, not i.lower_closed)):
        joined = united[-1].joined(side) if united else None
        if joined is None:
            united.append(side)
        else:
            united[-1] = joined
    return united


def _primes(boxes: list[Box]) -> list[Box]:
    """Return all of the largest boxes within the set, by joining pairs along an axis until nothing is new."""
    primes = boxes
    while True:
        new: list[Box] = []
        for a, b in itertools.combinations(primes, 2):
            for joined in _joins(a, b):
                if not any(known.covers(joined) for known in itertools.chain(primes, new)):
                    new.append(joined)
        if not new:
            return primes
        larger = _maximal(primes + new)
        if len(larger) > _PRIMES_AT_MOST:
            return boxes
        primes = larger


def _joins(a: Box, b: Box) -> Iterator[Box]:
    axes = {**dict.fromkeys(a), **dict.fromkeys(b)}
    both = {axis: a.get(axis, EVERYTHING).intersection(b.get(axis, EVERYTHING)) for axis in axes}
    empty = [axis for axis, side in both.items() if side.is_empty]
    if len(empty) > 1:
        return
    for axis in empty or axes:
        joined = a.get(axis, EVERYTHING).joined(b.get(axis, EVERYTHING))
        if joined is not None:
            yield Box({**both, axis: joined})


def _maximal(boxes: list[Box]) -> list[Box]:
    """Return the boxes without those that lie in another one."""
    kept: list[Box] = []
    for box in sorted(dict.fromkeys(boxes), key=len):
        if not any(other.covers(box) for other in kept):
            kept = [other for other in kept if not box.covers(other)]
            kept.append(box)
    return kept
