"""The symbols and nodes an expression is made of."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING

import casadi as ca

from .expression import NODES, SYMBOLS, Expression

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
        for element in ca.symvar(expression._sx):
            name = element.element_hash()
            symbol = SYMBOLS.get(name)
            if symbol is not None:
                symbols.append(symbol)
            else:
                nodes.add(NODES[name])
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


def symbols_below(node: Node) -> frozenset[Symbol]:
    """Return the symbols that the value of a node depends on, looking into nodes."""
    found: set[Symbol] = set()
    for inner in bottom_up((node,), lambda n: (n.value,), lambda n: n._symbols is not None):
        found.update(leaves(inner.value)[0])
        for leaf in leaves(inner.value)[1]:
            found.update(leaf._symbols or ())
    return frozenset(found)


def gradient_keys(expression: Expression, heuristic: bool = True) -> frozenset[Symbol]:
    """Return the keys that D(e) can have, without differentiating anything."""
    symbols, nodes = leaves(expression)
    keys = {s.derivative() for s in symbols if s.has_derivative}
    for node in bottom_up(nodes, lambda n: n.differentiated(heuristic), lambda n: heuristic in n._keys):
        node._keys[heuristic] = node.gradient_keys(heuristic)
    return frozenset(keys.union(*(node._keys[heuristic] for node in nodes)))


def bottom_up(
    nodes: Iterable[Node],
    parts: Callable[[Node], Iterable[Expression]],
    done: Callable[[Node], bool],
) -> Iterator[Node]:
    """Yield the nodes, and before each of them those in its ``parts``, none twice and none that is ``done``.

    What is defined by recursion over nodes is computed along this order instead: a minimum over a thousand
    distances is a thousand nodes deep, and a node that occurs twice is not worth twice the work.
    """
    seen: set[Node] = set()
    stack: list[tuple[Node, bool]] = [(node, False) for node in nodes]
    while stack:
        node, complete = stack.pop()
        if complete:
            yield node
        elif node not in seen and not done(node):
            seen.add(node)
            stack.append((node, True))
            stack.extend((inner, False) for part in parts(node) for inner in leaves(part)[1])
