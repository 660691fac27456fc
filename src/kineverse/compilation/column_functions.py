"""Compiled functions of vectors of a model's symbols."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import casadi as ca

from kineverse.expressions.expression import NO_NODES, from_casadi
from kineverse.expressions.layout import SX
from kineverse.lie import Array
from kineverse.symbols import Symbol

from . import CompiledFunction, compile
from .function import WantedTier


def compile_columns(
    columns: Sequence[SX], symbols: Sequence[Symbol], tier: WantedTier = "auto"
) -> CompiledFunction[tuple[Array, ...]]:
    """Compile columns of numbers as a function of a vector of symbols.

    Different symbols may have one name here, as parameters of one path with different values do. The columns
    contain no nodes: where a loop does not close the result is NaN, and no error.
    """
    names = Counter(map(str, set(symbols)))
    inputs = [s if names[str(s)] == 1 else Symbol(f"{s.path}/input {i}") for i, s in enumerate(symbols)]
    renamed = [(old.sx, new.sx) for old, new in zip(symbols, inputs, strict=True) if old is not new]
    if renamed:
        old, new = (ca.vertcat(*side) for side in zip(*renamed, strict=True))
        columns = ca.substitute(list(columns), [old], [new])
    outputs = [from_casadi(ca.densify(column), (column.numel(),), NO_NODES) for column in columns]
    return compile(outputs, inputs, tier=tier)


def insert_values(columns: list[SX], symbols: Sequence[Symbol]) -> list[SX]:
    """Replace symbols by their own values, 0 for those without one."""
    if not symbols:
        return columns
    values = ca.SX(ca.DM([s.value or 0.0 for s in symbols]))
    return ca.substitute(columns, [ca.vertcat(*(s.sx for s in symbols))], [values])
