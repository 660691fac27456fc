"""Transforms of TF: those that come in, those that go out, and poses in messages as matrices."""

from __future__ import annotations

from collections.abc import Container, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse.lie import Array, quaternion, to_quaternion, transform

from .inputs import SECOND

_UNIT = 1e-3  # largest difference of the norm of a quaternion from 1
_MOST_PACKED = 32  # of sets of frames that move together


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
        pose, stamp, passed = np.eye(4), None, set[str]()
        while frame not in ancestors:
            found = self._transforms.get(frame)
            if found is None or frame in passed:  # frames that hang on each other
                return None
            passed.add(frame)
            matrix = to_matrix(to_numbers(found.transform.translation, found.transform.rotation))
            if matrix is None:
                return None
            frame, pose = found.parent, matrix @ pose
            stamp = found.stamp if stamp is None else stamp
        return frame, stamp, pose


class TransformPublisher:
    """Publisher of transforms between the same frames again and again.

    Messages are serialised once, and then only their numbers change: to serialise fifty transforms takes
    rclpy a hundred times as long.

    Parameters
    ----------
    frames
        Names of the parent and the child of each transform.
    """

    def __init__(self, ros: Any, publisher: Any, frames: Sequence[tuple[str, str]]) -> None:
        self._ros, self._publisher, self._frames = ros, publisher, frames
        self._packed: dict[bytes, _PackedTransforms | None] = {}

    def publish(self, places: npt.NDArray[np.intp], stamps: npt.NDArray[np.int64], poses: Array) -> None:
        """Publish some of them, with stamps (n,) [ns] and poses (n, 7): positions, quaternions x y z w."""
        if not len(places):
            return
        key = places.tobytes()
        if key not in self._packed:
            if len(self._packed) >= _MOST_PACKED:
                self._packed.clear()
            self._packed[key] = self._pack(places)
        packed = self._packed[key]
        message = self._make(places, stamps, poses) if packed is None else packed.fill(stamps, poses)
        self._publisher.publish(message)

    def _make(self, places: npt.NDArray[np.intp], stamps: npt.NDArray[np.int64], poses: Array) -> Any:
        rows = zip(places.tolist(), stamps.tolist(), poses.tolist(), strict=True)
        return self._ros.TFMessage(
            transforms=[
                make_transform(self._ros, self._frames[place], stamp, pose) for place, stamp, pose in rows
            ]
        )

    def _pack(self, places: npt.NDArray[np.intp]) -> _PackedTransforms | None:
        """Return serialised transforms; None where their numbers cannot be found in the bytes."""
        # Numbers that are in no name: the bytes of a name are ASCII.
        stamps = SECOND * (0x7F80FF00 - np.arange(len(places))) + 0x3B9AC9FF
        poses = -np.pi * 1e9 - np.arange(7.0 * len(places)).reshape(-1, 7)
        data = self._ros.serialize(self._make(places, stamps, poses))
        if data is None:
            return None
        packed = _PackedTransforms.find(data, stamps, poses)
        return packed if packed is not None and packed.fill(stamps, poses) == data else None


class _PackedTransforms(NamedTuple):
    """Serialised transforms, and where their stamps (n, 2) and poses (n, 7) are in the bytes.

    Stamps are seconds and nanoseconds. Numbers are aligned from the end of a header of four bytes on.
    """

    data: npt.NDArray[np.uint8]  # with a gap at its end, and four bytes before it
    size: int
    stamps: npt.NDArray[np.intp]  # in units of four bytes
    poses: npt.NDArray[np.intp]  # in units of eight bytes

    @classmethod
    def find(cls, data: bytes, stamps: npt.NDArray[np.int64], poses: Array) -> _PackedTransforms | None:
        """Look for stamps and poses; None if one is not found, or lies across."""
        padded = bytes(4) + data + bytes(-(len(data) + 4) % 8)
        places = []
        for rows in (_split(stamps), poses):
            starts, unit = [padded.find(row.tobytes()) for row in rows], rows.itemsize
            if min(starts) < 0 or any(start % unit for start in starts):
                return None
            places.append(np.array(starts)[:, None] // unit + np.arange(rows.shape[1]))
        return cls(np.frombuffer(bytearray(padded), dtype=np.uint8), len(data), *places)

    def fill(self, stamps: npt.NDArray[np.int64], poses: Array) -> bytes:
        """Return the bytes with other stamps [ns] and poses."""
        self.data.view(np.uint32)[self.stamps] = _split(stamps)
        self.data.view(np.float64)[self.poses] = poses
        return self.data[4 : 4 + self.size].tobytes()


def _split(stamps: npt.NDArray[np.int64]) -> npt.NDArray[np.uint32]:
    """Return seconds and nanoseconds (n, 2)."""
    return np.stack(np.divmod(stamps, SECOND), axis=1).astype(np.uint32)


def make_transform(ros: Any, frames: tuple[str, str], stamp: int, pose: Sequence[float]) -> Any:
    """Return a TransformStamped from parent to child, with a stamp [ns] and a pose (7,), as above."""
    message = ros.TransformStamped(child_frame_id=frames[1])
    message.header.frame_id = frames[0]
    message.header.stamp = to_stamp(ros, stamp)
    place, turn = message.transform.translation, message.transform.rotation
    place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w = pose
    return message


def nanoseconds(stamp: Any) -> int:
    """Return the time of a stamp [ns]."""
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def to_stamp(ros: Any, time: int) -> Any:
    """Return the stamp of a time [ns]."""
    return ros.Time(sec=time // SECOND, nanosec=time % SECOND)


def from_matrix(pose: Array) -> tuple[float, ...]:
    """Return the position and the quaternion (7,) of a transform (4, 4)."""
    return (*pose[:3, 3].tolist(), *to_quaternion(pose[:3, :3]).tolist())


def to_numbers(position: Any, rotation: Any) -> tuple[float, ...]:
    """Return the position and the quaternion (7,) of messages."""
    return (position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w)


def to_matrix(numbers: Sequence[float]) -> Array | None:
    """Return the transform (4, 4) of a position and a quaternion (7,); None if that is no pose."""
    values = np.array(numbers)
    if not np.isfinite(values).all() or abs(np.linalg.norm(values[3:]) - 1.0) > _UNIT:
        return None
    return np.asarray(transform(quaternion(values[3:]), values[:3]))
