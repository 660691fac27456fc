"""A reader that turns every look into a question."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from kineverse.errors import UnknownNameError
from kineverse.expressions.expression import Expression
from kineverse.model.body import Pose
from kineverse.model.frame import WORLD, Frame
from kineverse.model.operation import FRAMES
from kineverse.model.reader import Reader, Reads
from kineverse.symbols import Symbol

from .question import OF_KIND


class AskingReader(Reader, ABC):
    """The model before an operation, for code that is to be followed in what it reads.

    Attributes
    ----------
    model
        The model itself.
    done
        Whether the code has run; who looks at its writes then is the same for all.
    """

    def __init__(self, model: Reader) -> None:
        super().__init__(model._value_at, model._names_at, Reads())
        self.model = model
        self.done = False

    @abstractmethod
    def ask(self, kind: str, *arguments: Any) -> Any:
        """Return the answer to a question, see :data:`.question.KINDS`."""

    def by_kind(self, kind: str) -> Mapping[str, Any]:
        """Return one kind of data by name."""
        return _AskedData(self, kind)

    def fk(self, frame: str, relative_to: str = WORLD) -> Expression:
        """Ask where a frame is in another."""
        result: Expression = self.ask("fk", frame, relative_to)
        return result

    def coordinates_between(self, frame: str, relative_to: str = WORLD) -> tuple[Symbol, ...]:
        """Ask which coordinates move a frame relative to another."""
        result: tuple[Symbol, ...] = self.ask("between", frame, relative_to)
        return result

    def resolve(self, expression: Expression) -> Expression:
        """Ask for an expression without coordinates that depend on others."""
        result: Expression = self.ask("resolve", expression)
        return result

    def carry(self, expression: Expression) -> Expression:
        """Ask for an expression with coordinates carried by their rates."""
        result: Expression = self.ask("carry", expression)
        return result


class _AskedData(Mapping[str, Any]):
    """One kind of data by name; reading is a question."""

    def __init__(self, reader: AskingReader, kind: str) -> None:
        self._reader = reader
        self._kind = kind

    def __getitem__(self, name: str) -> Any:
        answer = self._reader.ask(OF_KIND[self._kind], name)
        return _with_factors(answer, self._reader, name) if self._kind == FRAMES else answer

    def get(self, name: str, default: Any = None) -> Any:
        try:
            return self[name]
        except UnknownNameError:
            return default

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and bool(self._reader.ask("exists", self._kind, name))

    def __iter__(self) -> Iterator[str]:
        return iter(self._reader.ask("names", self._kind))

    def __len__(self) -> int:
        return len(self._reader.ask("names", self._kind))


def _with_factors(frame: Frame, reader: AskingReader, name: str) -> Frame:
    """Return a frame of one factor whose own are asked for by whoever wants to see them."""
    result = replace(frame, factors=_Factors(frame.factors, reader, name))
    vars(result)["transform"] = frame.transform  # a cached property, or it would ask for the factors
    return result


class _Factors(tuple["Pose | Expression", ...]):
    """The factors of a frame, of which most code only wants the product."""

    _reader: AskingReader
    _name: str

    def __new__(cls, product: tuple[Pose | Expression, ...], reader: AskingReader, name: str) -> _Factors:
        result = super().__new__(cls, product)
        result._reader, result._name = reader, name
        return result

    def _asked(self) -> tuple[Pose | Expression, ...]:
        if self._reader.done:
            return tuple(super().__iter__())
        result: tuple[Pose | Expression, ...] = self._reader.ask("factors", self._name)
        return result

    def __len__(self) -> int:
        return len(self._asked())

    def __iter__(self) -> Iterator[Pose | Expression]:
        return iter(self._asked())

    def __getitem__(self, key: Any) -> Any:
        return self._asked()[key]

    def __eq__(self, other: object) -> bool:
        return self._asked() == other

    def __hash__(self) -> int:
        return hash(self._asked())
