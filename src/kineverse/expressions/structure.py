"""Structural identity of expressions, and packing them for another process.

Both use CasADi's own serialisation, which is exact to the last bit. It is for pickling between like versions
only, documents have their own form.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

import casadi as ca

from .expression import Expression, make
from .layout import SX, Shape
from .leaves import bottom_up, leaves

if TYPE_CHECKING:
    from .node import Node

_STOREY = 16


def structural_key(expression: Expression) -> bytes:
    """Return a digest of shape, leaves and graph; equal for equal structure, in every process."""
    if expression._key is None:
        symbols, nodes = leaves(expression)
        digest = hashlib.blake2b(
            repr((expression._shape, [s.sort_key for s in symbols])).encode(), digest_size=16
        )
        for node in nodes:
            digest.update(node.key)
        sx = expression._sx
        if not sx.is_dense():
            sx = ca.densify(sx)
        if not sx.is_constant() and not sx.is_symbolic():
            sx = ca.cse(sx)  # whether equal parts are shared is no difference
        digest.update(sx.serialize().encode())
        expression._key = digest.digest()
    return expression._key


def pack(expression: Expression) -> tuple[Any, ...]:
    """Return what :func:`unpack` needs, all of it picklable."""
    symbols, nodes = leaves(expression)
    function = _function(expression._sx, [*(s._sx for s in symbols), *(n.sx for n in nodes)])
    return _landings(nodes), symbols, nodes, expression._shape, function.serialize()


def _landings(nodes: tuple[Node, ...]) -> tuple[Node, ...]:
    """Return nodes on the way down, lowest first: pickled in this order, none of them is deep any more."""
    if all(node.depth <= _STOREY for node in nodes):
        return ()
    below = bottom_up(nodes, lambda n: n.arguments, lambda n: False)
    return tuple(node for node in below if node.depth % _STOREY == 0)


def unpack(
    _: tuple[Any, ...], symbols: tuple[Any, ...], nodes: tuple[Any, ...], shape: Shape, graph: str
) -> Expression:
    """Rebuild an expression from :func:`pack`."""
    leaf = [*(s._sx for s in symbols), *(n.sx for n in nodes)]
    sx = ca.Function.deserialize(graph)(ca.vertcat(*map(ca.vec, leaf)) if leaf else ca.SX(0, 1))
    return make(sx, tuple(shape), frozenset(nodes))


def _function(sx: SX, leaf: list[SX]) -> Any:
    stacked = ca.vertcat(*map(ca.vec, leaf)) if leaf else ca.SX(0, 1)
    return ca.Function("e", [stacked], [sx])
