"""Unobservable directions, and states where the measurement Jacobian vanishes.

The cosine of an angle has none at 0: whatever is seen of it, the angle stays where it is. The elbow of an arm
that is stretched out has none either. So where an observation remains unexplained and some direction is open,
the search begins anew to both sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kineverse.errors import KineverseError
from kineverse.lie import Array

from .bounds import GroupBounds
from .gaussian import InformationState
from .layout import Layout
from .map_update import MapResult
from .process_model import ProcessModel

# A direction is open as long as it is known no better than to this part of what was assumed at the start.
_OPEN = 0.05
# Rounding may leave nothing of what was known; no step is longer than a hundred deviations at the start.
_LEAST = 1e-4


class UnobservableDirections:
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


# What is seen is explained if its squares are fewer deviations than these above their mean.
_EXPLAINED = 3.0
# Of all directions, those of which least is known are tried.
_MOST_WAYS = 2


class StationaryPoints:
    """Finds such places, and others to begin at.

    Parameters
    ----------
    layout, charted, openness, boxes
        The parts of a tracker.
    """

    def __init__(
        self,
        layout: Layout,
        charted: ProcessModel,
        openness: UnobservableDirections,
        boxes: Sequence[GroupBounds],
    ) -> None:
        self._layout, self._charted, self._openness, self._boxes = layout, charted, openness, boxes

    def unexplained(self, before: InformationState, found: MapResult) -> list[int]:
        """Return the numbers of the groups that are further off than noise is, and may be elsewhere."""
        beyond = found.nis > found.dof + _EXPLAINED * np.sqrt(2 * found.dof)
        if not beyond.any():
            return []
        return [n for n in np.flatnonzero(beyond).tolist() if self._may_be_elsewhere(n, before, found.belief)]

    def _may_be_elsewhere(self, number: int, before: InformationState, after: InformationState) -> bool:
        t = self._layout.groups[number].t
        is_kept = before.standing[number] is not None
        return is_kept or self._openness.is_open(number, after.information[np.ix_(t, t)])

    def aside(
        self, before: InformationState, after: InformationState, groups: Sequence[int], known: Array
    ) -> list[InformationState]:
        """Return what was believed before, about places to both sides in directions that are still open.

        Parameters
        ----------
        before, after
            What was believed before and after something was seen.
        groups
            The numbers of those that are moved; all of them at once, each in its next direction.
        known
            Values of what is known.
        """
        beliefs: list[InformationState] = []
        for number in groups:
            group, x = self._layout.groups[number], before.x[self._layout.groups[number].x]
            ways, turn = self._ways(number, before, after), 0
            for way in (*ways, *-ways):
                try:
                    there, _ = self._charted.step(number, x, way, known)
                    step = self._boxes[number].taken(x, self._boxes[number].clipped(there), way)
                    there, turned = self._charted.step(number, x, step, known)
                except KineverseError:  # nobody can be there
                    continue
                if turn == len(beliefs):
                    beliefs.append(before.copy())
                beliefs[turn].x[group.x] = there
                beliefs[turn].put(group.t, before.part(group.t).carried(step, turned))
                standing = before.standing[number]
                if standing is not None:
                    prior = standing.prior.carried(step, turned)
                    beliefs[turn].standing[number] = replace(standing, prior=prior)
                turn += 1
        return beliefs

    def _ways(self, number: int, before: InformationState, after: InformationState) -> Array:
        """Return directions that are open, or were before all of what is remembered was seen."""
        t = self._layout.groups[number].t
        ways, _ = self._openness.directions(number, after.information[np.ix_(t, t)])
        standing = before.standing[number]
        if not len(ways) and standing is not None:
            ways, _ = self._openness.directions(number, standing.prior.matrix)
        return ways[:_MOST_WAYS]
