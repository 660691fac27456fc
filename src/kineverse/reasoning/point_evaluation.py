"""Evaluation of expressions and conditions at points, compiled once for CasADi's interpreter."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache

from kineverse.compile import CompiledFunction, compile  # noqa: A004
from kineverse.errors import InvalidValueError, NoSolutionError
from kineverse.expressions.expression import Expression
from kineverse.model.model_view import ModelView
from kineverse.state import StateLike, as_state
from kineverse.symbols import Symbol

from .boxes import IntervalBox

_ROUNDING = 1e-9


def value_at(expression: Expression, point: Mapping[Symbol, float]) -> float:
    """Return the value of a scalar at a point, which may contain further symbols."""
    function = _function(expression)
    return float(function({symbol: point[symbol] for symbol in function.inputs}))


def is_inside(box: IntervalBox, point: Mapping[Symbol, float]) -> bool:
    """Return True if a point satisfies the conditions of a box."""
    return all(value_at(axis, point) in side for axis, side in box.items())


def default_point(model: ModelView) -> dict[Symbol, float]:
    """Return the default state, completed by the dependent coordinates."""
    point = dict(model.default_state())
    settle_point(model, point)
    return point


def start_point(model: ModelView, state: StateLike | None) -> dict[Symbol, float]:
    """Return the positions at a start: those of a state, and the default ones of what it lacks."""
    point = dict(model.default_state())
    if state is None:
        return point
    given = as_state(state, model.symbols)
    for symbol, value in given.items():
        if symbol.value is not None and value != symbol.value:
            raise InvalidValueError(
                f"The parameter '{symbol}' is {symbol.value:g} in the model and {value:g} in the state. "
                "Locks are read with the value in the model: leave it out of the state, or edit the model."
            )
    return point | dict(given)


def settle_point(model: ModelView, point: dict[Symbol, float]) -> bool:
    """Project a point onto the configurations of the model in place; return False if that is impossible.

    Coordinates whose rates preserve their norm, such as those of a quaternion, are normalised. Dependent
    coordinates are computed from the independent ones.
    """
    rates = model.rates
    for speeds in {frozenset(rates[x]) for x in rates}:
        group = [x for x in rates if rates[x].keys() == speeds]
        growths = (sum(point[x] * value_at(rates[x][v], point) for x in group) for v in speeds)
        size = math.hypot(*(point[x] for x in group))
        if size and all(abs(growth) <= _ROUNDING * size**2 for growth in growths):
            point.update({x: point[x] / size for x in group})
    try:
        point.update({x: value_at(e, point) for x, e in rates.dependent.items()})
    except NoSolutionError:
        return False
    return True


@lru_cache(1024)
def _function(expression: Expression) -> CompiledFunction:
    return compile(expression, tier="interpreter")
