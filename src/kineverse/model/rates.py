"""Rates of coordinates as linear functions of speeds, q̇ = R(q) u, and nodes that carry them.

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
from kineverse.expressions.expression import Expression, ExpressionLike, as_expression, from_casadi
from kineverse.expressions.graph import leaves, topological_order
from kineverse.expressions.node import Node
from kineverse.expressions.substitution import apply_substitution, compose_gradient, replace_nodes
from kineverse.symbols import Symbol

from .display import as_html, as_lines, count_values

if TYPE_CHECKING:
    from kineverse.expressions.substitution import Substitution


class Carried(Node):
    """Carried coordinate: a coordinate with its row as gradient."""

    __slots__ = ()
    kind = "carried"

    @property
    def rates(self) -> Rates:
        """Part of the rate table that the row depends on."""
        table: Rates = self.options[0]
        return table

    @property
    def coordinate(self) -> Symbol:
        """The plain coordinate."""
        (symbol,) = self.arguments
        assert isinstance(symbol, Symbol)
        return symbol

    @property
    def parts(self) -> tuple[Expression, ...]:
        """Expressions of the rows; the coordinate itself is not among them."""
        return tuple(entry for row in self.rates.values() for entry in row.values())

    @property
    def label(self) -> str:
        """Name in errors and in printed expressions."""
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
        """Return the node after a substitution."""
        relevant = {s: e for s, e in substitution.items() if s in self.rates.symbols}
        itself = _expression_of(self)
        return Composed.from_arguments((itself, *relevant.values()), (), tuple(relevant))


class Dependent(Node):
    """Dependent coordinate: value and gradient are those of an expression in other coordinates."""

    __slots__ = ()
    kind = "dependent"

    @property
    def coordinate(self) -> Symbol:
        """The plain coordinate."""
        symbol: Symbol = self.options[0]
        return symbol

    @property
    def label(self) -> str:
        """The coordinate's name."""
        return str(self.coordinate)

    @classmethod
    def _options_key(cls, options: tuple[Symbol, ...]) -> str:
        return repr(options[0].sort_key)

    def _value(self) -> Expression:
        return self.arguments[0]

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        return self.arguments[0].gradient(heuristic)

    def substitute(self, substitution: Substitution) -> Expression:
        """Return the expression after a substitution; it no longer stands for the coordinate."""
        return apply_substitution(self.arguments[0], substitution)


class Composed(Node):
    """Carried coordinate after a substitution, unfolded one derivative at a time."""

    __slots__ = ()
    kind = "composed"

    @property
    def substitution(self) -> dict[Symbol, Expression]:
        """Replacements by symbol."""
        return dict(zip(self.options, self.arguments[1:], strict=True))

    @classmethod
    def _options_key(cls, options: tuple[Symbol, ...]) -> str:
        return repr([s.sort_key for s in options])

    def _inner(self) -> Node:
        (node,) = self.arguments[0].nodes
        return node

    def _value(self) -> Expression:
        return apply_substitution(self._inner().value, self.substitution)

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        return compose_gradient(self._inner().gradient(heuristic), self.substitution, heuristic)

    def gradient_keys(self, heuristic: bool) -> frozenset[Symbol]:
        """Return the derivative symbols of the gradient, without building it."""
        return frozenset(self.gradient(heuristic))

    def depends_on(self, substitution: Substitution) -> bool:
        """Return whether a substitution changes the node."""
        return super().depends_on(substitution) or self._inner().depends_on(substitution)

    def substitute(self, substitution: Substitution) -> Expression:
        """Return the node after a substitution."""
        return Composed.from_arguments(
            (_expression_of(self), *substitution.values()), (), tuple(substitution)
        )


def to_plain(expression: Expression) -> Expression:
    """Replace carried coordinates by plain symbols, inside nodes as well."""
    if not expression.nodes:
        return expression
    images: dict[Node, Expression] = {}
    for node in topological_order(leaves(expression)[1], _parts, images.__contains__):
        image = _plain_image(node, lambda part: replace_nodes(part, images))
        if image is not None:
            images[node] = image
    return replace_nodes(expression, images)


def _parts(node: Node) -> tuple[Expression, ...]:
    return () if isinstance(node, Carried | Dependent) else node.arguments


def _plain_image(node: Node, plain_part: Callable[[Expression], Expression]) -> Expression | None:
    if isinstance(node, Carried | Dependent):
        return node.coordinate
    if isinstance(node, Composed):
        return _recompose(node, plain_part)
    arguments = tuple(map(plain_part, node.arguments))
    if all(new is old for new, old in zip(arguments, node.arguments, strict=True)):
        return None
    return type(node).from_arguments(arguments, node.shape, node.options)


def _recompose(node: Composed, plain_part: Callable[[Expression], Expression]) -> Expression | None:
    given = node.substitution
    inner = node.arguments[0]
    source = inner if isinstance(node._inner(), Carried) else plain_part(inner)
    replacements = {s: p for s, e in given.items() if (p := plain_part(e)) != s}
    if source is inner and all(replacements.get(s) is e for s, e in given.items()):
        return None
    composed = apply_substitution(source, replacements) if replacements else source
    # A coordinate without a replacement is an ordinary carried coordinate.
    return plain_part(inner) if composed is source else composed


def collect_symbols(expression: Expression) -> set[Symbol]:
    """Return the symbols of an expression, those of overridden gradients included."""
    symbols, nodes = leaves(expression)
    result = set(symbols)
    for node in topological_order(nodes, _subjects, lambda _: False):
        result.update(s for part in _subjects(node) for s in leaves(part)[0])
    return result


def _subjects(node: Node) -> tuple[Expression, ...]:
    """Return the arguments of a node that its value depends on."""
    # The first argument of a composition is the expression before the substitution.
    return node.arguments[isinstance(node, Composed) :]


def _expression_of(node: Node) -> Expression:
    return from_casadi(node.sx, node.shape, frozenset((node,)))


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
        raise ModelError(f"Only positions have a rate, not '{coordinate}'.")


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

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(
    ...         kv.articulations.DifferentialDrive(
    ...             name="base", parent="world", child="base", radius=0.1, track=0.5
    ...         )
    ...     )
    'joint base'
    >>> model.rates.row("base/angle")
    {base/left_wheel:velocity: -0.2, base/right_wheel:velocity: 0.2}
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
        dependent = f" and {len(self.dependent)} dependent coordinates" if self.dependent else ""
        return f"{count_values(len(self), 'rates')}{dependent}"

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
