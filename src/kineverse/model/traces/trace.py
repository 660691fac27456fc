"""Trace of an operation, and its evaluation on another model."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from kineverse.errors import KineverseError, ModelError
from kineverse.expressions.expression import Expression, as_expression
from kineverse.model.constraint import Constraint
from kineverse.model.operation import ARTICULATIONS, CONSTRAINTS, DATA, Cell, Writes, map_expressions
from kineverse.model.read_recorder import ReadRecorder

from .placeholder import ReadNode, fill_read_nodes, find_read_nodes, follow_gradient_path
from .trace_queries import FAILED, Access, Query, QueryResult, ResultPart

MAX_ANSWER = 200_000
"""Largest number of nodes in a query result."""


class UntraceableError(ModelError):
    """Operation that depends on values it reads in a way that a trace cannot represent."""


@dataclass(frozen=True)
class TraceStep:
    """Query of an operation, with the access to its result."""

    query: Query
    access: Access


@dataclass(frozen=True)
class Trace:
    """Computation of an operation as expressions.

    Attributes
    ----------
    steps
        Queries in order. The arguments of a query may contain results of earlier ones.
    writes
        Written values by cell, with :class:`.placeholder.ReadNode` nodes for query results.
    """

    steps: tuple[TraceStep, ...]
    writes: tuple[tuple[Cell, Any], ...]

    def run(self, model: ReadRecorder, before: ReadRecorder) -> Writes:
        """Evaluate the trace on a model, and return the writes.

        Parameters
        ----------
        model
            Present model.
        before
            Model at the time of the trace.

        Raises
        ------
        UntraceableError
            If a value has changed that the operation depends on.
        UnknownNameError
            If the name in a query no longer exists.
        """
        old: list[QueryResult] = []
        new: list[QueryResult] = []
        for step in self.steps:
            then = _ask(substitute_results(step.query, old), before)
            now = _ask(substitute_results(step.query, new), model)
            if isinstance(now, KineverseError) and not isinstance(then, KineverseError):
                raise now
            old.append(_reply(then))
            new.append(_like(_reply(now), old[-1]))
            _check_size(old[-1])
            _check_size(new[-1])
            problem = _difference(step.access, old[-1], new[-1])
            if problem:
                asked = ", ".join(str(a) for a in step.query.arguments if isinstance(a, str))
                raise UntraceableError(
                    f"{problem} of {step.query.kind}({asked}), which has changed, decides what it does."
                )
        return self.compute_writes(new)

    def compute_writes(self, results: Sequence[QueryResult]) -> Writes:
        """Return the writes for given query results."""
        fill = _into(results)

        def fill_datum(expression: Expression) -> Expression | float:
            # An expression of numbers is converted back to a number.
            parts = [results[a.query].parts[a.part] for a in find_read_nodes(expression)]
            result = fill(expression)
            of_numbers = bool(parts) and all(isinstance(part, float) for part in parts)
            is_number = of_numbers and not result.shape and result.is_constant
            if not is_number:
                return result
            number = float(result)
            if not math.isfinite(number):
                raise UntraceableError(f"a number that it writes would be {number}.")
            return number

        written = {
            (kind, name): map_expressions(kind, value, fill_datum if kind in (DATA, ARTICULATIONS) else fill)
            for (kind, name), value in self.writes
        }
        for (kind, _), value in written.items():
            if kind == CONSTRAINTS:
                Constraint.from_expressions(
                    value.lower, value.expression, value.upper
                )  # raises for an empty range
        return Writes.from_cells(written)


def _check_size(reply: QueryResult) -> None:
    """Refuse results of exponential size: each of several nested substitutions can double the size."""
    if sum(ca.n_nodes(part.sx) for part in reply.parts if isinstance(part, Expression)) > MAX_ANSWER:
        raise UntraceableError(f"an answer on the way to it is made of more than {MAX_ANSWER:,} nodes.")


def run_query(query: Query, model: ReadRecorder) -> QueryResult:
    """Return the result of a query; :data:`.trace_queries.FAILED` if it raises an error."""
    return _reply(_ask(query, model))


def _ask(query: Query, model: ReadRecorder) -> QueryResult | KineverseError:
    try:
        return query.ask(model)
    except KineverseError as error:
        return error


def _reply(answered: QueryResult | KineverseError) -> QueryResult:
    return QueryResult(FAILED, ()) if isinstance(answered, KineverseError) else answered


def _like(reply: QueryResult, before: QueryResult) -> QueryResult:
    """Return a result with integers as floats, if it had floats at the time of the trace."""
    is_whole = type(reply.rest) is int and isinstance(before.rest, ResultPart)
    return QueryResult(before.rest, (float(reply.rest),)) if is_whole else reply


def substitute_results(query: Query, results: Sequence[QueryResult]) -> Query:
    """Return a query with earlier results in its arguments."""
    if not any(isinstance(a, Expression) for a in query.arguments):
        return query
    fill = _into(results)
    return Query(query.kind, tuple(fill(a) if isinstance(a, Expression) else a for a in query.arguments))


def _into(results: Sequence[QueryResult]) -> Callable[[Expression], Expression]:
    def place(answer: ReadNode) -> Expression:
        parts = results[answer.query].parts
        part = as_expression(parts[answer.part]) if answer.part < len(parts) else None
        if part is None or part.shape != answer.shape:
            raise UntraceableError("it needs more than there is now.")
        return follow_gradient_path(part, answer.path)

    return lambda expression: fill_read_nodes(expression, place)


def _difference(access: Access, old: QueryResult, new: QueryResult) -> str | None:
    if old.rest != new.rest or len(old.parts) != len(new.parts):
        return "the names and kinds"
    for one, other in zip(old.parts, new.parts, strict=True):
        a, b = as_expression(one), as_expression(other)
        if a.shape != b.shape:
            return "the shape"
        if access >= Access.VALUE and a != b:
            return "the value"
        if access >= Access.SYMBOLS and _symbols(a) != _symbols(b):
            return "the symbols"
    return None


def _symbols(expression: Expression) -> list[object]:
    """Return the symbols of each element and of its gradients."""
    return [
        (e.symbols, *(frozenset(e.gradient(heuristic)) for heuristic in (False, True)))
        for e in (expression.ravel() if expression.shape else [expression])
    ]
