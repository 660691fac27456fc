"""Convention for pose errors and their covariance.

A measured pose is ``(p + δp, Exp(δθ) R)`` for the true position p and orientation R. Both errors are written
in the axes of the observing frame, linear part first, like the rows of ``model.jacobian(frame, relative_to,
form="world_aligned")``. ROS uses the same convention in ``PoseWithCovariance``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from kineverse.errors import InvalidValueError

if TYPE_CHECKING:
    from kineverse.lie import Array


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
                f"The standard deviation of the {name} is {value}. It has to be positive and finite; what is "
                "not measured at all is left out."
            )
    return np.diag([position**2] * 3 + [orientation**2] * 3)
