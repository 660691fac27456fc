"""Rotation matrices as the numbers that other programs and people read."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from kineverse.view.triangles import Floats


def quaternions(matrices: npt.ArrayLike) -> Floats:
    """Return (N, 4) unit quaternions, w x y z with w >= 0, of (N, 3, 3) or larger rotation matrices.

    Of the four ways to divide, each of which fails somewhere, the one with the largest divisor is taken
    (Shepperd 1978).
    """
    m = np.asarray(matrices, dtype=float)[:, :3, :3]
    trace = np.trace(m, axis1=1, axis2=2)
    diagonal = np.diagonal(m, axis1=1, axis2=2)
    # Four times the squares of w, x, y, z.
    squares = np.concatenate([(1.0 + trace)[:, None], 1.0 - trace[:, None] + 2.0 * diagonal], axis=1)
    products = np.empty((len(m), 4, 4))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        products[:, 0, k + 1] = products[:, k + 1, 0] = m[:, j, i] - m[:, i, j]
        products[:, i + 1, j + 1] = products[:, j + 1, i + 1] = m[:, j, i] + m[:, i, j]
    products[:, range(4), range(4)] = squares
    row = products[np.arange(len(m)), np.argmax(squares, axis=1)]
    row = row / np.linalg.norm(row, axis=1, keepdims=True)
    return np.asarray(row * np.where(row[:, :1] < 0.0, -1.0, 1.0))


def roll_pitch_yaw(matrix: npt.ArrayLike) -> Floats:
    """Return the angles (3,) about fixed x, y, z of a rotation, as URDF writes them [rad].

    At a pitch of a quarter turn, where only a sum of roll and yaw is defined, the roll is 0.
    """
    m = np.asarray(matrix, dtype=float)
    flat = float(np.hypot(m[0, 0], m[1, 0]))
    pitch = np.arctan2(-m[2, 0], flat)
    if flat < 1e-9:
        return np.array([0.0, pitch, np.arctan2(-m[0, 1], m[1, 1])])
    return np.array([np.arctan2(m[2, 1], m[2, 2]), pitch, np.arctan2(m[1, 0], m[0, 0])])
