"""Synthetic recordings of two parts with known motion and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from kineverse.estimation import pose_covariance

Array = npt.NDArray[np.float64]

# Which components of (v, ω) in the joint's frame are joint values, and how far they go.
JOINTS: dict[str, dict[int, float]] = {
    "rigid": {},
    "prismatic": {2: 0.4},
    "revolute": {5: 1.5},
    "screw": {5: 3.0},
    "cylindrical": {2: 0.3, 5: 1.5},
    "spherical": {3: 1.0, 4: 1.0, 5: 1.0},
    "planar": {0: 0.4, 1: 0.4, 5: 1.0},
    "free": {0: 0.4, 1: 0.4, 2: 0.4, 3: 1.0, 4: 1.0, 5: 1.0},
}
PITCH = 0.06


@dataclass(frozen=True)
class Recording:
    """Observed and true poses of two parts, and the joint between them."""

    parent: Array
    child: Array
    true_parent: Array
    true_relative: Array
    left: Array
    right: Array
    values: Array
    covariance: Array

    @property
    def axis(self) -> Array:
        return self.left[:3, 2]

    @property
    def point(self) -> Array:
        return self.left[:3, 3]


def recording(
    family: str,
    *,
    count: int,
    position: float,
    orientation: float,
    seed: int,
    extent: float | None = None,
    radius: float = 0.5,
) -> Recording:
    """Draw a random joint, random joint values and random parent poses, and observe them with noise."""
    random, joints = np.random.default_rng(seed), JOINTS[family]
    values = np.zeros((count, 6))
    for joint, size in joints.items():
        values[:, joint] = random.uniform(-0.5, 0.5, count) * (size if extent is None else extent)
    moved = values.copy()
    if family == "screw":
        moved[:, 2] = PITCH * values[:, 5]
    left = transform(Rotation.random(random_state=random), random.normal(0.0, 0.4, 3))
    right = transform(Rotation.random(random_state=random), (radius, 0.0, 0.1))
    relative = left @ transform(Rotation.from_rotvec(moved[:, 3:]), moved[:, :3]) @ right
    parent = transform(Rotation.random(count, random_state=random), random.normal(0.0, 1.0, (count, 3)))
    return Recording(
        noisy(parent, position, orientation, random),
        noisy(parent @ relative, position, orientation, random),
        parent,
        relative,
        left,
        right,
        values[:, list(joints)],
        pose_covariance(position, orientation),
    )


def transform(rotation: Rotation, place: npt.ArrayLike) -> Array:
    """Return transforms (..., 4, 4)."""
    matrices = rotation.as_matrix()
    result = np.zeros((*matrices.shape[:-2], 4, 4))
    result[..., :3, :3], result[..., :3, 3], result[..., 3, 3] = matrices, place, 1.0
    return result


def noisy(poses: Array, position: float, orientation: float, random: np.random.Generator) -> Array:
    """Return poses with errors in the observer's axes."""
    result = poses.copy()
    result[:, :3, 3] += random.normal(0.0, position, (len(poses), 3))
    turns = Rotation.from_rotvec(random.normal(0.0, orientation, (len(poses), 3)))
    result[:, :3, :3] = turns.as_matrix() @ poses[:, :3, :3]
    return result


def angle_between(a: Array, b: Array) -> float:
    """Return the angle between two axes regardless of sign [rad]."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)))


def off_axis(point: Array, axis: Array, from_point: Array) -> float:
    """Return the distance of a point from an axis [m]."""
    way = from_point - point
    return float(np.linalg.norm(way - axis * (axis @ way)))
