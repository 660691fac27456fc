"""Constraints relevant for an expression, and the symbols of a model.

An index from coordinates to constraints makes the cost of a query proportional to its result, independent of
the size of the model.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from kineverse.errors import ExpressionError
from kineverse.expressions.expression import Expression
from kineverse.symbols import Symbol

from .constraint import Constraint, coordinates
from .frame import Frame


class Relevance:
    """Index of constraints by the coordinates of their expressions and bounds."""

    def __init__(self, dependent: Mapping[Symbol, Expression]) -> None:
        # A limit on a dependent coordinate limits the coordinates that determine it.
        self._behind = {x.path: {s.path for s in e.symbols} for x, e in dependent.items()}
        self._by_expression: defaultdict[str, dict[str, None]] = defaultdict(dict)
        self._by_bounds: defaultdict[str, dict[str, None]] = defaultdict(dict)
        self._alone: defaultdict[Symbol, dict[str, None]] = defaultdict(dict)
        self._lines: defaultdict[Symbol, dict[str, None]] = defaultdict(dict)

    def add(self, name: str, constraint: Constraint) -> None:
        """Add a constraint to the index."""
        for names in self._groups(constraint):
            names[name] = None

    def remove(self, name: str, constraint: Constraint) -> None:
        """Remove a constraint from the index."""
        for names in self._groups(constraint):
            names.pop(name, None)

    def _groups(self, constraint: Constraint) -> Iterator[dict[str, None]]:
        """Yield the names under which a constraint is found."""
        symbols = constraint.expression.symbols
        for path in self._with_behind({s.path for s in symbols}):
            yield self._by_expression[path]
        bounds = (constraint.lower, constraint.upper)
        for path in self._with_behind({s.path for bound in bounds for s in bound.symbols}):
            yield self._by_bounds[path]
        if isinstance(constraint.expression, Symbol):
            yield self._alone[constraint.expression]
        elif len(symbols) == 1:
            yield self._lines[symbols[0]]

    def _with_behind(self, paths: set[str]) -> set[str]:
        return paths.union(*(self._behind.get(path, ()) for path in paths)) if self._behind else paths

    def on(self, symbol: Symbol) -> list[str]:
        """Return the names of the constraints whose expression is this symbol."""
        return list(self._alone.get(symbol, ()))

    def about(self, symbol: Symbol) -> list[str]:
        """Return the names of the constraints whose expression has this symbol and no other."""
        return [*self._alone.get(symbol, ()), *self._lines.get(symbol, ())]

    def find(
        self,
        subject: Expression | Iterable[Symbol | Expression],
        constraints: Mapping[str, Constraint],
        *,
        exact: bool,
        bounds: bool,
        closure: bool,
    ) -> list[str]:
        """Return the names of relevant constraints, sorted; see :meth:`.Model.constraints_for`."""
        if isinstance(subject, Expression) or not isinstance(subject, Iterable):
            subject = [subject]
        expressions = list(subject)
        for expression in expressions:
            if not isinstance(expression, Expression):
                raise ExpressionError(
                    f"Constraints are found for expressions or symbols, not for {expression!r}."
                )
        if exact:
            symbols = {s for e in expressions for s in e.symbols}
            return self._exact(symbols, constraints, bounds, closure)
        found: dict[str, None] = {}
        wanted = list(self._with_behind(set(coordinates(*expressions))))
        seen = set(wanted)
        while wanted:
            path = wanted.pop()
            new = dict(self._by_expression.get(path, ()))
            if bounds:
                new.update(self._by_bounds.get(path, ()))
            if closure:
                for name in new.keys() - found.keys():
                    c = constraints[name]
                    parts = (c.lower, c.expression, c.upper) if bounds else (c.expression,)
                    fresh = coordinates(*parts) - seen
                    seen |= fresh
                    wanted += fresh
            found.update(new)
        return sorted(found)

    def _exact(
        self, symbols: set[Symbol], constraints: Mapping[str, Constraint], bounds: bool, closure: bool
    ) -> list[str]:
        found: set[str] = set()
        while True:
            names: set[str] = set()
            for path in {s.path for s in symbols}:
                names |= self._by_expression.get(path, {}).keys()
                if bounds:
                    names |= self._by_bounds.get(path, {}).keys()
            about = {n: constraints[n] if bounds else constraints[n].expression for n in names - found}
            new = {name for name, part in about.items() if not symbols.isdisjoint(part.symbols)}
            found |= new
            if not closure or not new:
                return sorted(found)
            symbols = symbols.union(*(about[name].symbols for name in new))


class SymbolIndex:
    """Symbols of the frames and constraints of a model, with counts for incremental updates."""

    def __init__(self) -> None:
        self._count: dict[Symbol, int] = {}

    def add(self, value: Any, sign: int) -> None:
        """Count the symbols of a value that is added (1) or removed (-1)."""
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
    return {s for factor in value.factors if isinstance(factor, Expression) for s in factor.symbols}
