"""A Gaussian that goes on where a state moves that was known along a curve is as wide as the curve is bent.

A Gaussian is about the tangent of a ridge. At the next estimate the tangent is a bit different, and two of
them cross: as if something were known along them. So before it is carried on it is made so wide that the
curve fits in, as far as it reaches. Second-order filters add the same to each observation (Athans, Wishner
and Bertolini, Suboptimal state estimation for continuous-time nonlinear systems, 1968).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from kineverse.errors import KineverseError
from kineverse.estimation.noise import Array

from .belief import Belief, inverse
from .box import Box
from .charted import Charted
from .layout import Layout
from .openness import Openness
from .reading import Reader, Reading
from .residuals import Residuals
from .standing import Standing

_RANK = 1e-6
# What is off by fewer deviations of all that was seen is straight.
_STRAIGHT = 0.02


class Widening:
    """Makes beliefs so wide that what was seen before still fits in.

    Parameters
    ----------
    layout, residuals, charted, reader, boxes, openness
        The parts of a tracker.
    """

    def __init__(
        self,
        layout: Layout,
        residuals: Residuals,
        charted: Charted,
        reader: Reader,
        boxes: Sequence[Box],
        openness: Openness,
    ) -> None:
        self._layout, self._residuals, self._charted = layout, residuals, charted
        self._reader, self._boxes, self._openness = reader, boxes, openness

    def widen(self, number: int, belief: Belief) -> None:
        """Believe in a Gaussian that is wide enough, and forget what was seen."""
        standing = belief.standing[number]
        if standing is None:
            return
        t = self._layout.groups[number].t
        block = np.ix_(t, t)
        information = belief.information[block].copy()
        ways, _ = self._openness.directions(number, information)
        if len(ways):
            covariance = inverse(information)
            most, slopes = self._bends(number, belief, ways, standing, self._reader.nothing())
            missing = self._missing(number, covariance, most, slopes)
            belief.information[block] = inverse(covariance + missing)
            belief.vector[t] = belief.information[block] @ (covariance @ belief.vector[t])
        belief.standing[number] = None

    def is_straight(self, number: int, belief: Belief) -> bool:
        """Whether all that was seen of a group is straight as far as the belief reaches."""
        standing = belief.standing[number]
        assert standing is not None
        t = self._layout.groups[number].t
        ways, _ = self._openness.directions(number, belief.information[np.ix_(t, t)])
        reading = standing.reading(self._layout, self._reader)
        most, _ = self._bends(number, belief, ways, standing, reading)
        return max(most.values()) < _STRAIGHT**2

    def _bends(
        self, number: int, belief: Belief, ways: Array, standing: Standing, noise: Reading
    ) -> tuple[dict[int, float], dict[int, Array]]:
        """Return how far what was seen is off from straight, squared and by number, and slopes.

        Both are in deviations of the noise of a reading.
        """
        group, known = self._layout.groups[number], standing.known
        seen = list(standing.seen)
        here = self._residuals.evaluate(belief.x, known)
        as_said = noise._replace(values=self._reader.values_of(here))
        as_said.seen[seen] = True
        slopes = {i: s for i, (_, s) in self._residuals.errors(here, as_said, seen).items()}
        most = dict.fromkeys(seen, 0.0)
        for step in (*ways, *-ways):
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
        return most, slopes

    def _missing(
        self, number: int, covariance: Array, most: Mapping[int, float], slopes: Mapping[int, Array]
    ) -> Array:
        """Return what the covariance lacks (t, t), so that what was seen is as uncertain as it is bent."""
        lacking = []
        for i, slope in slopes.items():
            variance = float(np.einsum("ij,jk,ik->", slope, covariance, slope)) / len(slope)
            lacking.append(np.full(len(slope), max(most[i] - variance, 0.0)))
        scale = self._openness.deviations[self._layout.groups[number].t]
        back = np.linalg.pinv(np.concatenate(list(slopes.values())) * scale, rcond=_RANK)
        back *= scale[:, None]
        missing: Array = (back * np.concatenate(lacking)) @ back.T
        return missing
