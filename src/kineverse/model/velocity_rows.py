"""Linear inequality rows in the speeds that enforce constraints over a time step.

For a constraint on positions, ``l <= φ <= u``, at rate γ <= 1/Δt and without heuristics::

    (D(φ) - D(u))·v <= γ (u - φ)        (D(φ) - D(l))·v >= γ (l - φ)

so one step of Δt never crosses a bound. Outside a bound the right side asks for the way back, as fast as γ
says but never faster than one motion can go that keeps all other rows as well: :mod:`.way_back`. So all rows
together can always be obeyed, from anywhere, where speeds may be zero; limits on speeds that exclude zero are
kept as they are, and may then leave no way. Where accelerations are limited, the speed towards a bound stays
below what can be braked within the distance left, on the way back as well.

A constraint that is affine in speeds is the row itself. A limited norm of two speeds becomes the 16 sides of
the polygon inscribed in the circle, which gives away 1.9 % at most and never exceeds the limit; one of three
becomes the 128 faces of a polyhedron inscribed in the sphere, which gives away 3.8 %.

Farther out than a closed loop is known, what it determines has the rows that it has where that begins: the
way back needs no value from there.
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
    speed_limits: Mapping[str, Constraint] | None = None,
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
    speed_limits
        More constraints, of which those on speeds and accelerations of columns are kept as well, and so are
        those of the columns that these bring in. Others are passed over.

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
    rows = limits.rows + _position_rows(constraints, gaps, limits.of(moving), moving, gamma, dt, brakes)
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
    """Take in a constraint of order 1 or more; return the reason if it cannot be."""
    reason = limits.add(name, constraint) if constraint.order == 1 else _note_brake(constraint, brakes)
    return [] if reason is None else [(name, reason)]


def _note_brake(constraint: Constraint, brakes: dict[Symbol, Expression]) -> str | None:
    """Keep what one speed can be braked with; return why not, if it is something else."""
    expression, lower, upper = constraint.expression, constraint.lower, constraint.upper
    if not isinstance(expression, Symbol) or expression.order != 2:
        return "it limits derivatives beyond speeds, other than a single acceleration"
    if is_infinite(lower) and is_infinite(upper):
        return "it has no bounds"
    # The weaker side is what can be relied on for braking in either direction.
    deceleration = raw_min(-lower, upper)
    speed = expression.integral()
    brakes[speed] = raw_min(brakes[speed], deceleration) if speed in brakes else deceleration
    return None


def _speeds_of(constraint: Constraint, rates: Rates) -> set[Symbol]:
    """Return the free speeds that a constraint on speeds or on accelerations is about."""
    found: set[Symbol] = set()
    for s in constraint.expression.symbols:
        if s.order:
            row = rates.row(s.position)
            found.update([s.position.derivative()] if row is None else row)
    return found


@dataclass(frozen=True)
class _Gap:
    """The distance to one bound on positions, an upper one if the sign is 1, and how speeds widen it."""

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
    """Return the rows of constraints on positions; who is no column stands still and brakes nothing."""
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
                # Of a step at speed s, with s - a·dt in the next one and so on, s²/2a + s·dt is left to go.
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
        for sign, side, room in zip(signs, both.sides, rooms, strict=True):
            weights = side.away if sign < 0 else {s: -w for s, w in side.away.items()}
            low, high = (-room, INFINITE) if sign < 0 else (-INFINITE, room)
            ends.append(SpeedRow(name, weights, low, high))
        if len(ends) == 2 and ends[0].weights == ends[1].weights:
            ends = [SpeedRow(name, ends[0].weights, ends[0].lower, ends[1].upper)]
        rows += ends
    return rows


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
    weights: Mapping[Symbol, Expression], magnitudes: Mapping[Symbol, Expression]
) -> Expression | None:
    total = ZERO
    for speed, weight in weights.items():
        if speed not in magnitudes:
            return None
        total = total + abs(weight) * magnitudes[speed]
    return total
