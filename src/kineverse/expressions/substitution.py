"""Replacing symbols by expressions: composition, with gradients by the chain rule."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeAlias

import casadi as ca

from kineverse.errors import ExpressionError, ShapeError

from .expression import NO_NODES, Expression, ExpressionLike, as_expression, make
from .layout import SX
from .leaves import leaves

if TYPE_CHECKING:
    from kineverse.symbols import Symbol

    from .node import Node

Substitution: TypeAlias = "Mapping[Symbol, Expression]"


def substitute(expression: Expression, values: Mapping[Symbol, ExpressionLike]) -> Expression:
    """Return e∘S, see :meth:`Expression.substitute`."""
    from kineverse.symbols import Symbol

    substitution: dict[Symbol, Expression] = {}
    for symbol, value in values.items():
        if not isinstance(symbol, Symbol):
            raise ExpressionError(
                f"Only symbols can be replaced, and {symbol!r} is none; write {{kv.position('path'): value}}."
            )
        replacement = as_expression(value)
        if replacement.shape:
            raise ShapeError(
                f"'{symbol}' is a scalar and cannot become an array of shape {replacement.shape}."
            )
        if replacement is not symbol:
            substitution[symbol] = replacement
    return apply(expression, substitution)


def apply(expression: Expression, substitution: Substitution) -> Expression:
    """Return e∘S for a substitution that is known to be well formed."""
    if not substitution:
        return expression
    symbols, nodes = leaves(expression)
    old: list[ca.SX] = []
    new: list[ca.SX] = []
    kept: set[Node] = set()
    for symbol in symbols:
        if symbol in substitution:
            replacement = substitution[symbol]
            old.append(symbol._sx)
            new.append(replacement._sx)
            kept |= replacement._nodes
    for node in nodes:
        if node.depends_on(substitution):
            replacement = node.substitute(substitution)
            old.append(node.sx)
            new.append(_as_stored(replacement, node))
            kept |= replacement._nodes
        else:
            kept.add(node)
    if not old:
        return expression
    (sx,) = ca.substitute([expression._sx], old, new)
    return make(sx, expression._shape, frozenset(kept) or NO_NODES)


def replace_nodes(expression: Expression, replacements: Mapping[Node, Expression]) -> Expression:
    """Return the expression with nodes of its own graph exchanged for expressions of their shape."""
    _, nodes = leaves(expression)
    chosen = [n for n in nodes if n in replacements]
    if not chosen:
        return expression
    kept = frozenset(n for n in nodes if n not in replacements).union(
        *(replacements[n]._nodes for n in chosen)
    )
    (sx,) = ca.substitute(
        [expression._sx], [n.sx for n in chosen], [_as_stored(replacements[n], n) for n in chosen]
    )
    return make(sx, expression._shape, kept)


def compose_gradient(
    entries: Mapping[Symbol, Expression], substitution: Substitution, heuristic: bool
) -> dict[Symbol, Expression]:
    """Return D(e∘S) from D(e): ``Σ_a (D(e)[ȧ]∘S)·D(S(a))[w]`` and the keys that no replaced symbol has."""
    result: dict[Symbol, Expression] = {}

    def add(key: Symbol, value: Expression) -> None:
        result[key] = result[key] + value if key in result else value

    replaced = {a.derivative(): s for a, s in substitution.items() if a.has_derivative}
    for key, entry in entries.items():
        carried = apply(entry, substitution)
        if key in replaced:
            for inner, rate in replaced[key].gradient(heuristic).items():
                add(inner, carried * rate)
        else:
            add(key, carried)
    return result


def _as_stored(replacement: Expression, node: Node) -> SX:
    return ca.densify(replacement._sx)
