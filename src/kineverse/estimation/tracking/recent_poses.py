"""Recent measured poses of a tracker, for a check of its model."""

from __future__ import annotations

from collections.abc import Collection, Mapping
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
        Covariance of the error of each frame (6, 6).
    times
        (N,) [s]; None if they have none.
    """

    relative_to: str
    poses: Mapping[str, Array]
    covariances: Mapping[str, Array]
    times: Array | None


def collect_recent_poses(
    layout: Layout, readings: Collection[tuple[float | None, Measurements]]
) -> RecentPoses:
    """Return the poses of readings with their times, of the first observer among the observations."""
    poses = {i: one for i, one in enumerate(layout.observations) if one.is_pose}
    observer = next((one.relative_to for one in poses.values()), "")
    stamps = [stamp for stamp, _ in readings]
    order = (
        np.arange(len(stamps)) if None in stamps else np.argsort(np.array(stamps, dtype=float), kind="stable")
    )
    measured: dict[str, Array] = {}
    for i, one in poses.items():
        if one.relative_to == observer:
            where = layout.measurement_slices[i]
            values = [np.where(each.mask[i], each.values[where], np.nan) for _, each in readings]
            measured[one.frame] = np.reshape(values, (len(values), 4, 4))[order]
    return RecentPoses(
        observer,
        measured,
        {one.frame: one.covariance for one in poses.values() if one.relative_to == observer},
        None if None in stamps else np.array(stamps, dtype=float)[order],
    )
