"""Elementary functions and rounding, elementwise, with numpy's names.

Functions with a kink are nodes of :mod:`kineverse.expressions.nonsmooth`. Rounding functions are steps: their
gradient is 0, except that of the remainder, D(a % b) = D(a) - (a // b)·D(b).
"""

from __future__ import annotations

import math

import casadi as ca

from kineverse.errors import ShapeError

from .expression import (
    Expression,
    ExpressionLike,
    array,
    as_expression,
    binary,
    broadcast,
    from_casadi,
    unary,
)
from .nonsmooth import Extremum as Extremum
from .nonsmooth import Norm as Norm
from .nonsmooth import Power as Power
from .nonsmooth import Select as Select
from .nonsmooth import power as power


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


def log10(x: ExpressionLike) -> Expression:
    """Return the logarithm to base 10, elementwise; it may be off by a last digit."""
    return log(x) / math.log(10)


def log2(x: ExpressionLike) -> Expression:
    """Return the logarithm to base 2, elementwise; it may be off by a last digit."""
    return log(x) / math.log(2)


def cbrt(x: ExpressionLike) -> Expression:
    """Return the cube root, elementwise, of negative numbers too; its slope is infinite at 0."""
    operand = as_expression(x)
    root = binary(ca.OP_POW, operand, 1 / 3), -binary(ca.OP_POW, -operand, 1 / 3)
    holds = binary(ca.OP_LE, 0.0, operand)
    chosen = ca.if_else(holds._sx, root[0]._sx, root[1]._sx)
    return from_casadi(chosen, operand._shape, operand._nodes)


def square(x: ExpressionLike) -> Expression:
    """Return x², elementwise."""
    return unary(ca.OP_SQ, as_expression(x))


def absolute(x: ExpressionLike) -> Expression:
    """Return ``|x|``, elementwise; gradient 0 at 0."""
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
    """Return ``|x|`` with the sign of y, elementwise. A NaN counts as positive."""
    sign_of = as_expression(y)
    if not sign_of.is_constant:
        sign_of = binary(ca.OP_IF_ELSE_ZERO, _is_number(sign_of), sign_of)
    return binary(ca.OP_COPYSIGN, x, sign_of)


def where(condition: ExpressionLike, if_true: ExpressionLike, if_false: ExpressionLike) -> Expression:
    """Select elementwise: ``if_true`` where the condition is at least 0.5, else ``if_false``.

    A selection, not a blend: NaN in the branch that is not taken does not reach the result or its gradient.
    The gradient carries no trend of the condition.

    Examples
    --------
    >>> q = kv.position("q")
    >>> e = kv.where(q < 1, q, 1 + np.log(q))
    >>> e({"q": 0.5}), e({"q": np.e})
    (np.float64(0.5), np.float64(2.0))
    """
    c, a, b = broadcast(as_expression(condition), as_expression(if_true), as_expression(if_false))
    return Select.from_arguments((c, a, b), a.shape)


def minimum(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return the smaller, elementwise; the gradient is that of the smaller one, the mean of both at a tie.

    NaN if one of them is NaN, and so is the gradient then; ``np.fmin`` returns the other one.

    Examples
    --------
    >>> x = kv.position("x")
    >>> kv.minimum(kv.array([x, 2 * x]), 3)({"x": 2})
    array([2., 3.])
    """
    x, y = broadcast(as_expression(a), as_expression(b))
    return Extremum.from_arguments((x, y), x.shape, ("min",))


def maximum(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return the larger, elementwise; the gradient is that of the larger one, the mean of both at a tie.

    NaN if one of them is NaN, and so is the gradient then; ``np.fmax`` returns the other one.

    Examples
    --------
    >>> x, y = kv.position("x"), kv.position("y")
    >>> e = kv.maximum(x, y)
    >>> e({"x": 1, "y": 2})
    np.float64(2.0)
    >>> e.gradient()[y.derivative()]({"x": 1, "y": 2})
    np.float64(1.0)
    """
    x, y = broadcast(as_expression(a), as_expression(b))
    return Extremum.from_arguments((x, y), x.shape, ("max",))


def fmin(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return the smaller, elementwise; of a number and NaN, the number."""
    x, y = broadcast(as_expression(a), as_expression(b))
    return where(_is_number(x), where(_is_number(y), minimum(x, y), x), y)


def fmax(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return the larger, elementwise; of a number and NaN, the number."""
    x, y = broadcast(as_expression(a), as_expression(b))
    return where(_is_number(x), where(_is_number(y), maximum(x, y), x), y)


def _is_number(x: Expression) -> Expression:
    """Return 0 where x is NaN and 1 elsewhere, infinities included."""
    return binary(ca.OP_LE, absolute(x), math.inf)


def clip(x: ExpressionLike, lower: ExpressionLike, upper: ExpressionLike) -> Expression:
    """Return x limited to [lower, upper], elementwise.

    Examples
    --------
    >>> x = kv.position("x")
    >>> kv.clip(x, 0, 1)({"x": 1.7})
    np.float64(1.0)
    >>> kv.clip(x, 0, 1).gradient()[x.derivative()]({"x": 1.7})
    np.float64(0.0)
    """
    return minimum(maximum(x, lower), upper)


def norm(x: ExpressionLike) -> Expression:
    """Return the Euclidean norm over all elements, a scalar; its gradient at the origin is 0.

    The squares of elements neither overflow nor vanish: the norm of (3e200, 4e200) is 5e200.

    Examples
    --------
    >>> x, y = kv.position("x"), kv.position("y")
    >>> kv.norm(kv.array([x, y]))({"x": 3, "y": 4})
    np.float64(5.0)
    """
    vector = as_expression(x).ravel()
    if vector.size == 0:
        raise ShapeError("The norm of an empty array is not defined here.")
    return Norm.from_arguments((vector,), ())


def hypot(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return √(a² + b²), elementwise, for large and small numbers too; its gradient at the origin is 0."""
    x, y = broadcast(as_expression(a), as_expression(b))
    if not x.shape:
        return norm(array([x, y]))
    pairs = zip(x.ravel(), y.ravel(), strict=True)
    return array([norm(array([first, second])) for first, second in pairs]).reshape(x.shape)


def floor_divide(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return the largest integer not greater than the quotient, elementwise.

    As in numpy and Python, the exact quotient of the two floats is meant: ``1.0 // 0.1`` is 9, since the
    float 0.1 is slightly larger than a tenth. For a divisor of 0 the quotient is returned: ±infinity or NaN.
    """
    _, numerator, denominator = _with_positive_divisor(a, b)
    rest = binary(ca.OP_FMOD, numerator, denominator)
    quotient = (numerator - rest) / denominator - binary(ca.OP_LT, rest, 0.0)
    whole = floor(quotient)
    # Rounding may have left a quotient that should be whole slightly below it.
    whole = whole + binary(ca.OP_LT, 0.5, quotient - whole)
    divisor = denominator._sx
    if not divisor.is_constant() or any(float(e) == 0 for e in divisor.elements()):
        by_zero = binary(ca.OP_EQ, denominator, 0.0)
        infinite = binary(ca.OP_IF_ELSE_ZERO, by_zero, sign(numerator) * math.inf)
        whole = binary(ca.OP_IF_ELSE_ZERO, unary(ca.OP_NOT, by_zero), whole) + infinite
    return binary(ca.OP_COPYSIGN, whole, numerator)  # last, as sums lose the sign of 0


def remainder(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return ``a - (a // b)·b`` without its rounding, elementwise; it has the sign of b."""
    sense, numerator, denominator = _with_positive_divisor(a, b)
    rest = binary(ca.OP_FMOD, numerator, denominator)
    # A rest of -0 becomes +0 here, as its sign is that of b too.
    return sense * (rest + binary(ca.OP_IF_ELSE_ZERO, binary(ca.OP_LT, rest, 0.0), denominator))


def _with_positive_divisor(a: ExpressionLike, b: ExpressionLike) -> tuple[Expression, Expression, Expression]:
    """Return the sign of b, and both operands times that sign."""
    divisor = as_expression(b)
    sense = binary(ca.OP_COPYSIGN, 1.0, divisor)
    return sense, sense * as_expression(a), sense * divisor


def rint(x: ExpressionLike) -> Expression:
    """Return the nearest integer, elementwise; of two equally near, the even one."""
    operand = as_expression(x)
    below = floor(operand)
    above_half = operand - below
    odd = binary(ca.OP_LT, 2 * floor(below / 2), below)
    tie = binary(ca.OP_AND, binary(ca.OP_EQ, above_half, 0.5), odd)
    up = binary(ca.OP_OR, binary(ca.OP_LT, 0.5, above_half), tie)
    return copysign(below + up, operand)


def around(x: ExpressionLike, decimals: int = 0) -> Expression:
    """Return x rounded to a number of decimals, elementwise; of two equally near, the even one."""
    digits = int(decimals)
    if not digits:
        return rint(x)
    scale = 10.0 ** abs(digits)
    return rint(as_expression(x) * scale) / scale if digits > 0 else rint(as_expression(x) / scale) * scale


def trunc(x: ExpressionLike) -> Expression:
    """Return x rounded towards 0, elementwise."""
    return copysign(floor(absolute(x)), x)
