"""Noise models: errors of poses and their covariance, checks of both, and outliers.

A measured pose is ``(p + δp, Exp(δθ) R)`` for the true position p and orientation R. Both errors are written
in the axes of the observing frame, linear part first, like the rows of ``model.jacobian(frame, relative_to,
form="world_aligned")``. ROS uses the same convention in ``PoseWithCovariance``.

A covariance of a pose is 6×6 (of a position 3×3). Two short forms stand for one: its diagonal, the variances
(6,) [m²] and [rad²], and a pair (position, orientation) of standard deviations [m] and [rad], as
:func:`pose_covariance` takes them. A single number is refused: it may be either.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kineverse._checks import finite_number
from kineverse.errors import InvalidValueError, ShapeError
from kineverse.expressions.expression import Expression
from kineverse.lie import Array

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

    Examples
    --------
    >>> kv.estimation.pose_covariance(0.01, np.radians(1)).diagonal().round(6)
    array([0.0001  , 0.0001  , 0.0001  , 0.000305, 0.000305, 0.000305])
    """
    for name, value in (("position", position), ("orientation", orientation)):
        if not (math.isfinite(value) and value > 0.0):
            raise InvalidValueError(
                f"The standard deviation of the {name} is {value}. It has to be positive and finite; leave "
                "out what is not measured."
            )
    return np.diag([position**2] * 3 + [orientation**2] * 3)


UNKNOWN_NOISE = (0.005, math.radians(1.0))
"""Medians of the unknown standard deviations of positions [m] and orientations [rad]."""

NOISE_SPREAD = math.log(5.0)
"""Standard deviation of their logarithms: a factor of 5."""

CHI_SQUARED_6 = 22.5  # quantile of χ² with six degrees of freedom that is exceeded once in a thousand
_ROTATION_VOLUME = 8 * math.pi**2  # volume of SO(3) in rotation vectors [rad³]


@dataclass(frozen=True)
class Outliers:
    """Outlier model: a mixture of the noise density and a uniform density.

    A measurement with the noise density N is an inlier with the probability::

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

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> frames = ["kitchen/fridge_door", "kitchen/fridge_door_handle"]
    >>> tracker = kv.estimation.Tracker(model, frames, outliers=kv.estimation.Outliers(fraction=0.1))
    >>> poses = {frame: model.fk(frame)({"kitchen/fridge_door": 0.9}) for frame in frames}
    >>> for _ in range(5):
    ...     estimate = tracker.update(poses)
    >>> poses["kitchen/fridge_door"][:3, 3] += 0.5  # a false detection
    >>> tracker.update(poses).outliers
    ('kitchen/fridge_door',)
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
            ½ log det(2πR).
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


RIGID = 1e-4  # largest error of a rotation matrix; a pose in single precision has 1e-6
# Largest number and smallest standard deviation that double precision can handle.
_LARGEST, _SMALLEST = 1e9, 1e-7
_FORMS = "Short forms are a pair of standard deviations (position, orientation) and the {} variances."


def as_numbers(values: npt.ArrayLike, label: str) -> Array:
    """Return values as an array of real numbers; messages begin with the label."""
    try:
        if np.iscomplexobj(values):
            raise TypeError
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        is_expression = isinstance(values, Expression)
        hint = " expression({symbol: value}) has those of an expression." if is_expression else ""
        raise ShapeError(f"{label}: this is no array of numbers: {values!r:.80}.{hint}") from None


def check_rigid(poses: Array, part: str) -> None:
    """Check that matrices (N, 4, 4) are rigid transforms."""
    check_finite(poses.reshape(len(poses), -1), part)
    rotations = poses[:, :3, :3]
    off = np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max(axis=(1, 2))
    last = np.abs(poses[:, 3] - (0.0, 0.0, 0.0, 1.0)).max(axis=1)
    mirrored = np.linalg.det(rotations) < 0.0
    wrong = np.flatnonzero((off > RIGID) | (last > RIGID) | mirrored)
    if len(wrong):
        k = int(wrong[0])
        how = "mirrors" if mirrored[k] and off[k] <= RIGID else f"is off by {max(off[k], last[k]):.2g}"
        which = f"Pose {k}" if len(poses) > 1 else "The pose"
        raise InvalidValueError(
            f"{which} of the {part} is no rigid transform: its matrix {how}. "
            "Quaternions have to be of unit length before they become matrices."
        )


def check_finite(rows: Array, part: str, label: str = "Pose") -> None:
    """Check that the numbers of each row (N, m) are finite and of a reasonable size."""
    largest = np.abs(rows).max(axis=1, initial=0.0)
    wrong = np.flatnonzero(~(largest <= _LARGEST))
    if not len(wrong):
        return
    k, entry = int(wrong[0]), float(largest[wrong[0]])
    which = f"{label} {k}" if len(rows) > 1 else f"The {label.lower()}"
    if not math.isfinite(entry):
        raise InvalidValueError(f"{which} of the {part} is not finite. Leave out what was not observed.")
    raise InvalidValueError(
        f"{which} of the {part} has a number of {entry:.2g}. None is expected above {_LARGEST:.0g}: "
        "lengths are in metres, angles in radians."
    )


def check_covariance(given: npt.ArrayLike, rows: int, part: str, smallest: float = _SMALLEST) -> Array:
    """Return one covariance (rows, rows) from a matrix or a short form.

    ``smallest`` is the least standard deviation that is accepted. Only poses (6 rows) and positions (3 rows)
    may have a pair of standard deviations.
    """
    numbers = as_numbers(given, f"The covariance of the {part}")
    if numbers.shape == (2,) and rows in (3, 6):
        numbers = pose_covariance(*numbers.tolist())
    elif numbers.shape in ((rows,), (6,) if rows == 3 else (rows,)):
        numbers = np.diag(numbers)
    if rows == 3 and numbers.shape == (6, 6):
        numbers = numbers[:3, :3]
    if numbers.shape != (rows, rows):
        raise ShapeError(
            f"The covariance of the {part} has shape ({rows}, {rows}), not {numbers.shape}. "
            f"{_FORMS.format(rows)}"
        )
    _check_once(numbers.tobytes(), rows, part, smallest)
    return numbers


def check_covariances(given: npt.ArrayLike, count: int, rows: int, part: str) -> Array:
    """Return covariances (N, rows, rows) from one of each pose, or from a common one in any form."""
    numbers = as_numbers(given, f"The covariance of the {part}")
    if numbers.ndim < 3:
        numbers = check_covariance(numbers, rows, part)
    else:
        if rows == 3 and numbers.shape[1:] == (6, 6):
            numbers = numbers[:, :3, :3]
        if numbers.shape != (count, rows, rows):
            raise ShapeError(
                f"The covariance of the {part} has shape ({rows}, {rows}), or ({count}, {rows}, {rows}) with "
                f"one for each pose, not {numbers.shape}. {_FORMS.format(rows)}"
            )
        _check_positive(numbers, part, _SMALLEST)
    return np.ascontiguousarray(np.broadcast_to(numbers, (count, rows, rows)))


@functools.lru_cache(maxsize=64)
def _check_once(numbers: bytes, rows: int, part: str, smallest: float) -> None:
    """Check a covariance. The result is cached, because callers repeat the same one."""
    _check_positive(np.frombuffer(numbers).reshape(1, rows, rows), part, smallest)


def _check_positive(each: Array, part: str, smallest: float) -> None:
    check_finite(each.reshape(len(each), -1), part, "Covariance")
    scale = np.sqrt(np.abs(np.einsum("nii->ni", each)))
    scale[scale == 0.0] = 1.0
    relative = each / (scale[:, :, None] * scale[:, None, :])
    symmetric = np.abs(relative - np.swapaxes(relative, 1, 2)).max(axis=(1, 2)) < 1e-8
    wrong = np.flatnonzero(~symmetric | (np.linalg.eigvalsh(relative)[:, 0] < 1e-12))
    if len(wrong):
        k = int(wrong[0])
        how = "positive definite" if symmetric[k] else "symmetric"
        raise InvalidValueError(
            f"The covariance of the {part} is not {how} (at pose {k}). "
            "kv.estimation.pose_covariance(position, orientation) makes one of standard deviations."
        )
    least = float(np.sqrt(np.linalg.eigvalsh(each)[:, 0].min(initial=math.inf)))
    if least < smallest:
        raise InvalidValueError(
            f"The covariance of the {part} has a standard deviation of {least:.2g} (metres or radians). "
            f"Below {smallest:.0g} it is lost in rounding."
        )
