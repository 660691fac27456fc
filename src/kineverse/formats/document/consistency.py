"""Whether what a document says twice of an operation is the same: its trace, its reads and its writes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import casadi as ca

from kineverse.errors import KineverseError
from kineverse.expressions.expression import Expression
from kineverse.expressions.implicit import Implicit
from kineverse.expressions.leaves import bottom_up, leaves
from kineverse.model.contents import expressions_in
from kineverse.model.frame import WORLD
from kineverse.model.kinematics import branches
from kineverse.model.operation import FRAMES
from kineverse.model.reader import ABSENT, Cell, Read, Reader, Reads
from kineverse.model.traces import Question, Trace
from kineverse.model.traces.comparison import Pair, agree
from kineverse.model.traces.question import OF_EXPRESSIONS, Reply
from kineverse.model.traces.trace import in_terms_of, replied

from .checks import RefusedError
from .graph import Graph
from .limits import COST_OF_FRAME, COST_OF_NAME, COST_OF_NODE_BELOW, MAX_WORK

_COST_OF_POSE = 1000
"""What a frame on the way costs where poses are composed, in about as many products and sums."""


class Consistency:
    """Compares the trace of each operation with what else the document says about it.

    Reads are derived from the questions of a trace, since an operation that is said to read less than it asks
    for would stay as it is when that changes. What the trace writes is compared with the writes. Comparing is
    work: what is beyond all that documents contain, a million nodes and more, is taken at its word.

    Parameters
    ----------
    graph
        The expressions of the document.
    cells
        What the operations before the present one wrote; it grows.
    names
        The names of these, by kind.
    """

    def __init__(self, graph: Graph, cells: Mapping[Cell, Any], names: Mapping[str, set[str]]) -> None:
        self._graph, self._cells, self._names = graph, cells, names
        self._left = MAX_WORK

    def reads_of(self, trace: Trace, writes: tuple[tuple[Cell, Any], ...]) -> Reads:
        """Return what the questions of a trace read.

        Parameters
        ----------
        trace
            Of the operation that comes next.
        writes
            What else is said that it writes.

        Raises
        ------
        RefusedError
            If the trace leads to other writes, or to none.
        """
        if [cell for cell, _ in trace.writes] != [cell for cell, _ in writes]:
            raise RefusedError("it writes other things than the operation, and one of them is wrong")
        reads = Reads()
        try:
            replies = self._replies(trace, reads)
            if replies is None or not self._affords(self._cost_of_writes(trace)):
                return reads
            again = trace.written(replies).writes()
        except KineverseError as error:
            raise RefusedError(f"it cannot be followed: {error}") from None
        # Effects name kinds in an order of their own; that of the names of a kind counts.
        in_order = {cell: again[cell] for cell, _ in writes if cell in again}
        if len(in_order) < len(again) or not agree(in_order, dict(writes), self._affords_comparing):
            raise RefusedError("it leads to other values than the writes, and one of them is wrong")
        return reads

    def _replies(self, trace: Trace, reads: Reads) -> list[Reply] | None:
        """Note what all questions read; return the answers, or None where these are too much work."""
        replies: list[Reply] | None = []
        for step in trace.steps:
            question = step.question
            if question.kind in OF_EXPRESSIONS:
                if replies is None or not self._affords(_size(question)):
                    replies = None
                    continue
                question = in_terms_of(question, replies)
                if not self._affords(_cost(question)):
                    replies = None
                    continue
            elif question.kind == "fk":
                names = self._way(*question.arguments)
                if names and (replies is None or not self._affords(_COST_OF_POSE * len(names))):
                    self._note(names, question.arguments, reads)
                    replies = None
                    continue
            reply = self._ask(question, reads)
            if replies is not None:
                replies.append(reply)
                if not self._affords(sum(_nodes(part) for part in reply.parts)):
                    replies = None
        return replies

    def _ask(self, question: Question, reads: Reads) -> Reply:
        """Return the answer to a question, and note what it reads."""
        return replied(question, self._reader(reads))

    def _way(self, frame: str, relative_to: str) -> list[str]:
        """Return the frames between two, from their last common ancestor down; none if there is no way."""
        try:
            base, down = branches(frame, relative_to, lambda name: self._cells[FRAMES, name])
        except (KineverseError, KeyError):
            return []
        self._graph.budget.spend(COST_OF_FRAME * (len(base) + len(down)))
        return [*base, *down]

    def _note(self, names: list[str], ends: Iterable[str], reads: Reads) -> None:
        """Note what a pose reads without composing it: of long chains they are large."""
        reader = self._reader(reads)
        self._graph.budget.spend(2 * COST_OF_FRAME * len(names))
        for name in names:
            for factor in reader.frames[name].factors:
                if isinstance(factor, Expression):
                    reader.carry(factor)
        for end in set(ends) - {WORLD}:
            reads.add((FRAMES, end), Read.EXISTENCE)

    def _reader(self, reads: Reads) -> Reader:
        return Reader(lambda cell: self._cells.get(cell, ABSENT), self._sorted, reads)

    def _sorted(self, kind: str) -> list[str]:
        self._graph.budget.spend(COST_OF_NAME * len(self._names[kind]))
        return sorted(self._names[kind])

    def _affords(self, work: int) -> bool:
        self._left -= work
        return self._left >= 0

    def _cost_of_writes(self, trace: Trace) -> int:
        return sum(_nodes(e) for (kind, _), value in trace.writes for e in expressions_in(kind, value))

    def _affords_comparing(self, pairs: list[Pair]) -> bool:
        """Whether values and gradients can be compared: implicit functions are written out for that."""
        work = 0
        for expression in (e for pair in pairs for e in pair):
            inner = bottom_up(leaves(expression)[1], lambda n: n.parts, lambda _: False)
            steps = sum(self._graph.work.get(n.function.key, 0) for n in inner if isinstance(n, Implicit))
            parts = _nodes(expression) + sum(_nodes(part) for node in inner for part in node.parts)
            work += (steps + parts) * (1 + len(expression.symbols))
        return self._affords(work)


def with_reads(cells: Mapping[Cell, Read], reads: Reads) -> dict[Cell, Read]:
    """Return how closely cells were looked at by what is said and what is derived."""
    result = dict(cells)
    for cell, how in reads.cells.items():
        result[cell] = result.get(cell, Read(0)) | how
    return result


def _size(question: Question) -> int:
    return sum(_nodes(a) for a in question.arguments if isinstance(a, Expression))


def _cost(question: Question) -> int:
    """Return about what it takes to answer a question about expressions: a sweep for each derivative."""
    first, *others = (a for a in question.arguments if isinstance(a, Expression))
    sweeps = min(math.prod(first.shape), max((math.prod(a.shape) for a in others), default=1))
    return _size(question) * max(sweeps, 1)


def _nodes(part: Expression | float) -> int:
    if not isinstance(part, Expression):
        return 1
    return int(ca.n_nodes(part._sx)) + COST_OF_NODE_BELOW * len(part._nodes)
