"""Records of interlocks and of undecided constraints, and the opening order that they imply."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, overload

from kineverse.errors import ModelError
from kineverse.expressions.expression import Expression
from kineverse.symbols import Symbol

from .boxes import IntervalBox, axis_name

Hold = Literal["stands still", "cannot increase", "cannot decrease", "stays within", "has no value"]
"""Effect of an interlock on what it holds; see :class:`Interlock`."""


@dataclass(frozen=True)
class Interlock:
    """Restriction of a coordinate or a speed by constraints, and the condition under which it is active.

    Attributes
    ----------
    held
        The restricted quantity: a position, a speed (or a higher derivative), or an expression if the
        constraints limit a combination of several.
    hold
        ``stands still``: a speed is 0, or a position has one value left. ``cannot increase``,
        ``cannot decrease``: a speed is at most, or at least, 0. ``stays within``: a position lies between
        ``lower`` and ``upper``. ``has no value``: the bounds contradict each other.
    constraints
        Names of the constraints that together restrict it.
    when
        Boxes, in each of which the restriction is active.
    lower, upper
        Range of a position, or its one value twice. Both may depend on other coordinates.

    See Also
    --------
    kineverse.reasoning.interlocks
    """

    held: Expression
    hold: Hold
    constraints: tuple[str, ...]
    when: tuple[IntervalBox, ...]
    lower: Expression | None = None
    upper: Expression | None = None

    @property
    def is_permanent(self) -> bool:
        """True if the restriction is active everywhere."""
        return IntervalBox({}) in self.when

    @property
    def keys(self) -> tuple[Symbol, ...]:
        """Coordinates, speeds and parameters in the conditions, sorted."""
        result = {s for box in self.when for axis in box for s in axis.symbols}
        return tuple(sorted(result, key=lambda s: s.sort_key))

    def __str__(self) -> str:
        how = f"{axis_name(self.held)} {self.hold}"
        if self.hold == "stays within":
            how += f" [{_bound(self.lower)}, {_bound(self.upper)}]"
        elif self.lower is not None and self.hold == "stands still":
            how += f" at {_bound(self.lower)}"
        return f"{how}: {_either(self.when)} ({', '.join(self.constraints)})"


@dataclass(frozen=True)
class Undecided:
    """Constraint whose effect is unknown, with the reason and the region where it is unknown.

    See Also
    --------
    kineverse.reasoning.interlocks
    """

    constraint: str
    reason: str
    where: tuple[IntervalBox, ...] = (IntervalBox({}),)

    def __str__(self) -> str:
        return f"{self.constraint}: unknown, as {self.reason}: {_either(self.where)}"


class Interlocks(Sequence[Interlock]):
    """Interlocks of a model, in the order of its constraints, and its ``undecided`` constraints.

    See Also
    --------
    kineverse.reasoning.interlocks
    """

    def __init__(self, found: Sequence[Interlock], undecided: Sequence[Undecided] = ()) -> None:
        self._found = tuple(found)
        self.undecided = tuple(undecided)

    @overload
    def __getitem__(self, index: int) -> Interlock: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Interlock]: ...
    def __getitem__(self, index: int | slice) -> Interlock | Sequence[Interlock]:
        return self._found[index]

    def __len__(self) -> int:
        return len(self._found)

    def __iter__(self) -> Iterator[Interlock]:
        return iter(self._found)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Interlocks):
            return NotImplemented
        return self._found == other._found and self.undecided == other.undecided

    def __hash__(self) -> int:
        return hash((self._found, self.undecided))

    def locks_on(self, coordinate: Symbol | str) -> tuple[Interlock, ...]:
        """Return the interlocks on a coordinate or its derivatives, given by symbol or path."""
        path = coordinate.path if isinstance(coordinate, Symbol) else coordinate
        return tuple(result for result in self if any(s.path == path for s in result.held.symbols))

    def keys(self, coordinate: Symbol | str) -> tuple[Symbol, ...]:
        """Return the other coordinates that the interlocks on one depend on, as positions, sorted."""
        path = coordinate.path if isinstance(coordinate, Symbol) else coordinate
        result = {_position(key) for lock in self.locks_on(coordinate) for key in lock.keys}
        result |= {
            _position(s)
            for lock in self.locks_on(coordinate)
            for bound in (lock.lower, lock.upper)
            if bound is not None
            for s in bound.symbols
        }
        return tuple(sorted((s for s in result if s.path != path), key=lambda s: s.sort_key))

    def as_data(self) -> dict[str, Any]:
        """Return the interlocks as data for JSON: lists, mappings, texts and numbers."""
        return {
            "interlocks": [
                {
                    "held": axis_name(lock.held),
                    "hold": lock.hold,
                    "constraints": list(lock.constraints),
                    "when": [_box(box) for box in lock.when],
                    "lower": _number_or_text(lock.lower),
                    "upper": _number_or_text(lock.upper),
                }
                for lock in self
            ],
            "undecided": [
                {"constraint": u.constraint, "reason": u.reason, "where": [_box(b) for b in u.where]}
                for u in self.undecided
            ],
        }

    def __str__(self) -> str:
        return "\n".join(map(str, (*self, *self.undecided))) or "no interlocks"

    def __repr__(self) -> str:
        return f"<Interlocks: {len(self)} found, {len(self.undecided)} undecided>"


def _position(symbol: Symbol) -> Symbol:
    return symbol.position if symbol.order else symbol


def _either(boxes: tuple[IntervalBox, ...]) -> str:
    if len(boxes) == 1:
        return f"when {boxes[0]}" if boxes[0] else "always"
    return "when " + " or ".join(f"({box})" if len(box) > 1 else str(box) for box in boxes)


def _bound(bound: Expression | None) -> str:
    if bound is None or bound.symbols:
        return str(bound)
    return f"{float(bound):.12g}"


def _box(box: IntervalBox) -> dict[str, dict[str, Any]]:
    return {
        axis_name(axis): {
            "lower": None if math.isinf(side.lower) else float(side.lower),
            "upper": None if math.isinf(side.upper) else float(side.upper),
            "lower_closed": side.lower_closed,
            "upper_closed": side.upper_closed,
        }
        for axis, side in box.items()
    }


def _number_or_text(bound: Expression | None) -> float | str | None:
    if bound is None:
        return None
    if bound.symbols:
        return str(bound)
    return None if math.isinf(float(bound)) else float(bound)


def opening_order(found: Interlocks, goal: Symbol | str) -> tuple[Symbol, ...]:
    """Return the coordinates that interlocks on a goal depend on, directly or not: keys first, the goal last.

    The order does not say in which direction a key has to move, nor whether it has to move at all: that
    depends on the state.

    Raises
    ------
    ModelError
        If coordinates lock each other in a cycle, which the message lists.

    Examples
    --------
    >>> model = kv.load("articulations/garage_door")
    >>> found = kv.reasoning.interlocks(model)
    >>> kv.reasoning.opening_order(found, "garage_door/garage/door")
    (garage_door/garage/bolt, garage_door/garage/door)
    """
    start = goal if isinstance(goal, Symbol) else Symbol(goal)
    done: dict[str, Symbol] = {}
    path: dict[str, Symbol] = {start.path: start}
    while path:
        here = next(reversed(path.values()))
        waiting = next((key for key in found.keys(here) if key.path not in done), None)
        if waiting is None:
            done[here.path] = path.pop(here.path)
        elif waiting.path in path:
            names = list(path)
            circle = [*names[names.index(waiting.path) :], waiting.path]
            raise ModelError(f"There is no order, as coordinates lock each other: {' -> '.join(circle)}.")
        else:
            path[waiting.path] = waiting
    return tuple(done.values())
