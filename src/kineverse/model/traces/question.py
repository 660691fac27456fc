"""Questions that operations ask of a model, and what of an answer are expressions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from kineverse.expressions.expression import Expression, as_expression
from kineverse.model.articulation import Articulation
from kineverse.model.body import Body
from kineverse.model.constraint import Constraint
from kineverse.model.frame import Frame
from kineverse.model.operation import ARTICULATIONS, BODIES, CONSTRAINTS, DATA, FRAMES
from kineverse.model.reader import Reader


class Look(IntEnum):
    """How closely an operation looked at the expressions of an answer."""

    NOT = 0
    """It computed with them, whatever they are."""
    SYMBOLS = 1
    """It saw which symbols they and their gradients have."""
    VALUE = 2
    """It saw the expressions themselves."""


class Part(NamedTuple):
    """Where, in the rest of an answer, one of its expressions belongs."""

    place: int


class Reply(NamedTuple):
    """An answer in two: what an operation may have decided by, and expressions."""

    rest: Any
    parts: tuple[Expression, ...]


@dataclass(frozen=True)
class Question:
    """A question to a model.

    Attributes
    ----------
    kind
        One of :data:`KINDS`.
    arguments
        Names; for ``resolve`` and ``carry`` an expression.
    """

    kind: str
    arguments: tuple[Any, ...]

    def ask(self, model: Reader) -> Reply:
        """Return the model's answer.

        Raises
        ------
        UnknownNameError
            If what is asked for does not exist.
        """
        return KINDS[self.kind].ask(model, *self.arguments)

    def answer(self, rest: Any, parts: Sequence[Expression]) -> Any:
        """Return an answer as the reader gives it, of these expressions."""
        return KINDS[self.kind].join(rest, parts)


class Kind(NamedTuple):
    """How a kind of question is asked, and how its answer is put together."""

    ask: Callable[..., Reply]
    join: Callable[[Any, Sequence[Expression]], Any]
    arguments: int
    """How many arguments it has."""


def _split(datum: Any, parts: list[Expression]) -> Any:
    """Return a datum with parts in place of expressions and finite floats."""
    if isinstance(datum, tuple):
        return tuple(_split(item, parts) for item in datum)
    if isinstance(datum, Expression) or (type(datum) is float and math.isfinite(datum)):
        parts.append(as_expression(datum))
        return Part(len(parts) - 1)
    return datum


def _joined(rest: Any, parts: Sequence[Expression]) -> Any:
    if isinstance(rest, Part):
        return parts[rest.place]
    return tuple(_joined(item, parts) for item in rest) if isinstance(rest, tuple) else rest


def _datum(model: Reader, name: str) -> Reply:
    parts: list[Expression] = []
    return Reply(_split(model.data[name], parts), tuple(parts))


def _articulation(model: Reader, name: str) -> Reply:
    a = model.articulations[name]
    parts: list[Expression] = []
    names = a.kind, a.parent, a.child, a.coordinates, a.speeds
    return Reply((names, _split((a.home, a.dynamics, a.follows), parts)), tuple(parts))


def _join_articulation(rest: Any, parts: Sequence[Expression]) -> Articulation:
    (kind, parent, child, coordinates, speeds), others = rest
    home, dynamics, follows = _joined(others, parts)
    return Articulation(kind, parent, child, coordinates, home, speeds, dynamics, follows)


def _frame(model: Reader, name: str) -> Reply:
    frame = model.frames[name]
    return Reply(frame.parent, (frame.transform[:3],))


def _constraint(model: Reader, name: str) -> Reply:
    c = model.constraints[name]
    return Reply(None, (c.lower, c.expression, c.upper))


def _body(model: Reader, name: str) -> Reply:
    body: Body = model.bodies[name]
    return Reply(body, ())


def _names(model: Reader, kind: str) -> Reply:
    return Reply(tuple(model.by_kind(kind)), ())


def _homogeneous(upper: Expression) -> Expression:
    # The last row of a transform is no answer of the model, and zeros are worth keeping apart.
    return as_expression(np.concatenate([upper, as_expression([[0.0, 0.0, 0.0, 1.0]])]))


def _one(rest: Any, parts: Sequence[Expression]) -> Any:
    return parts[0]


def _rest(rest: Any, parts: Sequence[Expression]) -> Any:
    return rest


KINDS: dict[str, Kind] = {
    "exists": Kind(lambda model, kind, name: Reply(name in model.by_kind(kind), ()), _rest, 2),
    "names": Kind(_names, _rest, 1),
    "frame": Kind(_frame, lambda rest, parts: Frame(rest, (_homogeneous(parts[0]),)), 1),
    "body": Kind(_body, _rest, 1),
    "articulation": Kind(_articulation, _join_articulation, 1),
    "constraint": Kind(_constraint, lambda rest, parts: Constraint(*parts), 1),
    "datum": Kind(_datum, _joined, 1),
    "fk": Kind(
        lambda model, frame, to: Reply(None, (model.fk(frame, to)[:3],)),
        lambda rest, parts: _homogeneous(parts[0]),
        2,
    ),
    "between": Kind(lambda model, frame, to: Reply(model.coordinates_between(frame, to), ()), _rest, 2),
    "resolve": Kind(lambda model, expression: Reply(None, (model.resolve(expression),)), _one, 1),
    "carry": Kind(lambda model, expression: Reply(None, (model.carry(expression),)), _one, 1),
}

OF_KIND = {
    FRAMES: "frame",
    BODIES: "body",
    ARTICULATIONS: "articulation",
    CONSTRAINTS: "constraint",
    DATA: "datum",
}
"""Which question asks for one of a kind of data by its name."""
