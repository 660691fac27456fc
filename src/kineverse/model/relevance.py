"""Constraints relevant for an expression, and the symbols of a model.

An index from coordinates to constraints makes the cost of a query proportional to its result, independent of
the size of the model.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
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
        self._alone: dict[Symbol, dict[str, None]] = {}
        self._lines: dict[Symbol, dict[str, None]] = {}

    def add(self, name: str, constraint: Constraint) -> None:
        """Add a constraint to the index."""
        for path in self._paths(constraint):
            self._by_expression[path][name] = None
        for path in self._with_behind(_bounds(constraint)):
            self._by_bounds[path][name] = None
        if isinstance(constraint.expression, Symbol):
            self._alone.setdefault(constraint.expression, {})[name] = None
        elif len(constraint.expression.symbols) == 1:
            self._lines.setdefault(constraint.expression.symbols[0], {})[name] = None

    def remove(self, name: str, constraint: Constraint) -> None:
        """Remove a constraint from the index."""
        for path in self._paths(constraint):
            self._by_expression[path].pop(name, None)
        for path in self._with_behind(_bounds(constraint)):
            self._by_bounds[path].pop(name, None)
        if isinstance(constraint.expression, Symbol):
            self._alone.get(constraint.expression, {}).pop(name, None)
        elif len(constraint.expression.symbols) == 1:
            self._lines.get(constraint.expression.symbols[0], {}).pop(name, None)

    def _paths(self, constraint: Constraint) -> set[str]:
        return self._with_behind({s.path for s in constraint.expression.symbols})

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
            new = set()
            for name in names - found:
                c = constraints[name]
                if not symbols.isdisjoint(c.symbols if bounds else c.expression.symbols):
                    new.add(name)
            found |= new
            if not closure or not new:
                return sorted(found)
            for name in new:
                c = constraints[name]
                symbols = symbols | set(c.symbols if bounds else c.expression.symbols)


def _bounds(constraint: Constraint) -> set[str]:
    return {s.path for bound in (constraint.lower, constraint.upper) for s in bound.symbols}


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
    result: set[Symbol] = set()
    for factor in value.factors:
        if isinstance(factor, Expression):
            result.update(factor.symbols)
    return result
