"""Costs of a controller that no task states: damping, smoothness, posture; and limits on accelerations."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from kineverse.compilation.evaluator import bind
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, ExpressionLike, as_expression
from kineverse.expressions.graph import dense_column
from kineverse.lie import Array
from kineverse.model.frame_dependence import count_moved_bodies
from kineverse.model.model_view import ModelView
from kineverse.model.velocity_constraints.speed_limits import is_infinite, raw_min
from kineverse.symbols import Symbol

from .formulation import Formulation, GoalRows, HoldRows, find_speeds
from .tasks import Goal

_SAMPLES = 16
_IMMOVABLE = 1e-5
"""Root mean square of a gradient, relative to the largest one of equalities, below which it is rounding."""
_SHIFT = 1e-6  # step of finite differences, in units of coordinates
_LEAST_SHARE = 0.01  # smallest default weight of a speed, so that damping stays positive


@dataclass(frozen=True)
class Costs:
    """Weights of the terms that no task states."""

    damping: float = 1e-4  # of squared speeds
    smooth: float = 1e-2  # of first differences of commands
    jerk: float = 0.0  # of second differences
    progress: float = 10.0  # of the progress of holds, as a multiple of the largest weight of goals
    recovery: float = 5.0  # rate at which violations of limits decay [1/s]


@dataclass(frozen=True)
class JointWeights:
    """Factors of the speeds in the terms that no task states.

    The shares c_i are mean squares of the columns of the Jacobians of goals and holds over random states, so
    that units do not matter, times the share of bodies that a speed moves. By the name of a goal about
    positions, ``Σ κ_i v_i²`` bounds the second derivative of its errors: ``Σ_j |∂²e/∂q_i∂q_j| l_i/l_j``, with
    l the root mean squares of the columns, times the same share.
    """

    shares: tuple[Expression, ...]  # (n,), c_i
    curvatures: Mapping[str, tuple[Expression, ...]]  # (n,) each, κ_i
    immovable: frozenset[str]  # equalities of the model whose gradient is nothing but rounding


def joint_weights(
    formulation: Formulation, weights: Mapping[Symbol | str, ExpressionLike] | None
) -> JointWeights:
    """Return the factors of the speeds, with given ones by coordinate or speed in place of defaults."""
    model, speeds = formulation.model, formulation.speeds
    moved = count_moved_bodies(model, speeds)
    most = max(moved.values(), default=0)
    shares = {s: max(count / most, _LEAST_SHARE) if most else 1.0 for s, count in moved.items()}
    factors = {s: as_expression(share) for s, share in shares.items()}
    for key, weight in (weights or {}).items():
        chosen = find_speeds(model, (key,), "weights")
        if any(s not in factors for s in chosen):
            raise InvalidValueError(f"weights=: no task moves '{key}', so it has no weight.")
        factor = as_expression(weight)
        if not factor.symbols and not 0 < float(factor) < math.inf:
            raise InvalidValueError(f"weights=: the weight of '{key}' is positive, not {weight!r}.")
        factors |= dict.fromkeys(chosen, factor)
    squares, curvatures = _sample_jacobians(formulation)
    sizes = squares[len(formulation.goals) :].sum(axis=1)
    immovable = frozenset(
        hold.name
        for hold, size in zip(formulation.holds, sizes, strict=False)
        if hold.closure and size <= _IMMOVABLE**2 * sizes.max()
    )
    together = squares.sum(axis=0)
    positive = together[together > 0]
    together = np.where(together > 0, together, positive.mean() if len(positive) else 1.0)
    return JointWeights(
        tuple(float(square) * factors[s] for s, square in zip(speeds, together, strict=True)),
        {
            name: tuple(float(each) * factors[s] for s, each in zip(speeds, row, strict=True))
            for name, row in curvatures.items()
        },
        immovable,
    )


def _sample_jacobians(formulation: Formulation) -> tuple[Array, dict[str, Array]]:
    """Return mean squares l² of the columns of Jacobians of goals, then holds, (k, n), and factors κ.

    The factors are by the name of the goal, (n,), for goals about positions.
    """
    model, n = formulation.model, len(formulation.speeds)
    tasks: tuple[GoalRows | HoldRows, ...] = (*formulation.goals, *formulation.holds)
    if not tasks:
        return np.ones((1, n)), {}
    stacked = as_expression(np.concatenate([row.jacobian for row in tasks]))
    first = np.cumsum([0, *(row.error.size for row in tasks[:-1])])
    goals = {k: goal for k, goal in enumerate(formulation.goals) if not goal.about_speeds}
    part = as_expression(np.concatenate([np.zeros((0, n)), *(goal.jacobian for goal in goals.values())]))
    ends = np.cumsum([0, *(goal.error.size for goal in goals.values())])[:-1]
    symbols = stacked.symbols
    every, curved = _bind_matrix(stacked, symbols), _bind_matrix(part, symbols)
    place = {s: k for k, s in enumerate(symbols)}
    known = [(j, place[s.position]) for j, s in enumerate(formulation.speeds) if s.position in place]
    generator, squares, slopes = np.random.default_rng(0), [], []
    at = model.default_state()
    ranges = []
    for symbol in symbols:
        value = at.given(symbol) or symbol.value or 0.0
        lower, upper = model.limits(symbol) if symbol in model.degrees_of_freedom else (value, value)
        ranges.append((max(lower, value - math.pi), min(upper, value + math.pi)))
    for _ in range(_SAMPLES):
        q = np.array([generator.uniform(low, max(low, high)) for low, high in ranges])
        J, here = every(q), curved(q).copy()
        change = np.zeros((len(here), n, n))
        for j, k in known if goals else ():
            moved = q.copy()
            moved[k] += _SHIFT
            change[:, :, j] = (curved(moved) - here) / _SHIFT
        if np.isfinite(J).all() and np.isfinite(change).all():  # else outside of the domain of a closed loop
            squares.append(np.add.reduceat(J**2, first, axis=0))
            slopes.append(np.sqrt(np.add.reduceat(change**2, ends, axis=0)) if goals else change)
    if not squares:
        return np.ones((len(tasks), n)), {goal.name: np.ones(n) for goal in goals.values()}
    square = np.mean(squares, axis=0)
    bounds = _bound_curvature(formulation, square[list(goals)], slopes, symbols)
    return square, {goal.name: bound for goal, bound in zip(goals.values(), bounds, strict=True)}


def _bind_matrix(matrix: Expression, symbols: Sequence[Symbol]) -> Callable[[Array], Array]:
    """Return a function of values of symbols that writes an (m, n) matrix to one array, and returns it."""
    # Each state counts once, so common parts are not looked for.
    function = ca.Function("J", [ca.vertcat(*(s.sx for s in symbols))], [dense_column(matrix)])
    vector, result = np.zeros(len(symbols)), np.zeros(matrix.shape)
    run, keep = bind(function, vector, (result,), None)

    def evaluate(q: Array, _: object = keep) -> Array:
        vector[:] = q
        run()
        return result

    return evaluate


def _bound_curvature(
    formulation: Formulation, square: Array, slopes: Sequence[Array], symbols: Iterable[Symbol]
) -> Array:
    """Return factors κ, (k, n), from mean squares of the columns of Jacobians and derivatives (k, n, n)."""
    lever = np.sqrt(np.maximum(square, np.finfo(float).tiny))
    # The median, since rotation vectors jump.
    second = np.median(slopes, axis=0)
    second = np.maximum(second, second.transpose(0, 2, 1))
    # Speeds that drive other coordinates, such as those of wheels, count as rotations.
    driving = {s for symbol in symbols for s in formulation.model.rates.row(symbol) or ()}
    other = np.array([s in driving for s in formulation.speeds])
    product = lever[:, :, None] * lever[:, None, :]
    usual = product / np.maximum(lever[:, :, None], lever[:, None, :])
    second = np.where(other[:, None] & other, np.maximum(usual, second), second)
    ratio = np.where(square[:, None, :] > 0, lever[:, :, None] / lever[:, None, :], 0.0)
    bound: Array = np.where(square > 0, (second * ratio).sum(axis=2), 0.0)
    return bound


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
        goals = (task.expression for task in formulation.tasks if isinstance(task, Goal))
        asked = {goal for goal in goals if isinstance(goal, Symbol)}
        weights = {s: posture for s in formulation.speeds if s.position not in asked}
    result = {}
    for speed, weight in weights.items():
        coordinate = speed.position
        if weight and coordinate in model.degrees_of_freedom and coordinate not in model.rates:
            lower, upper = model.limits(coordinate)
            if math.isfinite(lower) and math.isfinite(upper):
                result[speed] = weight, (lower + upper) / 2
    return result


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
        limited = {s: a for key, a in chosen.items() for s in find_speeds(model, (key,), "acceleration")}
    else:
        limited = dict.fromkeys(model.speeds, chosen)
    for speed, limit in limited.items():
        if not (isinstance(limit, int | float) and 0 < limit < math.inf):
            name = speed.position
            raise InvalidValueError(f"The acceleration of '{name}' is a positive limit, not {limit!r}.")
    limits = {s: as_expression(limit) for s, limit in limited.items()}
    limits |= {s: raw_min(stated[s], limit) for s, limit in limits.items() if s in stated}
    return stated, limits
