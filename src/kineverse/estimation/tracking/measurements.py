"""Measurement models of poses, positions and expressions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.errors import DuplicateNameError, InvalidValueError, ShapeError
from kineverse.estimation.noise import pose_covariance
from kineverse.expressions.expression import Expression, array
from kineverse.lie import Array
from kineverse.model.frame import WORLD

if TYPE_CHECKING:
    from kineverse.model.model_view import ModelView

USUAL_POSITION, USUAL_ORIENTATION = 0.01, math.radians(1.0)
"""Default standard deviations of poses and positions [m], [rad]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Observed:
    """Common attributes of observed poses and positions."""

    relative_to: str = WORLD
    covariance: npt.ArrayLike | None = None
    name: str = ""


@dataclass(frozen=True, eq=False)
class ObservedPose(_Observed):
    """Observed pose of a frame relative to another one.

    Attributes
    ----------
    frame
        Name of the observed frame.
    relative_to
        Observing frame: the world, or a camera, which may move.
    covariance
        6×6, of the errors in the axes of ``relative_to``, linear part first [m²], [rad²]; by default 1 cm and
        1°. See :mod:`kineverse.estimation.noise`.
    name
        Key of its measurements; the name of the frame if empty.
    """

    frame: str


@dataclass(frozen=True, eq=False)
class ObservedPosition(_Observed):
    """Observed position of a point of a frame relative to another frame.

    Attributes
    ----------
    frame, point
        The point (3,) [m] in coordinates of the frame; its origin if not given.
    relative_to
        Observing frame: the world, or a camera, which may move.
    covariance
        3×3, in the axes of ``relative_to`` [m²]; by default 1 cm.
    name
        Key of its measurements; the name of the frame if empty.
    """

    frame: str
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class ObservedExpression:
    """Observed expression of coordinates, a scalar or a vector.

    Attributes
    ----------
    name
        Key of its measurements.
    expression
        Of shape () or (d,).
    covariance
        d×d, or the variance of a scalar.
    period
        Period of its values, such as 2π for an angle on a dial; None if they are not periodic.
    """

    name: str
    expression: Expression
    covariance: npt.ArrayLike
    period: float | None = None


ObservedLike: TypeAlias = str | ObservedPose | ObservedPosition | ObservedExpression


@dataclass(frozen=True, eq=False)
class MeasurementModel:
    """Checked measurement model of one observation."""

    name: str  # key of its measurements
    label: str  # name in error messages
    is_pose: bool  # True if the value is on SE(3); otherwise it is a vector
    value: Expression  # predicted measurement, 4×4 or (d,)
    covariance: Array  # default covariance of one measurement
    period: float = math.inf  # period of the values; inf if they are not periodic
    frame: str = ""  # [m]
    relative_to: str = ""
    is_stated: bool = True  # False if the covariance is a default

    @property
    def size(self) -> int:
        """Number of components of a residual."""
        return 6 if self.is_pose else self.value.shape[0]


def list_observed(observed: Iterable[ObservedLike] | ObservedLike) -> list[ObservedLike]:
    """Return observations as a list; a single one may be given alone."""
    if isinstance(observed, (str, ObservedPose, ObservedPosition, ObservedExpression)):
        return [observed]
    return list(observed)


def build_measurement_models(
    model: ModelView, observed: Iterable[ObservedLike]
) -> tuple[MeasurementModel, ...]:
    """Check observations and build their measurement models."""
    result: dict[str, MeasurementModel] = {}
    for item in observed:
        one = _observation(model, item)
        if one.name in result:
            raise DuplicateNameError(
                f"Two observations have the name '{one.name}'; give one of them a name=."
            )
        result[one.name] = one
    if not result:
        raise InvalidValueError("A tracker needs at least one frame that is observed.")
    return tuple(result.values())


def _observation(model: ModelView, item: ObservedLike) -> MeasurementModel:
    if isinstance(item, str):
        item = ObservedPose(item)
    if isinstance(item, ObservedPose):
        value = model.fk(item.frame, item.relative_to)
        usual = pose_covariance(USUAL_POSITION, USUAL_ORIENTATION)
    elif isinstance(item, ObservedPosition):
        homogeneous = np.append(np.asarray(item.point, dtype=float), 1.0)
        if homogeneous.shape != (4,) or not np.isfinite(homogeneous).all():
            raise InvalidValueError(f"The point of '{item.frame}' is three numbers [m], not {item.point!r}.")
        value = (model.fk(item.frame, item.relative_to) @ homogeneous)[:3]
        usual = np.eye(3) * USUAL_POSITION**2
    elif isinstance(item, ObservedExpression):
        value, usual = _vector(item), np.empty((0, 0))
    else:
        raise InvalidValueError(
            "What is observed is the name of a frame, ObservedPose, ObservedPosition or ObservedExpression, "
            f"not {item!r}."
        )
    if isinstance(item, ObservedExpression):
        name = label = item.name
    else:
        name = item.name or item.frame
        label = item.frame if item.relative_to == WORLD else f"{item.frame} in {item.relative_to}"
    is_pose = isinstance(item, ObservedPose)
    size = 6 if is_pose else value.shape[0]
    covariance = usual if item.covariance is None else require_covariance(item.covariance, size, label)
    period = item.period if isinstance(item, ObservedExpression) and item.period is not None else math.inf
    if not period > 0:
        raise InvalidValueError(f"The period of '{label}' is positive, not {period!r}.")
    frames = ("", "") if isinstance(item, ObservedExpression) else (item.frame, item.relative_to)
    return MeasurementModel(
        name, label, is_pose, value, covariance, float(period), *frames, item.covariance is not None
    )


def wrap_difference(difference: Array, period: float) -> Array:
    """Wrap differences of periodic numbers to at most half a period."""
    if math.isinf(period):
        return difference
    result: Array = difference - period * np.round(difference / period)
    return result


def _vector(item: ObservedExpression) -> Expression:
    value = array(item.expression)
    if value.shape == ():
        return array([value])
    if len(value.shape) != 1:
        raise ShapeError(f"'{item.name}' is a scalar or a vector, not of shape {value.shape}.")
    return value


def require_covariance(given: npt.ArrayLike, size: int, label: str) -> Array:
    """Check a covariance, size × size."""
    try:
        matrix = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidValueError(f"The covariance of '{label}' is not a matrix: {given!r:.80}.") from None
    if matrix.shape == () and size == 1:
        matrix = matrix.reshape(1, 1)
    if matrix.shape != (size, size):
        raise ShapeError(f"The covariance of '{label}' is {size}×{size}, not of shape {matrix.shape}.")
    if not np.isfinite(matrix).all():
        raise InvalidValueError(f"The covariance of '{label}' is not finite.")
    off = float(np.abs(matrix - matrix.T).max())
    if off > 1e-9 * float(np.abs(matrix).max()):
        raise InvalidValueError(f"The covariance of '{label}' is not symmetric: it is off by {off:.3g}.")
    matrix = (matrix + matrix.T) / 2
    least = float(np.linalg.eigvalsh(matrix)[0])
    if least <= 0:
        raise InvalidValueError(
            f"The covariance of '{label}' is not positive: its least eigenvalue is {least:.3g}. What is "
            "known exactly is given as inputs=, and what is not measured is left out."
        )
    return matrix


def require_number(given: Any, what: str) -> float:
    """Convert to float."""
    try:
        return float(given)
    except (TypeError, ValueError):
        raise InvalidValueError(f"{what} is a number, not {given!r:.80}.") from None


def require_mapping(given: Any, what: str) -> Mapping[Any, Any]:
    """Check values by name."""
    if not isinstance(given, Mapping):
        raise InvalidValueError(f"{what} is a mapping {{name: number}}, not {given!r:.80}.")
    return given


def require_positive(key: object, given: Any) -> float:
    """Check the standard deviation or variance of ``key``."""
    number = require_number(given, f"The uncertainty of '{key}'")
    if not (math.isfinite(number) and number > 0):
        raise InvalidValueError(f"The uncertainty of '{key}' is positive and finite, not {given!r}.")
    return number
