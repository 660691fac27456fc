"""Which symbols a model is about."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from kineverse.expressions.expression import Expression
from kineverse.symbols import Symbol

from .constraint import Constraint
from .frame import Frame


class SymbolIndex:
    """Which symbols the values of a model are about, counted so that changes are cheap."""

    def __init__(self) -> None:
        self._count: dict[Symbol, int] = {}

    def add(self, value: Any, sign: int) -> None:
        """Count the symbols of a value, which comes (1) or goes (-1)."""
        for symbol in _symbols_of(value):
            count = self._count.get(symbol, 0) + sign
            if count:
                self._count[symbol] = count
            else:
                del self._count[symbol]

    def sorted(self) -> tuple[Symbol, ...]:
        """Return the symbols in their order."""
        return tuple(sorted(self._count, key=lambda s: s.sort_key))


def _symbols_of(value: Frame | Constraint) -> Iterable[Symbol]:
    if isinstance(value, Constraint):
        return value.symbols
    found: set[Symbol] = set()
    for factor in value.factors:
        if isinstance(factor, Expression):
            found.update(factor.symbols)
    return found
