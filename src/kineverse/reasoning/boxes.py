"""Intervals and boxes of conditions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction

from kineverse.expressions.expression import Expression
from kineverse.expressions.functions import floor
from kineverse.symbols import Symbol

Number = float | Fraction


@dataclass(frozen=True)
class Interval:
    """The numbers between two ends, each of which belongs to it or not; infinite ends do not.

    ``x in interval`` says whether a number is among them.
    """

    lower: Number = -math.inf
    upper: Number = math.inf
    lower_closed: bool = False
    upper_closed: bool = False

    @property
    def is_empty(self) -> bool:
        """Whether no number is in it."""
        if self.lower == self.upper:
            return not (self.lower_closed and self.upper_closed)
        return self.lower > self.upper

    @property
    def is_everything(self) -> bool:
        """Whether every number is in it."""
        return self.lower == -math.inf and self.upper == math.inf

    def __contains__(self, number: Number) -> bool:
        above = number > self.lower or (self.lower_closed and number == self.lower)
        return above and (number < self.upper or (self.upper_closed and number == self.upper))

    def intersection(self, other: Interval) -> Interval:
        """Return what is in both."""
        low, low_open = max((self.lower, not self.lower_closed), (other.lower, not other.lower_closed))
        high, high_closed = min((self.upper, self.upper_closed), (other.upper, other.upper_closed))
        return Interval(low, high, not low_open, high_closed)

    def covers(self, other: Interval) -> bool:
        """Whether all of the other, which is not empty, is in this one."""
        starts = (self.lower, not self.lower_closed) <= (other.lower, not other.lower_closed)
        return starts and (self.upper, self.upper_closed) >= (other.upper, other.upper_closed)

    def joined(self, other: Interval) -> Interval | None:
        """Return the union if it is an interval; neither is empty."""
        first, second = sorted((self, other), key=lambda i: (i.lower, not i.lower_closed))
        touch = second.lower == first.upper and (second.lower_closed or first.upper_closed)
        if second.lower >= first.upper and not touch:
            return None
        high, closed = max((self.upper, self.upper_closed), (other.upper, other.upper_closed))
        return Interval(first.lower, high, first.lower_closed, closed)

    def outside(self) -> Iterator[Interval]:
        """Yield what is below and what is above it."""
        if self.lower > -math.inf:
            yield Interval(upper=self.lower, upper_closed=not self.lower_closed)
        if self.upper < math.inf:
            yield Interval(lower=self.upper, lower_closed=not self.upper_closed)

    def rounded(self) -> Interval:
        """Return it with ends that are floats."""
        return Interval(float(self.lower), float(self.upper), self.lower_closed, self.upper_closed)

    def of(self, name: str) -> str:
        """Return the condition on something of that name, as ``0 < b <= 0.3``."""
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
    """A conjunction of conditions: intervals of coordinates, or of sums of several of them; the rest is free.

    The empty box, without conditions, is everywhere.
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
        return " and ".join(side.of(axis_name(axis)) for axis, side in self._sides.items()) or "always"

    def __repr__(self) -> str:
        return f"<Box: {self}>"

    def intersection(self, other: IntervalBox) -> IntervalBox | None:
        """Return what is in both, None if nothing is."""
        sides = dict(self._sides)
        for axis, side in other.items():
            sides[axis] = sides[axis].intersection(side) if axis in sides else side
            if sides[axis].is_empty:
                return None
        return IntervalBox(sides)

    def covers(self, other: IntervalBox) -> bool:
        """Whether all of the other is in this one."""
        return all(axis in other and side.covers(other[axis]) for axis, side in self._sides.items())

    def without(self, other: IntervalBox) -> list[IntervalBox]:
        """Return what is in this one and not in the other, as boxes that do not overlap."""
        if self.intersection(other) is None:
            return [self]
        rest, parts = dict(self._sides), []
        for axis, side in other.items():
            own = rest.get(axis, EVERYTHING)
            for beyond in side.outside():
                part = own.intersection(beyond)
                if not part.is_empty:
                    parts.append(IntervalBox({**rest, axis: part}))
            rest[axis] = own.intersection(side)
        return parts

    def rounded(self) -> IntervalBox:
        """Return it with ends that are floats."""
        return IntervalBox({axis: side.rounded() for axis, side in self._sides.items()})


def axis_name(axis: Expression) -> str:
    """Return what an axis is called: a symbol's name, a sum, or ``angle mod 2π``."""
    if not isinstance(axis, Symbol) and len(axis.symbols) == 1 and axis == wrap_to_turn(axis.symbols[0]):
        return f"{axis.symbols[0]} mod 2π"
    return str(axis)


def wrap_to_turn(angle: Symbol) -> Expression:
    """Return an angle less whole turns, in [0, 2π)."""
    return angle - math.tau * floor(angle / math.tau)
