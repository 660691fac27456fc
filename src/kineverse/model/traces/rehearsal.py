"""Trying a trace beside the code, on answers that the model did not give.

Code may look at what it is given in ways that no one notices, as ``isinstance`` does. So it is run once more
on answers of other types: constants in place of what moves, symbols and whole numbers in place of numbers.
Where it then does what the trace does not, it decides by that answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

import numpy as np

from kineverse.errors import KineverseError
from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.leaves import leaves
from kineverse.model.contents import expressions_in
from kineverse.model.operation import Operation
from kineverse.model.reader import Reader
from kineverse.spatial import translation
from kineverse.symbols import Symbol, position

from .asking import AskingReader
from .comparison import agree
from .question import FAILED, OF_EXPRESSIONS, Question, Reply
from .trace import Trace, UntraceableError, in_terms_of

_STRANGER = "∂/stranger"
_SEED = 20221

Change = Callable[[Question, int, "Expression | float"], "Expression | float"]


def follows(
    trace: Trace, operation: Operation, model: Reader, replies: Sequence[Reply], free: Collection[int]
) -> bool:
    """Return whether a trace does what the code does where the answers to these questions are others."""
    for change in (_at_rest, partial(_moving, symbol=_symbol_of(trace))):
        others: list[Reply] = []
        try:
            for place, (step, reply) in enumerate(zip(trace.steps, replies, strict=True)):
                if step.question.kind in OF_EXPRESSIONS:
                    others.append(in_terms_of(step.question, others).ask(model))
                else:
                    others.append(_changed(change, step.question, reply) if place in free else reply)
            traced = trace.written(others).writes()
        except KineverseError:
            continue  # nobody follows such a change
        reader = _Rehearsal(model, trace, others)
        try:
            effects = operation.apply(reader)
            reader.done = True
            written = effects.writes()
        except UntraceableError:
            return False
        except Exception:  # it is anybody's code, and such answers may be none for it
            continue
        if not agree(traced, written):
            return False
    return True


def _changed(change: Change, question: Question, reply: Reply) -> Reply:
    return Reply(reply.rest, tuple(change(question, i, part) for i, part in enumerate(reply.parts)))


def _at_rest(question: Question, place: int, part: Expression | float) -> Expression | float:
    """Return another number in place of a number, and a constant for what moves."""
    if isinstance(part, float):
        return math.floor(part) + 2 if question.kind == "datum" else 1.25 * part + 0.5
    if question.kind == "constraint" and place == 1:
        return 2 * part  # what is limited is never constant
    random = np.random.default_rng(_SEED)
    try:
        value = part({s: random.uniform(0.1, 0.9) for s in part.symbols if s.value is None})
    except KineverseError:
        return part
    if not np.isfinite(value).all():
        return part
    return as_expression(value if part.shape else 1.25 * value + 0.5)


def _moving(question: Question, place: int, part: Expression | float, symbol: Symbol) -> Expression | float:
    """Return something that is, or is made of, nothing but one symbol."""
    symbol = symbol if isinstance(part, float) or not part.symbols else part.symbols[0]
    if isinstance(part, float) or not part.shape:
        return symbol
    if part.shape == (3, 4):
        return translation(symbol, symbol, symbol)[:3]
    return part + symbol


def _symbol_of(trace: Trace) -> Symbol:
    """Return a symbol that the code uses itself, as it may compare what it reads with that."""
    written = (e for (kind, _), value in trace.writes for e in expressions_in(kind, value))
    symbols = (s for e in written for s in leaves(e)[0] if not s.order and s.has_derivative)
    return next(symbols, position(_STRANGER))


class _Rehearsal(AskingReader):
    """A model that answers the questions of a trace in its own way, and no others."""

    def __init__(self, model: Reader, trace: Trace, replies: Sequence[Reply]) -> None:
        super().__init__(model)
        self._replies = {
            in_terms_of(step.question, replies).key: reply
            for step, reply in zip(trace.steps, replies, strict=True)
        }

    def ask(self, kind: str, *arguments: Any) -> Any:
        question = Question(kind, arguments)
        reply = self._replies.get(question.key)
        if reply is None:
            raise UntraceableError("it asks for other things then")
        if reply.rest is FAILED:
            question.ask(self.model)
        return question.answer(reply.rest, reply.parts)
