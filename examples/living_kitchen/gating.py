"""Which poses of a stranger are wrong: nobody knows yet how it moves, but it does not jump."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import kineverse as kv
from kineverse.estimation import ObservedPose, Outliers, Tracker
from kineverse.model.frame import WORLD

from .sensor import Seen, Sight
from .unknown_mechanisms import BASE, PART

RESTLESS = 0.05
"""The variance that each direction and turn gains [m²/s], [rad²/s]."""


class Sorter:
    """Follows base and part as two things that float, by a tracker that knows of outliers."""

    def __init__(self) -> None:
        self._model = kv.Model()
        with self._model.edit() as edit:
            for name in (BASE, PART):
                edit.apply(kv.Floating(name=name, parent=WORLD, child=name))
        self._tracker: Tracker | None = None
        self._sight: Sight | None = None

    def good(self, seen: Seen, dt: float, sight: Sight) -> npt.NDArray[np.bool_]:
        """Return which of base and part (2,) are seen where they can be, ``dt`` after the last time [s]."""
        if sight.outliers == 0.0:
            self._tracker = None
            return seen.there
        if self._tracker is None or sight != self._sight:
            self._tracker, self._sight = self._begin(sight), sight
        if dt > 0.0:
            self._tracker.predict(dt)
        names = [name for name, there in zip((BASE, PART), seen.there, strict=True) if there]
        poses = {BASE: seen.poses[0], PART: seen.poses[1]}
        wrong = self._tracker.update({name: poses[name] for name in names}).outliers
        return np.array([name in names and name not in wrong for name in (BASE, PART)])

    def _begin(self, sight: Sight) -> Tracker:
        return Tracker(
            self._model,
            [ObservedPose(name, covariance=sight.covariance) for name in (BASE, PART)],
            process_noise=dict.fromkeys(self._model.speeds, RESTLESS),
            outliers=Outliers(sight.outliers),
        )
