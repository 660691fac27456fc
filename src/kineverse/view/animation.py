"""Animation of every degree of freedom through its range."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from kineverse.model.model_view import ModelView
from kineverse.view.sliders import choose_slider_range

PERIOD = 8.0
"""Time from one limit to the other and back [s]."""

FADE_IN = 1.5
"""Time in which the motion grows from the initial posture [s]."""


class RangeAnimation:
    """Oscillation of all degrees of freedom between their limits, each a little behind the one before."""

    finished = False

    def __init__(
        self, start: Mapping[str, float], limits: Mapping[str, tuple[float, float]], now: float
    ) -> None:
        self._start = {name: start[name] for name in limits}
        self._limits = dict(limits)
        self._begin = now

    def values_at(self, now: float) -> dict[str, float]:
        """Return the values at a time [s]; continuous, and inside the limits if the start is."""
        elapsed = now - self._begin
        weight = min(elapsed / FADE_IN, 1.0)
        weight *= weight * (3.0 - 2.0 * weight)
        values = {}
        for number, (name, (lower, upper)) in enumerate(self._limits.items()):
            phase = 2.0 * math.pi * elapsed / PERIOD - 0.4 * number
            swing = lower + (upper - lower) * (0.5 - 0.5 * math.cos(phase))
            values[name] = (1.0 - weight) * self._start[name] + weight * swing
        return values


def select_animated(
    model: ModelView,
    limits: Mapping[str, tuple[float, float]],
    angles: Iterable[str],
    values: Mapping[str, float],
    units: Mapping[str, str],
) -> dict[str, tuple[float, float]]:
    """Return the ranges through which an animation moves, by name.

    Coordinates without limits have no range, and a robot would drive off the page. They are animated only if
    nothing else can move.
    """
    found = {name: (low, high) for name, (low, high) in limits.items() if high - low < 1e6}
    if found:
        return found
    rates = {str(symbol) for symbol in model.rates}
    found = dict.fromkeys(angles, (-0.5, 0.5))
    for name in limits.keys() - rates:
        found[name] = choose_slider_range(limits[name], values[name], units[name])
    return found
