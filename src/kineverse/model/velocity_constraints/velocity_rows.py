"""Linear inequality rows in the speeds that enforce constraints over a time step.

For a constraint on positions, ``l <= φ <= u``, at rate γ <= 1/Δt and without heuristics::

    (D(φ) - D(u))·v <= γ (u - φ)        (D(φ) - D(l))·v >= γ (l - φ)

so one step of Δt never crosses a bound. Outside a bound, with required recovery, the right side demands a
recovery speed of γ times the violation, reduced until one motion satisfies all rows: :mod:`.feasibility`. So
all rows together are feasible at every state, if zero speed is allowed. With allowed recovery, the right side
is 0 outside a bound: the violation must not grow. So zero speed satisfies all rows at every state, if it is
allowed. Limits on speeds that exclude zero are kept, and may make the rows infeasible. With limits on
accelerations, the speed towards a bound is at most the one that can be braked within the remaining distance,
also during recovery.

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
from functools import cached_property
from typing import Literal, TypeAlias

from msgspec.structs import replace

from kineverse._checks import real_number
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, ExpressionLike, array
from kineverse.expressions.functions import sqrt
from kineverse.expressions.implicit import clamp_to_domains
from kineverse.model.constraint import Constraint
from kineverse.model.rates import Rates
from kineverse.symbols import Symbol, check_symbols

from .feasibility import RecoveryBound, RecoveryBounds, limit_recovery
from .speed_limits import (
    INFINITE,
    ZERO,
    AdmissibleSpeeds,
    SpeedBounds,
    SpeedLimits,
    SpeedRow,
    clamp_above,
    clamp_below,
    is_infinite,
    merge_bounds,
    raw_max,
    raw_min,
    select_moving,
)

Recovery: TypeAlias = Literal["required", "allowed"]


@dataclass(frozen=True)
class VelocityRows:
    """Linear rows ``lower <= matrix @ v <= upper`` in the speeds v."""

    speeds: tuple[Symbol, ...]  # speeds in the order of the n columns
    rows: tuple[SpeedRow, ...]  # m rows, with their nonzero coefficients by speed
    skipped: tuple[tuple[str, str], ...]  # constraints that cannot be rows, as pairs (name, reason)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Name of the constraint of each row."""
        return tuple(row.name for row in self.rows)

    @cached_property
    def matrix(self) -> Expression:
        """Coefficients as an expression of positions (and parameters), shape (m, n)."""
        weights = [row.weights.get(s, ZERO) for row in self.rows for s in self.speeds]
        return array(weights).reshape(len(self.rows), len(self.speeds))

    @cached_property
    def entries(self) -> tuple[tuple[int, int, Expression], ...]:
        """Structurally nonzero entries of the matrix as (row, column, coefficient), row by row."""
        columns = {s: k for k, s in enumerate(self.speeds)}
        return tuple(
            (i, columns[s], weight) for i, row in enumerate(self.rows) for s, weight in row.weights.items()
        )

    @cached_property
    def lower(self) -> Expression:
        """Lower bounds, shape (m,); -infinity for none."""
        return array([row.lower for row in self.rows])

    @cached_property
    def upper(self) -> Expression:
        """Upper bounds, shape (m,); infinity for none."""
        return array([row.upper for row in self.rows])

    @cached_property
    def violation(self) -> Expression:
        """Signed excess of the position constraint of each row, in its unit, shape (m,).

        It is positive above the upper bound, negative below the lower bound, and 0 between them and for rows
        of constraints on speeds. A goal of recovery is ``matrix @ v = -gain * violation``. If the bounds of a
        constraint move differently, each has a row and its own violation.
        """
        return array([row.violation for row in self.rows])

    @cached_property
    def bounds(self) -> SpeedBounds:
        """Rows that have a single column with a constant coefficient, as bounds of that speed."""
        return merge_bounds(self.speeds, [row for row in self.rows if row.is_simple])

    @cached_property
    def general(self) -> VelocityRows:
        """The rows that are not in :attr:`bounds`, with the same columns."""
        return VelocityRows(self.speeds, tuple(row for row in self.rows if not row.is_simple), self.skipped)


def velocity_rows(
    constraints: Mapping[str, Constraint],
    dt: ExpressionLike,
    *,
    rates: Rates | None = None,
    speeds: Sequence[Symbol] | None = None,
    gain: ExpressionLike | None = None,
    speed_limits: Mapping[str, Constraint] | None = None,
    recovery: Recovery = "required",
) -> VelocityRows:
    """Return the rows that enforce constraints over the next step; see the module for the equations."""
    if recovery not in ("required", "allowed"):
        raise InvalidValueError(f"The recovery is 'required' or 'allowed', not {recovery!r}.")
    dt, gamma = _check_step(dt, gain)
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
    admissible = limits.admissible_speeds(moving) if recovery == "required" else None
    rows = limits.rows + _position_rows(constraints, gaps, admissible, moving, gamma, dt, brakes)
    rows = [replace(row, weights=select_moving(row.weights, columns)) for row in rows]
    return VelocityRows(columns, tuple(row for row in rows if row.weights), tuple(skipped))


def _check_step(
    dt: ExpressionLike, gain: ExpressionLike | None
) -> tuple[float | Expression, float | Expression]:
    """Return the step Δt and the gain γ, as numbers unless they are expressions."""
    step = _checked(dt, "The step dt")
    if not isinstance(step, Expression) and not 0 < step < math.inf:
        raise InvalidValueError(f"The step dt is a positive time in seconds, not {step!r}.")
    gamma = 1 / step if gain is None else _checked(gain, "The gain")
    most = math.inf if isinstance(step, Expression) else 1 / step
    if not isinstance(gamma, Expression) and not 0 < gamma <= most * (1 + 1e-12):
        raise InvalidValueError(f"The gain must lie in (0, 1/dt] = (0, {most:g}], not {gain!r}.")
    return step, gamma


def _checked(value: ExpressionLike, what: str) -> float | Expression:
    if isinstance(value, Expression) and value.symbols:
        if value.shape or any(s.order for s in value.symbols):
            raise InvalidValueError(f"{what} is a scalar that depends on no speed, not {value!r}.")
        return value
    try:
        return float(value) if isinstance(value, Expression) else real_number(value)
    except (TypeError, ValueError, OverflowError):
        raise InvalidValueError(f"{what} is a number or an expression, not {value!r}.") from None


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
    result: set[Symbol] = set()
    for s in constraint.expression.symbols:
        if s.order:
            row = rates.row(s.position)
            result.update([s.position.derivative()] if row is None else row)
    return result


@dataclass(frozen=True)
class _Gap:
    """Distance to one position bound, an upper bound if the sign is 1, and its rate by speed."""

    sign: int
    distance: Expression
    away: Mapping[Symbol, Expression]


def _gaps(constraint: Constraint, rates: Rates) -> list[_Gap]:
    result = []
    for sign, bound in ((-1, constraint.lower), (1, constraint.upper)):
        if not is_infinite(bound):
            distance = sign * (bound - constraint.expression)
            away = rates.over_free_speeds(distance.gradient(heuristic=False))
            away = {s: clamp_to_domains(weight) for s, weight in away.items()}
            result.append(_Gap(sign, clamp_to_domains(distance), select_moving(away, away)))
    return result


def _position_rows(
    constraints: Mapping[str, Constraint],
    gaps: Mapping[str, list[_Gap]],
    limits: AdmissibleSpeeds | None,
    moving: Collection[Symbol],
    gamma: float | Expression,
    dt: float | Expression,
    brakes: Mapping[Symbol, Expression],
) -> list[SpeedRow]:
    """Return the rows of position constraints; speeds that are no columns are zero.

    The limits are those of recovery speeds; None if recovery is allowed instead of required.
    """
    named: list[tuple[str, list[_Gap]]] = []
    bounds = []
    for name, found in gaps.items():
        sides, kept, braked = [], [], False
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
            sides.append(RecoveryBound(away, room if limits is not None else clamp_below(room, ZERO)))
            kept.append(gap)
        if sides:
            constant = not constraints[name].lower.symbols and not constraints[name].upper.symbols
            named.append((name, kept))
            bounds.append(RecoveryBounds(tuple(sides), apart=constant and not braked))
    if limits is not None:
        all_rooms = limit_recovery(bounds, limits)
    else:
        all_rooms = [[bound.room for bound in both.bounds] for both in bounds]
    rows = []
    for (name, kept), both, rooms in zip(named, bounds, all_rooms, strict=True):
        ends = []
        for gap, bound, room in zip(kept, both.bounds, rooms, strict=True):
            if gap.sign < 0:
                below = clamp_above(gap.distance, ZERO)
                ends.append(SpeedRow(name, bound.away, -room, INFINITE, below))
            else:
                outwards = {s: -w for s, w in bound.away.items()}
                above = clamp_below(-gap.distance, ZERO)
                ends.append(SpeedRow(name, outwards, -INFINITE, room, above))
        if len(ends) == 2 and ends[0].weights == ends[1].weights:
            low, high = ends
            total = low.violation + high.violation
            ends = [SpeedRow(name, low.weights, low.lower, high.upper, total)]
        rows += ends
    return rows


def _total(
    weights: Mapping[Symbol, Expression], magnitudes: Mapping[Symbol, Expression]
) -> Expression | None:
    total = ZERO
    for speed, weight in weights.items():
        if speed not in magnitudes:
            return None
        total = total + abs(weight) * magnitudes[speed]
    return total
