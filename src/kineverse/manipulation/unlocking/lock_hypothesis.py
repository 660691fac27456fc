"""Hypotheses about an unknown lock: conjunctions of thresholds that agree with all tries (version space).

A lock is taken to be open where each key is on its side of one threshold, ``q_k > t_k`` or ``q_k < t_k``.
Where the part moved, all these conditions hold, so they hold in the box that encloses these configurations.
Where it did not, at least one condition fails: one of the keys that are outside of that box is the reason.
A part that moves in boxes with a refusal between them has a lock with alternatives, one for each box.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, TypeAlias

Side: TypeAlias = Literal[1, -1]
SIDES: tuple[Side, Side] = (1, -1)
Configuration: TypeAlias = tuple[float, ...]

_HELD = 0.1  # relative probability of a condition that holds at the start: boxes come shut


class KeySide(NamedTuple):
    """Side of a threshold on which a key has to be: 1 above it, -1 below it."""

    key: int
    side: Side


class Enclosure(NamedTuple):
    """Box of configurations."""

    lower: Configuration
    upper: Configuration

    def contains(self, q: Configuration) -> bool:
        """Return whether a configuration is within the box."""
        return all(a <= x <= b for a, x, b in zip(self.lower, q, self.upper, strict=True))

    def extended(self, q: Configuration) -> Enclosure:
        """Return the smallest box that contains this one and a configuration."""
        return Enclosure(tuple(map(min, self.lower, q)), tuple(map(max, self.upper, q)))


@dataclass
class LockHypothesis:
    """Lock of a coordinate in one direction, as far as tries show."""

    number: int  # number of the locked coordinate, which is no key of its own
    limits: Enclosure  # limits of all coordinates
    start: Configuration  # configuration at the start
    moved: list[Configuration] = field(default_factory=list)  # configurations in which the part moved
    refused: list[Configuration] = field(default_factory=list)  # in which it did not
    boxes: list[Enclosure] = field(default_factory=list)

    def observe(self, q: Configuration, moved: bool) -> None:
        """Add a try at a configuration."""
        q, tries = self._without_own(q), self.moved if moved else self.refused
        if q not in tries:
            tries.append(q)
        self.boxes = []
        for one in self.moved:
            for k, box in enumerate(self.boxes):
                larger = box.extended(one)
                if not any(map(larger.contains, self.refused)):
                    self.boxes[k] = larger
                    break
            else:
                self.boxes.append(Enclosure(one, one))

    @property
    def is_tried(self) -> bool:
        """True if the part was tried."""
        return bool(self.moved or self.refused)

    @property
    def is_erratic(self) -> bool:
        """True if the part moved and did not move at one configuration, which no condition explains."""
        return any(box.contains(q) for box in self.boxes for q in self.refused)

    @property
    def is_conjunction(self) -> bool:
        """True while one conjunction explains all tries."""
        return len(self.boxes) <= 1 and not self.is_erratic

    @property
    def alternatives(self) -> Sequence[Enclosure]:
        """Boxes in which the lock is open; before the part has moved, a single one that is empty."""
        lower, upper = map(self._without_own, self.limits)
        return self.boxes or [Enclosure(upper, lower)]

    def suspects(self, q: Configuration, box: Enclosure) -> list[KeySide]:
        """Return the conditions of which one is the reason for a refusal, if the lock is open in a box."""
        result = list[KeySide]()
        for k, (x, low, high) in enumerate(zip(q, box.lower, box.upper, strict=True)):
            if x < low:
                result.append(KeySide(k, 1))
            if x > high:
                result.append(KeySide(k, -1))
        return result

    def sufficient(self) -> list[dict[KeySide, None]]:
        """Return for each alternative the conditions under which the part was seen to move."""
        ends = enumerate(zip(*self.limits, strict=True))
        sides = [KeySide(k, side) for k, _ in ends if k != self.number for side in SIDES]
        return [dict.fromkeys(s for s in sides if self.narrows(s, box)) for box in self.boxes]

    def narrows(self, s: KeySide, box: Enclosure) -> bool:
        """Return whether a box ends before a limit, so that there may be a condition."""
        if s.side > 0:
            return box.lower[s.key] > self.limits.lower[s.key]
        return box.upper[s.key] < self.limits.upper[s.key]

    def necessary(self) -> dict[KeySide, tuple[float, float]]:
        """Return the conditions of every conjunction that agrees with the tries, and where thresholds are."""
        result = dict[KeySide, tuple[float, float]]()
        if not self.is_conjunction:
            return result
        (box,) = self.alternatives
        for q in self.refused:
            suspects = self.suspects(q, box)
            if len(suspects) == 1:
                (only,) = suspects
                low, high = (q[only.key], box.lower[only.key])
                if only.side < 0:
                    low, high = box.upper[only.key], q[only.key]
                before = result.get(only, (-math.inf, math.inf))
                result[only] = max(before[0], low), min(before[1], high)
        return result

    def weight(self, s: KeySide) -> float:
        """Return the relative probability of a condition: less if it already holds at the start."""
        ends = self.limits.upper if s.side > 0 else self.limits.lower
        return _HELD if self.start[s.key] == ends[s.key] else 1.0

    def probability(self, q: Configuration, box: Enclosure | None = None) -> float:
        """Return how likely the part moves at a configuration.

        It is 1 or 0 only where all conjunctions that agree with the tries say so.
        """
        q = self._without_own(q)
        if box is None:
            return max(self.probability(q, box) for box in self.alternatives)
        if box.contains(q):
            return 1.0
        # Laplace's rule of succession: outside of what was seen nothing is certain.
        chance = (len(self.moved) + 1) / (len(self.moved) + 2)
        for one in self.refused:
            suspects = self.suspects(one, box)
            if not suspects:
                return 0.0
            cleared = sum(self.weight(s) * _passed(s, one, q, box) for s in suspects)
            chance *= cleared / sum(map(self.weight, suspects))
        return chance

    def _without_own(self, q: Configuration) -> Configuration:
        """Return a configuration in which the position of the locked coordinate does not count."""
        return (*q[: self.number], 0.0, *q[self.number + 1 :])


def _passed(s: KeySide, refused: Configuration, q: Configuration, box: Enclosure) -> float:
    """Return the probability that a threshold is between a refusal and a configuration."""
    known = box.lower[s.key] if s.side > 0 else box.upper[s.key]
    return min(max((q[s.key] - refused[s.key]) / (known - refused[s.key]), 0.0), 1.0)
