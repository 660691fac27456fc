"""Recovery speeds that keep all velocity rows jointly feasible.

Rows are seen from inside: ``a·v >= -r``, where r is the room left, negative outside. What a row outside asks
for has to be within reach. So one motion v* is built that everything allows, and no row asks for more than v*
gives it; then v* obeys all rows at once, wherever the state is, if only speeds may be zero:

1. *Wish.* Each speed goes for each row outside as fast as this row would need it if there were no others,
   within the speed's own limits; p upwards, n downwards.
2. *Harm.* What these wishes take of the room of a row is at most ``h = Σ max(a·n, -a·p)``. A norm of speeds
   grows by at most the norm of its components' largest values.
3. *Share.* Speeds that do a row harm get the share r/h of their wishes, the least over all rows. A row
   outside has no room, so no one does it any harm. Who does good is not slowed down, and is not counted on.

This is done twice. First those move who make room where wishes want more than there is; then, with the room
and the limits that this leaves, the wishes themselves.

v* is not the fastest of all motions, but safe and cheap: sums, products and comparisons of the rows' own
coefficients. It is the fastest for a row outside if only limits of single speeds are in its way. A speed that
rows outside want to go different ways stands still in v*, and so does one that needs room which others could
make only by turns; a row that depends on these asks for nothing until something has changed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import TypeAlias

import casadi as ca

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
"""Harm that is none: coefficients like cos(π/2) are not 0."""
_FLAT = as_expression(1e-8)
"""Square of the coefficient below which a speed is wished for in proportion to it, no longer inversely."""


RequestedSpeeds: TypeAlias = tuple[Mapping[Symbol, Expression], Mapping[Symbol, Expression]]


@dataclass(frozen=True)
class RecoveryBound:
    """One bound of a constraint on positions: ``away·v >= -room`` keeps it.

    Attributes
    ----------
    away
        How fast each speed leads away from the bound, to the inside.
    room
        How fast one may come nearer, negative outside.
    """

    away: Weights
    room: Expression


@dataclass(frozen=True)
class RecoveryBounds:
    """The bounds of one constraint; ``apart`` says that there is always room at one of them."""

    sides: tuple[RecoveryBound, ...]
    apart: bool


def limit_recovery(constraints: Sequence[RecoveryBounds], limits: AdmissibleSpeeds) -> list[list[Expression]]:
    """Return the rooms of the sides of constraints, made so large that one motion keeps them all."""
    users = Counter(s for c in constraints for s in {s for side in c.sides for s in side.away})
    users.update(s for row in limits.coupled for s in row.weights)
    users.update(s for ball in limits.balls for component in ball.components for s in component)
    alone = [_is_alone(c, users) for c in constraints]
    rest = [side for c, own in zip(constraints, alone, strict=True) if not own for side in c.sides]
    motion = _find_common_motion(rest, limits)
    return [
        _clip_single(c, limits.box)
        if own
        else [clamp_below(s.room, -_project_speed(s.away, motion)) for s in c.sides]
        for c, own in zip(constraints, alone, strict=True)
    ]


def _is_alone(constraint: RecoveryBounds, users: Mapping[Symbol, int]) -> bool:
    """Return whether a constraint is about one speed that nothing else is about, its own limits aside."""
    moving = [(s, w) for side in constraint.sides for s, w in side.away.items()]
    if len(moving) > len(constraint.sides) or any(w.symbols for _, w in moving):
        return False
    weights = [float(w) for _, w in moving]
    return users[moving[0][0]] == 1 and weights in ([weights[0]], [weights[0], -weights[0]])


def _clip_single(constraint: RecoveryBounds, box: SpeedBox) -> list[Expression]:
    """Return the rooms of a constraint on one speed: its limits and the other side are all that counts."""
    rooms = [side.room for side in constraint.sides]
    result = []
    for k, side in enumerate(constraint.sides):
        ((speed, weight),) = side.away.items()
        reach = INFINITE
        if speed in box:
            low, high = box[speed]
            factor = abs(float(weight))
            end = high if float(weight) > 0 else -low
            reach = end if is_infinite(end) else factor * end
        if len(rooms) == 2 and not constraint.apart:
            beyond = raw_max(rooms[1 - k], ZERO)
            reach = beyond if is_infinite(reach) else raw_min(reach, beyond)
        result.append(side.room if is_infinite(reach) else clamp_below(side.room, -reach))
    return result


def _find_common_motion(sides: Sequence[RecoveryBound], limits: AdmissibleSpeeds) -> dict[Symbol, Expression]:
    """Return v*, the speeds that are not always zero."""
    wishes = _request_speeds([(side.away, raw_max(-side.room, ZERO)) for side in sides], limits.box)
    missing = []
    for side in sides:
        # One of a single speed has nobody to help it.
        harm = _consume_room(side.away, wishes) if len(side.away) > 1 else []
        if harm:
            missing.append((side.away, raw_max(sum(harm, ZERO) - raw_max(side.room, ZERO), ZERO)))
    if not missing:
        return _limit_motion(wishes, sides, limits)
    first = _limit_motion(_request_speeds(missing, limits.box), sides, limits)
    sides = [RecoveryBound(side.away, side.room + _project_speed(side.away, first)) for side in sides]
    limits = _subtract_motion(first, limits)
    wishes = _request_speeds([(side.away, raw_max(-side.room, ZERO)) for side in sides], limits.box)
    second = _limit_motion(wishes, sides, limits)
    return {s: first.get(s, ZERO) + second.get(s, ZERO) for s in {**first, **second}}


def _limit_motion(
    wishes: RequestedSpeeds, sides: Sequence[RecoveryBound], limits: AdmissibleSpeeds
) -> dict[Symbol, Expression]:
    """Return wishes up and down as far as everything allows."""
    shares = _Shares(wishes)
    for side in sides:
        shares.keep(side.away, side.room)
    for row in limits.coupled:
        if not is_infinite(row.lower):
            shares.keep(row.weights, -row.lower)
        if not is_infinite(row.upper):
            shares.keep({s: -w for s, w in row.weights.items()}, row.upper)
    for ball in limits.balls:
        shares.keep_ball(ball)
    motion: dict[Symbol, Expression] = {}
    for wished, least, sign in zip(wishes, (shares.up, shares.down), (1, -1), strict=True):
        for speed, wish in wished.items():
            share = reduce(raw_min, least.get(speed, []), _ONE)
            motion[speed] = motion.get(speed, ZERO) + sign * wish * share
    return motion


def _subtract_motion(motion: Mapping[Symbol, Expression], limits: AdmissibleSpeeds) -> AdmissibleSpeeds:
    """Return what limits leave to be added to a motion within them."""
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
    """Return how fast speeds would go up, and how fast down, if each need were met by each of its speeds."""
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


def _consume_room(away: Weights, wishes: RequestedSpeeds) -> list[Expression]:
    """Return how fast wishes lead to a bound at most, by speed."""
    up, down = wishes
    harm = []
    for speed, weight in away.items():
        if not weight.symbols:
            wished = down if float(weight) > 0 else up
            harm += [abs(float(weight)) * wished[speed]] if speed in wished else []
            continue
        harm += [raw_max(weight, ZERO) * down[speed]] if speed in down else []
        harm += [raw_max(-weight, ZERO) * up[speed]] if speed in up else []
    return harm


class _Shares:
    """What share of its wishes each speed may have, upwards and downwards: the least of several."""

    def __init__(self, wishes: RequestedSpeeds) -> None:
        self.up: dict[Symbol, list[Expression]] = {}
        self.down: dict[Symbol, list[Expression]] = {}
        self._wishes = wishes

    def keep(self, away: Weights, room: Expression) -> None:
        """Take care that speeds keep ``away·v >= -room``."""
        up, down = self._wishes
        harm = _consume_room(away, self._wishes)
        if not harm:
            return
        share = _share(room, sum(harm, ZERO))
        for speed, weight in away.items():
            if not weight.symbols:
                wanted, shares = (down, self.down) if float(weight) > 0 else (up, self.up)
                if speed in wanted:
                    shares.setdefault(speed, []).append(share)
                continue
            # Only speeds that do harm: a comparison that holds is 1.
            if speed in up:
                share_up = raw_max(share, binary(ca.OP_LE, 0, weight))
                self.up.setdefault(speed, []).append(share_up)
            if speed in down:
                share_down = raw_max(share, binary(ca.OP_LE, weight, 0))
                self.down.setdefault(speed, []).append(share_down)

    def keep_ball(self, ball: NormBound) -> None:
        """Take care that speeds stay within a norm."""
        up, down = self._wishes
        sizes = []
        for component in ball.components:
            terms = []
            for speed, weight in component.items():
                wishes = [w[speed] for w in (up, down) if speed in w]
                if wishes:
                    terms.append(abs(weight) * reduce(raw_max, wishes))
            sizes += [sum(terms, ZERO)] if terms else []
        if not sizes:
            return
        share = _share(ball.radius, norm(sizes))
        for speed in {s for component in ball.components for s in component}:
            for wishes_of, shares in ((up, self.up), (down, self.down)):
                if speed in wishes_of:
                    shares.setdefault(speed, []).append(share)


def _share(room: Expression, harm: Expression) -> Expression:
    """Return room over harm, 1 or more where there is no harm to speak of; never 0/0."""
    harmless = binary(ca.OP_LT, harm, _ROUNDING)
    return (raw_max(room, ZERO) + harmless) / raw_max(harm, _ROUNDING)


def _clip_request(wish: Expression, limit: Expression) -> Expression:
    return wish if is_infinite(limit) else raw_min(wish, limit)


def _project_speed(weights: Weights, motion: Mapping[Symbol, Expression]) -> Expression:
    return sum((w * motion[s] for s, w in weights.items() if s in motion), ZERO)
