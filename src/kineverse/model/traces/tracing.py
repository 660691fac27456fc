"""Running an operation once more, to write down what it computes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import count
from typing import Any

import numpy as np

from kineverse.errors import UnknownNameError
from kineverse.expressions.expression import Expression
from kineverse.model.contents import expressions_in, mapped
from kineverse.model.frame import WORLD
from kineverse.model.operation import ARTICULATIONS, FRAMES, Operation
from kineverse.model.reader import Cell, Reader
from kineverse.symbols import Symbol

from .answer import Answer, answers_in, filled
from .question import OF_KIND, Look, Question, Reply
from .trace import Step, Trace, UntraceableError, in_terms_of

_SERIAL = count(1)
_SAMPLES = 3
_SEED = 20220


def trace(operation: Operation, model: Reader, writes: Mapping[Cell, Any]) -> Trace:
    """Return what an operation computes.

    Parameters
    ----------
    operation
        An operation that was applied.
    model
        The model before it.
    writes
        What it wrote. What its trace writes is compared with it, as code may look at what it is given in
        ways that no one notices.

    Raises
    ------
    UntraceableError
        If its code cannot do without the values that it read.
    """
    if not operation.traceable:
        raise UntraceableError("what it computes follows from numbers that it reads")
    reader = _TracedReader(model)
    try:
        effects = operation.apply(reader)
        reader.done = True
        traced = {cell: mapped(cell[0], value, _detached) for cell, value in effects.writes().items()}
        result = Trace(reader.steps(), tuple(traced.items()))
        again = result.written(reader.replies).writes()
    except UntraceableError:
        raise
    except Exception as error:  # it is anybody's code, and was written for other values
        first = str(error).partition("\n")[0]
        raise UntraceableError(f"its code needs values: {type(error).__name__}: {first[:200]}") from error
    if any(
        isinstance(v, Expression) for (kind, _), a in traced.items() if kind == ARTICULATIONS for v in a.home
    ):
        raise UntraceableError("a home that it writes follows from what it read")
    if list(again) != list(writes) or not all(_alike(cell[0], again[cell], writes[cell]) for cell in writes):
        raise UntraceableError("it decides by what it reads in a way that leaves no trace")
    if all(step.look is Look.VALUE for step in result.steps):
        raise UntraceableError("it looks at all the values that it reads")
    return result


class _TracedReader(Reader):
    """The model before an operation, with answers in place of expressions, every question written down."""

    def __init__(self, model: Reader) -> None:
        super().__init__(model._value_at, model._names_at, model._reads)
        self.serial = next(_SERIAL)
        self.done = False
        """Whether the operation's code has run; who looks at its writes then is the same for all."""
        self.replies: list[Reply] = []
        self._model = model
        self._places: dict[Question, int] = {}
        self._looks: list[Look] = []

    def steps(self) -> tuple[Step, ...]:
        return tuple(Step(_apart(q), look) for q, look in zip(self._places, self._looks, strict=True))

    def look(self, question: int, how: Look) -> None:
        if not self.done:
            self._looks[question] = max(self._looks[question], how)

    def ask(self, kind: str, *arguments: Any) -> Any:
        question = Question(kind, arguments)
        place = self._places.get(question)
        if place is None:
            reply = in_terms_of(question, self.replies).ask(self._model)
            place = self._places[question] = len(self.replies)
            self.replies.append(reply)
            self._looks.append(Look.NOT)
        rest, parts = self.replies[place]
        return question.answer(
            rest, [Answer.standing_for(part, self, place, i) for i, part in enumerate(parts)]
        )

    def by_kind(self, kind: str) -> Mapping[str, Any]:
        return _TracedData(self, kind)

    def fk(self, frame: str, relative_to: str = WORLD) -> Expression:
        result: Expression = self.ask("fk", frame, relative_to)
        return result

    def coordinates_between(self, frame: str, relative_to: str = WORLD) -> tuple[Symbol, ...]:
        result: tuple[Symbol, ...] = self.ask("between", frame, relative_to)
        return result

    def resolve(self, expression: Expression) -> Expression:
        result: Expression = self.ask("resolve", expression)
        return result

    def carry(self, expression: Expression) -> Expression:
        result: Expression = self.ask("carry", expression)
        return result


class _TracedData(Mapping[str, Any]):
    """One kind of data by name; reading is a question."""

    def __init__(self, reader: _TracedReader, kind: str) -> None:
        self._reader = reader
        self._kind = kind

    def __getitem__(self, name: str) -> Any:
        try:
            return self._reader.ask(OF_KIND[self._kind], name)
        except UnknownNameError:
            self._reader.ask("exists", self._kind, name)
            raise

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and bool(self._reader.ask("exists", self._kind, name))

    def __iter__(self) -> Iterator[str]:
        return iter(self._reader.ask("names", self._kind))

    def __len__(self) -> int:
        return len(self._reader.ask("names", self._kind))


def _detached(expression: Expression) -> Expression:
    """Return an expression whose places stand for nothing any more, and are the same in every process."""
    result = filled(expression, lambda a: Answer.empty(a.shape, a.question, a.part, a.path))
    if any(answer.arguments for answer in answers_in(result)):
        raise UntraceableError("what it read is inside of an implicit function")
    return result


def _apart(question: Question) -> Question:
    arguments = (_detached(a) if isinstance(a, Expression) else a for a in question.arguments)
    return Question(question.kind, tuple(arguments))


def _alike(kind: str, a: Any, b: Any) -> bool:
    """Whether two written values are equal, but for rounding."""
    if a == b:
        return True
    if kind == FRAMES:
        return a.parent == b.parent and _close(a.transform, b.transform)
    one, other = expressions_in(kind, a), expressions_in(kind, b)
    if len(one) != len(other) or mapped(kind, a, _nothing) != mapped(kind, b, _nothing):
        return False
    return all(map(_close, one, other))


def _nothing(_: Expression) -> float:
    return 0.0


def _close(a: Expression, b: Expression) -> bool:
    """Whether two expressions and their gradients agree at a few states."""
    if a == b:
        return True
    if a.shape != b.shape or answers_in(a):
        return False
    random = np.random.default_rng(_SEED)
    gradients = [(a.gradient(h), b.gradient(h)) for h in (True, False)]
    pairs = [(a, b), *((x[key], y[key]) for x, y in gradients for key in x if key in y)]
    if any(set(x) != set(y) for x, y in gradients):
        return False
    symbols = {s for pair in pairs for e in pair for s in e.symbols}
    for _ in range(_SAMPLES):
        at = {s: random.uniform(-1, 1) for s in sorted(symbols, key=lambda s: s.sort_key)}
        if not all(np.allclose(x(at), y(at), 1e-9, 1e-12, equal_nan=True) for x, y in pairs):
            return False
    return True
