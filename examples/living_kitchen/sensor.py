"""What is seen of poses: noise, wrong observations, and what is hidden."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError
from kineverse.estimation import pose_covariance
from kineverse.lie import retract
from kineverse.view.triangle_mesh import Floats

TURN = np.radians(1.0) / 0.01
"""The orientation's standard deviation for each of the position's: 1° a centimetre [rad/m]."""

BLINK = 3.0
"""For how long something stays hidden [s]."""

ASTRAY = 0.5
"""How far off a wrong observation is, as a standard deviation of each coordinate [m]."""


@dataclass(frozen=True, slots=True)
class Sight:
    """How well poses are seen.

    Attributes
    ----------
    noise
        The standard deviation of each coordinate of a position [m]; orientations go with it, 1° a centimetre.
    outliers, hidden
        The parts of the observations that are plain wrong, and that are missing.
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
        """Of the errors of a pose that is not wrong, 6×6, see :mod:`kineverse.estimation.noise`."""
        return pose_covariance(self.noise, TURN * self.noise)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Observations of one moment.

    Attributes
    ----------
    poses
        (m, 4, 4).
    there, wrong
        (m,) which of them were seen at all, and which of these are wrong.
    """

    poses: Floats
    there: npt.NDArray[np.bool_]
    wrong: npt.NDArray[np.bool_]


class Markers:
    """Sees poses by a sequence of random numbers of its own."""

    def __init__(self, count: int, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._lot = self._random.uniform(size=count)
        self._drawn = 0.0

    def look(self, poses: Floats, time: float, sight: Sight) -> Seen:
        """Return what is seen of true poses (m, 4, 4) at a time [s]."""
        count = len(poses)
        if not self._drawn <= time < self._drawn + BLINK:
            self._drawn = time
            self._lot = self._random.uniform(size=count)
        wrong = self._random.uniform(size=count) < sight.outliers
        size = np.where(wrong, ASTRAY, sight.noise)[:, None]
        moved = size * self._random.standard_normal((count, 3))
        turned = TURN * size * self._random.standard_normal((count, 3))
        seen = retract(poses, np.concatenate([moved, turned], axis=1))
        return Seen(seen, self._lot >= sight.hidden, wrong)
