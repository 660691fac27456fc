"""Traces of operations: what was read and written, with placeholders for values that were read."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

import casadi as ca
import numpy as np

from kineverse.errors import KineverseError, ModelError
from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.graph import leaves, topological_order
from kineverse.expressions.node import AccessListener, Node
from kineverse.expressions.substitution import apply_substitution, replace_nodes
from kineverse.model.constraint import Constraint
from kineverse.model.operation import ARTICULATIONS, CONSTRAINTS, DATA, Cell, Writes, map_expressions
from kineverse.model.read_recorder import ReadRecorder

from .trace_queries import FAILED, Access, Query, QueryResult, ResultPart

if TYPE_CHECKING:
    from kineverse.expressions.layout import ArrayShape
    from kineverse.expressions.substitution import Substitution
    from kineverse.symbols import Symbol

GradientPath = tuple[tuple["Symbol", bool], ...]


class Tracer(AccessListener, Protocol):
    """Receiver of the accesses to query results."""

    serial: int

    def record_access(self, query: int, how: Access) -> None:
        """Record an access to the result of a query."""


class ReadNode(Node):
    """Placeholder for an expression in a query result.

    While an operation is traced, the node behaves as the expression it stands for, and records accesses that
    an operation can base decisions on: to the symbols, and to the value, which comparing and printing also
    show. In a trace from a document it is empty: it has no arguments.

    The options are the tracer (None for none), the index of the query, the index of the expression in its
    result, and the *path*: the gradient entries that lead from that expression to this one, each with a flag
    for heuristic entries.

    See Also
    --------
    kineverse.formats.document.OpaqueOperation
    """

    __slots__ = ()
    kind = "read"

    @classmethod
    def from_expression(cls, expression: Expression, listener: Tracer, query: int, part: int) -> Expression:
        """Return a placeholder that stands for an expression."""
        return cls.from_arguments((expression,), expression.shape, (listener, query, part, ()))

    @classmethod
    def empty(cls, shape: ArrayShape, query: int, part: int, path: GradientPath) -> Expression:
        """Return an empty placeholder."""
        return cls.from_arguments((), shape, (None, query, part, path))

    @property
    def query(self) -> int:
        """Index of the query."""
        return int(self.options[1])

    @property
    def part(self) -> int:
        """Index of the expression in the query result."""
        return int(self.options[2])

    @property
    def path(self) -> GradientPath:
        """Gradient entries from the result to this expression, each with a flag for heuristic entries."""
        path: GradientPath = self.options[3]
        return path

    @property
    def parts(self) -> tuple[Expression, ...]:
        """Empty: the expression it stands for is not part of expressions with the placeholder."""
        return ()

    @property
    def is_constant(self) -> bool:
        """False, so that code takes its path for expressions and not for numbers."""
        return False

    def _initialise(
        self, key: bytes, arguments: tuple[Expression, ...], shape: ArrayShape, options: tuple[Any, ...]
    ) -> None:
        super()._initialise(key, arguments, shape, options)
        self.listener = options[0]

    @classmethod
    def _options_key(cls, options: tuple[Any, ...]) -> str:
        listener, query, part, path = options
        steps = [(symbol.sort_key, heuristic) for symbol, heuristic in path]
        return repr((listener and listener.serial, query, part, steps))

    def _look(self, how: Access) -> Expression:
        if not self.arguments:
            raise ModelError("A trace has no value before it is run.")
        # The symbols of gradient entries do not follow from those of the expression.
        self.options[0].record_access(self.query, Access.VALUE if self.path else how)
        return self.arguments[0]

    @property
    def symbols(self) -> frozenset[Symbol]:
        """Symbols of the expression it stands for."""
        return frozenset(self._look(Access.SYMBOLS).symbols)

    @property
    def value(self) -> Expression:
        """Expression it stands for."""
        return self._look(Access.VALUE)

    def gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        """Return the gradient, with placeholders as entries."""
        listener, query, part, path = self.options
        return {
            key: ReadNode.from_arguments(
                (entry,), self.shape, (listener, query, part, (*path, (key, heuristic)))
            )
            for key, entry in self._look(Access.SYMBOLS).gradient(heuristic).items()
        }

    def gradient_keys(self, heuristic: bool) -> frozenset[Symbol]:
        """Return the keys of the gradient."""
        return frozenset(self._look(Access.SYMBOLS).gradient(heuristic))

    def differentiated(self, heuristic: bool) -> tuple[Expression, ...]:
        """Return nothing, because gradient entries are queried one by one."""
        return ()

    def depends_on(self, substitution: Substitution) -> bool:
        """Return whether a substitution changes it."""
        return substitution.changes(self._look(Access.VALUE))

    def substitute(self, substitution: Substitution) -> Expression:
        """Return the expression it stands for after a substitution."""
        return apply_substitution(self._look(Access.VALUE), substitution)

    def _value(self) -> NoReturn:
        raise AssertionError("what calls this is overridden")

    def _gradient(self, heuristic: bool) -> NoReturn:
        raise AssertionError("what calls this is overridden")


def follow_gradient_path(expression: Expression, path: GradientPath) -> Expression:
    """Return the gradient entry at the end of a path; zero if there is none."""
    for key, heuristic in path:
        entry = expression.gradient(heuristic).get(key)
        expression = as_expression(np.zeros(expression.shape)) if entry is None else entry
    return expression


def fill_read_nodes(expression: Expression, replacement: Callable[[ReadNode], Expression]) -> Expression:
    """Replace the placeholders of an expression.

    Nodes are built again from their new arguments. Unlike in a substitution, overridden gradient entries stay
    overridden.
    """
    if not expression.nodes:
        return expression
    images: dict[Node, Expression] = {}
    for node in topological_order(leaves(expression)[1], _below, images.__contains__):
        if isinstance(node, ReadNode):
            images[node] = replacement(node)
            continue
        arguments = tuple(replace_nodes(part, images) for part in node.arguments)
        if any(new is not old for new, old in zip(arguments, node.arguments, strict=True)):
            images[node] = type(node).from_arguments(arguments, node.shape, node.options)
    return replace_nodes(expression, images)


def find_read_nodes(expression: Expression) -> list[ReadNode]:
    """Return the placeholders in an expression, at every depth."""
    nodes = topological_order(leaves(expression)[1], lambda n: n.parts, lambda _: False)
    return [node for node in nodes if isinstance(node, ReadNode)]


def _below(node: Node) -> tuple[Expression, ...]:
    return () if isinstance(node, ReadNode) else node.arguments


MAX_ANSWER = 200_000  # largest number of nodes in a query result


class UntraceableError(ModelError):
    """Operation that depends on values it reads in a way that a trace cannot represent.

    See Also
    --------
    kineverse.formats.document.OpaqueOperation
    """


@dataclass(frozen=True)
class TraceStep:
    """Query of an operation, with the access to its result.

    See Also
    --------
    kineverse.formats.document.OpaqueOperation
    """

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

    See Also
    --------
    kineverse.formats.document.OpaqueOperation
    """

    steps: tuple[TraceStep, ...]
    writes: tuple[tuple[Cell, Any], ...]

    def run(self, model: ReadRecorder, before: ReadRecorder) -> Writes:
        """Evaluate the trace on a model, and return the writes.

        Parameters
        ----------
        before
            Model at the time of the trace.

        Raises
        ------
        UntraceableError
            If a value has changed that the operation depends on.
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
            result = fill(expression)  # raises for an answer that is not there
            # An expression of numbers is converted back to a number.
            parts = [_parts(results[a.query])[a.part] for a in find_read_nodes(expression)]
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
    is_whole = not reply.parts and isinstance(before.rest, ResultPart)
    return QueryResult(before.rest, _parts(reply)) if is_whole else reply


def _parts(reply: QueryResult) -> tuple[Expression | float, ...]:
    """Return the parts of a result; an integer, which has none, is a number where the trace had one."""
    is_whole = type(reply.rest) is int and reply.rest.bit_length() < sys.float_info.max_exp
    return (float(reply.rest),) if is_whole and not reply.parts else reply.parts


def substitute_results(query: Query, results: Sequence[QueryResult]) -> Query:
    """Return a query with earlier results in its arguments."""
    if not any(isinstance(a, Expression) for a in query.arguments):
        return query
    fill = _into(results)
    return Query(query.kind, tuple(fill(a) if isinstance(a, Expression) else a for a in query.arguments))


def _into(results: Sequence[QueryResult]) -> Callable[[Expression], Expression]:
    def place(answer: ReadNode) -> Expression:
        parts = _parts(results[answer.query])
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
