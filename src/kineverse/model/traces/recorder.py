"""Recording of an operation as expressions of what it reads."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import count
from typing import Any

from kineverse.errors import KineverseError
from kineverse.expressions.expression import Expression, as_expression
from kineverse.model.operation import Cell, Operation, map_expressions
from kineverse.model.read_recorder import ReadRecorder

from .placeholder import ReadNode, fill_read_nodes, find_read_nodes
from .replay import replay_agrees, writes_agree
from .trace import Trace, TraceStep, UntraceableError, substitute_results
from .trace_queries import FAILED, Access, Query, QueryResult, TracingReader

_SERIAL = count(1)


def record_trace(operation: Operation, model: ReadRecorder, writes: Mapping[Cell, Any]) -> Trace:
    """Record the trace of an operation.

    Parameters
    ----------
    operation
        Operation that was applied.
    model
        Model before the operation.
    writes
        Writes of the operation. The trace must reproduce them. It must also agree with the code on perturbed
        query results, because code can inspect values in ways that are not recorded.

    Raises
    ------
    UntraceableError
        If the code needs the values that it reads.
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
        again = reader.trace(traced).written(reader.replies).writes()
    except UntraceableError:
        raise
    except Exception as error:  # user code, written for other types of values
        first = str(error).partition("\n")[0]
        raise UntraceableError(f"its code needs values: {type(error).__name__}: {first[:200]}") from error
    if not writes_agree(again, writes):
        raise UntraceableError("it decides by what it reads in a way that leaves no trace")

    def is_followed(free: Collection[int]) -> bool:
        return replay_agrees(reader.trace(traced), operation, reader.model, reader.replies, free)

    free = [i for i, step in enumerate(reader.steps()) if step.look is Access.NOT]
    if not is_followed(free):
        for place in free:
            if not is_followed([place]):
                reader.decided_by(place)
        if not is_followed([i for i in free if reader.steps()[i].look is Access.NOT]):
            raise UntraceableError("it decides by what it reads in a way that leaves no trace")
    result = reader.trace(traced)
    if all(step.look is Access.VALUE for step in result.steps):
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
        self.replies: list[QueryResult] = []
        self._plain_numbers = plain_numbers
        self._places: dict[object, int] = {}
        self._questions: list[Query] = []
        self._looks: list[Access] = []

    @property
    def gave_numbers(self) -> bool:
        """True if a query result has a number."""
        return any(isinstance(part, float) for reply in self.replies for part in reply.parts)

    def trace(self, writes: tuple[tuple[Cell, Any], ...]) -> Trace:
        """Return the trace of the recorded queries and of given writes."""
        return Trace(self.steps(), writes)

    def steps(self) -> tuple[TraceStep, ...]:
        """Return the recorded queries with their accesses."""
        return tuple(TraceStep(_apart(q), look) for q, look in zip(self._questions, self._looks, strict=True))

    def look(self, question: int, how: Access) -> None:
        if not self.done:
            self._looks[question] = max(self._looks[question], how)

    def decided_by(self, question: int) -> None:
        """Record that the operation depends on the value of a query result."""
        self._looks[question] = Access.VALUE

    def notify(self, expression: Expression) -> Expression:
        return fill_read_nodes(expression, lambda answer: answer.value)

    def ask(self, kind: str, *arguments: Any) -> Any:
        question = Query(kind, arguments)
        place = self._places.get(question.key)
        if place is None:
            place = self._ask(question)
        rest, parts = self.replies[place]
        if rest is FAILED:
            question.ask(self.model)
        if self._plain_numbers and any(isinstance(part, float) for part in parts):
            self.look(place, Access.VALUE)
        return question.answer(rest, [self._given(place, i, part) for i, part in enumerate(parts)])

    def _ask(self, question: Query) -> int:
        try:
            reply = substitute_results(question, self.replies).ask(self.model)
        except KineverseError:
            if any(isinstance(a, Expression) for a in question.arguments):
                raise
            reply = QueryResult(FAILED, ())
        place = self._places[question.key] = len(self.replies)
        self.replies.append(reply)
        self._questions.append(question)
        self._looks.append(Access.NOT)
        return place

    def _given(self, question: int, place: int, part: Expression | float) -> Expression | float:
        if self._plain_numbers and isinstance(part, float):
            return part
        return ReadNode.from_expression(as_expression(part), self, question, place)


def _detach(expression: Expression) -> Expression:
    """Return an expression with empty placeholders, equal in every process."""
    result = fill_read_nodes(expression, lambda a: ReadNode.empty(a.shape, a.question, a.part, a.path))
    if any(answer.arguments for answer in find_read_nodes(result)):
        raise UntraceableError("what it read is inside of an implicit function")
    return result


def _apart(question: Query) -> Query:
    arguments = (_detach(a) if isinstance(a, Expression) else a for a in question.arguments)
    return Query(question.kind, tuple(arguments))
