"""Queries of an operation to the model, their results, and the reader that records them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from kineverse.errors import UnknownNameError
from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.graph import structural_hash
from kineverse.model.articulation import Articulation
from kineverse.model.body import Pose
from kineverse.model.constraint import Constraint
from kineverse.model.frame import WORLD, Frame
from kineverse.model.operation import ARTICULATIONS, BODIES, CONSTRAINTS, DATA, FRAMES
from kineverse.model.read_recorder import ReadRecorder, Reads
from kineverse.spatial import quaternion, unit_vector
from kineverse.symbols import Symbol


class Access(IntEnum):
    """Access of an operation to the expressions of a query result.

    See Also
    --------
    kineverse.formats.document.OpaqueOperation
    """

    NOT = 0
    """It computed with the expressions only."""
    SYMBOLS = 1
    """It read the symbols of the expressions and their gradients."""
    VALUE = 2
    """It read the expressions themselves."""


class ResultPart(NamedTuple):
    """Position of an expression in the rest of a query result."""

    place: int


FAILED = "there is none"  # result of a query that raises an error


class QueryResult(NamedTuple):
    """Result of a query in two parts: data that the operation may depend on, and expressions."""

    rest: Any
    parts: tuple[Expression | float, ...]


@dataclass(frozen=True)
class Query:
    """Query to a model.

    Attributes
    ----------
    kind
        One of :data:`QUERY_KINDS`.
    arguments
        Names or expressions.

    See Also
    --------
    kineverse.formats.document.OpaqueOperation
    """

    kind: str
    arguments: tuple[Any, ...]

    @property
    def key(self) -> tuple[object, ...]:
        """Identity of the query, without access to the values of expressions."""
        return self.kind, *(structural_hash(a) if isinstance(a, Expression) else a for a in self.arguments)

    def ask(self, model: ReadRecorder) -> QueryResult:
        """Return the result of the query on a model."""
        return QUERY_KINDS[self.kind].ask(model, *self.arguments)

    def answer(self, rest: Any, parts: Sequence[Expression | float]) -> Any:
        """Assemble the result for the caller from these expressions."""
        return QUERY_KINDS[self.kind].join(rest, parts)


class QueryKind(NamedTuple):
    """Type of query: function that runs it, and function that assembles its result."""

    ask: Callable[..., QueryResult]
    join: Callable[[Any, Sequence[Any]], Any]
    arguments: int
    """Number of arguments."""


def _split(datum: Any, parts: list[Expression | float]) -> Any:
    """Return a datum with parts in place of expressions and finite floats."""
    if isinstance(datum, tuple):
        return tuple(_split(item, parts) for item in datum)
    if isinstance(datum, Expression) or (type(datum) is float and math.isfinite(datum)):
        parts.append(datum)
        return ResultPart(len(parts) - 1)
    return datum


def _join(rest: Any, parts: Sequence[Any]) -> Any:
    if isinstance(rest, ResultPart):
        return parts[rest.place]
    return tuple(_join(item, parts) for item in rest) if isinstance(rest, tuple) else rest


def _datum(model: ReadRecorder, name: str) -> QueryResult:
    parts: list[Expression | float] = []
    return QueryResult(_split(model.data[name], parts), tuple(parts))


def _articulation(model: ReadRecorder, name: str) -> QueryResult:
    a = model.articulations[name]
    parts: list[Expression | float] = []
    names = a.kind, a.parent, a.child, a.coordinates, a.home, a.speeds
    return QueryResult((names, _split((a.dynamics, a.follows), parts)), tuple(parts))


def _frame(model: ReadRecorder, name: str) -> QueryResult:
    frame = model.frames[name]
    return QueryResult(frame.parent, (frame.transform[:3],))


def _factors(model: ReadRecorder, name: str) -> QueryResult:
    factors = model.frames[name].factors
    parts = [f[:3] for f in factors if isinstance(f, Expression)]
    return QueryResult(tuple(f if isinstance(f, Pose) else None for f in factors), tuple(parts))


def _join_factors(rest: Any, parts: Sequence[Any]) -> tuple[Pose | Expression, ...]:
    transforms = map(_homogeneous, parts)
    return tuple(next(transforms) if pose is None else pose for pose in rest)


def _constraint(model: ReadRecorder, name: str) -> QueryResult:
    c = model.constraints[name]
    return QueryResult(None, (c.lower, c.expression, c.upper))


def _homogeneous(upper: Expression) -> Expression:
    # The last row of a transform is constant, and its zeros should stay structural.
    return as_expression(np.concatenate([upper, as_expression([[0.0, 0.0, 0.0, 1.0]])]))


def _one(rest: Any, parts: Sequence[Any]) -> Any:
    return parts[0]


def _rest(rest: Any, parts: Sequence[Any]) -> Any:
    return rest


QUERY_KINDS: dict[str, QueryKind] = {
    "exists": QueryKind(lambda model, kind, name: QueryResult(name in model.by_kind(kind), ()), _rest, 2),
    "names": QueryKind(lambda model, kind: QueryResult(tuple(model.by_kind(kind)), ()), _rest, 1),
    "frame": QueryKind(_frame, lambda rest, parts: Frame(rest, (_homogeneous(parts[0]),)), 1),
    "factors": QueryKind(_factors, _join_factors, 1),
    "body": QueryKind(lambda model, name: QueryResult(model.bodies[name], ()), _rest, 1),
    "articulation": QueryKind(
        _articulation, lambda rest, parts: Articulation(*rest[0], *_join(rest[1], parts)), 1
    ),
    "constraint": QueryKind(_constraint, lambda rest, parts: Constraint(*parts), 1),
    "datum": QueryKind(_datum, _join, 1),
    "fk": QueryKind(
        lambda model, frame, to: QueryResult(None, (model.fk(frame, to)[:3],)),
        lambda rest, parts: _homogeneous(parts[0]),
        2,
    ),
    "between": QueryKind(
        lambda model, frame, to: QueryResult(model.coordinates_between(frame, to), ()), _rest, 2
    ),
    "resolve": QueryKind(lambda model, expression: QueryResult(None, (model.resolve(expression),)), _one, 1),
    "carry": QueryKind(lambda model, expression: QueryResult(None, (model.carry(expression),)), _one, 1),
    "jacobian": QueryKind(lambda model, e, symbols: QueryResult(None, (e.jacobian(list(symbols)),)), _one, 2),
    "facts": QueryKind(
        lambda model, e, symbols: QueryResult(None, (e.jacobian(list(symbols), False),)), _one, 2
    ),
    "partial": QueryKind(lambda model, e, symbols: QueryResult(None, (e.partial(list(symbols)),)), _one, 2),
    "substitute": QueryKind(
        lambda model, e, symbols, values: QueryResult(
            None, (e.substitute(dict(zip(symbols, values, strict=True))),)
        ),
        _one,
        3,
    ),
    "unit": QueryKind(lambda model, vector: QueryResult(None, (unit_vector(vector),)), _one, 1),
    "quaternion": QueryKind(
        lambda model, q: QueryResult(None, (quaternion(q[0], q[1], q[2], q[3])[:3],)),
        lambda rest, parts: _homogeneous(parts[0]),
        1,
    ),
}

EXPRESSION_QUERIES = ("resolve", "carry", "jacobian", "facts", "partial", "substitute", "unit", "quaternion")
"""Queries with expressions as arguments. The last six do not depend on the model."""

DATA_QUERIES = {
    FRAMES: "frame",
    BODIES: "body",
    ARTICULATIONS: "articulation",
    CONSTRAINTS: "constraint",
    DATA: "datum",
}
"""Query for one value by name, by kind of data."""


class TracingReader(ReadRecorder, ABC):
    """Model before an operation that turns every read into a query."""

    def __init__(self, model: ReadRecorder) -> None:
        super().__init__(model._value_at, model._names_at, Reads(model.seen))
        self.model = model
        self.done = False

    @abstractmethod
    def ask(self, kind: str, *arguments: Any) -> Any:
        """Return the result of a query, see :data:`.trace_queries.QUERY_KINDS`."""

    def by_kind(self, kind: str) -> Mapping[str, Any]:
        """Return one kind of data by name."""
        return _QueriedData(self, kind)

    def fk(self, frame: str, relative_to: str = WORLD) -> Expression:
        """Query the pose of a frame in another."""
        result: Expression = self.ask("fk", frame, relative_to)
        return result

    def coordinates_between(self, frame: str, relative_to: str = WORLD) -> tuple[Symbol, ...]:
        """Query the coordinates that move a frame relative to another."""
        result: tuple[Symbol, ...] = self.ask("between", frame, relative_to)
        return result

    def resolve(self, expression: Expression) -> Expression:
        """Query an expression in independent coordinates."""
        result: Expression = self.ask("resolve", expression)
        return result

    def carry(self, expression: Expression) -> Expression:
        """Query an expression with coordinates carried by their rates."""
        result: Expression = self.ask("carry", expression)
        return result


class _QueriedData(Mapping[str, Any]):
    """Mapping of one kind of data by name, with a query for each read."""

    def __init__(self, reader: TracingReader, kind: str) -> None:
        self._reader = reader
        self._kind = kind

    def __getitem__(self, name: str) -> Any:
        answer = self._reader.ask(DATA_QUERIES[self._kind], name)
        return _with_factors(answer, self._reader, name) if self._kind == FRAMES else answer

    def get(self, name: str, default: Any = None) -> Any:
        try:
            return self[name]
        except UnknownNameError:
            return default

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and bool(self._reader.ask("exists", self._kind, name))

    def __iter__(self) -> Iterator[str]:
        return iter(self._reader.ask("names", self._kind))

    def __len__(self) -> int:
        return len(self._reader.ask("names", self._kind))


def _with_factors(frame: Frame, reader: TracingReader, name: str) -> Frame:
    """Return a frame with its product as one factor; access to the factors is a query."""
    result = replace(frame, factors=_Factors(frame.factors, reader, name))
    vars(result)["transform"] = frame.transform  # set the cached property, which would query the factors
    return result


class _Factors(tuple["Pose | Expression", ...]):
    """Factors of a frame, queried on demand because most code needs their product only."""

    _reader: TracingReader
    _name: str

    def __new__(cls, product: tuple[Pose | Expression, ...], reader: TracingReader, name: str) -> _Factors:
        result = super().__new__(cls, product)
        result._reader, result._name = reader, name
        return result

    def _asked(self) -> tuple[Pose | Expression, ...]:
        if self._reader.done:
            return tuple(super().__iter__())
        result: tuple[Pose | Expression, ...] = self._reader.ask("factors", self._name)
        return result

    def __len__(self) -> int:
        return len(self._asked())

    def __iter__(self) -> Iterator[Pose | Expression]:
        return iter(self._asked())

    def __getitem__(self, key: Any) -> Any:
        return self._asked()[key]

    def __eq__(self, other: object) -> bool:
        return self._asked() == other

    def __hash__(self) -> int:
        return hash(self._asked())
