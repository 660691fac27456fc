"""Velocity drive of coordinates that only speeds can move, such as the base of a car."""

from __future__ import annotations

import math
from collections.abc import Mapping

from kineverse.errors import KineverseError
from kineverse.model.model_view import ModelView
from kineverse.state import State

UNLIMITED_SPEED = 2.0
"""The largest speed on offer if the model sets no limit [m/s], [rad/s]."""

LONGEST_STEP = 0.2
"""The longest time step that is integrated [s]; after a pause nothing jumps."""


class VelocityDrive:
    """Speeds of coordinates with rates: wheels, drives, angular velocities."""

    def __init__(self, model: ModelView) -> None:
        self._model = model
        symbols = {speed for row in model.rates.values() for speed in row}
        ordered = sorted(symbols, key=lambda s: s.sort_key)
        self.speeds = {str(speed): 0.0 for speed in ordered}
        self.limits: dict[str, tuple[float, float]] = {}
        for speed in ordered:
            lower, upper = model.limits(speed)
            self.limits[str(speed)] = (
                lower if math.isfinite(lower) else -UNLIMITED_SPEED,
                upper if math.isfinite(upper) else UNLIMITED_SPEED,
            )

    @property
    def running(self) -> bool:
        """True if any speed is not 0."""
        return any(self.speeds.values())

    def stop(self) -> None:
        """Set all speeds to 0."""
        self.speeds = dict.fromkeys(self.speeds, 0.0)

    def step(self, values: Mapping[str, float], seconds: float) -> dict[str, float]:
        """Integrate values over a time [s]; return those that change, and stop at a violated constraint."""
        try:
            moved = self._model.integrate(State(values), self.speeds, min(seconds, LONGEST_STEP))
            changed = {name: moved[name] for name in values if moved[name] != values[name]}
            broken = {v.name for v in self._model.violations(State({**values, **changed}))}
            stuck = bool(broken) and not broken <= {v.name for v in self._model.violations(State(values))}
        except KineverseError:
            stuck = True
        if stuck:
            self.stop()
            return {}
        return changed
