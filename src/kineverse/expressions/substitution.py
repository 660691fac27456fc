"""Substitution of expressions for symbols, with gradients by the chain rule."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import casadi as ca

from kineverse.errors import ExpressionError, ShapeError

from .expression import (
    NO_NODES,
    Expression,
    ExpressionLike,
    access_listener,
    array,
    as_expression,
    from_casadi,
)
from .graph import gradient_keys, leaves, topological_order
from .layout import SX

if TYPE_CHECKING:
    from kineverse.symbols import Symbol

    from .node import Node


class Substitution(dict["Symbol", Expression]):
    """Replacements of symbols by expressions, with the images of nodes found so far."""

    def __init__(self, replacements: Mapping[Symbol, Expression]) -> None:
        super().__init__(replacements)
        self._images: dict[Node, Expression | None] = {}

    @classmethod
    def from_mapping(cls, replacements: Mapping[Symbol, Expression]) -> Substitution:
        """Return replacements as a substitution; a substitution is returned as it is."""
        return replacements if isinstance(replacements, cls) else cls(replacements)

    def changes(self, expression: Expression) -> bool:
        """Return True if the value or the gradient of an expression changes."""
        symbols, nodes = leaves(expression)
        if any(symbol in self for symbol in symbols):
            return True
        self.substitute_nodes(nodes)
        return any(self._images[node] is not None for node in nodes)

    def image(self, node: Node) -> Expression | None:
        """Return the image of a node, None if it does not change."""
        self.substitute_nodes((node,))
        return self._images[node]

    def substitute_nodes(self, nodes: Iterable[Node]) -> None:
        """Compute the images of nodes, inner ones first."""
        for node in topological_order(nodes, lambda n: n.arguments, self._images.__contains__):
            self._images[node] = node.substitute(self) if node.depends_on(self) else None


def substitute(expression: Expression, values: Mapping[Symbol, ExpressionLike]) -> Expression:
    """Return e∘S, see :meth:`Expression.substitute`."""
    from kineverse.symbols import Symbol

    substitution: dict[Symbol, Expression] = {}
    for symbol, value in values.items():
        if not isinstance(symbol, Symbol):
            raise ExpressionError(
                f"Only symbols can be replaced, not {symbol!r}; write {{kv.position('path'): value}}."
            )
        replacement = as_expression(value)
        if replacement.shape:
            shape = replacement.shape
            raise ShapeError(f"'{symbol}' is a scalar and cannot become an array of shape {shape}.")
        if replacement is not symbol:
            substitution[symbol] = replacement
    listener = access_listener(expression)
    if listener is not None and substitution:
        images = array(list(substitution.values()))
        result: Expression = listener.ask("substitute", expression, array(list(substitution)), images)
        return result
    moving = dummy_symbols(s for s, e in substitution.items() if not s.has_derivative and gradient_keys(e))
    if moving:
        # D of a parameter is empty, so a dummy symbol with a derivative is replaced in its place.
        expression = rename_symbols(expression, moving)
        substitution |= {stand_in: substitution[s] for s, stand_in in moving.items()}
    return apply_substitution(expression, substitution)


def dummy_symbols(parameters: Iterable[Symbol]) -> dict[Symbol, Symbol]:
    """Return a unique symbol with a derivative for each parameter, to differentiate by."""
    from kineverse.symbols import Symbol

    return {p: Symbol(f"∂/{i}/{p.path}") for i, p in enumerate(parameters) if not p.has_derivative}


def rename_symbols(expression: Expression, names: Mapping[Symbol, Symbol]) -> Expression:
    """Return the expression with symbols replaced by symbols that it does not contain."""
    images: dict[Node, Expression] = {}

    def rename(part: Expression) -> Expression:
        chosen = [s for s in leaves(part)[0] if s in names]
        inner = replace_nodes(part, images)
        if not chosen:
            return inner
        (sx,) = ca.substitute([inner._sx], [s._sx for s in chosen], [names[s]._sx for s in chosen])
        return from_casadi(sx, part._shape, inner._nodes)

    for node in topological_order(leaves(expression)[1], lambda n: n.arguments, images.__contains__):
        images[node] = type(node).from_arguments(tuple(map(rename, node.arguments)), node.shape, node.options)
    return rename(expression)


def apply_substitution(expression: Expression, replacements: Mapping[Symbol, Expression]) -> Expression:
    """Return e∘S for a valid substitution."""
    if not replacements:
        return expression
    substitution = Substitution.from_mapping(replacements)
    symbols, nodes = leaves(expression)
    old: list[SX] = []
    new: list[SX] = []
    kept: set[Node] = set()
    for symbol in symbols:
        if symbol in substitution:
            replacement = substitution[symbol]
            old.append(symbol._sx)
            new.append(ca.densify(replacement._sx))
            kept |= replacement._nodes
    substitution.substitute_nodes(nodes)
    for node in nodes:
        image = substitution.image(node)
        if image is None:
            kept.add(node)
        else:
            old.append(node.sx)
            new.append(ca.densify(image._sx))
            kept |= image._nodes
    if not old:
        return expression
    (sx,) = ca.substitute([expression._sx], old, new)
    return from_casadi(sx, expression._shape, frozenset(kept) or NO_NODES)


def replace_nodes(expression: Expression, replacements: Mapping[Node, Expression]) -> Expression:
    """Return the expression with nodes of its own graph replaced by expressions of their shape."""
    _, nodes = leaves(expression)
    chosen = [n for n in nodes if n in replacements]
    if not chosen:
        return expression
    images = [replacements[n] for n in chosen]
    kept = frozenset(n for n in nodes if n not in replacements).union(*(e._nodes for e in images))
    new = [ca.densify(e._sx) for e in images]
    (sx,) = ca.substitute([expression._sx], [n.sx for n in chosen], new)
    return from_casadi(sx, expression._shape, kept)


def compose_gradient(
    entries: Mapping[Symbol, Expression], replacements: Mapping[Symbol, Expression], heuristic: bool
) -> dict[Symbol, Expression]:
    """Return D(e∘S) from D(e): ``Σ_a (D(e)[ȧ]∘S)·D(S(a))[w]`` plus the entries of other keys."""
    substitution = Substitution.from_mapping(replacements)
    result: dict[Symbol, Expression] = {}

    def add(key: Symbol, value: Expression) -> None:
        result[key] = result[key] + value if key in result else value

    replaced = {a.derivative(): s for a, s in substitution.items() if a.has_derivative}
    for key, entry in entries.items():
        carried = apply_substitution(entry, substitution)
        if key in replaced:
            for inner, rate in replaced[key].gradient(heuristic).items():
                add(inner, carried * rate)
        else:
            add(key, carried)
    return result
