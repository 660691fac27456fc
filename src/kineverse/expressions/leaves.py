"""The symbols and nodes an expression is made of."""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca

from .expression import SYMBOLS, Expression

if TYPE_CHECKING:
    from kineverse.symbols import Symbol

    from .node import Node


def leaves(expression: Expression) -> tuple[tuple[Symbol, ...], tuple[Node, ...]]:
    """Return the symbols and the nodes that occur in the graph itself, each in canonical order."""
    if expression._leaves is None:
        if expression._sx.is_constant():
            expression._leaves = (), ()
            return expression._leaves
        symbols: list[Symbol] = []
        nodes: set[Node] = set()
        owners = {element: node for node in expression._nodes for element in node.elements}
        for element in ca.symvar(expression._sx):
            name = element.element_hash()
            symbol = SYMBOLS.get(name)
            if symbol is not None:
                symbols.append(symbol)
            else:
                nodes.add(owners[name])
        symbols.sort(key=lambda s: s.sort_key)
        expression._leaves = tuple(symbols), tuple(sorted(nodes, key=lambda n: n.key))
    return expression._leaves


def free_symbols(expression: Expression) -> tuple[Symbol, ...]:
    """Return the symbols that the value depends on, looking into nodes; sorted."""
    symbols, nodes = leaves(expression)
    if not nodes:
        return symbols
    found = set(symbols).union(*(node.symbols for node in nodes))
    return tuple(sorted(found, key=lambda s: s.sort_key))


def gradient_keys(expression: Expression, heuristic: bool = True) -> frozenset[Symbol]:
    """Return the keys that D(e) can have, without differentiating anything."""
    symbols, nodes = leaves(expression)
    keys = {s.derivative() for s in symbols if s.has_derivative}
    return frozenset(keys.union(*(node.gradient_keys(heuristic) for node in nodes)))
