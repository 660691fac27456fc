"""What was learnt along a straight line where the truth is a curve is believed less.

A point that is seen of a body on a plane says where this point is and nothing of the angle: states are
possible on a ring. A Gaussian is about the ring's tangent. Where the angle is then a bit different, so is the
tangent, and two tangents cross: as if the angle were known. So after an update a belief is made so wide that
the curve fits in, as far as it reaches. Second-order filters add the same to each observation (Athans,
Wishner and Bertolini, Suboptimal state estimation for continuous-time nonlinear systems, 1968).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from kineverse.errors import KineverseError
from kineverse.estimation.noise import Array

from .belief import Belief, inverse
from .box import Box
from .charted import Charted
from .layout import Layout
from .reading import Reader
from .residuals import Residuals

# A direction is open as long as it is known no better than to this part of what was assumed at the start.
_OPEN = 0.05
_RANK = 1e-6


class Widening:
    """Makes beliefs so wide that what was seen before still fits in.

    Parameters
    ----------
    layout, residuals, charted, reader, boxes
        The parts of a tracker.

    Attributes
    ----------
    deviations
        How uncertain the tangent was at the start (t,).
    """

    def __init__(
        self, layout: Layout, residuals: Residuals, charted: Charted, reader: Reader, boxes: Sequence[Box]
    ) -> None:
        self._layout, self._residuals, self._charted = layout, residuals, charted
        self._reader, self._boxes = reader, boxes
        # A single coordinate has no other to be traded for.
        self._groups = [number for number, group in enumerate(layout.groups) if len(group.t) > 1]
        self.deviations: Array = np.ones(len(layout.chart.tangent))

    def widened(self, belief: Belief, looked: npt.NDArray[np.bool_], known: Array) -> Belief:
        """Return a belief that is wide enough for what was looked at; the same one if it is that.

        Parameters
        ----------
        belief
            After an update.
        looked
            A mask of the observations of which something was seen so far (m,).
        known
            Values of what is known.
        """
        wide = belief
        for number in self._groups:
            seen = [i for i in self._layout.groups[number].seen if looked[i]]
            directions = self._open(number, belief) if seen else np.empty(0)
            if not directions.size:
                continue
            t = self._layout.groups[number].t
            block = np.ix_(t, t)
            covariance = inverse(belief.information[block])
            missing = self._missing(number, belief, covariance, directions, seen, known)
            if not missing.any():
                continue
            mean = covariance @ belief.vector[t]
            wide = belief.copy() if wide is belief else wide
            wide.information[block] = inverse(covariance + missing)
            wide.vector[t] = wide.information[block] @ mean
        return wide

    def _open(self, number: int, belief: Belief) -> Array:
        """Return steps of one deviation in directions in which little is known (k, t)."""
        t = self._layout.groups[number].t
        scale = self.deviations[t]
        values, vectors = np.linalg.eigh(belief.information[np.ix_(t, t)] * np.outer(scale, scale))
        is_open = values < _OPEN**-2
        lengths = np.maximum(values[is_open], 1.0) ** -0.5
        found: Array = (vectors[:, is_open] * lengths).T * scale
        return found

    def _missing(
        self,
        number: int,
        belief: Belief,
        covariance: Array,
        directions: Array,
        seen: Sequence[int],
        known: Array,
    ) -> Array:
        """Return what the covariance lacks (t, t), so that what was seen is as uncertain as it is bent."""
        group = self._layout.groups[number]
        here = self._residuals.evaluate(belief.x, known)
        nothing = self._reader.nothing()
        as_said = nothing._replace(values=self._reader.values_of(here), seen=~nothing.seen)
        slopes = {i: s for i, (_, s) in self._residuals.errors(here, as_said, seen).items()}
        most = dict.fromkeys(seen, 0.0)
        for step in (*directions, *-directions):
            try:
                x, _ = self._charted.step(number, belief.x[group.x], step, known)
                there = belief.x.copy()
                there[group.x] = self._boxes[number].clipped(x)
                said = self._residuals.evaluate(there, known)
            except KineverseError:  # nobody can be there
                continue
            taken = self._boxes[number].taken(belief.x[group.x], there[group.x], step)
            for i, (error, _) in self._residuals.errors(said, as_said, seen).items():
                bend = error + slopes[i] @ taken
                if np.isfinite(bend).all():
                    most[i] = max(most[i], float(bend @ bend) / len(bend))
        lacking = []
        for i, slope in slopes.items():
            variance = float(np.einsum("ij,jk,ik->", slope, covariance, slope)) / len(slope)
            lacking.append(np.full(len(slope), max(most[i] - variance, 0.0)))
        scale = self.deviations[group.t]
        back = np.linalg.pinv(np.concatenate(list(slopes.values())) * scale, rcond=_RANK)
        back *= scale[:, None]
        missing: Array = (back * np.concatenate(lacking)) @ back.T
        return missing
