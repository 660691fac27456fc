"""The expressions inside of what operations write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from kineverse.expressions.expression import Expression

from .constraint import Constraint
from .frame import Frame
from .operation import ARTICULATIONS, CONSTRAINTS, DATA, FRAMES, RATES

Map = Callable[[Expression], Any]


def mapped(kind: str, value: Any, f: Map) -> Any:
    """Return a written value with ``f(e)`` in place of each expression; symbols of records stay.

    Parameters
    ----------
    kind
        The kind of data that it is, one of :data:`kineverse.model.operation.KINDS`.
    value
        The value in canonical form, see :meth:`kineverse.Effects.writes`.
    f
        Returns a transform for those of frames, a scalar for those of constraints and rates; among data and
        in records numbers may take the place of expressions.
    """
    if kind == FRAMES:
        return Frame(value.parent, tuple(f(x) if isinstance(x, Expression) else x for x in value.factors))
    if kind == CONSTRAINTS:
        return Constraint(f(value.lower), f(value.expression), f(value.upper))
    if kind == RATES:
        coordinate, entry = value
        if isinstance(entry, Expression):
            return coordinate, f(entry)
        return coordinate, tuple((speed, f(factor)) for speed, factor in entry)
    if kind == ARTICULATIONS:
        return replace(value, dynamics=_below(value.dynamics, f), follows=_below(value.follows, f))
    return _below(value, f) if kind == DATA else value


def expressions_in(kind: str, value: Any) -> list[Expression]:
    """Return the expressions of a written value, symbols of records left out."""
    found: list[Expression] = []

    def note(expression: Expression) -> Expression:
        found.append(expression)
        return expression

    mapped(kind, value, note)
    return found


def _below(datum: Any, f: Map) -> Any:
    if isinstance(datum, Expression):
        return f(datum)
    return tuple(_below(item, f) for item in datum) if isinstance(datum, tuple) else datum
