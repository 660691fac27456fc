"""From constraints to linear rows in the speeds, the same for every controller, filter and check.

For a constraint on positions, ``l <= φ <= u``, at rate γ <= 1/Δt and without heuristics::

    (D(φ) - D(u))·v <= γ (u - φ)        (D(φ) - D(l))·v >= γ (l - φ)

so one step of Δt never crosses a bound. Outside a bound the right side asks for the way back, as fast as γ
says but never faster than the speed limits allow, so the row stays feasible. Where accelerations are limited,
the speed towards a bound stays below what can be braked within the distance left.

A constraint that is affine in speeds is the row itself. A limited norm of two speeds becomes the 16 sides of
the polygon inscribed in the circle, which gives away 1.9 % at most and never exceeds the limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from kineverse.errors import ValueRejectedError
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.expressions.functions import Norm, maximum, minimum, sqrt
from kineverse.expressions.gradient import partial
from kineverse.symbols import Symbol

from .constraint import Constraint
from .rates import Rates

SIDES = 16
_INF = float("inf")


@dataclass(frozen=True)
class VelocityRows:
    """Linear rows ``lower <= matrix @ v <= upper`` in the speeds v.

    Attributes
    ----------
    speeds
        The n speeds, in the order of the columns.
    matrix, lower, upper
        Expressions of positions (and parameters), shapes (m, n), (m,) and (m,).
    names
        For each row the name of the constraint it came from.
    skipped
        Pairs (name, reason) of constraints that are no rows in speeds; never silently empty-handed.
    """

    speeds: tuple[Symbol, ...]
    matrix: Expression
    lower: Expression
    upper: Expression
    names: tuple[str, ...]
    skipped: tuple[tuple[str, str], ...]


@dataclass
class _Row:
    name: str
    weights: dict[Symbol, Expression]
    lower: Expression
    upper: Expression


def velocity_rows(
    constraints: Mapping[str, Constraint],
    dt: float,
    *,
    rates: Rates | None = None,
    speeds: Sequence[Symbol] | None = None,
    gain: float | None = None,
) -> VelocityRows:
    """Return the rows that keep constraints over the next step, see the module.

    Parameters
    ----------
    constraints
        As a model hands them out: :attr:`Model.constraints` or :meth:`Model.constraints_for`.
    dt
        Length of a control step Δt [s].
    rates
        The model's rate table, to eliminate left-over speeds of coordinates that wheels move.
    speeds
        Columns; by default the speeds that occur, sorted.
    gain
        γ [1/s], at most 1/Δt, which is the default.

    Raises
    ------
    ValueRejectedError
        For a Δt that is not positive or a gain outside (0, 1/Δt].
    """
    if not 0 < dt < _INF:
        raise ValueRejectedError(f"The step dt is a positive time in seconds, not {dt!r}.")
    gamma = 1 / dt if gain is None else gain
    if not 0 < gamma <= 1 / dt * (1 + 1e-12):
        raise ValueRejectedError(f"The gain must lie in (0, 1/dt] = (0, {1 / dt:g}], not {gain!r}.")
    table = rates if rates is not None else Rates({})
    rows: list[_Row] = []
    skipped: list[tuple[str, str]] = []
    limits: dict[Symbol, tuple[Expression, Expression]] = {}
    accelerations: dict[Symbol, Expression] = {}
    on_positions: list[tuple[str, Constraint]] = []
    for name, constraint in constraints.items():
        if constraint.order == 0:
            on_positions.append((name, constraint))
        elif constraint.order == 1:
            reason = _speed_rows(name, constraint, table, rows, limits)
            if reason:
                skipped.append((name, reason))
        elif constraint.order == 2 and isinstance(constraint.expression, Symbol):
            # The weaker side is what can be relied on for braking in either direction.
            deceleration = minimum(-constraint.lower, constraint.upper)
            accelerations[constraint.expression.integral()] = deceleration
        else:
            skipped.append((name, "it limits derivatives beyond speeds, other than a single acceleration"))
    for name, constraint in on_positions:
        rows += _position_rows(name, constraint, gamma, dt, limits, accelerations)
    found = {s for row in rows for s in row.weights}
    columns = tuple(speeds) if speeds is not None else tuple(sorted(found, key=lambda s: s.sort_key))
    rows = [row for row in rows if any(s in row.weights for s in columns)]
    zero = as_expression(0.0)
    weights = [row.weights.get(s, zero) for row in rows for s in columns]
    return VelocityRows(
        columns,
        array(weights).reshape(len(rows), len(columns)),
        array([row.lower for row in rows]),
        array([row.upper for row in rows]),
        tuple(row.name for row in rows),
        tuple(skipped),
    )


def _position_rows(
    name: str,
    constraint: Constraint,
    gamma: float,
    dt: float,
    limits: Mapping[Symbol, tuple[Expression, Expression]],
    accelerations: Mapping[Symbol, Expression],
) -> list[_Row]:
    sides: list[tuple[dict[Symbol, Expression] | None, Expression]] = []
    for bound, sign in ((constraint.lower, -1), (constraint.upper, 1)):
        if not bound.symbols and math.isinf(float(bound)):
            sides.append((None, as_expression(sign * _INF)))
            continue
        # Written for an upper bound; a lower one is the same for -φ <= -l.
        room = sign * (bound - constraint.expression)
        weights = {k: -sign * w for k, w in room.gradient(heuristic=False).items()}
        towards = {k: sign * w for k, w in weights.items()}
        allowed = gamma * room
        deceleration = _total(towards, accelerations)
        if deceleration is not None:
            distance = maximum(room, 0)
            step = deceleration * dt
            allowed = minimum(allowed, sqrt(step * step + 2 * deceleration * distance) - step)
        slowest = _fastest_retreat(towards, limits)
        if slowest is not None:
            allowed = maximum(allowed, slowest)
        sides.append((weights, sign * allowed))
    (low_weights, lower), (high_weights, upper) = sides
    if low_weights is not None and high_weights is not None and low_weights != high_weights:
        # Bounds that move: two rows with different left sides.
        return [
            _Row(name, low_weights, lower, as_expression(_INF)),
            _Row(name, high_weights, as_expression(-_INF), upper),
        ]
    either = low_weights if low_weights is not None else high_weights
    return [_Row(name, either, lower, upper)] if either else []


def _fastest_retreat(
    towards: Mapping[Symbol, Expression], limits: Mapping[Symbol, tuple[Expression, Expression]]
) -> Expression | None:
    """Return the least value the row can take within the speed limits; None if a speed has none."""
    total = as_expression(0.0)
    for speed, weight in towards.items():
        if speed not in limits:
            return None
        low, high = limits[speed]
        total = total + minimum(weight * low, weight * high)
    return minimum(total, 0)


def _total(
    towards: Mapping[Symbol, Expression], magnitudes: Mapping[Symbol, Expression]
) -> Expression | None:
    total = as_expression(0.0)
    for speed, weight in towards.items():
        if speed not in magnitudes:
            return None
        total = total + abs(weight) * magnitudes[speed]
    return total if towards else None


def _speed_rows(
    name: str,
    constraint: Constraint,
    rates: Rates,
    rows: list[_Row],
    limits: dict[Symbol, tuple[Expression, Expression]],
) -> str | None:
    """Append the rows of a constraint on speeds; return why not, if it has none."""
    lower, upper = constraint.lower, constraint.upper
    if any(s.order for s in (*lower.symbols, *upper.symbols)):
        return "its bounds depend on speeds"
    norm = _norm_of(constraint.expression)
    if norm is None:
        affine = _affine(rates.eliminate(constraint.expression))
        if affine is None:
            return "it is neither affine in the speeds nor a norm of speeds"
        weights, offset = affine
        rows.append(_Row(name, weights, lower - offset, upper - offset))
        if isinstance(constraint.expression, Symbol) and list(weights) == [constraint.expression]:
            low, high = limits.get(constraint.expression, (lower, upper))
            limits[constraint.expression] = (maximum(low, lower), minimum(high, upper))
        return None
    if lower.symbols or float(lower) > 0:
        return "a norm can be bounded from above only"
    parts = [_affine(rates.eliminate(component)) for component in norm]
    if any(part is None for part in parts):
        return "the norm is of something that is not affine in the speeds"
    affine_parts = [part for part in parts if part is not None]
    if len(affine_parts) > 2:
        return "a norm of more than two speeds has no rows here"
    directions = _directions(len(affine_parts))
    reach = math.cos(math.pi / SIDES) if len(affine_parts) == 2 else 1.0
    for direction in directions:
        combined: dict[Symbol, Expression] = {}
        offset = as_expression(0.0)
        for factor, (own, constant) in zip(direction, affine_parts, strict=True):
            offset = offset + factor * constant
            for speed, weight in own.items():
                term = factor * weight
                combined[speed] = combined[speed] + term if speed in combined else term
        rows.append(_Row(name, combined, as_expression(-_INF), upper * reach - offset))
    if all(isinstance(c, Symbol) for c in norm):
        # The largest box inside the polygon, for what counts on single speeds.
        side = upper * (reach / math.sqrt(len(norm)))
        for component in norm:
            assert isinstance(component, Symbol)
            limits.setdefault(component, (-side, side))
    return None


def _directions(dimensions: int) -> list[tuple[float, ...]]:
    if dimensions == 1:
        return [(1.0,), (-1.0,)]
    angles = [2 * math.pi * (k + 0.5) / SIDES for k in range(SIDES)]
    return [(math.cos(a), math.sin(a)) for a in angles]


def _norm_of(expression: Expression) -> list[Expression] | None:
    """Return the components if the expression is a norm and nothing else."""
    if len(expression._nodes) != 1:
        return None
    (node,) = expression._nodes
    if not isinstance(node, Norm) or expression._sx.element_hash() != node.sx.element_hash():
        return None
    return list(node.arguments[0])


def _affine(expression: Expression) -> tuple[dict[Symbol, Expression], Expression] | None:
    """Return weights by speed and offset of ``Σ weight·speed + offset``; None if it is not affine."""
    speeds = [s for s in expression.symbols if s.order == 1]
    slopes = partial(expression, speeds)
    if any(s.order for s in slopes.symbols):
        return None
    offset = expression.substitute(dict.fromkeys(speeds, 0.0))
    return {s: slopes[i] for i, s in enumerate(speeds)}, offset
