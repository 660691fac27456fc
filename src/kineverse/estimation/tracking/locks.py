"""What a model's own locks hold: speeds that it bounds by nothing but 0, at a state."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.estimation.noise import Array
from kineverse.expressions.expression import array
from kineverse.symbols import Symbol

from .belief import Belief
from .charted import Charted
from .layout import Layout

if TYPE_CHECKING:
    from kineverse.model.view import ModelView

# Slower than this in both directions is locked [m/s], [rad/s]. At equality a truth is 0.5, and free.
_STILL = 1e-6


class Locks:
    """The constraints that bound single speeds by expressions of what is estimated or known.

    Parameters
    ----------
    model, layout, charted
        What is tracked.
    """

    def __init__(self, model: ModelView, layout: Layout, charted: Charted) -> None:
        chart = layout.chart
        values = (*chart.coordinates, *layout.known)
        self._speeds: list[Symbol] = []
        bounds = []
        for constraint in model.constraints_for(chart.coordinates).values():
            speed = constraint.expression
            low, high = chart.plain(constraint.lower), chart.plain(constraint.upper)
            looked_at = {*low.symbols, *high.symbols}
            if isinstance(speed, Symbol) and str(speed) in charted.speeds and looked_at <= set(values):
                self._speeds.append(speed)
                bounds += [low, high]
        self._bounds = compile(array(bounds), values) if bounds else None
        self._all = frozenset(charted.speeds.values())

    def free(self, belief: Belief, known: Array) -> frozenset[Symbol]:
        """Return the speeds that are not locked at what is believed."""
        if self._bounds is None:
            return self._all
        bounds = self._bounds(np.concatenate([belief.x, known])).reshape(-1, 2)
        still = np.abs(bounds).max(axis=1) < _STILL
        return self._all - {v for v, is_locked in zip(self._speeds, still.tolist(), strict=True) if is_locked}
