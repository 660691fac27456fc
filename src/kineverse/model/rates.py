"""Rates: how coordinates move with speeds, q̇ = R(q) u.

A coordinate x without a row is free, ``{ẋ: 1}``. A row ``{v: expression}`` says ``ẋ = Σ expression·v``: the
wheels of a differential drive, the angular velocity of a quaternion. What a model hands out has such
coordinates *carried*: each is an opaque node whose value is x and whose gradient is its row, so every
gradient shows the wheels.

Rows use the carried coordinates themselves (the heading in a wheel's row turns, or accelerations are wrong),
which may well be circular: a quaternion's rate is made of the quaternion. A carried coordinate therefore
refers to its table and unfolds one derivative at a time.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import TYPE_CHECKING

from kineverse.errors import ModelError, ValueRejectedError
from kineverse.expressions.expression import Expression, ExpressionLike, as_expression
from kineverse.expressions.leaves import leaves
from kineverse.expressions.node import Node
from kineverse.expressions.substitution import apply, compose_gradient, replace_nodes
from kineverse.symbols import Symbol

if TYPE_CHECKING:
    from kineverse.expressions.substitution import Substitution

Row = tuple[tuple[Symbol, Expression], ...]


def as_row(coordinate: Symbol, row: Mapping[Symbol, ExpressionLike]) -> Row:
    """Return a row in canonical order, carried coordinates put back to plain ones.

    Raises
    ------
    ModelError
        If the coordinate is not a position, or a key not a velocity.
    """
    if not isinstance(coordinate, Symbol) or coordinate.order or not coordinate.has_derivative:
        raise ModelError(f"Only positions have a rate, and '{coordinate}' is none.")
    if not isinstance(row, Mapping):
        raise ModelError(f"The rate of '{coordinate}' is a mapping {{speed: expression}}, not {row!r}.")
    entries = []
    for speed, value in row.items():
        if not isinstance(speed, Symbol) or speed.order != 1:
            raise ModelError(f"The rate of '{coordinate}' has velocities as keys, not '{speed}'.")
        entry = plain(as_expression(value))
        if entry.shape:
            raise ValueRejectedError(
                f"The rate of '{coordinate}' by '{speed}' is a scalar, not {entry.shape}."
            )
        entries.append((speed, entry))
    return tuple(sorted(entries, key=lambda item: item[0].sort_key))


class Rates(Mapping[Symbol, Mapping[Symbol, Expression]]):
    """An immutable rate table: from coordinates to rows over free speeds, in plain coordinates.

    Rows that name the speed of a coordinate which has a row itself are resolved through it.

    Raises
    ------
    ModelError
        For rows that never end in free speeds, with the circle of coordinates.
    """

    def __init__(self, rows: Mapping[Symbol, Row]) -> None:
        self._given = dict(rows)
        self._rows: dict[Symbol, dict[Symbol, Expression]] = {}
        self._carried: dict[Symbol, Expression] = {}
        self._paths = {x.path for x in self._given}
        for coordinate in self._given:
            self._resolve(coordinate)

    def _resolve(self, coordinate: Symbol) -> None:
        # A path through the rows, by hand: chains may be longer than Python's stack.
        path = {coordinate: None}
        while path:
            x = next(reversed(path))
            row = self._given[x]
            through = [v.position for v, _ in row if v.path in self._paths and v.position in self._given]
            waiting = next((y for y in through if y not in self._rows), None)
            if waiting is None:
                self._rows[x] = self._combined(row) if through else dict(row)
                del path[x]
            elif waiting in path:
                names = [str(y) for y in path]
                circle = " -> ".join([*names[names.index(str(waiting)) :], str(waiting)])
                raise ModelError(f"Cyclic rates, which never end in a free speed: {circle}.")
            else:
                path[waiting] = None

    def _combined(self, row: Row) -> dict[Symbol, Expression]:
        result: dict[Symbol, Expression] = {}
        for speed, factor in row:
            inner: Mapping[Symbol, ExpressionLike] = self._rows.get(speed.position, {speed: 1.0})
            for free, rate in inner.items():
                term = factor * rate
                result[free] = result[free] + term if free in result else term
        return result

    def __getitem__(self, coordinate: Symbol) -> Mapping[Symbol, Expression]:
        return self._rows[coordinate]

    def __iter__(self) -> Iterator[Symbol]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def __eq__(self, other: object) -> bool:
        return self.key == other.key if isinstance(other, Rates) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.key)

    def closure(self, coordinate: Symbol) -> Rates:
        """Return the part of the table that the row of one coordinate is made of."""
        wanted, found = [coordinate], set[Symbol]()
        while wanted:
            x = wanted.pop()
            if x in found:
                continue
            found.add(x)
            for speed, value in self._given[x]:
                wanted += [s for s in (*all_symbols(value), speed.position) if s in self._given]
        return Rates({x: self._given[x] for x in sorted(found, key=lambda s: s.sort_key)})

    @cached_property
    def key(self) -> bytes:
        """A digest of the content, the same in every process."""
        digest = hashlib.blake2b(digest_size=16)
        for x in sorted(self._given, key=lambda s: s.sort_key):
            digest.update(repr(x.sort_key).encode())
            for speed, value in self._given[x]:
                digest.update(repr(speed.sort_key).encode() + value.key)
        return digest.digest()

    @cached_property
    def symbols(self) -> frozenset[Symbol]:
        """Every coordinate, every symbol of a row, and the coordinates of the speeds."""
        found = set(self._rows)
        for row in self._rows.values():
            for speed, value in row.items():
                found |= {speed, speed.position, *all_symbols(value)}
        return frozenset(found)

    def carried(self, coordinate: Symbol) -> Expression:
        """Return the carried form of a coordinate in the table."""
        known = self._carried.get(coordinate)
        if known is None:
            known = self._carried[coordinate] = Carried.of((coordinate,), (), (self.closure(coordinate),))
        return known

    def carry(self, expression: Expression) -> Expression:
        """Return the expression in carried coordinates; carried twice is carried once."""
        if not self._rows:
            return expression
        expression = plain(expression)
        wanted = {s: self.carried(s) for s in all_symbols(expression) if s in self._rows}
        return apply(expression, wanted)

    def eliminate(self, expression: Expression) -> Expression:
        """Return the expression with every left-over ẋ replaced by ``Σ R[x][v]·v``."""
        wanted = {
            s: sum((self.carry(g) * v for v, g in self._rows[s.position].items()), as_expression(0.0))
            for s in expression.symbols
            if s.order == 1 and s.position in self._rows
        }
        return apply(expression, wanted)

    def __reduce__(self) -> tuple[type[Rates], tuple[dict[Symbol, Row]]]:
        return Rates, (self._given,)


class Carried(Node):
    """A coordinate whose gradient is its row."""

    __slots__ = ()
    kind = "carried"

    @property
    def rates(self) -> Rates:
        """The table, closed over what the row is made of."""
        table: Rates = self.options[0]
        return table

    @property
    def coordinate(self) -> Symbol:
        """The plain coordinate."""
        (symbol,) = self.arguments
        assert isinstance(symbol, Symbol)
        return symbol

    @property
    def label(self) -> str:
        """What errors and printing call it."""
        return "carried"

    @classmethod
    def _options_key(cls, options: tuple[Rates, ...]) -> str:
        return options[0].key.hex()

    def _value(self) -> Expression:
        return self.coordinate

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        return {v: self.rates.carry(g) for v, g in self.rates[self.coordinate].items()}

    def gradient_keys(self, heuristic: bool) -> frozenset[Symbol]:
        """Return the derivative symbols of the gradient, without building it."""
        return frozenset(self.rates[self.coordinate])

    def depends_on(self, substitution: Substitution) -> bool:
        """Return whether a substitution changes the node."""
        return any(s in self.rates.symbols for s in substitution)

    def substitute(self, substitution: Substitution) -> Expression:
        """Return what the node becomes under a substitution."""
        relevant = {s: e for s, e in substitution.items() if s in self.rates.symbols}
        itself = _expression_of(self)
        return Composed.of((itself, *relevant.values()), (), tuple(relevant))


class Composed(Node):
    """A carried coordinate after a substitution, unfolded one derivative at a time."""

    __slots__ = ()
    kind = "composed"

    @property
    def substitution(self) -> dict[Symbol, Expression]:
        """What was replaced by what."""
        return dict(zip(self.options, self.arguments[1:], strict=True))

    @classmethod
    def _options_key(cls, options: tuple[Symbol, ...]) -> str:
        return repr([s.sort_key for s in options])

    def _inner(self) -> Node:
        (node,) = self.arguments[0]._nodes
        return node

    def _value(self) -> Expression:
        return apply(self._inner().value, self.substitution)

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        return compose_gradient(self._inner().gradient(heuristic), self.substitution, heuristic)

    def gradient_keys(self, heuristic: bool) -> frozenset[Symbol]:
        """Return the derivative symbols of the gradient, without building it."""
        return frozenset(self.gradient(heuristic))

    def depends_on(self, substitution: Substitution) -> bool:
        """Return whether a substitution changes the node."""
        return super().depends_on(substitution) or self._inner().depends_on(substitution)

    def substitute(self, substitution: Substitution) -> Expression:
        """Return what the node becomes under a substitution."""
        return Composed.of((_expression_of(self), *substitution.values()), (), tuple(substitution))


def plain(expression: Expression) -> Expression:
    """Return the expression with carried coordinates put back to plain ones, looking into nodes."""
    return _rebuilt(expression, lambda node: node.coordinate if isinstance(node, Carried) else None)


def _rebuilt(expression: Expression, exchange: Callable[[Node], Expression | None]) -> Expression:
    if not expression._nodes:
        return expression
    replacements = {}
    for node in leaves(expression)[1]:
        replacement = exchange(node)
        if isinstance(node, Composed):
            replacement = _recomposed(node)
        elif replacement is None:
            arguments = tuple(_rebuilt(a, exchange) for a in node.arguments)
            if any(new is not old for new, old in zip(arguments, node.arguments, strict=True)):
                replacement = type(node).of(arguments, node.shape, node.options)
        if replacement is not None:
            replacements[node] = replacement
    return replace_nodes(expression, replacements)


def _recomposed(node: Composed) -> Expression | None:
    """Return a composition over plain replacements, None if they are plain already."""
    given = node.substitution
    inner = node.arguments[0]
    (inside,) = inner._nodes
    source = inner if isinstance(inside, Carried) else plain(inner)
    replacements = {s: p for s, e in given.items() if (p := plain(e)) != s}
    if source is inner and all(replacements.get(s) is e for s, e in given.items()):
        return None
    if not replacements:
        return plain(inner)
    return apply(source, replacements)


def all_symbols(expression: Expression) -> set[Symbol]:
    """Return the symbols of values and of given gradients."""
    symbols, nodes = leaves(expression)
    # What was replaced in a composition is inside it, but it is not about that any more.
    parts = (a for node in nodes for a in node.arguments[isinstance(node, Composed) :])
    return set(symbols).union(*map(all_symbols, parts))


def _expression_of(node: Node) -> Expression:
    from kineverse.expressions.expression import make

    return make(node.sx, node.shape, frozenset((node,)))
