"""Linear inequality rows in the speeds that enforce constraints over a time step.

For a constraint on positions, ``l <= φ <= u``, at rate γ <= 1/Δt and without heuristics::

    (D(φ) - D(u))·v <= γ (u - φ)        (D(φ) - D(l))·v >= γ (l - φ)

so one step of Δt never crosses a bound. Outside a bound, the right side demands a recovery speed of γ times
the violation, reduced until one motion satisfies all rows: :mod:`.feasibility`. So all rows together are
feasible at every state, if zero speed is allowed. Limits on speeds that exclude zero are kept, and may make
the rows infeasible. With limits on accelerations, the speed towards a bound is at most the one that can be
braked within the remaining distance, also during recovery.

A constraint that is affine in speeds is a row itself. A bound on the norm of two speeds becomes the 16 sides
of the polygon inscribed in the circle, which loses at most 1.9 % and never exceeds the limit; of three
speeds, the 128 faces of a polyhedron inscribed in the sphere, which loses at most 3.8 %.

Outside the domain of a closed loop, its dependent coordinates have the rows of the boundary of the domain, so
recovery needs no value outside.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from kineverse._checks import real_number
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, array
from kineverse.expressions.functions import sqrt
from kineverse.expressions.implicit import clamp_to_domains
from kineverse.symbols import Symbol, check_symbols

from .constraint import Constraint
from .feasibility import RecoveryBound, RecoveryBounds, limit_recovery
from .rates import Rates
from .speed_limits import (
    INFINITE,
    ZERO,
    AdmissibleSpeeds,
    SpeedLimits,
    SpeedRow,
    clamp_above,
    is_infinite,
    raw_max,
    raw_min,
    select_moving,
)


@dataclass(frozen=True)
class VelocityRows:
    """Linear rows ``lower <= matrix @ v <= upper`` in the speeds v.

    Attributes
    ----------
    speeds
        Speeds in the order of the n columns.
    matrix, lower, upper
        Expressions of positions (and parameters), shapes (m, n), (m,) and (m,).
    names
        Name of the constraint of each row.
    skipped
        Constraints that cannot be rows, as pairs (name, reason).
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
    speed_limits: Mapping[str, Constraint] | None = None,
) -> VelocityRows:
    """Return the rows that enforce constraints over the next step; see the module for the equations.

    Parameters
    ----------
    constraints
        Constraints by name, from :attr:`.Model.constraints` or :meth:`.Model.constraints_for`.
    dt
        Control period Δt [s].
    rates
        Rate table of the model, to eliminate the speeds of driven coordinates.
    speeds
        Columns; by default the speeds of the constraints, sorted. All other speeds are assumed to be zero.
    gain
        Gain γ [1/s], at most 1/Δt, which is the default.
    speed_limits
        Further constraints. Those on speeds and accelerations of columns are enforced as well, and so are
        those of the columns that they add. Others are ignored.

    Raises
    ------
    InvalidValueError
        For a Δt that is not positive or a gain outside (0, 1/Δt].
    """
    dt, gain = _checked(dt, "The step dt"), None if gain is None else _checked(gain, "The gain")
    if not 0 < dt < math.inf:
        raise InvalidValueError(f"The step dt is a positive time in seconds, not {dt!r}.")
    gamma = 1 / dt if gain is None else gain
    if not 0 < gamma <= 1 / dt * (1 + 1e-12):
        raise InvalidValueError(f"The gain must lie in (0, 1/dt] = (0, {1 / dt:g}], not {gain!r}.")
    table = rates if rates is not None else Rates({})
    limits = SpeedLimits(table)
    skipped: list[tuple[str, str]] = []
    brakes: dict[Symbol, Expression] = {}
    for name, constraint in constraints.items():
        if constraint.order:
            skipped += _about_speeds(name, constraint, limits, brakes)
    gaps: dict[str, list[_Gap]] = {}
    for name, constraint in constraints.items():
        if constraint.order == 0:
            found = [gap for gap in _gaps(constraint, table) if gap.away]
            bounded = not (is_infinite(constraint.lower) and is_infinite(constraint.upper))
            if any(s.order > 1 for gap in found for s in gap.away):
                skipped.append((name, "its gradient is about derivatives beyond speeds"))
            elif found:
                gaps[name] = found
            else:
                skipped.append((name, "nothing that moves changes it" if bounded else "it has no bounds"))
    moving = {s for found in gaps.values() for gap in found for s in gap.away}
    moving.update(s for row in limits.rows for s in row.weights)
    if speeds is not None:
        speeds = check_symbols(speeds)
        moving = set(speeds)
    waiting = {
        name: (constraint, _speeds_of(constraint, table))
        for name, constraint in (speed_limits or {}).items()
        if name not in constraints and constraint.order in (1, 2)
    }
    while named := [name for name, (_, about) in waiting.items() if not moving.isdisjoint(about)]:
        known = len(limits.rows)
        for name in named:
            skipped += _about_speeds(name, waiting.pop(name)[0], limits, brakes)
        if speeds is None:
            moving.update(s for row in limits.rows[known:] for s in row.weights)
    columns = tuple(speeds) if speeds is not None else tuple(sorted(moving, key=lambda s: s.sort_key))
    rows = limits.rows + _position_rows(
        constraints, gaps, limits.admissible_speeds(moving), moving, gamma, dt, brakes
    )
    rows = [row for row in rows if any(s in row.weights for s in columns)]
    weights = [row.weights.get(s, ZERO) for row in rows for s in columns]
    return VelocityRows(
        columns,
        array(weights).reshape(len(rows), len(columns)),
        array([row.lower for row in rows]),
        array([row.upper for row in rows]),
        tuple(row.name for row in rows),
        tuple(skipped),
    )


def _checked(value: float, what: str) -> float:
    try:
        return real_number(value)
    except (TypeError, ValueError, OverflowError):
        raise InvalidValueError(f"{what} is a number, not {value!r}.") from None


def _about_speeds(
    name: str, constraint: Constraint, limits: SpeedLimits, brakes: dict[Symbol, Expression]
) -> list[tuple[str, str]]:
    """Add a constraint of order 1 or 2, or return the reason if it cannot be a row."""
    reason = limits.add(name, constraint) if constraint.order == 1 else _note_brake(constraint, brakes)
    return [] if reason is None else [(name, reason)]


def _note_brake(constraint: Constraint, brakes: dict[Symbol, Expression]) -> str | None:
    """Record the deceleration limit of one speed, or return the reason if the constraint is none."""
    expression, lower, upper = constraint.expression, constraint.lower, constraint.upper
    if not isinstance(expression, Symbol) or expression.order != 2:
        return "it limits derivatives beyond speeds, other than a single acceleration"
    if is_infinite(lower) and is_infinite(upper):
        return "it has no bounds"
    # The smaller of the two limits holds for braking in both directions.
    deceleration = raw_min(-lower, upper)
    speed = expression.integral()
    brakes[speed] = raw_min(brakes[speed], deceleration) if speed in brakes else deceleration
    return None


def _speeds_of(constraint: Constraint, rates: Rates) -> set[Symbol]:
    """Return the free speeds of a constraint on speeds or accelerations."""
    found: set[Symbol] = set()
    for s in constraint.expression.symbols:
        if s.order:
            row = rates.row(s.position)
            found.update([s.position.derivative()] if row is None else row)
    return found


@dataclass(frozen=True)
class _Gap:
    """Distance to one position bound, an upper bound if the sign is 1, and its rate by speed."""

    sign: int
    distance: Expression
    away: Mapping[Symbol, Expression]


def _gaps(constraint: Constraint, rates: Rates) -> list[_Gap]:
    found = []
    for sign, bound in ((-1, constraint.lower), (1, constraint.upper)):
        if not is_infinite(bound):
            distance = sign * (bound - constraint.expression)
            away = _over_free_speeds(distance.gradient(heuristic=False), rates)
            away = {s: clamp_to_domains(weight) for s, weight in away.items()}
            found.append(_Gap(sign, clamp_to_domains(distance), select_moving(away, away)))
    return found


def _position_rows(
    constraints: Mapping[str, Constraint],
    gaps: Mapping[str, list[_Gap]],
    limits: AdmissibleSpeeds,
    moving: Collection[Symbol],
    gamma: float,
    dt: float,
    brakes: Mapping[Symbol, Expression],
) -> list[SpeedRow]:
    """Return the rows of position constraints; speeds that are no columns are zero."""
    named: list[tuple[str, list[int]]] = []
    bounds = []
    for name, found in gaps.items():
        sides, signs, braked = [], [], False
        for gap in found:
            away = select_moving(gap.away, moving)
            if not away:
                continue
            room = gamma * gap.distance
            deceleration = _total(away, brakes)
            if deceleration is not None:
                braked = True
                # Braking distance of steps at speeds s, s - a·dt, ...: at most s²/2a + s·dt.
                step = deceleration * dt
                left = 2 * deceleration * raw_max(gap.distance, ZERO)
                room = clamp_above(room, sqrt(step * step + left) - step)
            sides.append(RecoveryBound(away, room))
            signs.append(gap.sign)
        if sides:
            constant = not constraints[name].lower.symbols and not constraints[name].upper.symbols
            named.append((name, signs))
            bounds.append(RecoveryBounds(tuple(sides), apart=constant and not braked))
    rows = []
    for (name, signs), both, rooms in zip(named, bounds, limit_recovery(bounds, limits), strict=True):
        ends = []
        for sign, bound, room in zip(signs, both.bounds, rooms, strict=True):
            weights = bound.away if sign < 0 else {s: -w for s, w in bound.away.items()}
            low, high = (-room, INFINITE) if sign < 0 else (-INFINITE, room)
            ends.append(SpeedRow(name, weights, low, high))
        if len(ends) == 2 and ends[0].weights == ends[1].weights:
            ends = [SpeedRow(name, ends[0].weights, ends[0].lower, ends[1].upper)]
        rows += ends
    return rows


def _over_free_speeds(gradient: Mapping[Symbol, Expression], rates: Rates) -> dict[Symbol, Expression]:
    """Return a gradient in terms of free speeds."""
    result: dict[Symbol, Expression] = {}
    for key, entry in gradient.items():
        row = rates.row(key.position) if key.order == 1 else None
        terms = {key: entry} if row is None else {v: entry * rates.carry(g) for v, g in row.items()}
        for speed, term in terms.items():
            result[speed] = result[speed] + term if speed in result else term
    return result


def _total(
    weights: Mapping[Symbol, Expression], magnitudes: Mapping[Symbol, Expression]
) -> Expression | None:
    total = ZERO
    for speed, weight in weights.items():
        if speed not in magnitudes:
            return None
        total = total + abs(weight) * magnitudes[speed]
    return total
