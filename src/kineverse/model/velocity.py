"""From constraints to linear rows in the speeds, the same for every controller, filter and check.

For a constraint on positions, ``l <= φ <= u``, at rate γ <= 1/Δt and without heuristics::

    (D(φ) - D(u))·v <= γ (u - φ)        (D(φ) - D(l))·v >= γ (l - φ)

so one step of Δt never crosses a bound. Outside a bound the right side asks for the way back, as fast as γ
says but never faster than the speed limits allow, those on several speeds included, so the row stays
feasible. Only two constraints about the same speeds, both violated and pulling apart, can contradict each
other. Where accelerations are limited, the speed towards a bound stays below what can be braked within the
distance left.

A constraint that is affine in speeds is the row itself. A limited norm of two speeds becomes the 16 sides of
the polygon inscribed in the circle, which gives away 1.9 % at most and never exceeds the limit; one of three
becomes the 128 faces of a polyhedron inscribed in the sphere, which gives away 3.8 %.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from kineverse.errors import ValueRejectedError
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.expressions.functions import maximum, minimum, sqrt
from kineverse.symbols import Symbol

from .constraint import Constraint
from .rates import Rates
from .speed_limits import INFINITE, Box, Row, SpeedLimits, is_infinite, least


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
        Columns; by default the speeds that occur, sorted. Others count as standing still.
    gain
        γ [1/s], at most 1/Δt, which is the default.

    Raises
    ------
    ValueRejectedError
        For a Δt that is not positive or a gain outside (0, 1/Δt].
    """
    if not 0 < dt < math.inf:
        raise ValueRejectedError(f"The step dt is a positive time in seconds, not {dt!r}.")
    gamma = 1 / dt if gain is None else gain
    if not 0 < gamma <= 1 / dt * (1 + 1e-12):
        raise ValueRejectedError(f"The gain must lie in (0, 1/dt] = (0, {1 / dt:g}], not {gain!r}.")
    table = rates if rates is not None else Rates({})
    limits = SpeedLimits(table)
    skipped: list[tuple[str, str]] = []
    accelerations: dict[Symbol, Expression] = {}
    on_positions: list[tuple[str, Constraint]] = []
    for name, constraint in constraints.items():
        reason: str | None = None
        if constraint.order == 0:
            on_positions.append((name, constraint))
        elif constraint.order == 1:
            reason = limits.add(name, constraint)
        else:
            reason = _note_acceleration(constraint, accelerations)
        if reason is not None:
            skipped.append((name, reason))
    rows, box = limits.rows, limits.box()
    for name, constraint in on_positions:
        sides = [
            _side(sign, constraint, gamma, dt, table, box, accelerations)
            for sign, bound in ((-1, constraint.lower), (1, constraint.upper))
            if not is_infinite(bound)
        ]
        moving = [side for side in sides if side.weights]
        if any(s.order > 1 for side in moving for s in side.weights):
            skipped.append((name, "its gradient is about derivatives beyond speeds"))
        elif moving:
            rows += _joined(name, moving)
        else:
            skipped.append((name, "nothing that moves changes it" if sides else "it has no bounds"))
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


def _note_acceleration(constraint: Constraint, accelerations: dict[Symbol, Expression]) -> str | None:
    """Keep what one speed can be braked with; return why not, if it is something else."""
    expression, lower, upper = constraint.expression, constraint.lower, constraint.upper
    if not isinstance(expression, Symbol) or expression.order != 2:
        return "it limits derivatives beyond speeds, other than a single acceleration"
    if is_infinite(lower) and is_infinite(upper):
        return "it has no bounds"
    # The weaker side is what can be relied on for braking in either direction.
    deceleration = minimum(-lower, upper)
    speed = expression.integral()
    accelerations[speed] = (
        minimum(accelerations[speed], deceleration) if speed in accelerations else deceleration
    )
    return None


@dataclass(frozen=True)
class _Side:
    """One bound on positions, as ``weights·v <= bound`` (sign 1) or ``>=`` (sign -1)."""

    sign: int
    weights: Mapping[Symbol, Expression]
    bound: Expression


def _side(
    sign: int,
    constraint: Constraint,
    gamma: float,
    dt: float,
    rates: Rates,
    box: Box,
    accelerations: Mapping[Symbol, Expression],
) -> _Side:
    # Written for an upper bound; a lower one is the same for -φ <= -l.
    bound = constraint.upper if sign > 0 else constraint.lower
    room = sign * (bound - constraint.expression)
    away = _over_free_speeds(room.gradient(heuristic=False), rates)
    towards = {speed: -weight for speed, weight in away.items()}
    allowed = gamma * room
    deceleration = _total(towards, accelerations)
    if deceleration is not None:
        # Of a step at speed s, with s - a·dt in the next one and so on, s²/2a + s·dt is left to go at most.
        step = deceleration * dt
        allowed = minimum(allowed, sqrt(step * step + 2 * deceleration * maximum(room, 0)) - step)
    slowest = least(towards, box)
    if slowest is not None:
        allowed = maximum(allowed, minimum(slowest, 0))
    return _Side(sign, {s: sign * w for s, w in towards.items()}, sign * allowed)


def _joined(name: str, sides: list[_Side]) -> list[Row]:
    """Return one row for both sides, or two where bounds move and the left sides differ."""
    ends = [(-INFINITE, side.bound) if side.sign > 0 else (side.bound, INFINITE) for side in sides]
    if len(sides) == 2 and sides[0].weights == sides[1].weights:
        return [Row(name, sides[0].weights, sides[0].bound, sides[1].bound)]
    return [Row(name, side.weights, *end) for side, end in zip(sides, ends, strict=True)]


def _over_free_speeds(gradient: Mapping[Symbol, Expression], rates: Rates) -> dict[Symbol, Expression]:
    """Return a gradient with the speeds of coordinates that others move replaced by their rows."""
    result: dict[Symbol, Expression] = {}
    for key, entry in gradient.items():
        row = rates.row(key.position) if key.order == 1 else None
        terms = {key: entry} if row is None else {v: entry * rates.carry(g) for v, g in row.items()}
        for speed, term in terms.items():
            result[speed] = result[speed] + term if speed in result else term
    return result


def _total(
    towards: Mapping[Symbol, Expression], magnitudes: Mapping[Symbol, Expression]
) -> Expression | None:
    total = as_expression(0.0)
    for speed, weight in towards.items():
        if speed not in magnitudes:
            return None
        total = total + abs(weight) * magnitudes[speed]
    return total if towards else None
