"""Measurement models of poses, positions and expressions."""

from __future__ import annotations

import math
from collections.abc import Iterable
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
"""The standard deviations of a pose or position about which nothing was said [m], [rad]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Observed:
    """What all observations have in common."""

    relative_to: str = WORLD
    covariance: npt.ArrayLike | None = None
    name: str = ""


@dataclass(frozen=True, eq=False)
class ObservedPose(_Observed):
    """The pose of a frame, seen from another one.

    Attributes
    ----------
    frame
        What is seen.
    relative_to
        From where: the world, or a camera, which may move.
    covariance
        6×6, of the errors in the axes of ``relative_to``, linear first [m²], [rad²]; by default 1 cm and 1°.
        See :mod:`kineverse.estimation.noise`.
    name
        By which it is handed in; that of the frame if empty.
    """

    frame: str


@dataclass(frozen=True, eq=False)
class ObservedPosition(_Observed):
    """Where a point of a frame is, seen from another frame.

    Attributes
    ----------
    frame, point
        The point (3,) [m] in coordinates of the frame; its origin if not given.
    relative_to
        From where: the world, or a camera, which may move.
    covariance
        3×3, in the axes of ``relative_to`` [m²]; by default 1 cm.
    name
        By which it is handed in; that of the frame if empty.
    """

    frame: str
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class ObservedExpression:
    """Any expression of coordinates, a scalar or a vector.

    Attributes
    ----------
    name
        By which it is handed in.
    expression
        Of shape () or (d,).
    covariance
        d×d, or the variance of a scalar.
    period
        After which its numbers begin again, as those of an angle that is read off a dial do after 2π; None if
        they never do.
    """

    name: str
    expression: Expression
    covariance: npt.ArrayLike
    period: float | None = None


ObservedLike: TypeAlias = str | ObservedPose | ObservedPosition | ObservedExpression


@dataclass(frozen=True, eq=False)
class MeasurementModel:
    """An observation of a model, checked.

    Attributes
    ----------
    name
        By which it is handed in.
    label
        What errors call it.
    is_pose
        Whether it is on SE(3); everything else is a vector.
    value
        4×4, or (d,).
    covariance
        Of one observation.
    period
        After which numbers begin again; inf if they never do.
    """

    name: str
    label: str
    is_pose: bool
    value: Expression
    covariance: Array
    period: float = math.inf

    @property
    def size(self) -> int:
        """How many numbers an error has."""
        return 6 if self.is_pose else self.value.shape[0]


def build_measurement_models(
    model: ModelView, observed: Iterable[ObservedLike]
) -> tuple[MeasurementModel, ...]:
    """Return what is observed of a model.

    Raises
    ------
    UnknownNameError
        For frames that do not exist.
    DuplicateNameError
        If two have one name.
    InvalidValueError
        If there is nothing, something else, or a covariance that is not positive.
    """
    if isinstance(observed, (str, ObservedPose, ObservedPosition, ObservedExpression)):
        observed = [observed]
    found: dict[str, MeasurementModel] = {}
    for item in observed:
        one = _observation(model, item)
        if one.name in found:
            raise DuplicateNameError(
                f"Two observations have the name '{one.name}'; give one of them a name=."
            )
        found[one.name] = one
    if not found:
        raise InvalidValueError("A tracker needs at least one frame that is observed.")
    return tuple(found.values())


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
    return MeasurementModel(name, label, is_pose, value, covariance, float(period))


def wrap_difference(difference: Array, period: float) -> Array:
    """Return differences of numbers that begin again after a period, none longer than half of it."""
    if math.isinf(period):
        return difference
    found: Array = difference - period * np.round(difference / period)
    return found


def _vector(item: ObservedExpression) -> Expression:
    value = array(item.expression)
    if value.shape == ():
        return array([value])
    if len(value.shape) != 1:
        raise ShapeError(f"'{item.name}' is a scalar or a vector, not of shape {value.shape}.")
    return value


def require_covariance(given: npt.ArrayLike, size: int, label: str) -> Array:
    """Return a covariance, size × size.

    Raises
    ------
    ShapeError, InvalidValueError
        If it has another shape, is not finite, not symmetric or not positive.
    """
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
            "known exactly is handed in as known=, and what is not measured is left out."
        )
    return matrix


def require_number(given: Any, what: str) -> float:
    """Return a number.

    Raises
    ------
    InvalidValueError
        If it is none.
    """
    try:
        return float(given)
    except (TypeError, ValueError):
        raise InvalidValueError(f"{what} is a number, not {given!r:.80}.") from None


def require_positive(key: object, given: Any) -> float:
    """Return a deviation or variance of something.

    Raises
    ------
    InvalidValueError
        If it is not positive and finite.
    """
    number = require_number(given, f"The uncertainty of '{key}'")
    if not (math.isfinite(number) and number > 0):
        raise InvalidValueError(f"The uncertainty of '{key}' is positive and finite, not {given!r}.")
    return number
