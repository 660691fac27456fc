"""Transforms of TF, and poses in messages as matrices."""

from __future__ import annotations

from collections.abc import Container, Sequence
from typing import Any, NamedTuple

import numpy as np

from kineverse.lie import Array, quaternion, transform

from .inputs import SECOND

_UNIT = 1e-3  # largest difference of the norm of a quaternion from 1
_DEEPEST = 100  # largest number of transforms between two frames


class _Transform(NamedTuple):
    parent: str
    stamp: int | None  # [ns]; None for a static one
    transform: Any  # message


class TransformTree:
    """Newest transforms of TF, composed when they are asked for."""

    def __init__(self) -> None:
        self._transforms: dict[str, _Transform] = {}

    def put(self, message: Any, static: bool) -> None:
        """Take a TransformStamped."""
        stamp = None if static else nanoseconds(message.header.stamp)
        found = _Transform(message.header.frame_id, stamp, message.transform)
        self._transforms[message.child_frame_id] = found

    def find(self, frame: str, ancestors: Container[str]) -> tuple[str, int | None, Array] | None:
        """Return the nearest of some ancestors of a frame, the time [ns], and the pose (4, 4) in it.

        The time is that of the transform nearest to the frame; None if all are static. Without such an
        ancestor, or where a transform has no numbers, it is None.
        """
        pose, stamp = np.eye(4), None
        for _ in range(_DEEPEST):
            if frame in ancestors:
                return frame, stamp, pose
            found = self._transforms.get(frame)
            if found is None:
                return None
            matrix = to_matrix(to_numbers(found.transform.translation, found.transform.rotation))
            if matrix is None:
                return None
            frame, pose = found.parent, matrix @ pose
            stamp = found.stamp if stamp is None else stamp
        return None


def nanoseconds(stamp: Any) -> int:
    """Return the time of a stamp [ns]."""
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def to_numbers(position: Any, rotation: Any) -> tuple[float, ...]:
    """Return the position and the quaternion (7,) of messages."""
    return (position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w)


def to_matrix(numbers: Sequence[float]) -> Array | None:
    """Return the transform (4, 4) of a position and a quaternion (7,); None if that is no pose."""
    values = np.array(numbers)
    if not np.isfinite(values).all() or abs(np.linalg.norm(values[3:]) - 1.0) > _UNIT:
        return None
    return np.asarray(transform(quaternion(values[3:]), values[:3]))
