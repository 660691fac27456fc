"""Tasks of a controller: goals, holds and keeps on any expression.

A task says what is wanted of an expression e of a model's symbols. It knows nothing of joints: the speeds
that serve it are the keys of its gradient (task function approach: Samson, Le Borgne, Espiau 1991).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TypeAlias

from kineverse.errors import ExpressionError, InvalidValueError, ShapeError
from kineverse.expressions.expression import Expression, ExpressionLike, as_expression
from kineverse.model.constraint import Constraint

_LONGEST = 100
"""Largest number of characters of an expression in a message."""


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
            raise ShapeError(
                f"{self!r}: the weight is a scalar or has shape {self.expression.shape}, not {weights.shape}."
            )
        for weight in weights.ravel():
            _check_number(self, "weight", weight, 0.0)
        if any(s.order for s in error.symbols):
            if self.speed is not None or self.rate is not None:
                raise InvalidValueError(
                    f"{self!r} is about speeds; speed= and rate= are for goals of positions."
                )
            if not all(any(s.order for s in entry.symbols) for entry in error.ravel()):
                raise InvalidValueError(
                    f"{self!r} has entries of positions and of speeds; make two goals of it."
                )
        if self.rate is not None and as_expression(self.rate).shape not in ((), error.shape):
            raise ShapeError(
                f"{self!r}: the rate has shape {as_expression(self.rate).shape}, not {error.shape}."
            )

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
    """Return expression minus target after checks."""
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
        raise InvalidValueError(
            f"{task!r}: the {name} is a finite number of at least {least:g}, not {value!r}."
        )
