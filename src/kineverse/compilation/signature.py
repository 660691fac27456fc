"""Inputs of a compiled function: the order of symbols, and conversion of values to a vector."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from kineverse._checks import real_number
from kineverse.errors import (
    DuplicateNameError,
    ExpressionError,
    InvalidValueError,
    ShapeError,
    UnknownNameError,
    duplicate_value_error,
    suggest,
)
from kineverse.expressions import Expression
from kineverse.lie import Array
from kineverse.state import State
from kineverse.symbols import Symbol

_LISTED = 12


class Signature:
    """The inputs of a function."""

    def __init__(self, inputs: tuple[Symbol, ...]) -> None:
        self.inputs = inputs
        self.names = tuple(map(str, inputs))
        self.size = len(inputs)
        self._positions: dict[Any, int] | None = None

    @property
    def positions(self) -> dict[Any, int]:
        """The place of each symbol and of each name in the vector."""
        if self._positions is None:
            self._positions = {key: i for keys in (self.names, self.inputs) for i, key in enumerate(keys)}
        return self._positions

    def vector(self, x: Any) -> Array:
        """Return the numbers of all inputs as a contiguous vector, shape (n,)."""
        if isinstance(x, State):  # which may have more symbols
            return x.vector(self.inputs)
        if isinstance(x, Mapping):
            return self._from_mapping(x)
        if self.size and isinstance(x, tuple) and not x:
            raise ShapeError(f"Nothing is given; a call takes a vector of {self._described()}, or a mapping.")
        array = as_doubles(x, f"a vector of {self._described()}")
        if array.shape != (self.size,):
            raise ShapeError(
                f"Expected a vector of {self._described()}, not an array of shape {array.shape}."
            )
        return np.ascontiguousarray(array) if array.flags.aligned else array.copy()

    def _from_mapping(self, values: Mapping[Any, Any]) -> Array:
        positions = self.positions
        vector = [s.value for s in self.inputs]
        unknown = []
        given = set()
        for key, value in values.items():
            position = positions.get(key)
            if position is None:
                unknown.append(str(key))
                continue
            if position in given:
                raise duplicate_value_error(self.names[position])
            given.add(position)
            vector[position] = self._number(position, value)
        # A mapping is written for this function, so unknown names are mistakes.
        if unknown:
            raise UnknownNameError(
                f"Not among the inputs: {name_list(unknown)}. {suggest(unknown[0], self.names, 'input')}"
            )
        missing = [name for name, value in zip(self.names, vector, strict=True) if value is None]
        if missing:
            raise UnknownNameError(f"No value is given for {name_list(missing)}.")
        return np.array(vector, dtype=np.float64)

    def _number(self, position: int, value: Any) -> float:
        try:
            number = real_number(value)
        except (TypeError, ValueError, OverflowError, ExpressionError):
            raise InvalidValueError(
                f"The value of '{self.names[position]}' is not a number: {value!r}."
            ) from None
        if number != number:
            raise InvalidValueError(f"The value of '{self.names[position]}' is NaN.")
        return number

    def _described(self) -> str:
        return f"{self.size} numbers ({name_list(self.names, 6)})" if self.size else "no numbers"


def make_signature(
    outputs: Sequence[Expression], inputs: Iterable[Symbol] | None, call: str = "compile(outputs, inputs)"
) -> Signature:
    """Return the signature of a function of ``outputs``; ``call`` is that of the caller, for errors."""
    needed = set().union(*(e.symbols for e in outputs))
    if inputs is None:
        result = Signature(tuple(sorted(needed, key=lambda s: s.sort_key)))
    else:
        result = Signature(_symbols(inputs, call))
        missing = needed.difference(result.inputs)
        if missing:
            names = sorted(str(s) for s in missing)
            raise UnknownNameError(
                f"The outputs depend on symbols that are not among the inputs: {name_list(names)}."
            )
    if len(set(result.names)) < result.size:
        names = sorted({n for n in result.names if result.names.count(n) > 1})
        equal = len(set(result.inputs)) < result.size
        reason = "given twice" if equal else "the name of several symbols (of different roles or values)"
        raise DuplicateNameError(
            f"The inputs of a function have names of their own: {name_list(names)} is {reason}."
        )
    return result


def as_doubles(x: Any, wanted: str) -> Array:
    """Return real numbers as an array of doubles, of any shape and strides."""
    if type(x) is not np.ndarray and isinstance(x, np.ndarray) and isinstance(x, np.ma.MaskedArray):
        raise ShapeError(
            f"Expected {wanted}, not a masked array, some of whose entries have no value. Write "
            "x.filled(number) to give them one."
        )
    try:
        array = np.asarray(x)
    except (TypeError, ValueError):
        raise ShapeError(
            f"Expected {wanted}, not a {type(x).__name__} of entries that form no array."
        ) from None
    if array.dtype.kind not in "fiub":
        kind = type(x).__name__ if array.dtype.kind == "O" else f"{type(x).__name__} of {array.dtype}"
        raise ShapeError(f"Expected {wanted}, not a {kind}.")
    return array.astype(np.float64, copy=False)


def _symbols(inputs: Iterable[Symbol], call: str) -> tuple[Symbol, ...]:
    question = f"Were outputs and inputs swapped? It is {call}."
    if isinstance(inputs, Symbol):
        raise ExpressionError(f"Inputs are a sequence of symbols: write [{inputs}] for only one. {question}")
    if isinstance(inputs, (Expression, str)) or not isinstance(inputs, Iterable):
        raise ExpressionError(f"Inputs are a sequence of symbols, not {_brief(inputs)}. {question}")
    symbols = tuple(inputs)
    for symbol in symbols:
        if not isinstance(symbol, Symbol):
            raise ExpressionError(f"Inputs have to be symbols, not {_brief(symbol)}. {question}")
    return symbols


def _brief(value: object) -> str:
    if isinstance(value, Expression):
        return f"an expression of shape {value.shape}"
    text = repr(value)
    return text if len(text) <= 60 else f"a {type(value).__name__}"


def name_list(names: Sequence[str], limit: int = _LISTED) -> str:
    """Return names for an error, the first of them if they are many."""
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(f"'{n}'" for n in names[:limit]) + more
