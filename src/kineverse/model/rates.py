"""Rates of coordinates as linear functions of speeds, q̇ = R(q) u.

A coordinate x without a row is free, ``{ẋ: 1}``. A row ``{v: expression}`` stands for ``ẋ = Σ expression·v``,
as for the wheels of a differential drive or the angular velocity of a quaternion. In the expressions of a
model such coordinates are *carried*: an opaque node with the value x and the row as gradient. So every
gradient is in terms of the wheels.

A coordinate may also *depend* on others, as the angles of a closed loop on its crank. Then its entry is an
expression, which replaces the coordinate in the expressions of the model, with its gradient.

Rows contain carried coordinates themselves, because accelerations need the rate of the heading in a wheel's
row. This may be circular: the rate of a quaternion is a function of the quaternion. A carried coordinate
therefore refers to its table and unfolds one derivative at a time.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

from kineverse.errors import InvalidValueError, ModelError, UnknownNameError, suggest
from kineverse.expressions.expression import Expression, ExpressionLike, as_expression
from kineverse.expressions.substitution import apply_substitution
from kineverse.symbols import Symbol

from .display import as_html, as_lines
from .rate_nodes import (
    Carried,
    Dependent,
    collect_symbols,
    to_plain,
)

if TYPE_CHECKING:
    pass

RateRow: TypeAlias = tuple[tuple[Symbol, Expression], ...]
RateEntry: TypeAlias = RateRow | Expression


def as_entry(coordinate: Symbol, value: Mapping[Symbol, ExpressionLike] | ExpressionLike) -> RateEntry:
    """Return the row, or the expression of a dependent coordinate, in plain coordinates."""
    if isinstance(value, Mapping):
        return as_row(coordinate, value)
    _check_coordinate(coordinate)
    expression = to_plain(as_expression(value))
    if expression.shape:
        raise InvalidValueError(f"'{coordinate}' is a scalar, and not of shape {expression.shape}.")
    moving = [str(s) for s in expression.symbols if s.order]
    if moving:
        raise InvalidValueError(f"'{coordinate}' depends on positions, and not on {', '.join(moving)}.")
    return expression


def _check_coordinate(coordinate: Symbol) -> None:
    if not isinstance(coordinate, Symbol) or coordinate.order or not coordinate.has_derivative:
        raise ModelError(f"Only positions have a rate, and '{coordinate}' is none.")


def as_row(coordinate: Symbol, row: Mapping[Symbol, ExpressionLike]) -> RateRow:
    """Return a row in canonical order and plain coordinates."""
    _check_coordinate(coordinate)
    if not isinstance(row, Mapping):
        raise ModelError(f"The rate of '{coordinate}' is a mapping {{speed: expression}}, not {row!r}.")
    entries = []
    for speed, value in row.items():
        if not isinstance(speed, Symbol) or speed.order != 1:
            raise ModelError(f"The rate of '{coordinate}' has velocities as keys, not '{speed}'.")
        entry = to_plain(as_expression(value))
        if entry.shape:
            raise InvalidValueError(
                f"The rate of '{coordinate}' by '{speed}' is a scalar, not {entry.shape}."
            )
        entries.append((speed, entry))
    return tuple(sorted(entries, key=lambda item: item[0].sort_key))


class Rates(Mapping[Symbol, Mapping[Symbol, Expression]]):
    """Immutable rate table: rows over free speeds by driven coordinate, in plain coordinates.

    Speeds of coordinates with entries of their own are resolved in all rows. Dependent coordinates are not in
    the mapping; :meth:`row` returns their rows as well.

    Attributes
    ----------
    dependent
        Expressions of the dependent coordinates, in independent plain coordinates.

    Raises
    ------
    ModelError
        For cyclic rows and cyclic dependent coordinates, with the cycle.
    """

    dependent: Mapping[Symbol, Expression]

    def __init__(self, entries: Mapping[Symbol, RateEntry]) -> None:
        self._given = dict(entries)
        self._rows: dict[Symbol, dict[Symbol, Expression]] = {}
        self._carried: dict[Symbol, Expression] = {}
        expressions = {x: e for x, e in self._given.items() if isinstance(e, Expression)}
        self.dependent = dict[Symbol, Expression]()
        # Symbols of overridden gradients count, because these are carried as well.
        made_of = {
            x: sorted(collect_symbols(e) & expressions.keys(), key=str) for x, e in expressions.items()
        }
        for x in _sort_topologically(expressions, made_of.__getitem__, _DEPENDING):
            self.dependent[x] = self.resolve(expressions[x])
        rows = {x: self._expand(e) for x, e in self._given.items() if not isinstance(e, Expression)}
        paths = {x.path for x in rows}

        def through(x: Symbol) -> list[Symbol]:
            return [v.position for v, _ in rows[x] if v.path in paths and v.position in rows]

        for x in _sort_topologically(rows, through, _CYCLIC):
            self._rows[x] = self._combine(rows[x])

    def _expand(self, row: RateRow) -> RateRow:
        """Return a row in terms of independent coordinates."""
        if not self.dependent:
            return row
        result: dict[Symbol, Expression] = {}
        for speed, factor in row:
            factor = self.resolve(factor)
            itself = self.dependent.get(speed.position)
            gradient = {speed: as_expression(1.0)} if itself is None else itself.gradient(False)
            _add(result, {v: factor * g for v, g in gradient.items()})
        return tuple(result.items())

    def _combine(self, row: Iterable[tuple[Symbol, Expression]]) -> dict[Symbol, Expression]:
        """Return a row over free speeds."""
        result: dict[Symbol, Expression] = {}
        for speed, factor in row:
            inner: Mapping[Symbol, ExpressionLike] = self._rows.get(speed.position, {speed: 1.0})
            _add(result, {free: factor * rate for free, rate in inner.items()})
        return dict(sorted(result.items(), key=lambda item: item[0].sort_key))

    def resolve(self, expression: Expression) -> Expression:
        """Return an expression in independent plain coordinates."""
        wanted = {s: self.dependent[s] for s in collect_symbols(expression) if s in self.dependent}
        return apply_substitution(expression, wanted)

    def row(self, coordinate: Symbol | str) -> Mapping[Symbol, Expression] | None:
        """Return the row of a coordinate over free speeds, in plain coordinates; None if it is free."""
        if isinstance(coordinate, str):
            named = {str(symbol): symbol for symbol in (*self._rows, *self.dependent)}
            if coordinate not in named:
                return None
            coordinate = named[coordinate]
        itself = self.dependent.get(coordinate)
        if itself is not None:
            return self._combine(itself.gradient(False).items())
        return self._rows.get(coordinate)

    @property
    def is_empty(self) -> bool:
        """True if all coordinates are free."""
        return not self._given

    def __getitem__(self, coordinate: Symbol | str) -> Mapping[Symbol, Expression]:
        row: Mapping[Symbol, Expression] | None = self.get(coordinate)
        if row is not None:
            return row
        name = str(coordinate)
        if name in map(str, self.dependent):
            raise UnknownNameError(
                f"'{name}' has no row, because it depends on other coordinates: see rates.dependent and "
                "rates.row(coordinate)."
            )
        if not self._rows:
            raise UnknownNameError(f"'{name}' has no row: every coordinate moves freely, by its own speed.")
        raise UnknownNameError(
            f"There is no rate {name!r}; a coordinate without one moves freely, by its own speed. "
            f"{suggest(name, map(str, self._rows), 'rate')}"
        )

    def get(self, coordinate: object, default: Any = None) -> Any:
        """Return the row of a coordinate, by symbol or name, or the default."""
        if isinstance(coordinate, str):
            return self._by_name.get(coordinate, default)
        return self._rows.get(coordinate, default)  # type: ignore[call-overload]

    def __contains__(self, coordinate: object) -> bool:
        return coordinate in (self._by_name if isinstance(coordinate, str) else self._rows)

    @cached_property
    def _by_name(self) -> dict[str, Mapping[Symbol, Expression]]:
        return {str(coordinate): row for coordinate, row in self._rows.items()}

    def __iter__(self) -> Iterator[Symbol]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def __repr__(self) -> str:
        return as_lines(self._title, self._by_name.items(), len(self))

    def _repr_html_(self) -> str:
        return as_html(self._title, self._by_name.items(), len(self))

    @property
    def _title(self) -> str:
        beside = f" and {len(self.dependent)} dependent coordinates" if self.dependent else ""
        return f"{len(self)} rates{beside}"

    def __eq__(self, other: object) -> bool:
        return self.key == other.key if isinstance(other, Rates) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.key)

    def closure(self, coordinate: Symbol) -> Rates:
        """Return the part of the table that the row of one coordinate depends on."""
        wanted, found = [coordinate], set[Symbol]()
        while wanted:
            x = wanted.pop()
            if x in found:
                continue
            found.add(x)
            for value in self._rows[x].values():
                wanted += [s for s in collect_symbols(value) if s in self._rows]
        return Rates({x: tuple(self._rows[x].items()) for x in sorted(found, key=lambda s: s.sort_key)})

    @cached_property
    def key(self) -> bytes:
        """Digest of the content, equal in every process."""
        digest = hashlib.blake2b(digest_size=16)
        for x in sorted(self._given, key=lambda s: s.sort_key):
            digest.update(repr(x.sort_key).encode())
            entry = self._given[x]
            if isinstance(entry, Expression):
                digest.update(entry.key)
                continue
            for speed, value in entry:
                digest.update(repr(speed.sort_key).encode() + value.key)
        return digest.digest()

    @cached_property
    def symbols(self) -> frozenset[Symbol]:
        """Driven coordinates, symbols of rows, and coordinates of speeds."""
        found = set(self._rows)
        for row in self._rows.values():
            for speed, value in row.items():
                found |= {speed, speed.position, *collect_symbols(value)}
        return frozenset(found)

    def carried(self, coordinate: Symbol) -> Expression:
        """Return the carried form of a coordinate in the table."""
        known = self._carried.get(coordinate)
        if known is None:
            if coordinate in self._rows:
                known = Carried.from_arguments((coordinate,), (), (self.closure(coordinate),))
            else:
                known = Dependent.from_arguments((self.carry(self.dependent[coordinate]),), (), (coordinate,))
            self._carried[coordinate] = known
        return known

    def carry(self, expression: Expression) -> Expression:
        """Return the expression in carried coordinates; the function is idempotent."""
        if not self._given:
            return expression
        expression = to_plain(expression)
        wanted = {
            s: self.carried(s) for s in collect_symbols(expression) if s in self._rows or s in self.dependent
        }
        return apply_substitution(expression, wanted)

    def over_free_speeds(self, gradient: Mapping[Symbol, Expression]) -> dict[Symbol, Expression]:
        """Return a gradient D(e) with the speeds of driven and dependent coordinates eliminated.

        The result has the coefficients of the rate ``ė = Σ coefficient·v`` by free speed v: the columns of a
        task Jacobian, wheels included. It has no zero entries that the gradient lacks.

        Parameters
        ----------
        gradient
            Gradient of an expression: ``e.gradient(heuristic=False)`` for its rate.
        """
        result: dict[Symbol, Expression] = {}
        for key, entry in gradient.items():
            row = self.row(key.position) if key.order == 1 else None
            terms = {key: entry} if row is None else {v: entry * self.carry(g) for v, g in row.items()}
            _add(result, terms)
        return result

    def eliminate(self, expression: Expression) -> Expression:
        """Replace every remaining ẋ in an expression by ``Σ R[x][v]·v``."""
        wanted = {}
        for s in expression.symbols:
            row = self.row(s.position) if s.order == 1 else None
            if row is not None:
                wanted[s] = sum((self.carry(g) * v for v, g in row.items()), as_expression(0.0))
        return apply_substitution(expression, wanted)

    def __reduce__(self) -> tuple[type[Rates], tuple[dict[Symbol, RateEntry]]]:
        return Rates, (self._given,)


_CYCLIC = "Cyclic rates, which never end in a free speed"
_DEPENDING = "Coordinates that depend on themselves"


def _sort_topologically(
    coordinates: Iterable[Symbol], through: Callable[[Symbol], list[Symbol]], problem: str
) -> Iterator[Symbol]:
    """Yield coordinates in topological order; raise for a cycle."""
    done: set[Symbol] = set()
    for coordinate in coordinates:
        # Iterative search, because chains may be longer than Python's stack.
        path = {} if coordinate in done else {coordinate: None}
        while path:
            x = next(reversed(path))
            waiting = next((y for y in through(x) if y not in done), None)
            if waiting is None:
                yield x
                done.add(x)
                del path[x]
            elif waiting in path:
                names = [str(y) for y in path]
                circle = " -> ".join([*names[names.index(str(waiting)) :], str(waiting)])
                raise ModelError(f"{problem}: {circle}.")
            else:
                path[waiting] = None


def _add(row: dict[Symbol, Expression], terms: Mapping[Symbol, Expression]) -> None:
    for speed, term in terms.items():
        row[speed] = row[speed] + term if speed in row else term
