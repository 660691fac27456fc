"""Recent measured poses of a tracker, for a check of its model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kineverse.lie import Array

from .layout import Layout
from .residuals import Measurements


@dataclass(frozen=True, eq=False)
class RecentPoses:
    """Poses of frames that one observer measured.

    Attributes
    ----------
    relative_to
        Name of the observing frame.
    poses
        Poses by name of the frame (N, 4, 4), in order; NaN where missing.
    covariances
        Mean covariance of the errors of each frame (6, 6).
    times
        (N,) [s]; None if they have none.
    """

    relative_to: str
    poses: Mapping[str, Array]
    covariances: Mapping[str, Array]
    times: Array | None


def collect_recent_poses(
    layout: Layout, readings: Sequence[tuple[float | None, Measurements]]
) -> RecentPoses:
    """Return the poses of readings with their times, of the first observer among the observations."""
    poses = {i: one for i, one in enumerate(layout.observations) if one.is_pose}
    observer = next((one.relative_to for one in poses.values()), "")
    has_times = all(stamp is not None for stamp, _ in readings)
    stamps: Array = np.array(
        [stamp if has_times else k for k, (stamp, _) in enumerate(readings)], dtype=float
    )
    # Readings of one time are one row.
    times, rows = np.unique(stamps, return_inverse=True)
    measured, covariances = {}, {}
    for i, one in poses.items():
        if one.relative_to == observer:
            measured[one.frame] = np.full((len(times), 4, 4), np.nan)
            weights = []
            for row, (_, reading) in zip(rows.tolist(), readings, strict=True):
                if reading.mask[i]:
                    pose = reading.values[layout.measurement_slices[i]].reshape(4, 4)
                    measured[one.frame][row] = pose
                    weights.append(reading.whitening[layout.whitening_slices[i]].reshape(6, 6))
            white: Array = np.array(weights).reshape(-1, 6, 6)
            given = np.linalg.inv(white.transpose(0, 2, 1) @ white)
            covariances[one.frame] = given.mean(axis=0) if weights else one.covariance
    return RecentPoses(observer, measured, covariances, times if has_times else None)
