"""A motion that takes every degree of freedom through its range, to look at."""

from __future__ import annotations

import math
from collections.abc import Mapping

PERIOD = 8.0
"""Time from one limit to the other and back [s]."""

FADE = 1.5
"""Time in which the motion grows out of the posture in which it starts [s]."""


class Show:
    """All degrees of freedom swinging between their limits, each a little behind the one before.

    Parameters
    ----------
    start
        Values at the beginning, by name [m], [rad].
    limits
        Lower and upper limit of each degree of freedom to move, finite.
    now
        The time of the beginning [s].
    """

    def __init__(
        self, start: Mapping[str, float], limits: Mapping[str, tuple[float, float]], now: float
    ) -> None:
        self._start = {name: start[name] for name in limits}
        self._limits = dict(limits)
        self._begin = now

    def at(self, now: float) -> dict[str, float]:
        """Return the values at a time [s]; continuous, and inside the limits if the start is."""
        elapsed = now - self._begin
        weight = min(elapsed / FADE, 1.0)
        weight *= weight * (3.0 - 2.0 * weight)
        values = {}
        for number, (name, (lower, upper)) in enumerate(self._limits.items()):
            phase = 2.0 * math.pi * elapsed / PERIOD - 0.4 * number
            swing = lower + (upper - lower) * (0.5 - 0.5 * math.cos(phase))
            values[name] = (1.0 - weight) * self._start[name] + weight * swing
        return values
