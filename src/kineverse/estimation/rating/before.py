"""What a served joint moved by: a coordinate of its own, one that a loop determines, or what it follows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.estimation.identification.rigid import Array
from kineverse.expressions.expression import Expression
from kineverse.model.articulation import Articulation
from kineverse.model.model import Model
from kineverse.model.operation import ARTICULATIONS, CONSTRAINTS
from kineverse.model.rates import plain
from kineverse.symbols import Symbol

from .links import Link
from .served import Served


@dataclass(frozen=True)
class Before:
    """How far a joint had moved.

    Attributes
    ----------
    coordinate
        That of the served articulation.
    value
        How far the joint has moved, as an expression of it.
    follows
        What it follows, if it has no coordinate of its own.
    led
        Whether its value is more than the coordinate: one that follows, in whichever way.
    lower, upper
        Its limits.
    """

    coordinate: Symbol
    value: Expression
    follows: Expression | None
    led: bool
    lower: float
    upper: float

    def at(self, coordinates: Array) -> Array:
        """Return how far it had moved at values of the coordinate, (N,)."""
        if not self.led:
            return coordinates
        moved: Array = np.asarray(compile(self.value, [self.coordinate]).batch(coordinates[:, None]))
        return moved


def moved_before(
    model: Model, link: Link, served: Served, records: Mapping[str, Articulation]
) -> Before | None:
    """Return how far a joint had moved; None if that is not one number."""
    if served.joints != 1 or len(served.coordinates) != 1:
        return None
    (coordinate,) = served.coordinates
    position = next((record.position for record in records.values()), None)
    if position is None or position == coordinate:
        return Before(coordinate, coordinate, None, False, float(served.lower[0]), float(served.upper[0]))
    value = model.rates.resolve(plain(position))
    lower, upper = -math.inf, math.inf
    for (kind, _), limit in model.history.entry(link.tag).writes.items():
        if kind == CONSTRAINTS and limit.expression == position:
            if not (limit.lower.symbols or limit.upper.symbols):
                lower, upper = max(lower, float(limit.lower)), min(upper, float(limit.upper))
    follows = None if isinstance(position, Symbol) else position
    return Before(coordinate, value, follows, True, lower, upper)


def follows_another(model: Model, link: Link) -> bool:
    """Whether an operation says itself what its joint follows, as a mimic joint."""
    writes = model.history.entry(link.tag).writes
    return any(
        kind == ARTICULATIONS and value.child == link.frame and value.follows is not None
        for (kind, _), value in writes.items()
    )
