"""Whether two operations wrote the same."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.lowering import lower
from kineverse.model.contents import expressions_in, mapped
from kineverse.model.operation import ARTICULATIONS, DATA, FRAMES
from kineverse.model.reader import Cell

_SAMPLES = 3
_SEED = 20220

Pair = tuple[Expression, Expression]


def agree(
    one: Mapping[Cell, Any],
    other: Mapping[Cell, Any],
    affordable: Callable[[list[Pair]], bool] = lambda _: True,
) -> bool:
    """Return whether the same is written, in the same order, expressions compared by a few values.

    A number and a constant expression are the same. What is not structurally equal, and not ``affordable``,
    is not compared.
    """
    if list(one) != list(other):
        return False
    pairs: list[Pair] = []
    for cell in one:
        found = _pairs(cell[0], one[cell], other[cell])
        if found is None:
            return False
        pairs += found
    different = [(a, b) for a, b in pairs if a is not b and a != b]
    return not affordable(different) or _close(different)


def _pairs(kind: str, a: Any, b: Any) -> list[Pair] | None:
    """Return the expressions at the same places of two values; None if something else differs."""
    if a is b:
        return []
    if kind == FRAMES:
        return [(a.transform, b.transform)] if a.parent == b.parent else None
    a, b = _without_numbers(kind, a), _without_numbers(kind, b)
    one, other = expressions_in(kind, a), expressions_in(kind, b)
    if len(one) != len(other) or mapped(kind, a, _nothing) != mapped(kind, b, _nothing):
        return None
    return list(zip(one, other, strict=True))


def _nothing(_: Expression) -> float:
    return 0.0


def _without_numbers(kind: str, value: Any) -> Any:
    """Return a written value with expressions in place of its numbers."""
    if kind == ARTICULATIONS:
        return replace(value, dynamics=_without_numbers(DATA, value.dynamics))
    if kind != DATA:
        return value
    if isinstance(value, tuple):
        return tuple(_without_numbers(DATA, item) for item in value)
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return as_expression(value) if is_number else value


def _close(pairs: list[Pair]) -> bool:
    """Return whether expressions and their gradients agree at a few states."""
    values: list[Pair] = []
    for a, b in pairs:
        if a.shape != b.shape:
            return False
        values.append((a, b))
        for heuristic in (True, False):
            x, y = a.gradient(heuristic), b.gradient(heuristic)
            if set(x) != set(y):
                return False
            values += [(x[key], y[key]) for key in x]
    if not values:
        return True
    flat = [e for pair in values for e in pair]
    symbols = sorted({s for e in flat for s in e.symbols}, key=lambda s: s.sort_key)
    inputs = ca.vertcat(*(s._sx for s in symbols)) if symbols else ca.SX(0, 1)
    columns = lower(flat)
    both = ca.Function("both", [inputs], [ca.vertcat(*columns[::2]), ca.vertcat(*columns[1::2])])
    random = np.random.default_rng(_SEED)
    for _ in range(_SAMPLES):
        left, right = both(random.uniform(-1, 1, len(symbols)))
        if not np.allclose(np.array(left), np.array(right), 1e-9, 1e-12, equal_nan=True):
            return False
    return True
