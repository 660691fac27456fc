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
from kineverse.model.speed_limits import is_infinite, raw_min
from kineverse.symbols import Symbol

from .formulation import Formulation, GoalRows, HoldRows, find_speeds
from .tasks import Goal

_SAMPLES = 16
_IMMOVABLE = 1e-5
"""Root mean square of a gradient, relative to the largest one of equalities, below which it is rounding."""
_LEAST_SHARE = 0.01
"""Smallest default weight of a speed, so that damping stays positive."""


@dataclass(frozen=True)
class Costs:
    """Weights of the terms that no task states.

    Attributes
    ----------
    damping
        Weight of squared speeds.
    smooth, jerk
        Weights of the first and second differences of commands.
    progress
        Weight of the progress of holds, as a multiple of the largest one of goals.
    recovery
        Rate at which violations of limits decay [1/s].
    """

    damping: float = 1e-4
    smooth: float = 1e-2
    jerk: float = 0.0
    progress: float = 10.0
    recovery: float = 5.0


@dataclass(frozen=True)
class JointWeights:
    """Factors of the speeds in the terms that no task states.

    Attributes
    ----------
    shares
        (n,) factors c_i of damping, smoothness and posture. They are mean squares of the speed's column in
        the Jacobians of goals and holds over random states, so that units of coordinates do not matter; times
        the share of bodies that the speed moves, or a given factor.
    curvatures
        For each goal (n,) estimates of ``Σ_j |∂²e/∂q_i∂q_j|``: with the root l of the mean square of a column
        of its Jacobian, for a rotation the lever, ``Σ_j l_i² / max(l_i, l_j)``; times the same shares.
    immovable
        Names of equalities of the model whose gradient is nothing but rounding, such as the parts of a
        planar loop's closure that point out of its plane. A row of them would make others dependent.
    """

    shares: tuple[Expression, ...]
    curvatures: tuple[tuple[Expression, ...], ...]
    immovable: frozenset[str]


def joint_weights(
    formulation: Formulation, weights: Mapping[Symbol | str, ExpressionLike] | None
) -> JointWeights:
    """Return the factors of the speeds, with given ones by coordinate or speed in place of defaults."""
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
        given = as_expression(weight)
        if not given.symbols and not 0 < float(given) < math.inf:
            raise InvalidValueError(f"weights=: the weight of '{key}' is positive, not {weight!r}.")
        factors |= dict.fromkeys(chosen, given)
    scales = _column_scales(formulation)
    sizes = scales[len(formulation.goals) :].sum(axis=1)
    immovable = frozenset(
        hold.name
        for hold, size in zip(formulation.holds, sizes, strict=False)
        if hold.closure and size <= _IMMOVABLE**2 * sizes.max()
    )
    together = scales.sum(axis=0)
    positive = together[together > 0]
    together = np.where(together > 0, together, positive.mean() if len(positive) else 1.0)
    goals = scales[: len(formulation.goals)]
    levers = np.sqrt(np.maximum(goals, np.finfo(float).tiny))
    longer = np.maximum(levers[:, :, None], levers[:, None, :])
    curvatures = 0.75 * goals * ((goals > 0)[:, None, :] / longer).sum(axis=2)
    return JointWeights(
        tuple(float(scale) * factors[s] for s, scale in zip(speeds, together, strict=True)),
        tuple(
            tuple(float(each) * factors[s] for s, each in zip(speeds, row, strict=True)) for row in curvatures
        ),
        immovable,
    )


def _column_scales(formulation: Formulation) -> Array:
    """Return mean squares over random states of the columns of Jacobians of goals, then holds, (k, n)."""
    model, n = formulation.model, len(formulation.speeds)
    tasks: tuple[GoalRows | HoldRows, ...] = (*formulation.goals, *formulation.holds)
    if not tasks:
        return np.ones((1, n))
    stacked = as_expression(np.concatenate([row.jacobian for row in tasks]))
    first = np.cumsum([0, *(row.error.size for row in tasks[:-1])])
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
            squares.append(np.add.reduceat(J.reshape(-1, n) ** 2, first, axis=0))
    return np.asarray(np.mean(squares, axis=0)) if squares else np.ones((len(tasks), n))


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
    for value in posture.values() if isinstance(posture, Mapping) else (posture,):
        check_weight("posture", value)
    if isinstance(posture, Mapping):
        weights = {s: w for key, w in posture.items() for s in find_speeds(model, (key,), "posture")}
    else:
        asked = {task.expression for task in formulation.tasks if isinstance(task, Goal)}
        weights = {s: posture for s in formulation.speeds if s.position not in asked}
    found = {}
    for speed, weight in weights.items():
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
            speed, least = symbol.integral(), raw_min(-constraint.lower, constraint.upper)
            if not is_infinite(least):
                stated[speed] = raw_min(stated[speed], least) if speed in stated else least
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
