"""Recovery speeds that keep all velocity rows jointly feasible.

A row is ``a·v >= -r``. Its room r is negative if the state violates the constraint; such a row demands a
recovery speed. The demands must be jointly feasible. So a motion v* is constructed that all rows and limits
allow, and each demand is reduced to the speed that v* gives to its row. Then v* satisfies all rows together
at every state, provided that zero speed is allowed:

1. *Request.* For each violated row, each speed is requested as if the row were the only one, within the
   limits of that speed: p upwards, n downwards.
2. *Consumption.* The requests consume at most ``h = Σ max(a·n, -a·p)`` of the room of a row. A norm of
   speeds grows by at most the norm of the largest values of its components.
3. *Scaling.* Each speed that consumes room of a row is scaled by r/h, the minimum over all rows. A violated
   row has no room, so all speeds that consume its room are zero. Other speeds are not scaled.

The steps run twice: first for rows whose consumption exceeds their room, to make room; then for the violated
rows, within the remaining room and limits.

v* is not optimal, but safe and cheap: sums, products and comparisons of coefficients. It is optimal for a row
that is restricted by limits of single speeds only. A speed that violated rows request in both directions is
zero in v*, and so is a speed whose room takes more than two steps to make. A row that depends on such speeds
demands nothing until the state has changed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import TypeAlias

import casadi as ca
from msgspec import Struct

from kineverse.expressions.expression import Expression, as_expression, binary
from kineverse.expressions.functions import norm
from kineverse.symbols import Symbol

from .speed_limits import (
    INFINITE,
    ZERO,
    AdmissibleSpeeds,
    NormBound,
    SpeedBox,
    SpeedRow,
    Weights,
    clamp_below,
    is_infinite,
    raw_max,
    raw_min,
    subtract_offset,
)

_ONE = as_expression(1.0)
_ROUNDING = as_expression(1e-12)
"""Consumption that counts as zero: in floating point, coefficients such as cos(π/2) are not 0."""
_FLAT = as_expression(1e-8)
"""Square of the coefficient below which the requested speed is proportional to it instead of inverse."""

RequestedSpeeds: TypeAlias = tuple[Mapping[Symbol, Expression], Mapping[Symbol, Expression]]


class RecoveryBound(Struct, frozen=True):
    """Bound of a position constraint as a velocity row ``away·v >= -room``."""

    away: Weights  # coefficients of the speeds in the rate of the distance to the bound, positive inwards
    room: Expression  # largest speed towards the bound; negative if the bound is violated


class RecoveryBounds(Struct, frozen=True):
    """Bounds of one constraint; ``apart`` is True if at most one of them can be violated."""

    bounds: tuple[RecoveryBound, ...]
    apart: bool


def limit_recovery(constraints: Sequence[RecoveryBounds], limits: AdmissibleSpeeds) -> list[list[Expression]]:
    """Return the rooms of all bounds, enlarged until one motion satisfies all rows."""
    users = Counter(s for c in constraints for s in {s for bound in c.bounds for s in bound.away})
    users.update(s for row in limits.coupled for s in row.weights)
    users.update(s for ball in limits.balls for component in ball.components for s in component)
    alone = [_is_alone(c, users) for c in constraints]
    rest = [bound for c, own in zip(constraints, alone, strict=True) if not own for bound in c.bounds]
    motion = _find_common_motion(rest, limits)
    return [
        _clip_single(c, limits.box)
        if own
        else [clamp_below(s.room, -_project_speed(s.away, motion)) for s in c.bounds]
        for c, own in zip(constraints, alone, strict=True)
    ]


def _is_alone(constraint: RecoveryBounds, users: Mapping[Symbol, int]) -> bool:
    """Return whether a constraint has one speed, which no other row has, apart from its own limits."""
    moving = [(s, w) for bound in constraint.bounds for s, w in bound.away.items()]
    if len(moving) > len(constraint.bounds) or any(w.symbols for _, w in moving):
        return False
    weights = [float(w) for _, w in moving]
    return users[moving[0][0]] == 1 and weights in ([weights[0]], [weights[0], -weights[0]])


def _clip_single(constraint: RecoveryBounds, box: SpeedBox) -> list[Expression]:
    """Return the rooms of a constraint on one speed, limited by that speed's limits and the other bound."""
    rooms = [bound.room for bound in constraint.bounds]
    result = []
    for k, bound in enumerate(constraint.bounds):
        ((speed, weight),) = bound.away.items()
        reach = INFINITE
        if speed in box:
            low, high = box[speed]
            factor = abs(float(weight))
            end = high if float(weight) > 0 else -low
            reach = end if is_infinite(end) else factor * end
        if len(rooms) == 2 and not constraint.apart:
            beyond = raw_max(rooms[1 - k], ZERO)
            reach = beyond if is_infinite(reach) else raw_min(reach, beyond)
        result.append(bound.room if is_infinite(reach) else clamp_below(bound.room, -reach))
    return result


def _find_common_motion(
    bounds: Sequence[RecoveryBound], limits: AdmissibleSpeeds
) -> dict[Symbol, Expression]:
    """Return the motion v*, without speeds that are always zero."""
    requested = _request_speeds([(bound.away, raw_max(-bound.room, ZERO)) for bound in bounds], limits.box)
    missing = []
    for bound in bounds:
        # No other speed can make room in a row with a single speed.
        consumed = _consume_room(bound.away, requested) if len(bound.away) > 1 else []
        if consumed:
            missing.append((bound.away, raw_max(sum(consumed, ZERO) - raw_max(bound.room, ZERO), ZERO)))
    if not missing:
        return _limit_motion(requested, bounds, limits)
    first = _limit_motion(_request_speeds(missing, limits.box), bounds, limits)
    bounds = [RecoveryBound(bound.away, bound.room + _project_speed(bound.away, first)) for bound in bounds]
    limits = _subtract_motion(first, limits)
    requested = _request_speeds([(bound.away, raw_max(-bound.room, ZERO)) for bound in bounds], limits.box)
    second = _limit_motion(requested, bounds, limits)
    return {s: first.get(s, ZERO) + second.get(s, ZERO) for s in {**first, **second}}


def _limit_motion(
    requested: RequestedSpeeds, bounds: Sequence[RecoveryBound], limits: AdmissibleSpeeds
) -> dict[Symbol, Expression]:
    """Return the requested speeds, scaled to satisfy all rows and limits."""
    scales = _SpeedScales(requested)
    for bound in bounds:
        scales.limit_row(bound.away, bound.room)
    for row in limits.coupled:
        if not is_infinite(row.lower):
            scales.limit_row(row.weights, -row.lower)
        if not is_infinite(row.upper):
            scales.limit_row({s: -w for s, w in row.weights.items()}, row.upper)
    for ball in limits.balls:
        scales.limit_norm(ball)
    motion: dict[Symbol, Expression] = {}
    for speeds, least, sign in zip(requested, (scales.up, scales.down), (1, -1), strict=True):
        for speed, request in speeds.items():
            scale = reduce(raw_min, least.get(speed, []), _ONE)
            motion[speed] = motion.get(speed, ZERO) + sign * request * scale
    return motion


def _subtract_motion(motion: Mapping[Symbol, Expression], limits: AdmissibleSpeeds) -> AdmissibleSpeeds:
    box = dict(limits.box)
    for speed, done in motion.items():
        if speed in box:
            low, high = box[speed]
            box[speed] = (subtract_offset(low, done), subtract_offset(high, done))
    coupled = []
    for row in limits.coupled:
        done = _project_speed(row.weights, motion)
        coupled.append(
            SpeedRow(
                row.name, row.weights, subtract_offset(row.lower, done), subtract_offset(row.upper, done)
            )
        )
    balls = []
    for ball in limits.balls:
        parts = [_project_speed(component, motion) for component in ball.components]
        balls.append(NormBound(ball.components, ball.radius - norm(parts)))
    return AdmissibleSpeeds(box, coupled, balls)


def _request_speeds(needs: Sequence[tuple[Weights, Expression]], box: SpeedBox) -> RequestedSpeeds:
    """Return the largest requested speeds upwards and downwards, each row meeting its need by each speed."""
    up: dict[Symbol, list[Expression]] = {}
    down: dict[Symbol, list[Expression]] = {}
    for away, need in needs:
        for speed, weight in away.items():
            if not weight.symbols:
                (up if float(weight) > 0 else down).setdefault(speed, []).append(need / abs(float(weight)))
                continue
            inverse = _ONE / raw_max(weight * weight, _FLAT)
            up.setdefault(speed, []).append(inverse * raw_max(weight, ZERO) * need)
            down.setdefault(speed, []).append(inverse * raw_max(-weight, ZERO) * need)
    return (
        {s: _clip_request(reduce(raw_max, w), box[s][1] if s in box else INFINITE) for s, w in up.items()},
        {s: _clip_request(reduce(raw_max, w), -box[s][0] if s in box else INFINITE) for s, w in down.items()},
    )


def _consume_room(away: Weights, requested: RequestedSpeeds) -> list[Expression]:
    """Return the room that each requested speed consumes at most."""
    up, down = requested
    consumed = []
    for speed, weight in away.items():
        if not weight.symbols:
            opposing = down if float(weight) > 0 else up
            consumed += [abs(float(weight)) * opposing[speed]] if speed in opposing else []
            continue
        consumed += [raw_max(weight, ZERO) * down[speed]] if speed in down else []
        consumed += [raw_max(-weight, ZERO) * up[speed]] if speed in up else []
    return consumed


class _SpeedScales:
    """Scale factors of the requested speeds, upwards and downwards; the minimum of each list counts."""

    def __init__(self, requested: RequestedSpeeds) -> None:
        self.up: dict[Symbol, list[Expression]] = {}
        self.down: dict[Symbol, list[Expression]] = {}
        self._wishes = requested

    def limit_row(self, away: Weights, room: Expression) -> None:
        """Add the scale factors that satisfy ``away·v >= -room``."""
        up, down = self._wishes
        consumed = _consume_room(away, self._wishes)
        if not consumed:
            return
        scale = _scale(room, sum(consumed, ZERO))
        for speed, weight in away.items():
            if not weight.symbols:
                wanted, scales = (down, self.down) if float(weight) > 0 else (up, self.up)
                if speed in wanted:
                    scales.setdefault(speed, []).append(scale)
                continue
            # A comparison that holds is 1: speeds that consume no room are not scaled.
            if speed in up:
                scale_up = raw_max(scale, binary(ca.OP_LE, 0, weight))
                self.up.setdefault(speed, []).append(scale_up)
            if speed in down:
                scale_down = raw_max(scale, binary(ca.OP_LE, weight, 0))
                self.down.setdefault(speed, []).append(scale_down)

    def limit_norm(self, ball: NormBound) -> None:
        """Add the scale factors that satisfy a norm bound."""
        up, down = self._wishes
        sizes = []
        for component in ball.components:
            terms = []
            for speed, weight in component.items():
                requested = [w[speed] for w in (up, down) if speed in w]
                if requested:
                    terms.append(abs(weight) * reduce(raw_max, requested))
            sizes += [sum(terms, ZERO)] if terms else []
        if not sizes:
            return
        scale = _scale(ball.radius, norm(sizes))
        for speed in {s for component in ball.components for s in component}:
            for requests, scales in ((up, self.up), (down, self.down)):
                if speed in requests:
                    scales.setdefault(speed, []).append(scale)


def _scale(room: Expression, consumed: Expression) -> Expression:
    """Return room / consumed, at least 1 if the consumption is negligible; never 0/0."""
    negligible = binary(ca.OP_LT, consumed, _ROUNDING)
    return (raw_max(room, ZERO) + negligible) / raw_max(consumed, _ROUNDING)


def _clip_request(request: Expression, limit: Expression) -> Expression:
    return request if is_infinite(limit) else raw_min(request, limit)


def _project_speed(weights: Weights, motion: Mapping[Symbol, Expression]) -> Expression:
    return sum((w * motion[s] for s, w in weights.items() if s in motion), ZERO)
