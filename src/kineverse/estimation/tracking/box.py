"""The limits of one group, as rows in its tangent."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from kineverse.estimation.noise import Array

from .layout import Layout
from .limits import Limits

_FAR = 1e300


class Room(NamedTuple):
    """What a step may change at a place: ``lower <= rows ξ <= upper``."""

    rows: Array
    lower: Array
    upper: Array

    @property
    def violation(self) -> float:
        """By how much the place itself is outside."""
        return float(np.maximum(np.maximum(self.lower, -self.upper), 0.0).sum())


class Box:
    """The limits of one group.

    Parameters
    ----------
    number
        Of the group.
    layout, limits
        The parts of a tracker.
    """

    def __init__(self, number: int, layout: Layout, limits: Limits) -> None:
        group = layout.groups[number]
        by_speeds = layout.chart.by_speeds
        self._own = [k for k, x in enumerate(group.coordinates) if x not in by_speeds]
        places = group.x[self._own]
        self._lower, self._upper = limits.lower[places], limits.upper[places]
        self._curved = [layout.limit_slices[k] for k in group.limits]
        self._rows = np.zeros((len(self._own), len(group.tangent)))
        for row, k in enumerate(self._own):
            self._rows[row, group.tangent.index(group.coordinates[k].derivative())] = 1.0

    def room(self, x: Array, out: Array) -> Room:
        """Return what steps may change at a place, where the model was evaluated."""
        own = x[self._own]
        rows, lower, upper = self._rows, self._lower - own, self._upper - own
        if self._curved:
            curved = np.stack([out[where] for where in self._curved])
            rows = np.concatenate([rows, curved[:, 3:]])
            # Bounds that hold only now and then are infinite else, and so may be what they are compared with.
            value = np.nan_to_num(curved[:, 0], nan=np.nan, posinf=_FAR, neginf=-_FAR)
            lower = np.concatenate([lower, curved[:, 1] - value])
            upper = np.concatenate([upper, curved[:, 2] - value])
        return Room(rows, lower, upper)

    def clipped(self, x: Array) -> Array:
        """Return a place that rounding has not led out of the bounds of single coordinates."""
        x[self._own] = np.clip(x[self._own], self._lower, self._upper)
        return x

    def taken(self, x: Array, after: Array, step: Array) -> Array:
        """Return what is left of a step in the tangent if it was clipped on the way from x."""
        left = step.copy()
        for row, k in zip(self._rows, self._own, strict=True):
            left[row == 1.0] = after[k] - x[k]
        return left
