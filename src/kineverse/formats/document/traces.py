"""Traces of operations in documents, and their consistency with reads and writes.

A trace is ``{"questions": [[kind, access, argument, ...], ...], "writes": {...}}``: the queries, the access
to each result (0 none, 1 its symbols, 2 its value), and writes like those of the operation, whose expressions
contain ``read`` nodes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import casadi as ca

from kineverse.errors import KineverseError
from kineverse.expressions.expression import Expression
from kineverse.expressions.graph import leaves, topological_order
from kineverse.expressions.implicit import Implicit
from kineverse.model.frame import WORLD
from kineverse.model.kinematics import branches
from kineverse.model.operation import FRAMES, Cell, find_expressions
from kineverse.model.read_recorder import ABSENT, Read, ReadRecorder, Reads
from kineverse.model.traces import Access, Query, Trace, TraceStep
from kineverse.model.traces.replay import ExpressionPair, writes_agree
from kineverse.model.traces.trace import find_read_nodes, run_query, substitute_results
from kineverse.model.traces.trace_queries import DATA_QUERIES, EXPRESSION_QUERIES, QUERY_KINDS, QueryResult

from . import structs
from .budget import COST_OF_FRAME, COST_OF_NAME, COST_OF_NODE_BELOW, MAX_WORK, Budget, InvalidDocumentError
from .node_graph import NodeGraph
from .values import Names, Ref, decode_writes

_KIND_OF = {question: kind for kind, question in DATA_QUERIES.items()}


def encode_queries(trace: Trace, ref: Ref) -> list[list[Any]]:
    """Encode the queries of a trace."""
    return [
        [
            step.query.kind,
            int(step.access),
            *(ref(a) if isinstance(a, Expression) else a for a in step.query.arguments),
        ]
        for step in trace.steps
    ]


def decode_trace(given: structs.TraceValue, graph: NodeGraph, names: Names) -> Trace:
    """Decode a trace."""
    steps: list[TraceStep] = []
    for item in given.questions:
        if len(item) < 2:
            raise InvalidDocumentError(
                "a question is its kind, how closely it was looked at, and what it is about"
            )
        kind, look, *arguments = item
        if type(kind) is not str or kind not in QUERY_KINDS:
            raise InvalidDocumentError(f"a question is one of {', '.join(QUERY_KINDS)}")
        if type(look) is not int or not 0 <= look <= 2:
            raise InvalidDocumentError("how closely an answer was looked at is 0, 1 or 2")
        if len(arguments) != QUERY_KINDS[kind].arguments:
            raise InvalidDocumentError(
                f"the question {kind!r} has {QUERY_KINDS[kind].arguments} arguments, not {len(arguments)}"
            )
        query = Query(kind, _decode_arguments(kind, arguments, graph, names))
        for expression in (a for a in query.arguments if isinstance(a, Expression)):
            check_read_nodes(expression, len(steps))
        steps.append(TraceStep(query, Access(look)))
    writes = tuple(decode_writes(given.writes, graph, names, is_trace=True))
    for expression in (e for (kind, _), value in writes for e in find_expressions(kind, value)):
        check_read_nodes(expression, len(steps))
    return Trace(tuple(steps), writes)


def check_read_nodes(expression: Expression, questions: int) -> None:
    """Check that the read nodes of an expression refer to earlier queries."""
    for answer in find_read_nodes(expression):
        if answer.query >= questions:
            raise InvalidDocumentError(
                f"it is about the answer to question {answer.query}, which is not asked"
            )


def _decode_arguments(kind: str, given: list[Any], graph: NodeGraph, names: Names) -> tuple[Any, ...]:
    if kind == "exists":
        return names.cell(given[0], given[1])
    if kind == "names":
        return (names.cell(given[0], "x")[0],)
    if kind in ("fk", "between"):
        return tuple(names.cell(FRAMES, name)[1] for name in given)
    if kind in EXPRESSION_QUERIES:
        return tuple(map(graph.expression, given))
    # The body of the world is that of a frame of this name.
    return (names.cell(FRAMES if kind == "body" else _KIND_OF.get(kind, FRAMES), given[0])[1],)


def named_reads(trace: Trace) -> Reads:
    """Return the reads that follow from the names in the queries of a trace, whatever the model contains."""
    reads = Reads()
    for step in trace.steps:
        kind, arguments = step.query.kind, step.query.arguments
        if kind == "exists":
            reads.add((arguments[0], arguments[1]), Read.EXISTENCE)
        elif kind == "names":
            reads.listings.add(arguments[0])
        elif kind in ("fk", "between"):
            for name in set(arguments) - {WORLD}:
                reads.add((FRAMES, name), Read.EXISTENCE)
        elif kind not in EXPRESSION_QUERIES:
            reads.add((_KIND_OF.get(kind, FRAMES), arguments[0]), Read.VALUE)
    return reads


_COST_OF_POSE = 1000  # cost of a frame in a composed pose, about its number of products and sums


class TraceConsistency:
    """Check of the trace of each operation against its reads and writes in the document.

    Reads are derived from the queries of a trace: an operation with too few reads on record would not be run
    again when one changes. The writes of the trace are compared with those on record. Comparing costs work;
    beyond a budget far above that of all known documents, a million nodes and more, it is skipped.
    """

    def __init__(self, budget: Budget, cells: Mapping[Cell, Any], names: Mapping[str, set[str]]) -> None:
        self._budget, self._cells, self._names = budget, cells, names
        self._left = MAX_WORK

    def reads_of(self, trace: Trace, writes: Mapping[Cell, Any]) -> Reads:
        """Return the reads of the queries of a trace."""
        if [cell for cell, _ in trace.writes] != list(writes):
            raise InvalidDocumentError("it writes other things than the operation, and one of them is wrong")
        reads = Reads()
        try:
            replies = self._replies(trace, reads)
            written = (e for (kind, _), value in trace.writes for e in find_expressions(kind, value))
            if replies is None or not self._spend(sum(map(_nodes, written))):
                return reads
            again = trace.compute_writes(replies).writes()
        except KineverseError as error:
            raise InvalidDocumentError(f"it cannot be followed: {error}") from None
        # Writes have a fixed order of kinds; only the order of names within a kind counts.
        in_order = {cell: again[cell] for cell in writes if cell in again}
        if len(in_order) < len(again) or not writes_agree(in_order, writes, self._spend_comparison):
            raise InvalidDocumentError("it leads to other values than the writes, and one of them is wrong")
        return reads

    def _replies(self, trace: Trace, reads: Reads) -> list[QueryResult] | None:
        """Record the reads of all queries; return their results, or None if these are too much work."""
        replies: list[QueryResult] | None = []
        for step in trace.steps:
            question = step.query
            if question.kind in EXPRESSION_QUERIES:
                if replies is None or not self._spend(_size(question)):
                    replies = None
                    continue
                question = substitute_results(question, replies)
                if not self._spend(_cost(question)):
                    replies = None
                    continue
            elif question.kind == "fk":
                names = self._chain(*question.arguments)
                if names and (replies is None or not self._spend(_COST_OF_POSE * len(names))):
                    self._record_chain(names, question.arguments, reads)
                    replies = None
                    continue
            reply = run_query(question, self._reader(reads))
            if replies is not None:
                replies.append(reply)
                if not self._spend(sum(_nodes(part) for part in reply.parts)):
                    replies = None
        return replies

    def _chain(self, frame: str, relative_to: str) -> list[str]:
        """Return the frames between two, from their common ancestor down; none if they are not connected."""
        try:
            base, down = branches(frame, relative_to, lambda name: self._cells[FRAMES, name])
        except (KineverseError, KeyError):
            return []
        self._budget.spend(COST_OF_FRAME * (len(base) + len(down)))
        return [*base, *down]

    def _record_chain(self, names: list[str], ends: Iterable[str], reads: Reads) -> None:
        """Record the reads of a pose without composing it, which is large for a long chain."""
        reader = self._reader(reads)
        self._budget.spend(2 * COST_OF_FRAME * len(names))
        for name in names:
            for factor in reader.frames[name].factors:
                if isinstance(factor, Expression):
                    reader.carry(factor)
        for end in set(ends) - {WORLD}:
            reads.add((FRAMES, end), Read.EXISTENCE)

    def _reader(self, reads: Reads) -> ReadRecorder:
        return ReadRecorder(lambda cell: self._cells.get(cell, ABSENT), self._sorted, reads)

    def _sorted(self, kind: str) -> list[str]:
        self._budget.spend(COST_OF_NAME * len(self._names[kind]))
        return sorted(self._names[kind])

    def _spend(self, work: int) -> bool:
        self._left -= work
        return self._left >= 0

    def _spend_comparison(self, pairs: list[ExpressionPair]) -> bool:
        """Spend the work of comparing values and gradients, which writes out implicit functions."""
        work = 0
        for expression in (e for pair in pairs for e in pair):
            inner = topological_order(leaves(expression)[1], lambda n: n.parts, lambda _: False)
            functions = [n.function.key for n in inner if isinstance(n, Implicit)]
            steps = sum(self._budget.functions.get(key, 0) for key in functions)
            parts = _nodes(expression) + sum(_nodes(part) for node in inner for part in node.parts)
            work += (steps + parts) * (1 + len(expression.symbols))
        return self._spend(work)


def _size(question: Query) -> int:
    return sum(_nodes(a) for a in question.arguments if isinstance(a, Expression))


def _cost(question: Query) -> int:
    """Estimate the work of a query about expressions: a sweep for each derivative."""
    first, *others = (a for a in question.arguments if isinstance(a, Expression))
    sweeps = min(math.prod(first.shape), max((math.prod(a.shape) for a in others), default=1))
    return _size(question) * max(sweeps, 1)


def _nodes(part: Expression | float) -> int:
    if not isinstance(part, Expression):
        return 1
    return int(ca.n_nodes(part.sx)) + COST_OF_NODE_BELOW * len(part.nodes)
