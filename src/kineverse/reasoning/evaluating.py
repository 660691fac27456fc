"""Values of expressions at points, each compiled once for CasADi's interpreter."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

from kineverse.compile import CompiledFunction, compile  # noqa: A004
from kineverse.expressions.expression import Expression
from kineverse.symbols import Symbol


def value_at(expression: Expression, point: Mapping[Symbol, float]) -> float:
    """Return the value of a scalar at a point, which may say more than it needs."""
    function = _function(expression)
    return float(function({symbol: point[symbol] for symbol in function.inputs}))


@lru_cache(1024)
def _function(expression: Expression) -> CompiledFunction:
    return compile(expression, tier="interpreter")
