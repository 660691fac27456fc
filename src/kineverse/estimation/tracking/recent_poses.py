"""Recent measured poses of a tracker, for a check of its model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView

from .layout import Layout
from .residuals import Measurements


@dataclass(frozen=True, eq=False)
class RecentPoses:
    """Poses of frames that one observer measured."""

    relative_to: str  # name of the observing frame
    poses: Mapping[str, Array]  # poses by name of the frame (N, 4, 4), in order; NaN where missing
    covariances: Mapping[str, Array]  # (6, 6), (N, 6, 6)
    times: Array | None  # (N,) [s]; None if they have none


def collect_recent_poses(
    model: ModelView, layout: Layout, readings: Sequence[tuple[float | None, Measurements, Array]]
) -> RecentPoses:
    """Return the poses of readings with their times, of the first observer among the observations."""
    poses = {i: one for i, one in enumerate(layout.observations) if one.is_pose}
    observer = next((one.relative_to for one in poses.values()), "")
    has_times = all(stamp is not None for stamp, _, _ in readings)
    stamps: Array = np.array(
        [stamp if has_times else k for k, (stamp, _, _) in enumerate(readings)], dtype=float
    )
    # Readings of one time are one row.
    times, rows = np.unique(stamps, return_inverse=True)
    measured, covariances = {}, {}
    inputs = np.zeros((len(times), len(layout.inputs)))
    for row, (_, _, values) in zip(rows.tolist(), readings, strict=True):
        inputs[row] = values
    for i, one in poses.items():
        if one.relative_to == observer:
            measured[one.frame] = np.full((len(times), 4, 4), np.nan)
            weights = []
            for row, (_, reading, _) in zip(rows.tolist(), readings, strict=True):
                if reading.mask[i]:
                    pose = reading.values[layout.measurement_slices[i]].reshape(4, 4)
                    measured[one.frame][row] = pose
                    weights.append(reading.whitening[layout.whitening_slices[i]].reshape(6, 6))
            white: Array = np.array(weights).reshape(-1, 6, 6)
            given = np.linalg.inv(white.transpose(0, 2, 1) @ white)
            mean = given.mean(axis=0) if weights else one.covariance
            if one.is_stated or not np.allclose(mean, one.covariance, rtol=1e-9):
                covariances[one.frame] = mean
    if observer in model.frames and len(times):
        place = model.fk(observer)
        if place.symbols and {*place.symbols} <= {*layout.inputs}:
            # No joint between an observer that moves and a part could be tested.
            places = compile(place, layout.inputs).batch(inputs)
            turns = np.zeros((len(times), 6, 6))
            turns[:, :3, :3] = turns[:, 3:, 3:] = places[:, :3, :3]
            measured = {name: places @ seen for name, seen in measured.items()}
            covariances = {name: turns @ one @ turns.mT for name, one in covariances.items()}
            observer = WORLD
    return RecentPoses(observer, measured, covariances, times if has_times else None)
