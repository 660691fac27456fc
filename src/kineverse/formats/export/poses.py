"""Constant transforms as the numbers that descriptions write: an offset, and three angles or a quaternion."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.formats import poses
from kineverse.formats.poses import snap
from kineverse.model.body import Vector3

Matrix: TypeAlias = npt.NDArray[np.float64]

ROTATION_TOLERANCE = 1e-13
"""How far a rotation that is written may be from what was meant, entry by entry."""


def rpy_angles(pose: Matrix) -> Vector3:
    """Return roll, pitch and yaw about the fixed axes [rad]; right at a pitch of π/2, too."""
    r = pose[:3, :3].tolist()
    yaw = math.atan2(r[1][0], r[0][0]) if abs(r[1][0]) + abs(r[0][0]) > 1e-12 else 0.0
    c, s = math.cos(yaw), math.sin(yaw)
    pitch = math.atan2(-r[2][0], c * r[0][0] + s * r[1][0])
    roll = math.atan2(s * r[0][2] - c * r[1][2], c * r[1][1] - s * r[0][1])
    return snap(roll), snap(pitch), snap(yaw)


def unit_quaternion(pose: Matrix) -> tuple[float, float, float, float]:
    """Return the unit quaternion (x, y, z, w) of a rotation, w not negative."""
    r = pose[:3, :3]
    products = np.array(
        [
            [1 + r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], 1 - r[0, 0] + r[1, 1] - r[2, 2], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 - r[0, 0] - r[1, 1] + r[2, 2], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1 + np.trace(r)],
        ]
    )
    # Of the four columns, all multiples of q, the longest is the most exact.
    best = products[int(np.argmax(np.diag(products)))]
    best = best / np.linalg.norm(best)
    x, y, z, w = (snap(float(n)) + 0.0 for n in (best if best[3] >= 0 else -best))
    return x, y, z, w


def rotation_deviation(pose: Matrix) -> float:
    """Return by how much the rotation that is written differs from the one given: it may not be rigid."""
    written = poses.pose_from_rpy((0.0, 0.0, 0.0), rpy_angles(pose)).matrix
    return float(np.abs(written[:3, :3] - pose[:3, :3]).max())
