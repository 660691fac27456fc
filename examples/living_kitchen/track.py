"""Tracking of the kitchen from markers, and the quality of the track."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import kineverse as kv
from kineverse.estimation import Estimate, ObservedPose, Tracker
from kineverse.model.model_view import ModelView
from kineverse.view.rendering.triangle_mesh import Floats

from .sensor import MarkerReadings, SensorModel

PROCESS_NOISE = 0.1
"""Variance that a coordinate gains, since any may move at any time [m²/s], [rad²/s]."""

SIGMAS = 2.0
"""Half width of drawn uncertainties, in standard deviations."""


@dataclass(frozen=True, slots=True)
class TrackingQuality:
    """Errors of markers and of a track.

    Attributes
    ----------
    marker
        The root mean square error of the positions of visible inliers [m].
    mean, most
        The mean and the largest error of the tracked positions of the markers [m].
    nees
        The normalised estimation error squared for each coordinate: 1 for a consistent track.
    seconds
        The duration of the update.
    """

    marker: float
    mean: float
    most: float
    nees: float
    seconds: float


def average(qualities: Sequence[TrackingQuality]) -> TrackingQuality:
    """Return the average of qualities: means, the largest ``most``, the median time."""
    markers = [f.marker for f in qualities if not math.isnan(f.marker)]
    return TrackingQuality(
        float(np.sqrt(np.mean(np.square(markers)))) if markers else math.nan,
        float(np.mean([f.mean for f in qualities])),
        max(f.most for f in qualities),
        float(np.mean([f.nees for f in qualities])),
        float(np.median([f.seconds for f in qualities])),
    )


class KitchenTracker:
    """Tracker of the coordinates of a model, by markers on the parts that they move.

    Parameters
    ----------
    model
        The model. Each articulation with a coordinate has a marker, on its handle if there is one.
    sensor
        The sensor model of the markers.
    """

    def __init__(self, model: ModelView, sensor: SensorModel) -> None:
        self.model = model
        self.frames = find_marked_frames(model)
        self._poses = kv.compile([model.fk(frame) for frame in self.frames])
        self._names = [str(symbol) for symbol in self._poses.inputs]
        self.tracker = self._create_tracker(sensor)
        self.estimate: Estimate = self.tracker.estimate
        self._sensor = sensor

    def _create_tracker(self, sensor: SensorModel, start: Estimate | None = None) -> Tracker:
        """Return a tracker that continues from an estimate."""
        return Tracker(
            self.model,
            [ObservedPose(frame, covariance=sensor.covariance) for frame in self.frames],
            process_noise={symbol.derivative(): PROCESS_NOISE for symbol in self.model.degrees_of_freedom},
            outliers=True if sensor.outliers else None,
            start=None if start is None else start.state,
            uncertainty=None if start is None else {s: start.deviation[s] for s in start.state},
        )

    def step(
        self, readings: MarkerReadings, truth: dict[str, float], dt: float, sensor: SensorModel
    ) -> TrackingQuality:
        """Update with readings taken after ``dt`` seconds, and return the quality of readings and track."""
        if (sensor.noise, sensor.outliers) != (self._sensor.noise, self._sensor.outliers):
            self.tracker = self._create_tracker(sensor, self.estimate)
        self._sensor = sensor
        begin = time.perf_counter()
        if dt > 0.0:
            self.tracker.predict(dt)
        self.estimate = self.tracker.update_poses(readings.poses, readings.visible)
        seconds = time.perf_counter() - begin
        return self._rate(readings, truth, seconds)

    def _rate(self, readings: MarkerReadings, truth: dict[str, float], seconds: float) -> TrackingQuality:
        positions = self.positions(truth)
        off = np.linalg.norm(self.positions(self.values) - positions, axis=1)
        good = readings.visible & ~readings.wrong
        marker = np.linalg.norm(readings.poses[good, :3, 3] - positions[good], axis=1)
        # The covariance is that of the Gaussian, not of the most probable state inside the limits.
        error = np.array([truth[str(s)] - self.estimate.state[s] for s in self.tracker.symbols])
        error -= self.estimate.mean
        return TrackingQuality(
            float(np.sqrt(np.mean(marker**2))) if good.any() else float("nan"),
            float(off.mean()),
            float(off.max()),
            float(error @ self.estimate.information @ error) / len(error),
            seconds,
        )

    @property
    def values(self) -> dict[str, float]:
        """The most probable values, by name."""
        return {str(symbol): value for symbol, value in self.estimate.state.items()}

    def poses(self, values: dict[str, float]) -> Floats:
        """Return the poses of the marked frames, (m, 4, 4)."""
        return np.stack(self._poses(np.array([values[name] for name in self._names])))

    def positions(self, values: dict[str, float]) -> Floats:
        """Return the positions of the marked frames, (m, 3)."""
        return self.poses(values)[:, :3, 3]

    def uncertainty_paths(self, points: int = 5) -> Floats:
        """Return the paths of markers through ±2 standard deviations: (m, points, 3).

        Each coordinate is assumed to move markers that no other one moves.
        """
        values, deviation = self.values, self.estimate.deviation
        limits = {str(s): bounds for s, bounds in self.tracker.limits.items()}
        rows = np.array(
            [
                [np.clip(values[n] + sigma * deviation[n], *limits[n]) for n in self._names]
                for sigma in np.linspace(-SIGMAS, SIGMAS, points)
            ]
        )
        return np.stack([poses[:, :3, 3] for poses in self._poses.batch(rows)])

    def uncertainty_lengths(self) -> Floats:
        """Return the lengths of the uncertainty paths of the marked frames (m,) [m]."""
        paths = self.uncertainty_paths(3)
        lengths: Floats = np.linalg.norm(np.diff(paths, axis=1), axis=2).sum(axis=1)
        return lengths


def find_marked_frames(model: ModelView) -> list[str]:
    """Return the frames that carry a marker: handles, and moving frames without one."""
    moving = [record.child for record in model.articulations.values() if record.coordinates]
    return [f"{name}_handle" if f"{name}_handle" in model.frames else name for name in moving]
