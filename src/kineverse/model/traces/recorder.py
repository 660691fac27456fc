"""Recording of an operation as expressions of what it reads."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import count
from typing import Any

from kineverse.errors import KineverseError
from kineverse.expressions.expression import Expression, as_expression
from kineverse.model.operation import Cell, Operation, map_expressions
from kineverse.model.read_recorder import ReadRecorder

from .replay import replay_agrees, writes_agree
from .trace import (
    ReadNode,
    Trace,
    TraceStep,
    UntraceableError,
    fill_read_nodes,
    find_read_nodes,
    substitute_results,
)
from .trace_queries import FAILED, Access, Query, QueryResult, TracingReader

_SERIAL = count(1)


def record_trace(operation: Operation, model: ReadRecorder, writes: Mapping[Cell, Any]) -> Trace:
    """Record the trace of an operation.

    Parameters
    ----------
    model
        Model before the operation.
    writes
        Writes of the operation. The trace must reproduce them. It must also agree with the code on perturbed
        query results, because code can inspect values in ways that are not recorded.

    Raises
    ------
    UntraceableError
        If the code needs the values that it reads.

    See Also
    --------
    kineverse.formats.document.OpaqueOperation
    """
    if not operation.traceable:
        raise UntraceableError("what it computes follows from numbers that it reads")
    reader = _RecordingReader(model)
    try:
        return _run_traced(operation, reader, writes)
    except UntraceableError as error:
        if not reader.gave_numbers:
            raise
        try:  # much code needs its numbers, but only computes with its poses
            return _run_traced(operation, _RecordingReader(model, plain_numbers=True), writes)
        except UntraceableError:
            raise error from None


def _run_traced(operation: Operation, reader: _RecordingReader, writes: Mapping[Cell, Any]) -> Trace:
    try:
        effects = operation.apply(reader)
        reader.done = True
        traced = tuple(
            (cell, map_expressions(cell[0], value, _detach)) for cell, value in effects.writes().items()
        )
        again = reader.trace(traced).compute_writes(reader.results).writes()
    except UntraceableError:
        raise
    except Exception as error:  # user code, written for other types of values
        first = str(error).partition("\n")[0]
        raise UntraceableError(f"its code needs values: {type(error).__name__}: {first[:200]}") from error
    if not writes_agree(again, writes):
        raise UntraceableError("it decides by what it reads in a way that leaves no trace")

    def is_followed(free: Collection[int]) -> bool:
        return replay_agrees(reader.trace(traced), operation, reader.model, reader.results, free)

    free = [i for i, step in enumerate(reader.steps()) if step.access is Access.NOT]
    if not is_followed(free):
        for place in free:
            if not is_followed([place]):
                reader.decided_by(place)
        if not is_followed([i for i in free if reader.steps()[i].access is Access.NOT]):
            raise UntraceableError("it decides by what it reads in a way that leaves no trace")
    result = reader.trace(traced)
    if all(step.access is Access.VALUE for step in result.steps):
        raise UntraceableError("it looks at all the values that it reads")
    return result


class _RecordingReader(TracingReader):
    """Model before an operation, with placeholders for expressions; it records all queries.

    With ``plain_numbers``, numbers of data and records are passed as they are, and count as accessed by
    value.
    """

    def __init__(self, model: ReadRecorder, plain_numbers: bool = False) -> None:
        super().__init__(model)
        self.serial = next(_SERIAL)
        self.results: list[QueryResult] = []
        self._plain_numbers = plain_numbers
        self._places: dict[object, int] = {}
        self._queries: list[Query] = []
        self._accesses: list[Access] = []

    @property
    def gave_numbers(self) -> bool:
        return any(isinstance(part, float) for reply in self.results for part in reply.parts)

    def trace(self, writes: tuple[tuple[Cell, Any], ...]) -> Trace:
        return Trace(self.steps(), writes)

    def steps(self) -> tuple[TraceStep, ...]:
        return tuple(
            TraceStep(_apart(q), access) for q, access in zip(self._queries, self._accesses, strict=True)
        )

    def record_access(self, query: int, how: Access) -> None:
        if not self.done:
            self._accesses[query] = max(self._accesses[query], how)

    def decided_by(self, query: int) -> None:
        self._accesses[query] = Access.VALUE

    def notify(self, expression: Expression) -> Expression:
        return fill_read_nodes(expression, lambda answer: answer.value)

    def ask(self, kind: str, *arguments: Any) -> Any:
        query = Query(kind, arguments)
        place = self._places.get(query.key)
        if place is None:
            place = self._ask(query)
        rest, parts = self.results[place]
        if rest is FAILED:
            query.ask(self.model)
        if self._plain_numbers and any(isinstance(part, float) for part in parts):
            self.record_access(place, Access.VALUE)
        return query.answer(rest, [self._given(place, i, part) for i, part in enumerate(parts)])

    def _ask(self, query: Query) -> int:
        try:
            reply = substitute_results(query, self.results).ask(self.model)
        except KineverseError:
            if any(isinstance(a, Expression) for a in query.arguments):
                raise
            reply = QueryResult(FAILED, ())
        place = self._places[query.key] = len(self.results)
        self.results.append(reply)
        self._queries.append(query)
        self._accesses.append(Access.NOT)
        return place

    def _given(self, query: int, place: int, part: Expression | float) -> Expression | float:
        if self._plain_numbers and isinstance(part, float):
            return part
        return ReadNode.from_expression(as_expression(part), self, query, place)


def _detach(expression: Expression) -> Expression:
    """Return an expression with empty placeholders, equal in every process."""
    result = fill_read_nodes(expression, lambda a: ReadNode.empty(a.shape, a.query, a.part, a.path))
    if any(answer.arguments for answer in find_read_nodes(result)):
        raise UntraceableError("what it read is inside of an implicit function")
    return result


def _apart(query: Query) -> Query:
    arguments = (_detach(a) if isinstance(a, Expression) else a for a in query.arguments)
    return Query(query.kind, tuple(arguments))
