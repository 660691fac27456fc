"""In which directions little is known yet: there, what is linear is not to be trusted."""

from __future__ import annotations

import numpy as np

from kineverse.estimation.noise import Array

from .layout import Layout

# A direction is open as long as it is known no better than to this part of what was assumed at the start.
_OPEN = 0.05
# Rounding may leave nothing of what was known; no step is longer than a hundred deviations at the start.
_LEAST = 1e-4


class Openness:
    """Tells open directions from others.

    Parameters
    ----------
    layout
        What is estimated.

    Attributes
    ----------
    deviations
        How uncertain the tangent was at the start (t,).
    """

    def __init__(self, layout: Layout) -> None:
        self._groups = layout.groups
        self.deviations: Array = np.ones(len(layout.chart.tangent))

    def directions(self, number: int, information: Array) -> tuple[Array, Array]:
        """Return steps of one deviation in the tangent of a group: open ones (k, t), and others (t - k, t).

        They are orthogonal in the metric of the information (t, t).
        """
        scale = self.deviations[self._groups[number].t]
        values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
        steps = (vectors * np.maximum(values, _LEAST) ** -0.5).T * scale
        is_open = values < _OPEN**-2
        return steps[is_open], steps[~is_open]

    def is_open(self, number: int, information: Array) -> bool:
        """Whether a group has such directions."""
        scale = self.deviations[self._groups[number].t]
        if len(scale) == 1:
            return float(information[0, 0]) * float(scale[0]) ** 2 < _OPEN**-2
        return bool(np.linalg.eigvalsh(information * np.outer(scale, scale))[0] < _OPEN**-2)
