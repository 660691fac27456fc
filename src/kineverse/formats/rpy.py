"""Poses written as an offset and three angles.

URDF and SDF both turn by roll about x, then pitch about y, then yaw about z, all about the fixed axes:
``a_R_b = Rz(yaw) Ry(pitch) Rx(roll)``.
"""

from __future__ import annotations

import math
from functools import lru_cache

from kineverse.model.body import Pose

SNAP = 1e-15
"""Entries of a rotation this close to 0, 1 or -1 are exactly that.

Quarter turns are written to 16 digits, whose cosine is 6e-17; taken literally, it would stay in every
expression of a chain as a term that only noise feeds.
"""


@lru_cache(maxsize=8192)
def pose_of(xyz: tuple[float, ...], rpy: tuple[float, ...]) -> Pose:
    """Return the pose with offset ``xyz`` [m] and angles ``rpy`` [rad] about the fixed x, y and z axes."""
    x, y, z = xyz
    if rpy == (0.0, 0.0, 0.0):
        return Pose((1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, z))
    roll, pitch, yaw = rpy
    cr, sr = snap(math.cos(roll)), snap(math.sin(roll))
    cp, sp = snap(math.cos(pitch)), snap(math.sin(pitch))
    cy, sy = snap(math.cos(yaw)), snap(math.sin(yaw))
    return Pose(
        (
            snap(cy * cp),
            snap(cy * sp * sr - sy * cr),
            snap(cy * sp * cr + sy * sr),
            x,
            snap(sy * cp),
            snap(sy * sp * sr + cy * cr),
            snap(sy * sp * cr - cy * sr),
            y,
            snap(-sp),
            snap(cp * sr),
            snap(cp * cr),
            z,
        )
    )


SHORTEST = 1e-9
"""The length below which a quaternion says nothing."""


def is_rotation(xyzw: tuple[float, ...]) -> bool:
    """Return whether a quaternion is long enough to say a rotation."""
    return math.hypot(*xyzw) >= SHORTEST


def pose_of_quaternion(xyz: tuple[float, ...], xyzw: tuple[float, ...]) -> Pose:
    """Return the pose with offset ``xyz`` [m] and the rotation of a quaternion (x, y, z, w), normalised.

    One of length zero turns nothing, as for MuJoCo and libsdformat.
    """
    if not is_rotation(xyzw):
        xyzw = (0.0, 0.0, 0.0, 1.0)
    length = math.hypot(*xyzw)
    a, b, c, w = (q / length for q in xyzw)
    x, y, z = xyz
    return Pose(
        (
            snap(1.0 - 2.0 * (b * b + c * c)),
            snap(2.0 * (a * b - c * w)),
            snap(2.0 * (a * c + b * w)),
            x,
            snap(2.0 * (a * b + c * w)),
            snap(1.0 - 2.0 * (a * a + c * c)),
            snap(2.0 * (b * c - a * w)),
            y,
            snap(2.0 * (a * c - b * w)),
            snap(2.0 * (b * c + a * w)),
            snap(1.0 - 2.0 * (a * a + b * b)),
            z,
        )
    )


def snap(value: float) -> float:
    """Return 0, 1 or -1 if the value is within ``SNAP`` of it, else the value."""
    if abs(value) <= SNAP:
        return 0.0
    if abs(abs(value) - 1.0) <= SNAP:
        return math.copysign(1.0, value)
    return value
