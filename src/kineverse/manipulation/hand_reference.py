"""References of a hand: the way that a controller follows, for pages and pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kineverse.lie import Array


@dataclass(slots=True, eq=False)
class HandReference:
    """Way of a hand that a controller follows."""

    poses: Array  # world poses (K, 4, 4) along the way [m]
    share: float = 0.0  # share of the way that lies behind, in [0, 1]

    @property
    def pose(self) -> Array:
        """Pose (4, 4) of the way that is wanted now."""
        pose: Array = self.poses[round(self._place)].copy()
        pose[:3, 3] = self.ahead[0]
        return pose

    @property
    def ahead(self) -> Array:
        """Points (k, 3) of the rest of the way [m], the present one first."""
        points, place = self.poses[:, :3, 3], self._place
        before = int(place)
        after = min(before + 1, len(points) - 1)
        here = points[before] + (place - before) * (points[after] - points[before])
        rest: Array = np.concatenate([here[None], points[after:]])
        return rest

    @property
    def _place(self) -> float:
        return float(np.clip(self.share, 0.0, 1.0)) * (len(self.poses) - 1)
