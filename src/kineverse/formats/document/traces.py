"""Traces of operations as JSON values and back.

A trace is ``{"questions": [[kind, look, argument, ...], ...], "writes": {...}}``: what was asked, how closely
the answer was looked at (0 not at all, 1 its symbols, 2 its value), and writes as those of the operation,
whose expressions contain ``read`` nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from kineverse.expressions.expression import Expression
from kineverse.model.contents import expressions_in
from kineverse.model.operation import FRAMES
from kineverse.model.reader import Cell
from kineverse.model.traces import Look, Question, Step, Trace
from kineverse.model.traces.answer import answers_in
from kineverse.model.traces.question import KINDS, OF_EXPRESSIONS, OF_KIND

from .checks import RefusedError, exactly, listed, whole
from .graph import Graph
from .limits import MAX_QUESTIONS
from .values import Ref

_KIND_OF = {question: kind for kind, question in OF_KIND.items()}


def expressions_of(trace: Trace) -> list[Expression]:
    """Return the expressions of a trace."""
    asked = [a for step in trace.steps for a in step.question.arguments if isinstance(a, Expression)]
    return asked + [e for (kind, _), value in trace.writes for e in expressions_in(kind, value)]


def written_questions(trace: Trace, ref: Ref) -> list[list[Any]]:
    """Return the questions of a trace as JSON has them."""
    return [
        [
            step.question.kind,
            int(step.look),
            *(ref(a) if isinstance(a, Expression) else a for a in step.question.arguments),
        ]
        for step in trace.steps
    ]


def read_questions(value: Any, graph: Graph, cell: Callable[[str, Any], Cell]) -> tuple[Step, ...]:
    """Return the questions of a trace.

    Parameters
    ----------
    value
        What stands in the document.
    graph
        The expressions.
    cell
        Returns the cell of a kind and a name as the document gives it.

    Raises
    ------
    RefusedError
        For what is no question.
    """
    steps = []
    if len(listed(value, "questions")) > MAX_QUESTIONS:
        raise RefusedError(f"{len(value)} questions, more than {MAX_QUESTIONS}")
    for place, item in enumerate(value):
        if len(listed(item, "a question")) < 2:
            raise RefusedError("a question is its kind, how closely it was looked at, and what it is about")
        kind, look, *arguments = item
        if type(kind) is not str or kind not in KINDS:
            raise RefusedError(f"a question is one of {', '.join(KINDS)}")
        exactly(arguments, KINDS[kind].arguments)
        steps.append(Step(Question(kind, _arguments(kind, arguments, graph, cell)), Look(whole(look, 2))))
        for expression in (a for a in steps[-1].question.arguments if isinstance(a, Expression)):
            check_answers(expression, place)
    return tuple(steps)


def check_answers(expression: Expression, questions: int) -> None:
    """Refuse an expression about answers that are not there.

    Raises
    ------
    RefusedError
        If one is to a question that comes later, or never.
    """
    for answer in answers_in(expression):
        if answer.question >= questions:
            raise RefusedError(f"it is about the answer to question {answer.question}, which is not asked")


def _arguments(
    kind: str, given: list[Any], graph: Graph, cell: Callable[[str, Any], Cell]
) -> tuple[Any, ...]:
    if kind == "exists":
        return cell(given[0], given[1])
    if kind == "names":
        return (cell(given[0], "x")[0],)
    if kind in ("fk", "between"):
        return tuple(cell(FRAMES, name)[1] for name in given)
    if kind in OF_EXPRESSIONS:
        return tuple(map(graph.expression, given))
    return (cell(FRAMES if kind in ("body", "factors") else _KIND_OF[kind], given[0])[1],)
