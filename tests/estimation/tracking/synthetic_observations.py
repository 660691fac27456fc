"""Synthetic noisy observations of a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import kineverse as kv


def add_pose_noise(poses: Any, position: float, orientation: float, rng: np.random.Generator) -> Any:
    """Add noise to poses (..., 4, 4), on each axis of the observing frame."""
    data = np.array(poses)
    flat = data.reshape(-1, 4, 4)
    flat[:, :3, 3] += position * rng.standard_normal((len(flat), 3))
    turned = Rotation.from_rotvec(orientation * rng.standard_normal((len(flat), 3))).as_matrix()
    flat[:, :3, :3] = turned @ flat[:, :3, :3]
    return data


def make_slides() -> kv.Model:
    """Return two coordinates with linear observations."""
    model = kv.Model()
    a, b = kv.position("a"), kv.position("b")
    with model.edit() as edit:
        edit.add_frame("cart", parent="world", transform=kv.translation(a, b, 0))
    return model


class NoisyObserver:
    """Noisy measurements of frames of a model, in the form that a tracker takes."""

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
        return np.array(self._poses(kv.State(state)))

    def array(self, state: Mapping[Any, float]) -> Any:
        """Return the measured poses, (m, 4, 4)."""
        return add_pose_noise(self.truth(state), self.position, self.orientation, self.rng)

    def __call__(self, state: Mapping[Any, float]) -> dict[str, Any]:
        """Return the measured poses by frame."""
        return dict(zip(self.frames, self.array(state), strict=True))

    @property
    def covariance(self) -> Any:
        """Covariance of the noise."""
        return kv.estimation.pose_covariance(self.position, self.orientation)
