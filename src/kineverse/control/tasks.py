"""Tasks of controllers and inverse kinematics: goals, holds and keeps on any expression; targets.

A task constrains an expression e of a model's symbols. It knows nothing of joints: the speeds that serve it
are the keys of its gradient (task function approach: Samson, Le Borgne, Espiau 1991). Task functions, such as
:func:`same_pose`, are expressions that are zero where a relation of frames holds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.errors import ExpressionError, InvalidValueError, ShapeError
from kineverse.expressions.expression import Expression, ExpressionLike, array, as_expression, binary
from kineverse.expressions.functions import arctan2, sqrt, where
from kineverse.model.constraint import Constraint
from kineverse.spatial import as_transform, inverse, log_so3, unit_vector
from kineverse.symbols import Symbol, parameter

_LONGEST = 100  # largest number of characters of an expression in a message


@dataclass(frozen=True, eq=False)
class Goal:
    """Soft task: the expression moves towards a target at ``rate - gain·(expression - target)``.

    Parameters
    ----------
    expression
        Expression of positions, of any shape; or of speeds, then linear in them, and the target is a speed.
    target
        Target in the unit of the expression, a number, an array or an expression, such as a parameter.
    name
        Name in results and messages; by default that of the expression, or its number among the tasks.
    gain
        Rate at which the error decays [1/s], at most 1/dt. Goals about speeds have no use for it.
    speed
        Largest norm of the wanted rate, in the unit of the expression per second; None for no limit.
    rate
        Feed-forward rate of the target, such as that of a trajectory; None for 0.
    weight
        Weight of the squared rate error: a scalar, or one for each entry of the expression; numbers or
        expressions. 0 switches the goal off.
    heuristic
        Whether trends of logic count as gradients; see :mod:`kineverse.logic`.

    Raises
    ------
    ExpressionError
        For a text in place of an expression.
    ShapeError
        For a 4×4 transform, or a target of another shape.
    InvalidValueError
        For an expression that nothing moves, a gain or speed that is not positive, or a negative weight; for
        a goal about speeds that has a speed or rate, or entries without a speed.

    Examples
    --------
    >>> model = kv.load("fetch")
    >>> height = model.fk("fetch/gripper_link")[2, 3]
    >>> goal = kv.control.Goal(height, 0.9, speed=0.2, name="height")
    >>> result = kv.control.inverse_kinematics(model, [goal], fixed=["fetch/base"])
    >>> height(result.best).round(4)
    np.float64(0.9)
    """

    expression: Expression
    target: ExpressionLike = 0.0
    name: str = field(default="", kw_only=True)
    gain: ExpressionLike = field(default=2.0, kw_only=True)
    speed: ExpressionLike | None = field(default=None, kw_only=True)
    rate: ExpressionLike | None = field(default=None, kw_only=True)
    weight: ExpressionLike = field(default=1.0, kw_only=True)
    heuristic: bool = field(default=True, kw_only=True)

    def __post_init__(self) -> None:
        error = _error_of(self, self.expression, self.target)
        _check_positive(self, "gain", self.gain)
        if self.speed is not None:
            _check_positive(self, "speed", self.speed)
        weights = as_expression(self.weight)
        if weights.shape not in ((), self.expression.shape):
            shape = self.expression.shape
            raise ShapeError(f"{self!r}: the weight is a scalar or has shape {shape}, not {weights.shape}.")
        for weight in weights.ravel():
            _check_number(self, "weight", weight, 0.0)
        if any(s.order for s in error.symbols):
            if self.speed is not None or self.rate is not None:
                raise InvalidValueError(f"{self!r} is about speeds; speed= and rate= are for positions.")
            if not all(any(s.order for s in entry.symbols) for entry in error.ravel()):
                raise InvalidValueError(f"{self!r} has entries of positions and speeds; make two goals.")
        if self.rate is not None and (shape := as_expression(self.rate).shape) not in ((), error.shape):
            raise ShapeError(f"{self!r}: the rate has shape {shape}, not {error.shape}.")

    @property
    def error(self) -> Expression:
        """Expression minus target, flat, shape (k,)."""
        return (self.expression - self.target).ravel()

    def __repr__(self) -> str:
        return f"Goal({_describe(self.name, self.expression)})"


@dataclass(frozen=True, eq=False)
class Hold:
    """Equality that is kept while anything moves: ``ė = -gain·s·(expression - target)``, s the progress.

    The progress s in [0, 1] of a hold is a variable of the controller's quadratic program. So one that is not
    satisfied yet is approached as fast as the limits allow, and standing still is always allowed.

    Parameters
    ----------
    expression
        Expression of positions, of any shape, such as :func:`.same_pose` of hand and handle.
    target
        Value to hold, a number, an array or an expression.
    gain
        Rate at which errors decay [1/s], at most 1/dt; by default half of that, and at most 10.
    name
        Name in results and messages.

    Raises
    ------
    ExpressionError, ShapeError, InvalidValueError
        As for :class:`Goal`; also for an expression of speeds.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> left, right = model.symbol("kitchen/fridge_door"), model.symbol("kitchen/oven_door")
    >>> together = kv.control.Hold(left - right, name="together")
    >>> tasks = [together, kv.control.Goal(left, 0.5)]
    >>> result = kv.control.inverse_kinematics(model, tasks)
    >>> round(result.best[left], 3), round(result.best[right], 3)
    (0.5, 0.5)
    """

    expression: Expression
    target: ExpressionLike = 0.0
    name: str = field(default="", kw_only=True)
    gain: ExpressionLike | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        error = _error_of(self, self.expression, self.target)
        if any(s.order for s in error.symbols):
            raise InvalidValueError(f"{self!r} is about speeds. A range of speeds is a Keep.")
        if self.gain is not None:
            _check_positive(self, "gain", self.gain)

    @property
    def error(self) -> Expression:
        """Expression minus target, flat, shape (k,)."""
        return (self.expression - self.target).ravel()

    def __repr__(self) -> str:
        return f"Hold({_describe(self.name, self.expression)})"


@dataclass(frozen=True, eq=False)
class Keep:
    """Hard range of positions or speeds, ``lower <= expression <= upper``, like a constraint of the model.

    Parameters
    ----------
    lower, upper
        Bounds, numbers or expressions; ±inf for none.
    expression
        Scalar expression of positions, or of speeds.
    name
        Name in results and messages.

    Raises
    ------
    ExpressionError, ShapeError, InvalidValueError
        For a text, an expression that is no scalar or depends on no symbol, or an empty range.

    Examples
    --------
    >>> model = kv.load("fetch")
    >>> hand = model.fk("fetch/gripper_link")[:3, 3]
    >>> tasks = [kv.control.Goal(hand, [0.8, 0, 1.2]), kv.control.Keep(0.3, hand[2], 1.0, name="height")]
    >>> result = kv.control.inverse_kinematics(model, tasks, fixed=["fetch/base"])
    >>> result.solved, hand(result.best)[2].round(3)
    (False, np.float64(1.0))
    """

    lower: ExpressionLike
    expression: Expression
    upper: ExpressionLike
    name: str = field(default="", kw_only=True)

    def __post_init__(self) -> None:
        for part in (self.lower, self.expression, self.upper):
            _refuse_text(self, part)
        _ = self.constraint

    @property
    def constraint(self) -> Constraint:
        """The range as a constraint."""
        return Constraint.from_expressions(self.lower, self.expression, self.upper)

    def __repr__(self) -> str:
        return f"Keep({_describe(self.name, self.expression)})"


Task: TypeAlias = Goal | Hold | Keep
"""A task of a controller or of inverse kinematics."""


def _describe(name: str, expression: object) -> str:
    text = repr(name or expression)
    return text if name or len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def _refuse_text(task: object, value: object) -> None:
    if isinstance(value, str):
        raise ExpressionError(
            f"{type(task).__name__}: {value!r} is a text where an expression is meant. The symbol of that "
            f"name is model.symbol({value!r}), the pose of a frame model.fk({value!r})."
        )


def _error_of(task: Goal | Hold, expression: Expression, target: ExpressionLike) -> Expression:
    _refuse_text(task, expression)
    _refuse_text(task, target)
    if not isinstance(expression, Expression):
        raise ExpressionError(f"{type(task).__name__} takes an expression, not {expression!r}.")
    if expression.shape in ((4, 4), (3, 3)):
        raise ShapeError(
            f"{task!r} is about a {expression.shape[0]}×{expression.shape[1]} matrix, whose entries are not "
            "independent. For a pose use kv.control.same_pose(a_T, b_T), for a position T[:3, 3]."
        )
    wanted = as_expression(target)
    if wanted.shape not in ((), expression.shape):
        raise ShapeError(f"{task!r}: the target has shape {wanted.shape}, the expression {expression.shape}.")
    if not wanted.symbols and not all(math.isfinite(float(v)) for v in wanted.ravel()):
        raise InvalidValueError(f"{task!r}: the target {target!r} is not finite.")
    error = expression - wanted
    # The gradient over speeds would be that of accelerations.
    if not any(s.order for s in error.symbols) and not error.gradient():
        raise InvalidValueError(
            f"{task!r} depends on nothing that moves, so no speed can serve it. The pose of a frame that is "
            "fixed to the world is a constant."
        )
    return error


def _check_positive(task: object, name: str, value: ExpressionLike) -> None:
    _check_number(task, name, value, 0.0)
    expression = as_expression(value)
    if not expression.symbols and not float(expression) > 0:
        raise InvalidValueError(f"{task!r}: the {name} is positive, not {value!r}.")


def _check_number(task: object, name: str, value: ExpressionLike, least: float) -> None:
    _refuse_text(task, value)
    expression = as_expression(value)
    if expression.shape:
        raise ShapeError(f"{task!r}: the {name} is a scalar, not of shape {expression.shape}.")
    if not expression.symbols and not (math.isfinite(float(expression)) and float(expression) >= least):
        raise InvalidValueError(f"{task!r}: the {name} is a finite number from {least:g}, not {value!r}.")


_LAST_ROW = [0.0, 0.0, 0.0, 1.0]
_LENGTH_TOLERANCE, _ANGLE_TOLERANCE = 1.1e-5, 1e-6
"""Tolerances of the squared lengths and of the scalar products of a rotation's rows."""


class Target:
    """Array of parameters: a pose, a point or other numbers that change without another compilation.

    Use :attr:`expression` in tasks, and :meth:`.Controller.set` while the controller runs. Elsewhere
    :meth:`values` gives the entries of a state.

    Parameters
    ----------
    name
        Path of the parameters.
    value
        Initial value: a number, a vector, or a 4×4 transform, whose last row stays (0, 0, 0, 1). Constant
        expressions are values, too.

    Attributes
    ----------
    expression
        The parameters in the shape of the value.
    parameters
        The parameters, row by row.

    See Also
    --------
    kineverse.control.InverseKinematics
    kineverse.control.Controller.set
    """

    expression: Expression
    parameters: tuple[Symbol, ...]

    def __init__(self, name: str, value: npt.ArrayLike | Expression) -> None:
        self.name = name
        initial = self._as_array(value)
        self._shape, self._transform = initial.shape, initial.shape == (4, 4)
        numbers = self._check(initial, initial.shape)
        self.parameters = tuple(parameter(f"{name}/{k}", v) for k, v in enumerate(numbers.tolist()))
        entries: list[Expression | float] = [*self.parameters, *(_LAST_ROW if self._transform else ())]
        self.expression = array(entries).reshape(*initial.shape) if initial.shape else array(entries)[0]

    def values(self, value: npt.ArrayLike | Expression) -> dict[Symbol, float]:
        """Return the values of the parameters for a value of the target.

        Raises
        ------
        ShapeError, InvalidValueError
            For a value of another shape, a NaN, or a 4×4 matrix that is no transform.
        """
        return dict(zip(self.parameters, self.numbers(value).tolist(), strict=True))

    def numbers(self, value: npt.ArrayLike | Expression) -> npt.NDArray[np.float64]:
        """Return the values of the parameters in their order; for errors see :meth:`values`."""
        return self._check(self._as_array(value), self._shape)

    def _as_array(self, value: npt.ArrayLike | Expression) -> npt.NDArray[np.float64]:
        if isinstance(value, Expression) and not value.symbols:
            value = value()
        try:
            return np.asarray(value, dtype=float)
        except (TypeError, ValueError) as error:
            told = f"The target '{self.name}' is a number or an array of numbers, not {value!r}."
            raise InvalidValueError(told) from error

    def _check(self, value: npt.NDArray[np.float64], shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
        if value.shape != shape:
            raise ShapeError(f"The target '{self.name}' has shape {shape}, not {value.shape}.")
        flat = value.ravel()
        if not math.isfinite(flat.dot(flat)) and not np.isfinite(flat).all():
            raise InvalidValueError(f"The target '{self.name}' has to be finite.")
        if self._transform:
            if not _is_transform(value):
                raise InvalidValueError(f"The target '{self.name}' takes a transform; this matrix is none.")
            return flat[:12]
        return flat

    def __repr__(self) -> str:
        return f"Target({self.name!r}, {self.expression.shape})"


def _is_transform(matrix: npt.NDArray[np.float64]) -> bool:
    """Return whether a finite (4, 4) matrix is a transform, ten times as fast as by numpy's functions."""
    (a, b, c, _), (d, e, f, _), (g, h, i, _), last = matrix.tolist()
    lengths = a * a + b * b + c * c, d * d + e * e + f * f, g * g + h * h + i * i
    products = a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i
    return bool(
        last == _LAST_ROW
        and max(abs(length - 1.0) for length in lengths) <= _LENGTH_TOLERANCE
        and max(map(abs, products)) <= _ANGLE_TOLERANCE
        and a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) > 0.0
    )


def same_position(a_T: ExpressionLike, b_T: ExpressionLike) -> Expression:
    """Return the position of b minus that of a in the common frame, shape (3,) [m].

    Examples
    --------
    >>> kv.control.same_position(kv.translation(1, 0, 0), kv.translation(1, 0.2, 0))()
    array([0. , 0.2, 0. ])
    """
    return as_transform(b_T)[:3, 3] - as_transform(a_T)[:3, 3]


def same_orientation(a_T: ExpressionLike, b_T: ExpressionLike) -> Expression:
    """Return the rotation vector of b in a, shape (3,) [rad]; see :func:`kineverse.spatial.log_so3`.

    Examples
    --------
    >>> kv.control.same_orientation(kv.rotation_z(0.1), kv.rotation_z(0.4))().round(3)
    array([0. , 0. , 0.3])
    """
    return log_so3(as_transform(a_T)[:3, :3].T @ as_transform(b_T)[:3, :3])


def same_pose(a_T: ExpressionLike, b_T: ExpressionLike) -> Expression:
    """Return the pose of b in a as 6 numbers: position [m], then rotation vector [rad].

    All are zero where both poses are equal.

    Parameters
    ----------
    a_T, b_T
        Poses in a common frame, 4×4 expressions or arrays.

    Examples
    --------
    >>> a, b = kv.translation(1, 0, 0), kv.translation(1, 0.2, 0) @ kv.rotation_z(0.5)
    >>> kv.control.same_pose(a, b)().round(3)
    array([0. , 0.2, 0. , 0. , 0. , 0.5])
    """
    a_T_b = inverse(a_T) @ as_transform(b_T)
    return as_expression(np.concatenate([a_T_b[:3, 3], log_so3(a_T_b[:3, :3])]))


def look_at(
    camera_T: ExpressionLike, point: ExpressionLike, axis: ExpressionLike = (1.0, 0.0, 0.0)
) -> Expression:
    """Return the rotation vector that turns the viewing axis of a camera towards a point.

    It is in the camera's frame, shape (3,); its length is the angle between axis and ray [rad]. The rotation
    about the ray stays free. Straight behind the camera the direction of the turn is undefined.

    Parameters
    ----------
    camera_T
        Pose of the camera, 4×4.
    point
        Point in the frame of the pose, shape (3,) [m], away from the camera.
    axis
        Viewing axis in the camera's frame, shape (3,).

    Examples
    --------
    >>> model = kv.load("fetch")
    >>> camera = model.fk("fetch/head_tilt_link")
    >>> goal = kv.control.Goal(kv.control.look_at(camera, [2.0, 1.0, 0.0]))
    >>> kv.control.inverse_kinematics(model, [goal], fixed=["fetch/base"]).solved
    True
    """
    pose = as_transform(camera_T)
    forward = unit_vector(axis, "The viewing axis")
    ray = pose[:3, :3].T @ (as_expression(point) - pose[:3, 3])
    turn = as_expression(np.cross(forward, ray))
    cosine = forward @ ray
    sine2 = turn @ turn
    # atan(t)/t is 1 at t = 0; the branch avoids 0/0 and keeps the derivative there.
    aligned = _is_greater(cosine, 0.0) * _is_greater(1e-12 * cosine * cosine, sine2)
    sine = sqrt(where(aligned, 1.0, sine2))
    return turn * where(aligned, 1 / where(aligned, cosine, 1.0), arctan2(sine, cosine) / sine)


def _is_greater(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return 1 where a > b, else 0; for selections, without gradient and trend."""
    return binary(ca.OP_LT, b, a)
