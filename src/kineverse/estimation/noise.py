"""Noise models: errors of poses and their covariance, and outliers.

A measured pose is ``(p + δp, Exp(δθ) R)`` for the true position p and orientation R. Both errors are written
in the axes of the observing frame, linear part first, like the rows of ``model.jacobian(frame, relative_to,
form="world_aligned")``. ROS uses the same convention in ``PoseWithCovariance``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from kineverse._checks import finite_number
from kineverse.errors import InvalidValueError

if TYPE_CHECKING:
    from kineverse.lie import Array

    from .tracking.measurements import MeasurementModel


def pose_covariance(position: float, orientation: float) -> Array:
    """Return the covariance of a pose with isotropic errors: diag(σp² I, σr² I), 6×6.

    Parameters
    ----------
    position
        Standard deviation of each of the three coordinates [m].
    orientation
        Standard deviation of each of the three components of the rotation vector [rad].

    Raises
    ------
    InvalidValueError
        If one of them is not a positive finite number.
    """
    for name, value in (("position", position), ("orientation", orientation)):
        if not (math.isfinite(value) and value > 0.0):
            raise InvalidValueError(
                f"The standard deviation of the {name} is {value}. It has to be positive and finite; leave "
                "out what is not measured."
            )
    return np.diag([position**2] * 3 + [orientation**2] * 3)


CHI_SQUARED_6 = 22.5  # quantile of χ² with six degrees of freedom that is exceeded once in a thousand
_ROTATION_VOLUME = 8 * math.pi**2  # volume of SO(3) in rotation vectors [rad³]


@dataclass(frozen=True)
class Outliers:
    """Outlier model: a mixture of the noise density and a uniform density.

    A measurement with the noise density N is an inlier with the probability

        w = (1 - ε) N / ((1 - ε) N + ε u)

    where u is the density of a pose that is uniform in a cube and over all rotations. The measurement has the
    weight w. Below one half it is listed as an outlier. So inliers have full weight and gross errors none, in
    contrast to weights that fall with a power (Huber, Student).

    Attributes
    ----------
    fraction
        ε, the expected fraction of outliers.
    reach
        Edge of the cube [m], and for expressions the range of each of their numbers.
    gate
        Gate of a tracker, in standard deviations: the norm of the whitened residual at which a measurement
        has the weight one half. It sets u in place of the reach. None for the density of the reach, whose
        gate depends on the noise.

    Raises
    ------
    InvalidValueError
        For a fraction that is not between 0 and 1, or a reach or gate that is not positive.
    """

    fraction: float = 0.05
    reach: float = 2.0
    gate: float | None = None

    def __post_init__(self) -> None:
        if not 0 < (finite_number(self.fraction) or 0.0) < 1:
            raise InvalidValueError(f"The fraction of outliers is between 0 and 1, not {self.fraction!r}.")
        if not (finite_number(self.reach) or 0.0) > 0:
            raise InvalidValueError(f"The reach of outliers is positive and finite, not {self.reach!r}.")
        if self.gate is not None and not (finite_number(self.gate) or 0.0) > 0:
            raise InvalidValueError(
                f"The gate of outliers is a positive number of standard deviations, not {self.gate!r}."
            )

    @property
    def log_uniform_density(self) -> float:
        """Logarithm of u for a pose."""
        return -3 * math.log(self.reach) - math.log(_ROTATION_VOLUME)

    def log_density(self, observation: MeasurementModel, log_scale: float) -> float:
        """Return log(ε u) of a measurement with the noise density exp(-``log_scale``) at its peak."""
        if self.gate is not None:
            return math.log(1 - self.fraction) - self.gate**2 / 2 - log_scale
        if observation.is_pose:
            return math.log(self.fraction) + self.log_uniform_density
        return math.log(self.fraction) - observation.size * math.log(self.reach)

    def weigh(self, square: float, log_scale: float, log_density: float) -> tuple[float, float]:
        """Return the inlier probability of a measurement, and its robust cost.

        Parameters
        ----------
        square
            Squared norm of its whitened residual.
        log_scale
            ½ log |2πR|.
        log_density
            Result of :meth:`log_density`.

        Returns
        -------
        weight, cost
            The cost is the negative log density less ``log_scale``; without outliers it is ½ ``square``.
        """
        inlier = math.log(1 - self.fraction) - square / 2
        total = float(np.logaddexp(inlier, log_density + log_scale))
        return math.exp(inlier - total), -total


def cauchy_weight(square: float, size: int) -> float:
    """Return the weight of a Cauchy distribution, which is robust to starts far away."""
    return (1 + size) / (1 + square)


def as_outliers(argument: Outliers | bool | None, has_gate: bool = False) -> Outliers | None:
    """Convert an argument to an outlier model: True stands for the default, False and None for none."""
    if isinstance(argument, Outliers):
        if argument.gate is not None and not has_gate:
            raise InvalidValueError(
                "Only a tracker has a gate of outliers. Here an outlier is defined by fraction and reach."
            )
        return argument
    if argument is None or isinstance(argument, bool):
        return Outliers() if argument else None
    raise InvalidValueError(f"Outliers are True, False or Outliers(fraction=, reach=), not {argument!r}.")
