"""Velocity drive of coordinates that only speeds can move, such as the base of a car."""

from __future__ import annotations

import math
from collections.abc import Mapping

from kineverse.errors import KineverseError
from kineverse.model.model_view import ModelView
from kineverse.state import State

UNLIMITED_SPEED = 2.0
"""The fastest that is offered where the model sets no limit [m/s], [rad/s]."""

LONGEST_STEP = 0.2
"""Longest time between two pictures that is made up for [s]; after a pause nothing jumps."""


class VelocityDrive:
    """The speeds by which coordinates with rates move: wheels, drives, angular velocities.

    Parameters
    ----------
    model
        The model.

    Attributes
    ----------
    speeds
        How fast each goes now, by name [m/s], [rad/s].
    limits
        How fast each may go, finite.
    """

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
        """Whether anything goes."""
        return any(self.speeds.values())

    def stop(self) -> None:
        """Set all speeds to 0."""
        self.speeds = dict.fromkeys(self.speeds, 0.0)

    def after(self, values: Mapping[str, float], seconds: float) -> dict[str, float]:
        """Return the values that are others after a time [s]; stop where a constraint would be broken."""
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
