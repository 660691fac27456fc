"""Outlier gate for poses of two bodies whose joint is not known yet."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import kineverse as kv
from kineverse.estimation import ObservedPose, Outliers, Tracker
from kineverse.model.frame import WORLD

from .sensor import MarkerReadings, SensorModel
from .unknown_mechanisms import BASE, PART

PROCESS_NOISE = 0.05
"""Variance that each coordinate gains [m²/s], [rad²/s]."""


class OutlierGate:
    """Outlier gate that tracks base and part as two floating bodies, with an outlier model."""

    def __init__(self) -> None:
        self._model = kv.Model()
        with self._model.edit() as edit:
            for name in (BASE, PART):
                edit.apply(kv.Floating(name=name, parent=WORLD, child=name))
        self._tracker: Tracker | None = None
        self._sensor: SensorModel | None = None

    def find_inliers(self, readings: MarkerReadings, dt: float, sensor: SensorModel) -> npt.NDArray[np.bool_]:
        """Return a mask (2,) of inliers, for base and part, ``dt`` after the previous readings [s]."""
        if sensor.outliers == 0.0:
            self._tracker = None
            return readings.visible
        if self._tracker is None or sensor != self._sensor:
            self._tracker, self._sensor = self._create_tracker(sensor), sensor
        if dt > 0.0:
            self._tracker.predict(dt)
        names = [name for name, visible in zip((BASE, PART), readings.visible, strict=True) if visible]
        poses = {BASE: readings.poses[0], PART: readings.poses[1]}
        wrong = self._tracker.update({name: poses[name] for name in names}).outliers
        return np.array([name in names and name not in wrong for name in (BASE, PART)])

    def _create_tracker(self, sensor: SensorModel) -> Tracker:
        return Tracker(
            self._model,
            [ObservedPose(name, covariance=sensor.covariance) for name in (BASE, PART)],
            process_noise=dict.fromkeys(self._model.speeds, PROCESS_NOISE),
            outliers=Outliers(sensor.outliers),
        )
