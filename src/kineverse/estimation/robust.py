"""Outlier likelihood and inlier probability."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from kineverse.errors import InvalidValueError

if TYPE_CHECKING:
    from .tracking.measurements import MeasurementModel

# So much rotation there is: the volume of SO(3) in rotation vectors [rad³].
_ROTATIONS = 8 * math.pi**2


@dataclass(frozen=True)
class Outliers:
    """How often observations are wrong, and where they are then: anywhere.

    An observation with the density N of the noise is right with the probability

        w = (1 - ε) N / ((1 - ε) N + ε u)

    where u is the density of any pose within a cube, turned in any way. It counts by w; what is believed
    less than one half is listed as an outlier. So a good observation counts in full and a gross error not at
    all, other than with weights that fall with a power (Huber, Student).

    Attributes
    ----------
    fraction
        ε, of all observations.
    reach
        The edge of the cube [m], and for expressions the range of each of their numbers.

    Raises
    ------
    InvalidValueError
        For a fraction that is not between 0 and 1, or a reach that is not positive.
    """

    fraction: float = 0.05
    reach: float = 2.0

    def __post_init__(self) -> None:
        if not 0 < self.fraction < 1:
            raise InvalidValueError(f"The fraction of outliers is between 0 and 1, not {self.fraction!r}.")
        if not (math.isfinite(self.reach) and self.reach > 0):
            raise InvalidValueError(f"The reach of outliers is positive and finite, not {self.reach!r}.")

    @property
    def log_anywhere(self) -> float:
        """The logarithm of u, of a pose."""
        return -3 * math.log(self.reach) - math.log(_ROTATIONS)

    def log_density(self, one: MeasurementModel) -> float:
        """Return log(ε u) of an observation."""
        if one.is_pose:
            return math.log(self.fraction) + self.log_anywhere
        return math.log(self.fraction) - one.size * math.log(self.reach)

    def judge(self, square: float, log_scale: float, log_density: float) -> tuple[float, float]:
        """Return how probable it is that an observation is right, and what it costs as it is.

        Parameters
        ----------
        square
            Of its whitened error.
        log_scale
            ½ log |2πR|.
        log_density
            What :meth:`log_density` gave.

        Returns
        -------
        weight, cost
            The cost is -log of its density, less ``log_scale``; ½ ``square`` where there are no outliers.
        """
        right = math.log(1 - self.fraction) - square / 2
        wrong = log_density + log_scale
        together = float(np.logaddexp(right, wrong))
        return math.exp(right - together), -together


def cauchy_weight(square: float, size: int) -> float:
    """Return the weight of a Cauchy distribution, which draws to where most agree from far away."""
    return (1 + size) / (1 + square)


def as_outliers(given: Outliers | bool | None) -> Outliers | None:
    """Return what was said about outliers: True means the usual ones."""
    if isinstance(given, Outliers):
        return given
    if given is None or isinstance(given, bool):
        return Outliers() if given else None
    raise InvalidValueError(f"Outliers are True, False or Outliers(fraction=, reach=), not {given!r}.")
