"""Running an operation again from its trace."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from kineverse.errors import KineverseError, ModelError
from kineverse.expressions.expression import Expression, as_expression
from kineverse.model.constraint import Constraint
from kineverse.model.contents import mapped
from kineverse.model.operation import ARTICULATIONS, CONSTRAINTS, DATA, Effects
from kineverse.model.reader import Cell, Reader

from .answer import Answer, answers_in, entry_along, filled
from .question import FAILED, Look, Part, Question, Reply

MAX_ANSWER = 200_000
"""How many nodes an answer may be made of."""


class UntraceableError(ModelError):
    """An operation decides by what it read in a way that its trace cannot follow."""


@dataclass(frozen=True)
class Step:
    """A question, and how closely its answer was looked at."""

    question: Question
    look: Look


@dataclass(frozen=True)
class Trace:
    """What an operation computes.

    Attributes
    ----------
    steps
        The questions in the order in which they were asked; one may be about the answers before it.
    writes
        What is written, by cell, with :class:`.answer.Answer` nodes where answers belong.
    """

    steps: tuple[Step, ...]
    writes: tuple[tuple[Cell, Any], ...]

    def run(self, model: Reader, before: Reader) -> Effects:
        """Return what the operation writes, given a model.

        Parameters
        ----------
        model
            The model as it is now.
        before
            The model as it was when the operation was traced.

        Raises
        ------
        UntraceableError
            If something has changed that the operation decided by.
        UnknownNameError
            If something that it asked for does not exist any more.
        """
        old: list[Reply] = []
        new: list[Reply] = []
        for step in self.steps:
            then = _answered(in_terms_of(step.question, old), before)
            now = _answered(in_terms_of(step.question, new), model)
            if isinstance(now, KineverseError) and not isinstance(then, KineverseError):
                raise now
            old.append(_reply(then))
            new.append(_like(_reply(now), old[-1]))
            _check_size(old[-1])
            _check_size(new[-1])
            problem = _difference(step.look, old[-1], new[-1])
            if problem:
                asked = ", ".join(str(a) for a in step.question.arguments if isinstance(a, str))
                raise UntraceableError(
                    f"{problem} of {step.question.kind}({asked}), which has changed, decides what it does."
                )
        return self.written(new)

    def written(self, replies: Sequence[Reply]) -> Effects:
        """Return what the operation writes, given the answers to its questions."""
        put = _into(replies)

        def put_datum(expression: Expression) -> Expression | float:
            # What is made of numbers alone is a number again.
            parts = [replies[a.question].parts[a.part] for a in answers_in(expression)]
            result = put(expression)
            of_numbers = bool(parts) and all(isinstance(part, float) for part in parts)
            is_number = of_numbers and not result.shape and result.is_constant
            if not is_number:
                return result
            number = float(result)
            if not math.isfinite(number):
                raise UntraceableError(f"a number that it writes would be {number}.")
            return number

        written = {
            (kind, name): mapped(kind, value, put_datum if kind in (DATA, ARTICULATIONS) else put)
            for (kind, name), value in self.writes
        }
        for (kind, _), value in written.items():
            if kind == CONSTRAINTS:
                Constraint.of(value.lower, value.expression, value.upper)  # raises where there is no range
        return Effects.of(written)


def _check_size(reply: Reply) -> None:
    """Refuse what has no end: each of some dozen substitutions in one another doubles what there is."""
    if sum(ca.n_nodes(part._sx) for part in reply.parts if isinstance(part, Expression)) > MAX_ANSWER:
        raise UntraceableError(f"an answer on the way to it is made of more than {MAX_ANSWER:,} nodes.")


def replied(question: Question, model: Reader) -> Reply:
    """Return the answer to a question, :data:`.question.FAILED` where asking is an error."""
    return _reply(_answered(question, model))


def _answered(question: Question, model: Reader) -> Reply | KineverseError:
    try:
        return question.ask(model)
    except KineverseError as error:
        return error


def _reply(answered: Reply | KineverseError) -> Reply:
    return Reply(FAILED, ()) if isinstance(answered, KineverseError) else answered


def _like(reply: Reply, before: Reply) -> Reply:
    """Return a reply with a whole number as a number, if that was one that is not whole."""
    is_whole = type(reply.rest) is int and isinstance(before.rest, Part)
    return Reply(before.rest, (float(reply.rest),)) if is_whole else reply


def in_terms_of(question: Question, replies: Sequence[Reply]) -> Question:
    """Return a question with earlier answers put into it."""
    if not any(isinstance(a, Expression) for a in question.arguments):
        return question
    put = _into(replies)
    return Question(
        question.kind, tuple(put(a) if isinstance(a, Expression) else a for a in question.arguments)
    )


def _into(replies: Sequence[Reply]) -> Callable[[Expression], Expression]:
    def place(answer: Answer) -> Expression:
        parts = replies[answer.question].parts
        part = as_expression(parts[answer.part]) if answer.part < len(parts) else None
        if part is None or part.shape != answer.shape:
            raise UntraceableError("it needs more than there is now.")
        return entry_along(part, answer.path)

    return lambda expression: filled(expression, place)


def _difference(look: Look, old: Reply, new: Reply) -> str | None:
    if old.rest != new.rest or len(old.parts) != len(new.parts):
        return "the names and kinds"
    for one, other in zip(old.parts, new.parts, strict=True):
        a, b = as_expression(one), as_expression(other)
        if a.shape != b.shape:
            return "the shape"
        if look >= Look.VALUE and a != b:
            return "the value"
        if look >= Look.SYMBOLS and _symbols(a) != _symbols(b):
            return "the symbols"
    return None


def _symbols(expression: Expression) -> list[object]:
    """Return the symbols of each element and of its gradients."""
    return [
        (e.symbols, *(frozenset(e.gradient(heuristic)) for heuristic in (False, True)))
        for e in (expression.ravel() if expression.shape else [expression])
    ]
