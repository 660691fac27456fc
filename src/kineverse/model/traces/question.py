"""Questions that operations ask of a model, and what of an answer are expressions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.structure import structural_key
from kineverse.model.articulation import Articulation
from kineverse.model.body import Body, Pose
from kineverse.model.constraint import Constraint
from kineverse.model.frame import Frame
from kineverse.model.operation import ARTICULATIONS, BODIES, CONSTRAINTS, DATA, FRAMES
from kineverse.model.reader import Reader
from kineverse.spatial import quaternion, unit


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


FAILED = "there is none"
"""In place of an answer, where asking is an error."""


class Reply(NamedTuple):
    """An answer in two: what an operation may have decided by, and expressions."""

    rest: Any
    parts: tuple[Expression | float, ...]


@dataclass(frozen=True)
class Question:
    """A question to a model.

    Attributes
    ----------
    kind
        One of :data:`KINDS`.
    arguments
        Names, or an expression.
    """

    kind: str
    arguments: tuple[Any, ...]

    @property
    def key(self) -> tuple[object, ...]:
        """What tells it from others, without looking at expressions closely."""
        return self.kind, *(structural_key(a) if isinstance(a, Expression) else a for a in self.arguments)

    def ask(self, model: Reader) -> Reply:
        """Return the model's answer.

        Raises
        ------
        UnknownNameError
            If what is asked for does not exist.
        """
        return KINDS[self.kind].ask(model, *self.arguments)

    def answer(self, rest: Any, parts: Sequence[Expression | float]) -> Any:
        """Return an answer as the reader gives it, of these expressions."""
        return KINDS[self.kind].join(rest, parts)


class Kind(NamedTuple):
    """How a kind of question is asked, and how its answer is put together."""

    ask: Callable[..., Reply]
    join: Callable[[Any, Sequence[Any]], Any]
    arguments: int
    """How many arguments it has."""


def _split(datum: Any, parts: list[Expression | float]) -> Any:
    """Return a datum with parts in place of expressions and finite floats."""
    if isinstance(datum, tuple):
        return tuple(_split(item, parts) for item in datum)
    if isinstance(datum, Expression) or (type(datum) is float and math.isfinite(datum)):
        parts.append(datum)
        return Part(len(parts) - 1)
    return datum


def _joined(rest: Any, parts: Sequence[Any]) -> Any:
    if isinstance(rest, Part):
        return parts[rest.place]
    return tuple(_joined(item, parts) for item in rest) if isinstance(rest, tuple) else rest


def _datum(model: Reader, name: str) -> Reply:
    parts: list[Expression | float] = []
    return Reply(_split(model.data[name], parts), tuple(parts))


def _articulation(model: Reader, name: str) -> Reply:
    a = model.articulations[name]
    parts: list[Expression | float] = []
    names = a.kind, a.parent, a.child, a.coordinates, a.home, a.speeds
    return Reply((names, _split((a.dynamics, a.follows), parts)), tuple(parts))


def _join_articulation(rest: Any, parts: Sequence[Any]) -> Articulation:
    names, others = rest
    return Articulation(*names, *_joined(others, parts))


def _frame(model: Reader, name: str) -> Reply:
    frame = model.frames[name]
    return Reply(frame.parent, (frame.transform[:3],))


def _factors(model: Reader, name: str) -> Reply:
    factors = model.frames[name].factors
    parts = [f[:3] for f in factors if isinstance(f, Expression)]
    return Reply(tuple(f if isinstance(f, Pose) else None for f in factors), tuple(parts))


def _join_factors(rest: Any, parts: Sequence[Any]) -> tuple[Pose | Expression, ...]:
    transforms = map(_homogeneous, parts)
    return tuple(next(transforms) if pose is None else pose for pose in rest)


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


def _one(rest: Any, parts: Sequence[Any]) -> Any:
    return parts[0]


def _rest(rest: Any, parts: Sequence[Any]) -> Any:
    return rest


KINDS: dict[str, Kind] = {
    "exists": Kind(lambda model, kind, name: Reply(name in model.by_kind(kind), ()), _rest, 2),
    "names": Kind(_names, _rest, 1),
    "frame": Kind(_frame, lambda rest, parts: Frame(rest, (_homogeneous(parts[0]),)), 1),
    "factors": Kind(_factors, _join_factors, 1),
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
    "jacobian": Kind(lambda model, e, symbols: Reply(None, (e.jacobian(list(symbols)),)), _one, 2),
    "facts": Kind(lambda model, e, symbols: Reply(None, (e.jacobian(list(symbols), False),)), _one, 2),
    "partial": Kind(lambda model, e, symbols: Reply(None, (e.partial(list(symbols)),)), _one, 2),
    "substitute": Kind(
        lambda model, e, symbols, values: Reply(
            None, (e.substitute(dict(zip(symbols, values, strict=True))),)
        ),
        _one,
        3,
    ),
    "unit": Kind(lambda model, vector: Reply(None, (unit(vector),)), _one, 1),
    "quaternion": Kind(
        lambda model, q: Reply(None, (quaternion(q[0], q[1], q[2], q[3])[:3],)),
        lambda rest, parts: _homogeneous(parts[0]),
        1,
    ),
}

OF_EXPRESSIONS = ("resolve", "carry", "jacobian", "facts", "partial", "substitute", "unit", "quaternion")
"""Questions whose arguments are expressions; the last six look at these, and not into the model."""

OF_KIND = {
    FRAMES: "frame",
    BODIES: "body",
    ARTICULATIONS: "articulation",
    CONSTRAINTS: "constraint",
    DATA: "datum",
}
"""Which question asks for one of a kind of data by its name."""
