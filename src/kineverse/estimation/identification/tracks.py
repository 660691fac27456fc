"""Poses of parts over time, some of them missing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.errors import ShapeError, ValueRejectedError

from .observations import Observations, check_rigid, covariances
from .rigid import Array

Poses: TypeAlias = "npt.ArrayLike | tuple[npt.ArrayLike, npt.ArrayLike]"
"""Poses (N, 4, 4), or a pair of them and their covariance: (6, 6), or (N, 6, 6) with one for each pose. Where
points are welcome, positions (N, 3) with (3, 3) or (N, 3, 3)."""


@dataclass(frozen=True)
class Track:
    """The poses of one frame over time.

    Attributes
    ----------
    poses
        (N, 4, 4); of a point, with rotations that mean nothing.
    covariances
        (N, 6, 6), or (N, 3, 3) of a point; None if they are exact.
    seen
        When it was seen, (N,).
    """

    poses: Array
    covariances: Array | None
    seen: npt.NDArray[np.bool_]

    @property
    def is_point(self) -> bool:
        """Whether only positions were seen."""
        return self.covariances is not None and self.covariances.shape[-1] == 3


def tracks(
    observations: Mapping[str, Poses], noise: npt.ArrayLike | None, points: bool = False
) -> dict[str, Track]:
    """Return what was seen, checked.

    Parameters
    ----------
    observations
        By the name of the frame: poses, or pairs of poses and covariance. A pose that is NaN throughout was
        not seen.
    noise
        The covariance of those that come with none.
    points
        Whether positions, (N, 3), do as well.

    Raises
    ------
    ShapeError, ValueRejectedError
        For poses or covariances that are none, numbers of poses that differ, and a frame without covariance.
    """
    if not isinstance(observations, Mapping):
        raise ShapeError("Observations are a mapping from names of frames to poses of shape (N, 4, 4).")
    found = {name: _track(name, given, noise, points) for name, given in observations.items()}
    counts = {name: len(track.poses) for name, track in found.items()}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{count} of '{name}'" for name, count in counts.items())
        raise ShapeError(
            f"There are poses at different numbers of times: {listed}. Where something was not seen, its "
            "pose is NaN."
        )
    return found


def _track(name: str, given: Any, noise: npt.ArrayLike | None, points: bool) -> Track:
    covariance = noise
    if isinstance(given, tuple) and len(given) == 2:
        given, covariance = given
    try:
        poses = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ShapeError(f"The poses of '{name}' are no array of numbers.") from None
    is_point = points and poses.ndim == 2 and poses.shape[1] == 3
    if is_point:
        positions, poses = poses, np.tile(np.eye(4), (len(poses), 1, 1))
        poses[:, :3, 3] = positions
        poses[np.isnan(positions).all(axis=1)] = np.nan
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        also = ", or (N, 3) of a point" if points else ""
        raise ShapeError(f"The poses of '{name}' are an array of shape (N, 4, 4){also}, not {poses.shape}.")
    if covariance is None:
        raise ValueRejectedError(
            f"How well '{name}' is seen is not known, and without that nothing can be judged: give a pair of "
            "poses and their covariance, or noise=kv.estimation.pose_covariance(position, orientation)."
        )
    rows = 3 if is_point else 6
    if not len(poses):
        return Track(poses, np.zeros((0, rows, rows)), np.zeros(0, dtype=bool))
    seen: npt.NDArray[np.bool_] = np.logical_not(np.isnan(poses).all(axis=(1, 2)))
    poses[~seen] = np.eye(4)
    check_rigid(poses, f"frame '{name}'")
    spread = np.array(covariance, dtype=np.float64)
    if is_point and spread.shape[-2:] == (6, 6):
        spread = spread[..., :3, :3]
    if spread.ndim == 3 and len(spread) == len(seen):
        spread[~seen] = np.eye(spread.shape[-1])
    return Track(poses, covariances(spread, len(poses), rows, f"frame '{name}'"), seen)


def exactly(count: int) -> Track:
    """Return the track of the frame in which everything was seen."""
    return Track(np.tile(np.eye(4), (count, 1, 1)), None, np.ones(count, dtype=bool))


def between(parent: Track, child: Track, rows: npt.NDArray[Any]) -> Observations:
    """Return the poses of two frames at some times."""
    return Observations(
        parent.poses[rows],
        child.poses[rows],
        None if parent.covariances is None else parent.covariances[rows],
        _given(child)[rows],
    )


def _given(track: Track) -> Array:
    assert track.covariances is not None  # only the observer is exact, and it is no child
    return track.covariances


def joined(parts: Sequence[Track]) -> Track:
    """Return tracks one after the other."""
    return Track(
        np.concatenate([part.poses for part in parts]),
        None
        if parts[0].covariances is None
        else np.concatenate([part.covariances for part in parts if part.covariances is not None]),
        np.concatenate([part.seen for part in parts]),
    )
