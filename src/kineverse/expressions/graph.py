"""Traversal of expression graphs: leaves, lowering to CasADi, structural hash, pickling.

Hashes and pickles use CasADi's serialisation, which is exact to the last bit. Pickles are for equal versions
of CasADi only; documents have a format of their own.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import accumulate
from typing import TYPE_CHECKING, Any

import casadi as ca

from . import layout
from .expression import NODES, SYMBOLS, Expression, from_casadi
from .layout import SX, ArrayShape

if TYPE_CHECKING:
    from kineverse.symbols import Symbol

    from .node import Node


def leaves(expression: Expression) -> tuple[tuple[Symbol, ...], tuple[Node, ...]]:
    """Return the symbols and the nodes of the graph, those inside of nodes excluded, in canonical order."""
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
    """Return the symbols that the value depends on, those inside of nodes included, sorted."""
    symbols, nodes = leaves(expression)
    if not nodes:
        return symbols
    found = set(symbols).union(*(node.symbols for node in nodes))
    return tuple(sorted(found, key=lambda s: s.sort_key))


def node_symbols(node: Node) -> frozenset[Symbol]:
    """Return the symbols that the value of a node depends on, those inside of other nodes included."""
    found: set[Symbol] = set()
    for inner in topological_order((node,), lambda n: (n.value,), lambda n: n._symbols is not None):
        found.update(leaves(inner.value)[0])
        for leaf in leaves(inner.value)[1]:
            found.update(leaf._symbols or ())
    return frozenset(found)


def gradient_keys(expression: Expression, heuristic: bool = True) -> frozenset[Symbol]:
    """Return the keys that D(e) can have, without differentiation.

    Examples
    --------
    >>> kv.expressions.gradient_keys(np.sin(kv.position("x")))
    frozenset({x:velocity})
    """
    symbols, nodes = leaves(expression)
    keys = {s.derivative() for s in symbols if s.has_derivative}
    for node in topological_order(
        nodes, lambda n: n.differentiated(heuristic), lambda n: heuristic in n._keys
    ):
        node._keys[heuristic] = node.gradient_keys(heuristic)
    return frozenset(keys.union(*(node._keys[heuristic] for node in nodes)))


def has_infinite_product(expression: Expression) -> bool:
    """Return True if an infinite number is multiplied by an expression."""
    nodes = topological_order(leaves(expression)[1], lambda n: n.arguments, lambda _: False)
    return any(
        _has_infinite_product(part._sx)
        for part in (expression, *(argument for node in nodes for argument in node.arguments))
    )


_FEW_NODES = 200
"""Number of nodes up to which the text of a graph is searched before its instructions, which takes longer."""


def _has_infinite_product(sx: SX) -> bool:
    if sx.is_constant() or (ca.n_nodes(sx) < _FEW_NODES and "inf" not in str(sx)):
        return False
    f = ca.Function("f", [ca.veccat(*ca.symvar(sx))], [sx])
    constants: dict[int, float] = {}
    for k in range(f.n_instructions()):
        kind, inputs, outputs = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        if kind == ca.OP_MUL and any(math.isinf(constants.get(i, 0.0)) for i in inputs):
            return True
        if kind == ca.OP_OUTPUT:
            continue
        for register in outputs:
            constants.pop(register, None)
        if kind == ca.OP_CONST:
            constants[outputs[0]] = f.instruction_constant(k)
    return False


def topological_order(
    nodes: Iterable[Node], parts: Callable[[Node], Iterable[Expression]], done: Callable[[Node], bool]
) -> Iterator[Node]:
    """Yield the nodes, each after the nodes in its ``parts``, none twice and none that is ``done``.

    It replaces recursion over nodes: a minimum over a thousand distances is a thousand nodes deep, and a node
    that occurs twice is visited once.
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


def expand_nodes(expression: Expression) -> SX:
    """Return the ``SX`` with every node replaced by its value."""
    if not expression._nodes:
        return expression._sx
    if expression._lowered is None:
        for node in topological_order(leaves(expression)[1], lambda n: (n.value,), _is_lowered):
            _lower(node.value)
        _lower(expression)
    return expression._lowered


def _is_lowered(node: Node) -> bool:
    return not node.value._nodes or node.value._lowered is not None


def _lower(expression: Expression) -> None:
    _, nodes = leaves(expression)
    if nodes:
        values = [ca.densify(expand_nodes(n.value)) for n in nodes]
        (expression._lowered,) = ca.substitute([expression._sx], [n.sx for n in nodes], values)
    else:
        expression._lowered = expression._sx


def dense_column(expression: Expression) -> SX:
    """Return an expression as one dense column of its elements in C order."""
    return ca.densify(layout.column(expand_nodes(expression), expression.shape))


def lower(expressions: Sequence[Expression]) -> list[SX]:
    """Return each expression as one dense column of its elements in C order, common parts shared.

    Examples
    --------
    >>> x = kv.position("x")
    >>> first, second = kv.expressions.lower([x**2, kv.array([[1, x], [2, 3]])])
    >>> second.shape
    (4, 1)
    """
    columns = [dense_column(e) for e in expressions]
    if not columns:
        return []
    offsets = [0, *accumulate(column.numel() for column in columns)]
    return [ca.densify(c) for c in ca.vertsplit(ca.cse(ca.vertcat(*columns)), offsets)]


_PICKLING_DEPTH = 16
_DEEP = 5000  # nodes of a graph that may be as deep as it is large


def structural_hash(expression: Expression) -> bytes:
    """Return a digest of shape, leaves and graph; equal for equal structure, in every process."""
    if expression._key is None:
        symbols, nodes = leaves(expression)
        head = repr((expression._shape, [s.sort_key for s in symbols]))
        digest = hashlib.blake2b(head.encode(), digest_size=16)
        for node in nodes:
            digest.update(node.key)
        sx = expression._sx
        if not sx.is_dense():
            sx = ca.densify(sx)
        if not sx.is_constant() and not sx.is_symbolic():
            sx = ca.cse(sx)  # sharing of equal parts makes no difference
        # CasADi serialises a graph by recursion, which ends the process where it is deep.
        graph = sx if ca.n_nodes(sx) <= _DEEP else _casadi_function(sx, _leaf_graphs(symbols, nodes))
        digest.update(graph.serialize().encode())
        expression._key = digest.digest()
    return expression._key


def pack(expression: Expression) -> tuple[Any, ...]:
    """Return the picklable arguments of :func:`unpack`."""
    symbols, nodes = leaves(expression)
    function = _casadi_function(expression._sx, _leaf_graphs(symbols, nodes))
    return _pickling_order(nodes), symbols, nodes, expression._shape, function.serialize()


def _leaf_graphs(symbols: Iterable[Symbol], nodes: Iterable[Node]) -> list[SX]:
    return [*(s._sx for s in symbols), *(n.sx for n in nodes)]


def _pickling_order(nodes: tuple[Node, ...]) -> tuple[Node, ...]:
    """Return every sixteenth level of inner nodes, lowest first, so that pickling does not recurse deeper."""
    if all(node.depth <= _PICKLING_DEPTH for node in nodes):
        return ()
    below = topological_order(nodes, lambda n: n.arguments, lambda n: False)
    return tuple(node for node in below if node.depth % _PICKLING_DEPTH == 0)


def unpack(
    _: tuple[Any, ...], symbols: tuple[Any, ...], nodes: tuple[Any, ...], shape: ArrayShape, graph: str
) -> Expression:
    """Rebuild an expression from :func:`pack`."""
    leaf = _leaf_graphs(symbols, nodes)
    sx = ca.Function.deserialize(graph)(ca.vertcat(*map(ca.vec, leaf)) if leaf else ca.SX(0, 1))
    return from_casadi(sx, tuple(shape), frozenset(nodes))


def _casadi_function(sx: SX, leaf: list[SX]) -> Any:
    stacked = ca.vertcat(*map(ca.vec, leaf)) if leaf else ca.SX(0, 1)
    return ca.Function("e", [stacked], [sx])
