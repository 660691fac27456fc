"""Rounding to whole numbers, and division with a remainder: numpy's, to the last bit.

All of these are steps, so their gradients are 0, but for that of the remainder,
D(a % b) = D(a) - (a // b)·D(b).
"""

from __future__ import annotations

import math

import casadi as ca

from .expression import Expression, ExpressionLike, as_expression, binary, unary
from .functions import absolute, copysign, floor, sign


def floor_divide(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return the largest whole number not greater than the quotient, elementwise.

    As numpy and Python have it: of the true quotient, so that ``1.0 // 0.1`` is 9, since 0.1 is a little more
    than a tenth. By 0 it is the quotient: infinite, or NaN.
    """
    _, numerator, denominator = _turned(a, b)
    rest = binary(ca.OP_FMOD, numerator, denominator)
    quotient = (numerator - rest) / denominator - binary(ca.OP_LT, rest, 0.0)
    whole = floor(quotient)
    # What should be whole may be off by its rounding.
    whole = whole + binary(ca.OP_LT, 0.5, quotient - whole)
    if not _never_zero(denominator):
        by_zero = binary(ca.OP_EQ, denominator, 0.0)
        infinite = binary(ca.OP_IF_ELSE_ZERO, by_zero, sign(numerator) * math.inf)
        whole = binary(ca.OP_IF_ELSE_ZERO, unary(ca.OP_NOT, by_zero), whole) + infinite
    # Last, as sums lose the sign of 0.
    return copysign(whole, numerator)


def remainder(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return ``a - (a // b)·b`` without its rounding, elementwise; it has the sign of b."""
    sense, numerator, denominator = _turned(a, b)
    rest = binary(ca.OP_FMOD, numerator, denominator)
    # A rest of -0 becomes +0 here, as its sign is that of b too.
    return sense * (rest + binary(ca.OP_IF_ELSE_ZERO, binary(ca.OP_LT, rest, 0.0), denominator))


def fmod(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return the remainder of the division rounded towards 0, elementwise: it has the sign of a."""
    return binary(ca.OP_FMOD, a, b)


def _turned(a: ExpressionLike, b: ExpressionLike) -> tuple[Expression, Expression, Expression]:
    """Return the sign of b, and both operands times it: a divisor that is not negative."""
    divisor = as_expression(b)
    sense = copysign(1.0, divisor)
    return sense, sense * as_expression(a), sense * divisor


def _never_zero(x: Expression) -> bool:
    return bool(x._sx.is_constant()) and not any(float(e) == 0 for e in x._sx.elements())


def rint(x: ExpressionLike) -> Expression:
    """Return the nearest whole number, elementwise; of two, the even one."""
    operand = as_expression(x)
    below = floor(operand)
    above_half = operand - below
    odd = binary(ca.OP_LT, 2 * floor(below / 2), below)
    up = binary(
        ca.OP_OR,
        binary(ca.OP_LT, 0.5, above_half),
        binary(ca.OP_AND, binary(ca.OP_EQ, above_half, 0.5), odd),
    )
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
