"""Rigid transforms by the row: arrays (N, 4, 4), rotations (N, 3, 3), vectors (N, 3)."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def pose(rotation: Array, position: Array) -> Array:
    """Return transforms of rotations (..., 3, 3) and positions (..., 3)."""
    shape = rotation.shape[:-2]
    if shape != position.shape[:-1]:
        shape = np.broadcast_shapes(shape, position.shape[:-1])
    result = np.zeros((*shape, 4, 4))
    result[..., :3, :3] = rotation
    result[..., :3, 3] = position
    result[..., 3, 3] = 1.0
    return result


def inverse(a_T_b: Array) -> Array:
    """Return b_T_a."""
    b_R_a = np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    return pose(b_R_a, -(b_R_a @ a_T_b[..., :3, 3:])[..., 0])


def orthonormal(a_T_b: Array) -> Array:
    """Return transforms whose rotations are the nearest ones, for rotations that are nearly so.

    One step of Newton's method for the polar decomposition: R (3 - RᵀR) / 2 squares the error.
    """
    rotation = a_T_b[..., :3, :3]
    nearer = 0.5 * rotation @ (3.0 * np.eye(3) - np.swapaxes(rotation, -1, -2) @ rotation)
    return pose(nearer, a_T_b[..., :3, 3])


def frame_along(z: Array) -> Array:
    """Return a rotation (3, 3) whose last column is a direction z (3,)."""
    z = z / np.linalg.norm(z)
    # By numbers, as numpy takes long over three of them.
    z0, z1, z2 = z.tolist()
    least = int(np.argmin(np.abs(z)))
    x0, x1, x2 = ((0.0, -z2, z1), (z2, 0.0, -z0), (-z1, z0, 0.0))[least]
    length = math.hypot(x0, x1, x2)
    x0, x1, x2 = x0 / length, x1 / length, x2 / length
    y0, y1, y2 = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
    return np.array([[x0, y0, z0], [x1, y1, z1], [x2, y2, z2]])


def mean_rotation(rotations: Array) -> Array:
    """Return the rotation nearest to the mean of matrices (N, 3, 3), as one matrix."""
    u, _, vt = np.linalg.svd(rotations.mean(axis=0))
    if np.linalg.det(u @ vt) < 0.0:
        u[:, 2] *= -1.0
    result: Array = u @ vt
    return result
