"""Convention for pose errors and their covariance.

A measured pose is ``(p + δp, Exp(δθ) R)`` for a true position p and orientation R: both errors are written in
the axes of the frame in which the pose was measured, linear part first, as the rows of
``model.jacobian(frame, relative_to, form="world_aligned")`` are. This is also what ROS means by a
``PoseWithCovariance``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from kineverse.errors import InvalidValueError

if TYPE_CHECKING:
    from kineverse.lie import Array


def pose_covariance(position: float, orientation: float) -> Array:
    """Return the covariance of a pose whose errors have no preferred direction: diag(σp² I, σr² I), 6×6.

    Parameters
    ----------
    position
        The standard deviation of each of the three coordinates [m].
    orientation
        The standard deviation of each of the three components of the rotation vector [rad].

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
