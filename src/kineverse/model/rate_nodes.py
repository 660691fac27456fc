"""Expression nodes of carried and dependent coordinates."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from kineverse.expressions.expression import Expression, from_casadi
from kineverse.expressions.graph import leaves, topological_order
from kineverse.expressions.node import Node
from kineverse.expressions.substitution import apply_substitution, compose_gradient, replace_nodes
from kineverse.symbols import Symbol

if TYPE_CHECKING:
    from kineverse.expressions.substitution import Substitution
    from kineverse.model.rates import Rates


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
    """Return the expressions that are converted before a node is."""
    return () if isinstance(node, Carried | Dependent) else node.arguments


def _plain_image(node: Node, plain_part: Callable[[Expression], Expression]) -> Expression | None:
    """Return the plain form of a node; None if it is plain already."""
    if isinstance(node, Carried | Dependent):
        return node.coordinate
    if isinstance(node, Composed):
        return _recompose(node, plain_part)
    arguments = tuple(map(plain_part, node.arguments))
    if all(new is old for new, old in zip(arguments, node.arguments, strict=True)):
        return None
    return type(node).from_arguments(arguments, node.shape, node.options)


def _recompose(node: Composed, plain_part: Callable[[Expression], Expression]) -> Expression | None:
    """Return a composition over plain replacements; None if they are plain already."""
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
    found = set(symbols)
    for node in topological_order(nodes, _subjects, lambda _: False):
        found.update(s for part in _subjects(node) for s in leaves(part)[0])
    return found


def _subjects(node: Node) -> tuple[Expression, ...]:
    """Return the arguments of a node that its value depends on."""
    # The first argument of a composition is the expression before the substitution.
    return node.arguments[isinstance(node, Composed) :]


def _expression_of(node: Node) -> Expression:
    return from_casadi(node.sx, node.shape, frozenset((node,)))
