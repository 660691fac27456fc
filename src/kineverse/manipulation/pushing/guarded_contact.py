"""Guarded contact of a pusher with an object: touch, lag of the servos, speed, and value at the contact.

A robot that is late presses: its servos are springs between where it should be and where it is. The lag

    ℓ = ∫ u·(J q̇ - ẋ) dt

of the tip x in the direction u of the push is known from the encoders. The commanded speed exceeds the
measured one by a ramp, which shrinks with the lag, so that a press grows slowly and ends. Where the robot has
stood between two steps, as it does while readings are missing, nothing is added to the lag.

While a sensor reports a touch, the object is where the pusher is: the gap is 0, whatever the estimate says.
The value of the coordinate is corrected so that it is, and moves with the pusher. An estimate in which the
pusher penetrates the object is corrected likewise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from .push_program import PRESS
from .vectors import ZERO, Vector, add, inner_product, length, rotate_back, scale, subtract, transform_point

RAMP = 0.02  # speed of the contact point beyond the measured one that is tried [m/s]
SPEED = 0.25  # largest speed of the contact point [m/s]
_MOST_LAG = 8e-4  # lag at which the press grows no more [m]
_CREEP = 0.02  # speed at which a pusher feels for an object whose distance is uncertain [m/s]
STILL = 5e-3  # speed of a contact point that counts as none [m/s]
_DEEPEN, _DEEPER = 0.5, 3.0  # time in which a press on what does not move gets deeper [s], and its factor
_FORGET, _FORGET_DISTANCE = 1.0, 0.01
"""Time [s] and distance [m] after which a lag is forgotten: lag of acceleration and delays is no press, and
what moves on gives way."""
_REMEMBER = 0.1  # time for which a touch counts after the last report [s]
STOPPED = 2.0  # number of periods between two steps from which on the robot has stood meanwhile
_RETURN = 0.3  # time in which a correction returns to the estimate without a touch [s]
_LEAST_RATE = 0.02  # least rate of a gap over the coordinate for a correction [m/rad]


class PushPress:
    """Estimates of a press, from one step to the next."""

    def __init__(self, dt: float, sign: float) -> None:
        self._dt, self._sign = dt, sign
        self.deviation = 0.0
        self.reset()

    def reset(self) -> None:
        """Forget everything but the deviation."""
        self.speed = self.lag = self.correction = 0.0
        self._travel = self._crept = self._stuck = 0.0
        self._touch, self._estimate, self._value = math.inf, math.nan, math.nan
        self._tip: Vector | None = None
        self._planned, self._velocity = ZERO, ZERO

    @property
    def slack(self) -> float:
        """Error of gaps that is allowed for [m]: three deviations."""
        return 3.0 * self.deviation

    @property
    def touched(self) -> bool:
        """True if a sensor has just reported a touch."""
        return self._touch <= _REMEMBER

    @property
    def weight(self) -> float:
        """Weight of the latest estimate in a filter that makes noise of speeds as small as the ramp."""
        return self._dt / (self._dt + self.deviation / RAMP)

    def advance(
        self,
        estimate: float,
        tip: Vector,
        touching: bool,
        *,
        touched: bool = False,
        passed: float | None = None,
    ) -> float:
        """Return the value of the coordinate at a step, by an estimate and the place of the tip.

        ``touched`` is what touch sensors report, and ``passed`` the time since the last step [s].
        """
        passed = self._dt if passed is None else passed
        self._touch = 0.0 if touched else self._touch + passed
        moved = ZERO if self._tip is None else subtract(tip, self._tip)
        leverage = length(self._velocity)
        along = scale(1.0 / max(leverage, 1e-9), self._velocity)
        self._travel = travel = inner_product(along, moved)
        shift = self._sign * (estimate - self._estimate) if math.isfinite(self._estimate) else 0.0
        if touching and self.touched:
            self.speed = max(travel / passed, 0.0)
        else:
            self.speed = max(self.speed + self.weight * (shift * leverage / passed - self.speed), 0.0)
        if touching:
            kept = self.lag * math.exp(-passed / _FORGET - max(travel, 0.0) / _FORGET_DISTANCE)
            new = inner_product(along, self._planned) * passed - travel
            self.lag = max(kept + (new if passed < STOPPED * self._dt else 0.0), 0.0)
        else:
            self.lag = 0.0
        self._stuck = self._stuck + passed if touching and self.speed < STILL else 0.0
        if touching and self.touched and leverage > _LEAST_RATE:
            self.correction += self._sign * (max(travel, 0.0) / leverage - shift)
        elif not self.touched:
            self.correction *= max(1.0 - passed / _RETURN, 0.0)
        self._tip, self._estimate = tip, estimate
        return estimate + self.correction

    def correct(self, gap: float, rate: float) -> None:
        """Correct the value by a gap, for the next step."""
        self._crept = self._crept + max(self._travel, 0.0) if gap < self.slack else 0.0
        if self.deviation > 0.0 and abs(rate) > _LEAST_RATE and gap < (self.slack if self.touched else 0.0):
            most = self.slack / abs(rate)
            self.correction = min(max(self.correction - gap / rate, -most), most)

    @property
    def certain(self) -> bool:
        """True if the pusher has crept from the one end of the allowed errors to the other."""
        return self._crept >= 2.0 * self.slack

    def plan(self, velocity: Vector, tip_velocity: Vector) -> None:
        """Take the velocity of the contact point per unit of the push, and of the tip by a command."""
        self._velocity, self._planned = velocity, tip_velocity

    @property
    def depth(self) -> float:
        """Depth to which the pusher may press on the object [m]; it grows while the object does not move."""
        return PRESS * (1.0 + _DEEPER * min(self._stuck / _DEEPEN, 1.0))

    def margin(self, gap: float, touching: bool, gain: float) -> float:
        """Return the margin of contact slots between pusher and object [m].

        Beyond the slack a gap shrinks as fast as slots allow, and within it at the speed of creeping. It may
        seem to be negative there, as the estimate may be wrong by as much.
        """
        known = self.deviation == 0.0 or (self.touched and touching)
        if known:
            return max(min(0.0, gap - _CREEP / gain), -self.depth)
        return min(self.slack, gap - _CREEP / gain)

    @property
    def reserve(self) -> float:
        """Part of the largest lag that is left; negative beyond it."""
        return 1.0 - self.lag / _MOST_LAG

    def pace(self) -> float:
        """Return the speed of the contact point that may be tried [m/s]."""
        return min(max(self.speed + RAMP * self.reserve, 0.0), SPEED)


class TipAnchor:
    """Place on an object at which the tip of a pusher touched first."""

    def __init__(self) -> None:
        self._thing: int | None = None
        self._anchor, self._drift = ZERO, ZERO

    def drift(self, thing: int, pose: Sequence[Sequence[float]], tip: Vector, weight: float) -> Vector:
        """Return how far the tip has moved on a body since the first touch [m], filtered."""
        if self._thing != thing:
            offset = subtract(tip, transform_point(pose, ZERO))
            self._thing, self._anchor, self._drift = thing, rotate_back(pose, offset), ZERO
        now = subtract(tip, transform_point(pose, self._anchor))
        self._drift = add(self._drift, subtract(now, self._drift), weight)
        return self._drift
