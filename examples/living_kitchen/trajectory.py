"""Periodic trajectory of a kitchen: all doors and drawers open and close smoothly, a few at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kineverse.model.model_view import ModelView

START_INTERVAL = 0.9
"""Time between the starts of two motions [s]."""

OPENING_TIME, OPEN_TIME = 2.6, 2.2
"""Shortest time of opening, and time for which it stays open [s]."""

RANGE_FRACTION = 0.9
"""Fraction of a range that is used."""

LARGEST_SLOPE = 1.875
"""The largest slope of :func:`smooth_step`."""

SPEED_FRACTION = 0.8
"""Fraction of a speed limit that is used."""


@dataclass(frozen=True, slots=True)
class _Motion:
    """Start, end positions and duration of the motion of one degree of freedom."""

    start: float
    closed: float
    open: float
    duration: float


class PeriodicTrajectory:
    """Periodic motion of the degrees of freedom of a model between their limits.

    Parameters
    ----------
    model
        The model, whose coordinates with finite limits move.

    Attributes
    ----------
    period
        The period [s].
    """

    def __init__(self, model: ModelView) -> None:
        limited = [
            (symbol, *limits)
            for symbol in model.degrees_of_freedom
            if all(map(math.isfinite, limits := model.limits(symbol)))
        ]
        self._motions: dict[str, _Motion] = {}
        # Neighbours in the list are neighbours in the kitchen, so consecutive motions are spread over it.
        stride = _coprime(len(limited))
        for number in range(len(limited)):
            symbol, low, high = limited[number * stride % len(limited)]
            distance = RANGE_FRACTION * (high - low)
            fastest = SPEED_FRACTION * min(abs(v) for v in model.limits(symbol.derivative()))
            duration = OPENING_TIME
            if fastest > 0.0:
                duration = max(duration, LARGEST_SLOPE * distance / fastest)
            self._motions[str(symbol)] = _Motion(START_INTERVAL * number, low, low + distance, duration)
        longest = max((motion.duration for motion in self._motions.values()), default=OPENING_TIME)
        self.period = max(START_INTERVAL * len(limited), 2.0 * longest + OPEN_TIME)

    @property
    def names(self) -> list[str]:
        """The moving coordinates, in the order of their motions."""
        return list(self._motions)

    def evaluate(self, time: float) -> dict[str, float]:
        """Return the values at a time [s], by name [m], [rad]."""
        return {name: self._value(motion, time) for name, motion in self._motions.items()}

    def _value(self, motion: _Motion, time: float) -> float:
        since = (time - motion.start) % self.period if time >= motion.start else 0.0
        left = 2.0 * motion.duration + OPEN_TIME - since
        share = min(smooth_step(since / motion.duration), smooth_step(left / motion.duration))
        return motion.closed + share * (motion.open - motion.closed)


def smooth_step(share: float) -> float:
    """Return a step from 0 to 1 without velocity and acceleration at its ends, 10 s³ - 15 s⁴ + 6 s⁵."""
    s = min(max(share, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


def _coprime(count: int) -> int:
    """Return a stride that visits all of ``count`` places, far from one to the next."""
    return next((k for k in range(max(count // 3, 1), count + 1) if math.gcd(k, count) == 1), 1)
