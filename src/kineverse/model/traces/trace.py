"""Running an operation again from its trace."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from kineverse.errors import ModelError
from kineverse.expressions.expression import Expression
from kineverse.model.contents import mapped
from kineverse.model.operation import ARTICULATIONS, DATA, Effects
from kineverse.model.reader import Cell, Reader
from kineverse.symbols import Symbol

from .answer import Answer, entry_along, filled
from .question import Look, Question, Reply


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
            for replies, reader in ((old, before), (new, model)):
                replies.append(in_terms_of(step.question, replies).ask(reader))
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
            # What was a number when it was read is one again.
            result = put(expression)
            is_number = result is not expression and not result.shape and result.is_constant
            return float(result) if is_number else result

        return Effects.of(
            {
                (kind, name): mapped(kind, value, put_datum if kind in (DATA, ARTICULATIONS) else put)
                for (kind, name), value in self.writes
            }
        )


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
        if answer.part >= len(parts) or parts[answer.part].shape != answer.shape:
            raise UntraceableError("it needs more than there is now.")
        return entry_along(parts[answer.part], answer.path)

    return lambda expression: filled(expression, place)


def _difference(look: Look, old: Reply, new: Reply) -> str | None:
    if old.rest != new.rest or len(old.parts) != len(new.parts):
        return "the names and kinds"
    for a, b in zip(old.parts, new.parts, strict=True):
        if a.shape != b.shape:
            return "the shape"
        if look >= Look.VALUE and a != b:
            return "the value"
        if look >= Look.SYMBOLS and (a.symbols != b.symbols or _keys(a) != _keys(b)):
            return "the symbols"
    return None


def _keys(e: Expression) -> tuple[set[Symbol], ...]:
    return tuple(set(e.gradient(heuristic)) for heuristic in (False, True))
