"""Limits of speeds and accelerations of single coordinates, from a model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from kineverse._checks import finite_number
from kineverse.control.regularization import acceleration_limits
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.expressions.expression import Expression
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.model.velocity_constraints.speed_limits import SpeedLimits
from kineverse.state import State, StateLike, as_state
from kineverse.symbols import Symbol

RAMP = 0.5  # time from rest to the full speed [s] where the model states no acceleration
UNSTATED_SPEED = 1.0  # speed [rad/s], [m/s] of coordinates for which the model states none


class MotionLimits(NamedTuple):
    """Largest speeds and accelerations of coordinates, (n,) each [rad/s], [m/s] and per second.

    See Also
    --------
    kineverse.planning.motion_limits
    """

    velocity: Array
    acceleration: Array


def motion_limits(
    model: ModelView,
    symbols: Sequence[Symbol],
    *,
    ramp: float = RAMP,
    speed: float = UNSTATED_SPEED,
    state: StateLike | None = None,
) -> MotionLimits:
    """Return limits of single coordinates that imply those of the model.

    Each coordinate may use its limits whatever the others do: the limit of a sum or of a norm of k speeds,
    such as that of a mobile base, is shared by them, 1/k or 1/√k for each. Limits that depend on the state
    are those at one state.

    Parameters
    ----------
    symbols
        Coordinates that move together (n,).
    ramp
        Time from rest to full speed [s], which gives the acceleration of coordinates without a limit of it
        in the model.
    speed
        Speed of coordinates without a limit of it [rad/s], [m/s], such as those that wheels move.
    state
        State at which limits are evaluated; the default state if None.

    Raises
    ------
    InvalidValueError
        For a ramp or speed that is not positive.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> kv.planning.motion_limits(model, [model.symbol("kitchen/fridge_door")])
    MotionLimits(velocity=array([1.5]), acceleration=array([3.]))
    """
    for name, number in (("ramp", ramp), ("speed", speed)):
        checked = finite_number(number)
        if checked is None or checked <= 0:
            raise InvalidValueError(f"{name}= is a positive number, not {number!r}.")
    known = model.symbols
    for symbol in symbols:
        if symbol not in known:
            raise UnknownNameError(
                f"The model has no coordinate '{symbol}'. {suggest(str(symbol), map(str, known), 'symbol')}"
            )
    values = model.default_state() if state is None else as_state(state, known)
    speeds = [symbol.derivative() for symbol in symbols]
    bounds = _speed_bounds(model, speeds, values)
    velocity = np.array([bounds.get(s, math.inf) for s in speeds])
    velocity[np.isinf(velocity)] = speed
    stated, _ = acceleration_limits(model, None)
    result = [_evaluate(stated[s], values) if s in stated else math.inf for s in speeds]
    acceleration = np.array(result, dtype=float)
    return MotionLimits(velocity, np.where(np.isfinite(acceleration), acceleration, velocity / ramp))


def _speed_bounds(model: ModelView, speeds: Sequence[Symbol], values: State) -> dict[Symbol, float]:
    """Return largest magnitudes of speeds that may all be used at once."""
    moving = {s for s in speeds if s in model.speeds}
    limits = SpeedLimits(model.rates)
    for name, constraint in model.constraints_for(moving).items():
        if max((s.order for s in constraint.expression.symbols), default=0) == 1:
            limits.add(name, constraint)
    admissible, bounds = limits.admissible_speeds(moving), {}
    for symbol, (low, high) in admissible.box.items():
        bounds[symbol] = min(-_evaluate(low, values), _evaluate(high, values))

    def tighten(weights: Mapping[Symbol, Expression], bound: float) -> None:
        for symbol, weight in weights.items():
            size = abs(_evaluate(weight, values))
            if size > 0:
                bounds[symbol] = min(bounds.get(symbol, math.inf), bound / size)

    for row in admissible.coupled:
        count = sum(abs(_evaluate(w, values)) > 0 for w in row.weights.values())
        bound = min(-_evaluate(row.lower, values), _evaluate(row.upper, values))
        tighten(row.weights, bound / max(count, 1))
    for ball in admissible.balls:
        count = len({symbol for component in ball.components for symbol in component})
        radius = _evaluate(ball.radius, values)
        for component in ball.components:
            # √count for the number of speeds in the norm, and once more for those within a component.
            tighten(component, radius / math.sqrt(count) / math.sqrt(max(len(component), 1)))
    return bounds


def _evaluate(expression: Expression, values: State) -> float:
    if not expression.symbols:
        return float(expression)
    return float(expression(State({s: values[s] for s in expression.symbols if s in values})))
