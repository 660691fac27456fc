"""Augmented gradients: the chain rule over symbols and opaque nodes (2022 paper, Eqs. 5-8).

For an expression e with leaves l (symbols and elements of nodes), ``D(e)[w] = Σ_l ∂e/∂l · D(l)[w]``, where a
symbol a has ``D(a) = {ȧ: 1}``, a parameter ``{}`` and a node says itself what its D is. CasADi computes the
partial derivatives, all keys at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from kineverse.errors import ExpressionError

from . import layout
from .expression import NO_NODES, Expression, make
from .leaves import bottom_up, leaves

if TYPE_CHECKING:
    from kineverse.symbols import Symbol

    from .node import Node


def gradient(expression: Expression, heuristic: bool = True) -> Mapping[Symbol, Expression]:
    """Return D(e), see :meth:`Expression.gradient`."""
    known = expression._gradients.get(heuristic)
    if known is None:
        known = MappingProxyType(_gradient(expression, heuristic))
        expression._gradients[heuristic] = known
    result: Mapping[Symbol, Expression] = known
    return result


def _gradient(expression: Expression, heuristic: bool) -> dict[Symbol, Expression]:
    symbols, nodes = leaves(expression)
    # Only leaves with a gradient take part: the partial derivative by a parameter in an exponent is NaN for a
    # negative base, and nobody asked for it.
    moving = [s for s in symbols if s.has_derivative]
    for node in bottom_up(nodes, lambda n: n.differentiated(heuristic), lambda n: heuristic in n._gradients):
        node.gradient(heuristic)
    opaque = [(node, entries) for node in nodes if (entries := node.gradient(heuristic))]
    if not moving and not opaque:
        return {}
    keys = sorted(
        {s.derivative() for s in moving}.union(*(entries for _, entries in opaque)), key=lambda s: s.sort_key
    )
    elements = layout.column(expression._sx, expression._shape)
    if not opaque:
        by_key = ca.jacobian(elements, ca.vertcat(*(s._sx for s in moving)))
        column_of = {s.derivative(): i for i, s in enumerate(moving)}
        return _collect(expression, by_key, [column_of[k] for k in keys], keys, {})
    position = {key: i for i, key in enumerate(keys)}
    blocks = [s._sx for s in moving] + [layout.column(n.sx, n.shape) for n, _ in opaque]
    seeds = []
    for symbol in moving:
        row = ca.SX(1, len(keys))
        row[0, position[symbol.derivative()]] = 1
        seeds.append(row)
    nodes_of: dict[Symbol, frozenset[Node]] = {}
    for node, entries in opaque:
        rows = ca.SX(node.size, len(keys))
        for key, value in entries.items():
            rows[:, position[key]] = layout.column(value._sx, value._shape)
            nodes_of[key] = nodes_of.get(key, NO_NODES) | value._nodes
        seeds.append(ca.sparsify(rows))
    # Cheaper than ca.jtimes, which differentiates once per key.
    by_key = ca.mtimes(ca.jacobian(elements, ca.vertcat(*blocks)), ca.vertcat(*seeds))
    return _collect(expression, by_key, list(range(len(keys))), keys, nodes_of)


def _collect(
    expression: Expression,
    by_key: layout.SX,
    columns: list[int],
    keys: list[Symbol],
    nodes_of: Mapping[Symbol, frozenset[Node]],
) -> dict[Symbol, Expression]:
    result = {}
    for key, index in zip(keys, columns, strict=True):
        entry = by_key[:, index]
        if entry.is_zero():
            continue
        nodes = expression._nodes | nodes_of.get(key, NO_NODES)
        result[key] = make(layout.from_column(ca.densify(entry), expression._shape), expression._shape, nodes)
    return result


def jacobian(expression: Expression, symbols: Sequence[Symbol], heuristic: bool = True) -> Expression:
    """Return the derivatives by ``symbols`` along the last axis, see :meth:`Expression.jacobian`."""
    from kineverse.symbols import check_symbols

    entries = gradient(expression, heuristic)
    columns = []
    nodes = NO_NODES
    for symbol in check_symbols(symbols):
        if not symbol.has_derivative:
            raise ExpressionError(
                f"Parameter '{symbol}' has no derivative to read a column from; "
                "use partial([...]) for ∂/∂parameter."
            )
        entry = entries.get(symbol.derivative())
        if entry is None:
            columns.append(ca.SX.zeros(expression.size, 1))
        else:
            columns.append(layout.column(entry._sx, entry._shape))
            nodes = nodes | entry._nodes
    shape = (*expression._shape, len(columns))
    matrix = ca.horzcat(*columns) if columns else ca.SX.zeros(expression.size, 0)
    return make(_last_axis(matrix, shape), shape, nodes)


def partial(expression: Expression, symbols: Sequence[Symbol]) -> Expression:
    """Return the plain partial derivatives, see :meth:`Expression.partial`."""
    from kineverse.symbols import check_symbols

    from .lowering import lowered

    shape = (*expression._shape, len(symbols))
    elements = layout.column(lowered(expression), expression._shape)
    wanted = check_symbols(symbols)
    if not wanted:
        return make(_last_axis(ca.SX.zeros(expression.size, 0), shape), shape, NO_NODES)
    matrix = ca.densify(ca.jacobian(elements, ca.vertcat(*(s._sx for s in wanted))))
    return make(_last_axis(matrix, shape), shape, NO_NODES)


def _last_axis(matrix: layout.SX, shape: layout.Shape) -> layout.SX:
    # rows are the elements of the expression in C order, so this already is the layout of the longer shape;
    # only a vector of columns, which is stored upright, has to be turned.
    return matrix.T if len(shape) == 1 else matrix


def total_derivative(expression: Expression, heuristic: bool = False) -> Expression:
    """Return ``ė = Σ D(e)[v]·v``, of the expression's shape: its rate as a function of the speeds."""
    if not expression._shape and not expression._nodes and expression._sx.is_symbolic():
        (symbol,) = expression.symbols  # by far the most frequent case: a limit on a joint's speed
        return (
            symbol.derivative()
            if symbol.has_derivative
            else make(layout.from_array(np.zeros(())), (), NO_NODES)
        )
    rate = make(layout.from_array(np.zeros(expression.shape)), expression.shape, NO_NODES)
    for key, entry in gradient(expression, heuristic).items():
        rate = rate + entry * key
    return rate
