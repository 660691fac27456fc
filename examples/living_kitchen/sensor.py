"""Simulated marker sensor: noise, outliers, and hidden markers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError
from kineverse.estimation import pose_covariance
from kineverse.lie import retract
from kineverse.view.rendering.triangle_mesh import Floats

ORIENTATION_RATIO = np.radians(1.0) / 0.01
"""Ratio of the orientation's standard deviation to the position's: 1° a centimetre [rad/m]."""

HIDDEN_TIME = 3.0
"""Time for which a marker stays hidden [s]."""

OUTLIER_DEVIATION = 0.5
"""Standard deviation of each coordinate of an outlier [m]."""


@dataclass(frozen=True, slots=True)
class SensorModel:
    """Noise, outliers and visibility of observed poses.

    Attributes
    ----------
    noise
        The standard deviation of each coordinate of a position [m]; of orientations 1° a centimetre of it.
    outliers, hidden
        The fractions of readings that are outliers, and that are missing.
    """

    noise: float = 0.03
    outliers: float = 0.0
    hidden: float = 0.0

    def __post_init__(self) -> None:
        if not 1e-4 <= self.noise <= 1.0:
            raise InvalidValueError(f"noise is between 0.1 mm and 1 m, not {self.noise!r} m")
        for name, share in (("outliers", self.outliers), ("hidden", self.hidden)):
            if not 0.0 <= share < 1.0:
                raise InvalidValueError(f"{name} is a share, at least 0 and less than 1, not {share!r}")

    @property
    def covariance(self) -> Floats:
        """The covariance of the error of an inlier, 6×6, see :mod:`kineverse.estimation.noise`."""
        return pose_covariance(self.noise, ORIENTATION_RATIO * self.noise)


@dataclass(frozen=True, slots=True, eq=False)
class MarkerReadings:
    """Readings of all markers at one time.

    Attributes
    ----------
    poses
        (m, 4, 4).
    visible, wrong
        (m,) masks of the visible markers, and of the outliers.
    """

    poses: Floats
    visible: npt.NDArray[np.bool_]
    wrong: npt.NDArray[np.bool_]


class MarkerSampler:
    """Sampler of readings, with a random generator of its own."""

    def __init__(self, count: int, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._lottery = self._random.uniform(size=count)
        self._drawn = 0.0

    def observe(self, poses: Floats, time: float, sensor: SensorModel) -> MarkerReadings:
        """Return readings of true poses (m, 4, 4) at a time [s]."""
        count = len(poses)
        if not self._drawn <= time < self._drawn + HIDDEN_TIME:
            self._drawn = time
            self._lottery = self._random.uniform(size=count)
        wrong = self._random.uniform(size=count) < sensor.outliers
        size = np.where(wrong, OUTLIER_DEVIATION, sensor.noise)[:, None]
        shifts = size * self._random.standard_normal((count, 3))
        turns = ORIENTATION_RATIO * size * self._random.standard_normal((count, 3))
        observed = retract(poses, np.concatenate([shifts, turns], axis=1))
        return MarkerReadings(observed, self._lottery >= sensor.hidden, wrong)
