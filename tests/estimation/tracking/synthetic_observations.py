"""Noisy eyes for the tests: what is seen of a model at a state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import kineverse as kv


def noisy(poses: Any, position: float, orientation: float, rng: np.random.Generator) -> Any:
    """Return poses (..., 4, 4) with errors on each axis of the observer."""
    seen = np.array(poses)
    flat = seen.reshape(-1, 4, 4)
    flat[:, :3, 3] += position * rng.standard_normal((len(flat), 3))
    turned = Rotation.from_rotvec(orientation * rng.standard_normal((len(flat), 3))).as_matrix()
    flat[:, :3, :3] = turned @ flat[:, :3, :3]
    return seen


class Eyes:
    """Sees frames of a model, as a tracker wants to hear it."""

    def __init__(
        self,
        model: kv.Model,
        frames: Sequence[str],
        position: float = 0.01,
        orientation: float = np.radians(1.0),
        seed: int = 0,
        relative_to: str = "world",
    ) -> None:
        self.frames = tuple(frames)
        self.position, self.orientation = position, orientation
        self.rng = np.random.default_rng(seed)
        self._poses = kv.compile([model.fk(f, relative_to) for f in frames])

    def truth(self, state: Mapping[Any, float]) -> Any:
        """Return the poses as they are."""
        return np.array(self._poses(kv.State(state)))

    def array(self, state: Mapping[Any, float]) -> Any:
        """Return the poses as they are seen, (m, 4, 4)."""
        return noisy(self.truth(state), self.position, self.orientation, self.rng)

    def __call__(self, state: Mapping[Any, float]) -> dict[str, Any]:
        """Return the same by frame."""
        return dict(zip(self.frames, self.array(state), strict=True))

    @property
    def covariance(self) -> Any:
        """What a tracker has to know."""
        return kv.estimation.pose_covariance(self.position, self.orientation)
