"""Measurement models of poses, positions and expressions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse._checks import finite_number
from kineverse.errors import DuplicateNameError, InvalidValueError, ShapeError
from kineverse.estimation.noise import as_numbers, check_covariance, pose_covariance
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
    relative_to
        Observing frame: the world, or a camera, which may move.
    covariance
        6×6, of the errors in the axes of ``relative_to``, linear part first [m²], [rad²], its diagonal, or a
        pair of standard deviations [m], [rad]; by default 1 cm and 1°. See :func:`.pose_covariance`.
    name
        Key of its measurements; the name of the frame if empty.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> seen = kv.estimation.ObservedPose("kitchen/fridge_door", covariance=(0.002, 0.01), name="tag 7")
    >>> tracker = kv.estimation.Tracker(model, [seen])
    >>> pose = model.fk("kitchen/fridge_door")({"kitchen/fridge_door": 0.9})
    >>> round(tracker.update({"tag 7": pose}).state["kitchen/fridge_door"], 2)
    0.9
    """

    frame: str


@dataclass(frozen=True, eq=False)
class ObservedPosition(_Observed):
    """Observed position of a point of a frame relative to another frame.

    Attributes
    ----------
    frame, point
        The point (3,) [m] in coordinates of the frame; its origin if None.
    relative_to
        Observing frame: the world, or a camera, which may move.
    covariance
        3×3, in the axes of ``relative_to`` [m²]; by default 1 cm.
    name
        Key of its measurements; the name of the frame if empty.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> handle = kv.estimation.ObservedPosition("kitchen/fridge_door_handle")
    >>> tracker = kv.estimation.Tracker(model, [handle])
    >>> point = model.fk("kitchen/fridge_door_handle")({"kitchen/fridge_door": 0.9})[:3, 3]
    >>> round(tracker.update({"kitchen/fridge_door_handle": point}).state["kitchen/fridge_door"], 2)
    0.9
    """

    frame: str
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class ObservedExpression:
    """Observed expression of coordinates, or of speeds, a scalar or a vector.

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

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> door = model.symbol("kitchen/fridge_door")
    >>> encoder = kv.estimation.ObservedExpression("encoder", 2 * door, covariance=1e-4)
    >>> tracker = kv.estimation.Tracker(model, [encoder])
    >>> round(tracker.update({"encoder": 1.6}).state[door], 3)
    0.8
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
    covariance: Array  # of one measurement
    period: float = math.inf  # of the values; inf if they are not periodic
    frame: str = ""  # observed frame of a pose or position; empty for an expression
    relative_to: str = ""
    is_stated: bool = True  # False if the covariance is a default

    @property
    def size(self) -> int:
        """Number of components of a residual."""
        return 6 if self.is_pose else self.value.shape[0]


def list_observed(observed: Iterable[ObservedLike] | ObservedLike) -> list[ObservedLike]:
    """Return observations as a list; a single one needs no list."""
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
    if isinstance(item, ObservedExpression):
        value = array(item.expression)
        if len(value.shape) > 1:
            raise ShapeError(f"'{item.name}' is a scalar or a vector, not of shape {value.shape}.")
        value = value.reshape(-1)
        covariance = require_covariance(item.covariance, len(value), item.name)
        period = math.inf if item.period is None else item.period
        if not period > 0:
            raise InvalidValueError(f"The period of '{item.name}' is positive, not {period!r}.")
        return MeasurementModel(item.name, item.name, False, value, covariance, float(period))
    if isinstance(item, ObservedPose):
        value = model.fk(item.frame, item.relative_to)
        covariance = pose_covariance(USUAL_POSITION, USUAL_ORIENTATION)
    elif isinstance(item, ObservedPosition):
        homogeneous = np.append(np.asarray(item.point, dtype=float), 1.0)
        if homogeneous.shape != (4,) or not np.isfinite(homogeneous).all():
            raise InvalidValueError(f"The point of '{item.frame}' is three numbers [m], not {item.point!r}.")
        value = (model.fk(item.frame, item.relative_to) @ homogeneous)[:3]
        covariance = np.eye(3) * USUAL_POSITION**2
    else:
        raise InvalidValueError(
            "observed= has names of frames, ObservedPose, ObservedPosition or ObservedExpression, "
            f"not {item!r}."
        )
    label = item.frame if item.relative_to == WORLD else f"{item.frame} in {item.relative_to}"
    is_pose, is_stated = isinstance(item, ObservedPose), item.covariance is not None
    if item.covariance is not None:
        covariance = require_covariance(item.covariance, len(covariance), label)
    frames = (item.frame, item.relative_to)
    return MeasurementModel(
        item.name or item.frame, label, is_pose, value, covariance, math.inf, *frames, is_stated
    )


def wrap_difference(difference: Array, period: float) -> Array:
    """Wrap differences of periodic numbers to at most half a period."""
    if math.isinf(period):
        return difference
    return np.asarray(difference - period * np.round(difference / period))


def require_covariance(covariance: npt.ArrayLike, size: int, label: str) -> Array:
    """Check a covariance, size × size, or one of its short forms; see :mod:`.noise`."""
    part = f"observation '{label}'"
    matrix = as_numbers(covariance, f"The covariance of the {part}")
    return check_covariance(matrix.reshape(1, 1) if matrix.size == size == 1 else matrix, size, part, 0.0)


def require_mapping(values: Any, label: str) -> Mapping[Any, Any]:
    """Check values by name."""
    if not isinstance(values, Mapping):
        raise InvalidValueError(f"{label} is a mapping {{name: number}}, not {values!r:.80}.")
    return values


def require_time(at: object) -> float:
    """Check the time of an observation [s]."""
    if (time := finite_number(at)) is None:
        raise InvalidValueError(f"The time of an observation is a finite number of seconds, not {at!r}.")
    return time


def require_positive(key: object, value: Any) -> float:
    """Check the standard deviation or variance of ``key``."""
    number = finite_number(value)
    if number is None or number <= 0:
        raise InvalidValueError(f"The uncertainty of '{key}' is positive and finite, not {value!r}.")
    return number
