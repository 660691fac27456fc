"""From expressions with opaque nodes to plain CasADi graphs of symbols."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from . import layout
from .expression import Expression
from .layout import SX
from .leaves import leaves


def lowered(expression: Expression) -> SX:
    """Return the ``SX`` with every node replaced by its value."""
    if not expression._nodes:
        return expression._sx
    if expression._lowered is None:
        _, nodes = leaves(expression)
        if nodes:
            (expression._lowered,) = ca.substitute(
                [expression._sx], [n.sx for n in nodes], [lowered(n.value) for n in nodes]
            )
        else:
            expression._lowered = expression._sx
    return expression._lowered


def lower(expressions: Sequence[Expression]) -> list[SX]:
    """Return each expression as one dense column of its elements in C order, common parts shared."""
    columns = [ca.densify(layout.column(lowered(e), e.shape)) for e in expressions]
    if not columns:
        return []
    return [ca.densify(c) for c in ca.vertsplit(ca.cse(ca.vertcat(*columns)), _offsets(columns))]


def _offsets(columns: list[SX]) -> list[int]:
    offsets = [0]
    for column in columns:
        offsets.append(offsets[-1] + column.numel())
    return offsets
