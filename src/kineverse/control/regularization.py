"""Costs of a controller that no task states: damping, smoothness, posture; and limits on accelerations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, ExpressionLike, as_expression
from kineverse.expressions.graph import dense_column
from kineverse.lie import Array
from kineverse.model.frame_dependence import count_moved_bodies
from kineverse.model.model_view import ModelView
from kineverse.model.speed_limits import raw_min
from kineverse.symbols import Symbol

from .formulation import Formulation, find_speeds
from .tasks import Goal

_SAMPLES = 16
_LEAST_SHARE = 0.01
"""Smallest default weight of a speed, so that damping stays positive."""


@dataclass(frozen=True)
class Costs:
    """Weights of the terms that no task states.

    Attributes
    ----------
    damping, error_damping
        Weight of squared speeds, and factor of their product with the rates that goals want.
    smooth, jerk
        Weights of the first and second differences of commands.
    progress
        Weight of the progress of holds.
    recovery
        Rate at which violations of limits decay [1/s].
    """

    damping: float = 1e-4
    error_damping: float = 1.0
    smooth: float = 1e-2
    jerk: float = 0.0
    progress: float = 10.0
    recovery: float = 5.0


def joint_weights(
    formulation: Formulation, weights: Mapping[Symbol | str, ExpressionLike] | None
) -> dict[Symbol, Expression]:
    """Return the factor c_i of damping, smoothness and posture of each speed.

    It is the mean square of the speed's column in the Jacobians of goals and holds over random states, so
    that units of coordinates do not matter; times the share of bodies that the speed moves, or a given
    factor.
    """
    model, speeds = formulation.model, formulation.speeds
    moved = count_moved_bodies(model, speeds)
    most = max(moved.values(), default=0)
    factors = {
        s: as_expression(max(count / most, _LEAST_SHARE) if most else 1.0) for s, count in moved.items()
    }
    for key, weight in (weights or {}).items():
        chosen = find_speeds(model, (key,), "weights")
        if any(s not in factors for s in chosen):
            raise InvalidValueError(f"weights=: no task moves '{key}', so it has no weight.")
        factors |= dict.fromkeys(chosen, as_expression(weight))
    scales = _column_scales(formulation)
    return {s: float(scale) * factors[s] for s, scale in zip(speeds, scales, strict=True)}


def _column_scales(formulation: Formulation) -> Array:
    """Return the mean square of each column of the tasks' Jacobians over random states, (n,)."""
    model, n = formulation.model, len(formulation.speeds)
    jacobians = [row.jacobian for row in formulation.goals] + [row.jacobian for row in formulation.holds]
    if not jacobians:
        return np.ones(n)
    stacked = as_expression(np.concatenate(jacobians))
    symbols = stacked.symbols
    # Each state counts once, so common parts are not looked for.
    function = ca.Function("J", [ca.vertcat(*(s.sx for s in symbols))], [dense_column(stacked)])
    generator, squares = np.random.default_rng(0), []
    at = model.default_state()
    ranges = []
    for symbol in symbols:
        value = at.given(symbol) or symbol.value or 0.0
        lower, upper = model.limits(symbol) if symbol in model.degrees_of_freedom else (value, value)
        ranges.append((max(lower, value - math.pi), min(upper, value + math.pi)))
    for _ in range(_SAMPLES):
        J = np.array(function([generator.uniform(low, max(low, high)) for low, high in ranges]))
        if np.isfinite(J).all():  # else outside of the domain of a closed loop
            squares.append((J.reshape(-1, n) ** 2).sum(axis=0))
    found = np.mean(squares, axis=0) if squares else np.ones(n)
    positive = found[found > 0]
    return np.where(found > 0, found, positive.mean() if len(positive) else 1.0)


def check_weight(name: str, value: float) -> None:
    """Raise InvalidValueError for a weight that is no finite number of at least 0."""
    if not (isinstance(value, int | float) and 0 <= value < math.inf):
        raise InvalidValueError(f"{name}= is a weight of at least 0, not {value!r}.")


def find_posture(
    formulation: Formulation, posture: float | Mapping[Symbol | str, float]
) -> dict[Symbol, tuple[float, float]]:
    """Return weight and middle of the limits by speed.

    By default these are the coordinates that no goal is about directly, such as a door to be opened.
    """
    model = formulation.model
    if isinstance(posture, Mapping):
        weights = {s: w for key, w in posture.items() for s in find_speeds(model, (key,), "posture")}
    else:
        asked = {task.expression for task in formulation.tasks if isinstance(task, Goal)}
        weights = {s: posture for s in formulation.speeds if s.position not in asked}
    found = {}
    for speed, weight in weights.items():
        check_weight("posture", weight)
        coordinate = speed.position
        if weight and coordinate in model.degrees_of_freedom and coordinate not in model.rates:
            lower, upper = model.limits(coordinate)
            if math.isfinite(lower) and math.isfinite(upper):
                found[speed] = weight, (lower + upper) / 2
    return found


def acceleration_limits(
    model: ModelView, chosen: float | Mapping[Symbol | str, float] | None
) -> tuple[dict[Symbol, Expression], dict[Symbol, Expression]]:
    """Return the limits on accelerations that the model states, and those that were chosen, by speed."""
    stated: dict[Symbol, Expression] = {}
    for constraint in model.constraints.values():
        symbol = constraint.expression
        if isinstance(symbol, Symbol) and symbol.order == 2:
            stated[symbol.integral()] = raw_min(-constraint.lower, constraint.upper)
    if chosen is None:
        return stated, {}
    if isinstance(chosen, Mapping):
        given = {s: a for key, a in chosen.items() for s in find_speeds(model, (key,), "acceleration")}
    else:
        given = dict.fromkeys(model.speeds, chosen)
    for speed, limit in given.items():
        if not (isinstance(limit, int | float) and 0 < limit < math.inf):
            raise InvalidValueError(
                f"The acceleration of '{speed.position}' is a positive limit, not {limit!r}."
            )
    limits = {s: as_expression(limit) for s, limit in given.items()}
    limits |= {s: raw_min(stated[s], limit) for s, limit in limits.items() if s in stated}
    return stated, limits
