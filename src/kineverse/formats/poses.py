"""Constant poses: from roll-pitch-yaw and quaternions, their products and inverses.

URDF and SDF both rotate by roll about x, then pitch about y, then yaw about z, all about the fixed axes:
``a_R_b = Rz(yaw) Ry(pitch) Rx(roll)``.
"""

from __future__ import annotations

import math
from functools import lru_cache
from struct import Struct
from typing import TYPE_CHECKING

import numpy as np

from kineverse.lie import snap, to_quaternion, to_rpy
from kineverse.model.body import Pose, Vector3

if TYPE_CHECKING:
    from .description import Matrix

_KEY = Struct("6d")


def pose_from_rpy(xyz: tuple[float, ...], rpy: tuple[float, ...]) -> Pose:
    """Return the pose with offset ``xyz`` [m] and angles ``rpy`` [rad] about the fixed x, y and z axes."""
    return _cached_pose(_KEY.pack(*xyz, *rpy))


@lru_cache(maxsize=8192)
def _cached_pose(key: bytes) -> Pose:
    # As bytes, -0.0 is not 0.0: the pose does not depend on files read before.
    x, y, z, *angles = _KEY.unpack(key)
    if angles == [0.0, 0.0, 0.0]:
        return Pose((1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, z))
    roll, pitch, yaw = angles
    cr, sr = snap(math.cos(roll)), snap(math.sin(roll))
    cp, sp = snap(math.cos(pitch)), snap(math.sin(pitch))
    cy, sy = snap(math.cos(yaw)), snap(math.sin(yaw))
    return Pose(
        (
            *(snap(cy * cp), snap(cy * sp * sr - sy * cr), snap(cy * sp * cr + sy * sr), x),
            *(snap(sy * cp), snap(sy * sp * sr + cy * cr), snap(sy * sp * cr - cy * sr), y),
            *(snap(-sp), snap(cp * sr), snap(cp * cr), z),
        )
    )


SHORTEST = 1e-9  # smallest length of a valid quaternion


def is_valid_quaternion(xyzw: tuple[float, ...]) -> bool:
    """Return True if a quaternion is long enough to define a rotation."""
    return math.hypot(*xyzw) >= SHORTEST


def pose_from_quaternion(xyz: tuple[float, ...], xyzw: tuple[float, ...]) -> Pose:
    """Return the pose with offset ``xyz`` [m] and the rotation of a quaternion (x, y, z, w), normalised.

    A quaternion of length zero is the identity, as in MuJoCo and libsdformat.
    """
    if not is_valid_quaternion(xyzw):
        xyzw = (0.0, 0.0, 0.0, 1.0)
    length = math.hypot(*xyzw)
    a, b, c, w = (q / length for q in xyzw)
    x, y, z = xyz
    return Pose(
        (
            *(snap(1.0 - 2.0 * (b * b + c * c)), snap(2.0 * (a * b - c * w)), snap(2.0 * (a * c + b * w)), x),
            *(snap(2.0 * (a * b + c * w)), snap(1.0 - 2.0 * (a * a + c * c)), snap(2.0 * (b * c - a * w)), y),
            *(snap(2.0 * (a * c - b * w)), snap(2.0 * (b * c + a * w)), snap(1.0 - 2.0 * (a * a + b * b)), z),
        )
    )


IDENTITY = Pose()
_SAME = 1e-12


def compose_poses(a_T_b: Pose, b_T_c: Pose) -> Pose:
    """Return the product a_T_c."""
    if b_T_c is IDENTITY:
        return a_T_b
    if a_T_b is IDENTITY:
        return b_T_c
    m, n = a_T_b.rows, b_T_c.rows
    rows: list[float] = []
    for i in (0, 4, 8):
        a, b, c, p = m[i : i + 4]
        rows += [snap(a * n[j] + b * n[4 + j] + c * n[8 + j]) for j in range(3)]
        rows.append(a * n[3] + b * n[7] + c * n[11] + p)
    return Pose(tuple(rows))


def invert_pose(a_T_b: Pose) -> Pose:
    """Return the inverse b_T_a."""
    if a_T_b is IDENTITY:
        return a_T_b
    a, b, c, x, d, e, f, y, g, h, i, z = a_T_b.rows
    return Pose(
        (
            *(a, d, g, -(a * x + d * y + g * z)),
            *(b, e, h, -(b * x + e * y + h * z)),
            *(c, f, i, -(c * x + f * y + i * z)),
        )
    )


def rotate_direction(a_T_b: Pose, b_v: Vector3) -> Vector3:
    """Return a direction in the axes of a, a_v."""
    a, b, c, _, d, e, f, _, g, h, i, _ = a_T_b.rows
    x, y, z = b_v
    return (snap(a * x + b * y + c * z), snap(d * x + e * y + f * z), snap(g * x + h * y + i * z))


def is_identity(pose: Pose) -> bool:
    """Return True if a pose is the identity up to rounding."""
    return all(abs(a - b) <= _SAME for a, b in zip(pose.rows, IDENTITY.rows, strict=True))


ROTATION_TOLERANCE = 1e-13  # largest deviation of an entry of a written rotation matrix


def rpy_angles(pose: Matrix) -> Vector3:
    """Return roll, pitch and yaw about the fixed axes [rad], also at a pitch of π/2."""
    roll, pitch, yaw = map(snap, to_rpy(pose[:3, :3]).tolist())
    return roll, pitch, yaw


def unit_quaternion(pose: Matrix) -> tuple[float, float, float, float]:
    """Return the unit quaternion (x, y, z, w) of a rotation, with w >= 0."""
    x, y, z, w = map(snap, to_quaternion(pose[:3, :3]).tolist())
    return x, y, z, w


def rotation_deviation(pose: Matrix) -> float:
    """Return the largest deviation of an entry from the written rotation; the given matrix may be none."""
    written = pose_from_rpy((0.0, 0.0, 0.0), rpy_angles(pose)).matrix
    return float(np.abs(written[:3, :3] - pose[:3, :3]).max())
