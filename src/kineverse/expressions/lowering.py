"""From expressions with opaque nodes to plain CasADi graphs of symbols."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import casadi as ca

from . import layout
from .expression import Expression
from .layout import SX
from .leaves import bottom_up, leaves

if TYPE_CHECKING:
    from .node import Node


def lowered(expression: Expression) -> SX:
    """Return the ``SX`` with every node replaced by its value."""
    if not expression._nodes:
        return expression._sx
    if expression._lowered is None:
        for node in bottom_up(leaves(expression)[1], lambda n: (n.value,), _is_lowered):
            _lower(node.value)
        _lower(expression)
    return expression._lowered


def _is_lowered(node: Node) -> bool:
    return not node.value._nodes or node.value._lowered is not None


def _lower(expression: Expression) -> None:
    _, nodes = leaves(expression)
    if nodes:
        values = [ca.densify(lowered(n.value)) for n in nodes]
        (expression._lowered,) = ca.substitute([expression._sx], [n.sx for n in nodes], values)
    else:
        expression._lowered = expression._sx


def dense_column(expression: Expression) -> SX:
    """Return an expression as one dense column of its elements in C order."""
    return ca.densify(layout.column(lowered(expression), expression.shape))


def lower(expressions: Sequence[Expression]) -> list[SX]:
    """Return each expression as one dense column of its elements in C order, common parts shared."""
    columns = [dense_column(e) for e in expressions]
    if not columns:
        return []
    return [ca.densify(c) for c in ca.vertsplit(ca.cse(ca.vertcat(*columns)), _offsets(columns))]


def _offsets(columns: list[SX]) -> list[int]:
    offsets = [0]
    for column in columns:
        offsets.append(offsets[-1] + column.numel())
    return offsets
