"""Elementary functions of expressions; numpy's functions of the same names give the same.

What has a kink is written so that its gradient stays finite wherever a derivative can be given: selections
never multiply the branch that was not taken, and a norm has gradient 0 at the origin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from kineverse.errors import ShapeError

from . import layout
from .expression import (
    Expression,
    ExpressionLike,
    array,
    as_expression,
    binary,
    broadcast,
    make,
    matmul,
    unary,
    union,
)
from .node import Node

if TYPE_CHECKING:
    from kineverse.symbols import Symbol


def sin(x: ExpressionLike) -> Expression:
    """Return the sine, elementwise; x [rad]."""
    return unary(ca.OP_SIN, as_expression(x))


def cos(x: ExpressionLike) -> Expression:
    """Return the cosine, elementwise; x [rad]."""
    return unary(ca.OP_COS, as_expression(x))


def tan(x: ExpressionLike) -> Expression:
    """Return the tangent, elementwise; x [rad]."""
    return unary(ca.OP_TAN, as_expression(x))


def arcsin(x: ExpressionLike) -> Expression:
    """Return the inverse sine in [-π/2, π/2] [rad]; its slope is infinite at ±1."""
    return unary(ca.OP_ASIN, as_expression(x))


def arccos(x: ExpressionLike) -> Expression:
    """Return the inverse cosine in [0, π] [rad]; its slope is infinite at ±1."""
    return unary(ca.OP_ACOS, as_expression(x))


def arctan(x: ExpressionLike) -> Expression:
    """Return the inverse tangent in (-π/2, π/2) [rad]."""
    return unary(ca.OP_ATAN, as_expression(x))


def arctan2(y: ExpressionLike, x: ExpressionLike) -> Expression:
    """Return the angle of the point (x, y) in (-π, π] [rad]; at the origin it has no derivative (NaN)."""
    return binary(ca.OP_ATAN2, y, x)


def sinh(x: ExpressionLike) -> Expression:
    """Return the hyperbolic sine, elementwise."""
    return unary(ca.OP_SINH, as_expression(x))


def cosh(x: ExpressionLike) -> Expression:
    """Return the hyperbolic cosine, elementwise."""
    return unary(ca.OP_COSH, as_expression(x))


def tanh(x: ExpressionLike) -> Expression:
    """Return the hyperbolic tangent, elementwise."""
    return unary(ca.OP_TANH, as_expression(x))


def arcsinh(x: ExpressionLike) -> Expression:
    """Return the inverse hyperbolic sine, elementwise."""
    return unary(ca.OP_ASINH, as_expression(x))


def arccosh(x: ExpressionLike) -> Expression:
    """Return the inverse hyperbolic cosine, elementwise."""
    return unary(ca.OP_ACOSH, as_expression(x))


def arctanh(x: ExpressionLike) -> Expression:
    """Return the inverse hyperbolic tangent, elementwise."""
    return unary(ca.OP_ATANH, as_expression(x))


def exp(x: ExpressionLike) -> Expression:
    """Return e to the power x, elementwise."""
    return unary(ca.OP_EXP, as_expression(x))


def log(x: ExpressionLike) -> Expression:
    """Return the natural logarithm, elementwise."""
    return unary(ca.OP_LOG, as_expression(x))


def expm1(x: ExpressionLike) -> Expression:
    """Return exp(x) - 1, accurate for small x."""
    return unary(ca.OP_EXPM1, as_expression(x))


def log1p(x: ExpressionLike) -> Expression:
    """Return log(1 + x), accurate for small x."""
    return unary(ca.OP_LOG1P, as_expression(x))


def sqrt(x: ExpressionLike) -> Expression:
    """Return the square root, elementwise; its slope is infinite at 0."""
    return unary(ca.OP_SQRT, as_expression(x))


def square(x: ExpressionLike) -> Expression:
    """Return x², elementwise."""
    return unary(ca.OP_SQ, as_expression(x))


def absolute(x: ExpressionLike) -> Expression:
    """Return |x|, elementwise; gradient 0 at 0."""
    return unary(ca.OP_FABS, as_expression(x))


def sign(x: ExpressionLike) -> Expression:
    """Return -1, 0 or 1, elementwise; gradient 0."""
    return unary(ca.OP_SIGN, as_expression(x))


def floor(x: ExpressionLike) -> Expression:
    """Return the largest integer not greater than x, elementwise; gradient 0."""
    return unary(ca.OP_FLOOR, as_expression(x))


def ceil(x: ExpressionLike) -> Expression:
    """Return the smallest integer not less than x, elementwise; gradient 0."""
    return unary(ca.OP_CEIL, as_expression(x))


def copysign(x: ExpressionLike, y: ExpressionLike) -> Expression:
    """Return |x| with the sign of y, elementwise."""
    return binary(ca.OP_COPYSIGN, x, y)


def where(condition: ExpressionLike, if_true: ExpressionLike, if_false: ExpressionLike) -> Expression:
    """Select elementwise: ``if_true`` where the condition is at least 0.5, else ``if_false``.

    A selection, not a blend: NaN in the branch that is not taken stays there, in the gradient as well. The
    gradient carries no trend of the condition.
    """
    c, a, b = broadcast(as_expression(condition), as_expression(if_true), as_expression(if_false))
    return Select.of((c, a, b), a.shape)


def minimum(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return the smaller, elementwise; the gradient is that of the smaller one, the mean of both at a tie.

    NaN if one of them is NaN, and so is the gradient then; ``np.fmin`` returns the other one.
    """
    x, y = broadcast(as_expression(a), as_expression(b))
    return Extremum.of((x, y), x.shape, ("min",))


def maximum(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return the larger, elementwise; the gradient is that of the larger one, the mean of both at a tie.

    NaN if one of them is NaN, and so is the gradient then; ``np.fmax`` returns the other one.
    """
    x, y = broadcast(as_expression(a), as_expression(b))
    return Extremum.of((x, y), x.shape, ("max",))


def fmin(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return the smaller, elementwise, and of a number and NaN the number."""
    x, y = broadcast(as_expression(a), as_expression(b))
    return where(_is_number(x), where(_is_number(y), minimum(x, y), x), y)


def fmax(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return the larger, elementwise, and of a number and NaN the number."""
    x, y = broadcast(as_expression(a), as_expression(b))
    return where(_is_number(x), where(_is_number(y), maximum(x, y), x), y)


def _is_number(x: Expression) -> Expression:
    """Return 0 where x is NaN and 1 elsewhere, infinities included."""
    return binary(ca.OP_LE, absolute(x), math.inf)


def clip(x: ExpressionLike, lower: ExpressionLike, upper: ExpressionLike) -> Expression:
    """Return x limited to [lower, upper], elementwise."""
    return minimum(maximum(x, lower), upper)


def norm(x: ExpressionLike) -> Expression:
    """Return the Euclidean norm over all elements, a scalar; its gradient at the origin is 0."""
    vector = as_expression(x).ravel()
    if vector.size == 0:
        raise ShapeError("The norm of an empty array is not defined here.")
    return Norm.of((vector,), ())


def hypot(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return √(a² + b²), elementwise; its gradient at the origin is 0."""
    x, y = broadcast(as_expression(a), as_expression(b))
    if not x.shape:
        return norm(array([x, y]))
    squares = square(x) + square(y)
    return where(
        make(ca.SX.binary(ca.OP_LT, 0, squares._sx), squares.shape, squares._nodes), sqrt(squares), 0
    )


def sum_along(x: ExpressionLike, axis: int | tuple[int, ...] | None = None) -> Expression:
    """Return the sum over all elements, or along one axis or several."""
    rows, rest = _axis_first(x, axis)
    return make(ca.sum1(rows._sx).T, (rows.shape[1],), rows._nodes).reshape(rest)


def product_along(x: ExpressionLike, axis: int | tuple[int, ...] | None = None) -> Expression:
    """Return the product of all elements, or along one axis or several; 1 of none."""
    rows, rest = _axis_first(x, axis)
    result = as_expression(np.ones(rows.shape[1]))
    for row in rows:
        result = result * row
    return result.reshape(rest)


def smallest(x: ExpressionLike, axis: int | tuple[int, ...] | None = None) -> Expression:
    """Return the smallest of all elements, or along one axis or several.

    The gradient is the mean of those of all the elements that are the smallest; see :func:`minimum`.
    """
    return _among(x, axis, "min")


def largest(x: ExpressionLike, axis: int | tuple[int, ...] | None = None) -> Expression:
    """Return the largest of all elements, or along one axis or several.

    The gradient is the mean of those of all the elements that are the largest; see :func:`maximum`.
    """
    return _among(x, axis, "max")


def _among(x: ExpressionLike, axis: int | tuple[int, ...] | None, which: str) -> Expression:
    rows, rest = _axis_first(x, axis)
    if not rows.shape[0]:
        raise ShapeError("Nothing has no smallest or largest element.")
    columns = (tuple(column) for column in rows.T)
    return array([c[0] if len(c) == 1 else Extremum.of(c, (), (which,)) for c in columns]).reshape(rest)


def _axis_first(x: ExpressionLike, axis: int | tuple[int, ...] | None) -> tuple[Expression, tuple[int, ...]]:
    """Return a matrix with the wanted axes as its rows and all others as its columns; the others' shape."""
    operand = as_expression(x)
    axes = tuple(range(operand.ndim)) if axis is None else axis if isinstance(axis, tuple) else (axis,)
    try:
        index = np.moveaxis(layout.indices(operand.shape), axes, range(len(axes)))
    except (ValueError, TypeError):
        raise ShapeError(f"Axis {axis} does not fit an array of shape {operand.shape}.") from None
    along, rest = index.shape[: len(axes)], index.shape[len(axes) :]
    return operand._rearranged(index.reshape(math.prod(along), math.prod(rest))), rest


def inverse(matrix: ExpressionLike) -> Expression:
    """Return the inverse of a square matrix, ``D(A⁻¹) = -A⁻¹ D(A) A⁻¹``.

    For homogeneous transforms use :func:`kineverse.spatial.inverse`, which is far smaller.
    """
    a = as_expression(matrix)
    if a.ndim != 2 or a.shape[0] != a.shape[1]:
        raise ShapeError(f"Only a square matrix has an inverse, not one of shape {a.shape}.")
    return make(ca.inv(a._sx), a.shape, a._nodes)


def determinant(matrix: ExpressionLike) -> Expression:
    """Return the determinant of a square matrix, a scalar."""
    a = as_expression(matrix)
    if a.ndim != 2 or a.shape[0] != a.shape[1]:
        raise ShapeError(f"Only a square matrix has a determinant, not one of shape {a.shape}.")
    n = a.shape[0]
    if not n:
        return as_expression(1.0)
    if n < 5:
        return make(ca.det(a._sx), (), a._nodes)
    # Minors grow with n!, so larger ones by the characteristic polynomial (Faddeev-LeVerrier).
    identity = as_expression(np.eye(n))
    power, coefficient = identity, as_expression(1.0)
    for k in range(1, n + 1):
        product = matmul(a, power)
        coefficient = sum_along(product[np.arange(n), np.arange(n)]) / -k
        power = product + coefficient * identity
    return coefficient if n % 2 == 0 else -coefficient


class Select(Node):
    """``where``: its arguments are condition and branches, all of the node's shape."""

    __slots__ = ()
    kind = "select"
    own_partials = True

    @property
    def _holds(self) -> Expression:
        return binary(ca.OP_LE, 0.5, self.arguments[0])

    def _value(self) -> Expression:
        return self._chosen(self.arguments[1], self.arguments[2])

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        a, b = (argument.gradient(heuristic) for argument in self.arguments[1:])
        zero = as_expression(np.zeros(self.shape))
        return {key: self._chosen(a.get(key, zero), b.get(key, zero)) for key in {**a, **b}}

    def _chosen(self, if_true: Expression, if_false: Expression) -> Expression:
        from .implicit import implicit_nodes

        if implicit_nodes(self.arguments[:1]):
            # A loop that does not close here is NaN. Nothing is chosen then, and evaluation says why.
            fails = binary(ca.OP_LT, self.arguments[0], 0.5)
            neither = make(ca.SX.nan(*if_false._sx.shape), if_false.shape, frozenset())
            if_false = _selected(fails, if_false, neither)
        return _selected(self._holds, if_true, if_false)

    def differentiated(self, heuristic: bool) -> tuple[Expression, ...]:
        """Return the branches; the condition selects and has no part in the gradient."""
        return self.arguments[1:]


def _selected(holds: Expression, if_true: Expression, if_false: Expression) -> Expression:
    """Return a choice by a comparison; CasADi keeps such choices free of NaN in every derivative."""
    return make(
        ca.if_else(holds._sx, if_true._sx, if_false._sx), holds._shape, union((holds, if_true, if_false))
    )


class Extremum(Node):
    """``minimum`` and ``maximum`` of two or more arguments of the node's shape."""

    __slots__ = ()
    kind = "extremum"
    own_partials = True

    @property
    def label(self) -> str:
        """``minimum`` or ``maximum``."""
        return f"{self.options[0]}imum"

    def _value(self) -> Expression:
        number = _in_rounds(ca.OP_FMIN if self.options[0] == "min" else ca.OP_FMAX, self.arguments)
        # Where an argument is NaN this is NaN, and else a number or infinite. CasADi takes x == x for true,
        # and 0 <= sqrt(x) too.
        size = _in_rounds(ca.OP_ADD, tuple(map(absolute, self.arguments)))
        unordered = unary(ca.OP_NOT, binary(ca.OP_LE, size, math.inf))
        # Subtracted, because -0 + 0 would be another zero.
        return number - binary(ca.OP_IF_ELSE_ZERO, unordered, size)

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        won = [binary(ca.OP_EQ, argument, self.value) for argument in self.arguments]
        each = 1 / _in_rounds(ca.OP_ADD, won)
        result: dict[Symbol, Expression] = {}
        for argument, wins in zip(self.arguments, won, strict=True):
            share = wins * each  # 1, 0, at a tie 1/n; of NaN 0/0, NaN as well
            for key, entry in argument.gradient(heuristic).items():
                # Zero times NaN would be NaN; what has no share is not looked at.
                term = binary(ca.OP_IF_ELSE_ZERO, share, share * entry)
                result[key] = result[key] + term if key in result else term
        return result


def _in_rounds(op: int, operands: Sequence[Expression]) -> Expression:
    """Return operands joined in pairs, these again in pairs, and so on: a thousand are ten deep."""
    joined = list(operands)
    while len(joined) > 1:
        odd = joined[-1:] if len(joined) % 2 else []
        joined = [binary(op, x, y) for x, y in zip(joined[:-1:2], joined[1::2], strict=False)] + odd
    return joined[0]


class Norm(Node):
    """The Euclidean norm of one vector."""

    __slots__ = ()
    kind = "norm"
    own_partials = True

    def _value(self) -> Expression:
        (vector,) = self.arguments
        return sqrt(make(ca.sumsqr(vector._sx), (), vector._nodes))

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        (vector,) = self.arguments
        away = binary(ca.OP_LT, 0, self.value)
        length = where(away, self.value, 1)
        return {key: vector @ entry / length for key, entry in vector.gradient(heuristic).items()}
