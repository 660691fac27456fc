"""Rotations of constant transforms as roll, pitch and yaw, or as a quaternion, for description files."""

from __future__ import annotations

import numpy as np

from kineverse.formats import poses
from kineverse.formats.description import Matrix
from kineverse.lie import snap, to_quaternion, to_rpy
from kineverse.model.body import Vector3

ROTATION_TOLERANCE = 1e-13
"""Largest deviation of an entry of a written rotation matrix."""


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
    written = poses.pose_from_rpy((0.0, 0.0, 0.0), rpy_angles(pose)).matrix
    return float(np.abs(written[:3, :3] - pose[:3, :3]).max())
