"""Taylor series whose coefficients are ranges: how a function goes on from wherever it is in an interval.

The coefficient k of a series over an interval of x holds f⁽ᵏ⁾(x)/k! for each x in there (R. E. Moore, Methods
and Applications of Interval Analysis, 3.4). A series is as long as that is known: one that only has its first
coefficient says between which numbers the function lies, one with two also how steep it is.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import casadi as ca

from . import ranges
from .ranges import ALL, Range

Series: TypeAlias = tuple[Range, ...]

ORDER = 5
"""The power up to which series go."""

ONE: Range = (1.0, 1.0)
_NONE: Series = (ALL,)


def constant(number: float) -> Series:
    """Return a number."""
    return ((number, number), *(ranges.ZERO,) * ORDER)


def variable(where: Range) -> Series:
    """Return x itself, anywhere in an interval."""
    return (where, ONE, *(ranges.ZERO,) * (ORDER - 1))


def add(a: Series, b: Series) -> Series:
    """Return the series of f + g."""
    return tuple(ranges.add(x, y) for x, y in zip(a, b, strict=False))


def negative(a: Series) -> Series:
    """Return the series of -f."""
    return tuple(map(ranges.negative, a))


def subtract(a: Series, b: Series) -> Series:
    """Return the series of f - g."""
    return add(a, negative(b))


def multiply(a: Series, b: Series) -> Series:
    """Return the series of f·g."""
    count = min(len(a), len(b))
    result = [_dot(a, b, 0, k) for k in range(count)]
    if a is b:
        result[0] = ranges.square(a[0])
    return tuple(result)


def divide(a: Series, b: Series) -> Series:
    """Return the series of f/g."""
    if b[0][0] <= 0 <= b[0][1]:
        return _NONE
    inverse = ranges.reciprocal(b[0])
    result: list[Range] = []
    for k in range(min(len(a), len(b))):
        rest = ranges.add(a[k], ranges.negative(_dot(b, result, 1, k)))
        result.append(ranges.multiply(rest, inverse))
    return tuple(result)


def power(a: Series, exponent: Range) -> Series:
    """Return the series of f to a constant power."""
    n = exponent[0]
    if exponent[0] != exponent[1]:
        return (ranges.power(a[0], exponent),)
    if n == int(n) and abs(n) <= 16:
        result = constant(1.0)
        for _ in range(int(abs(n))):
            result = multiply(result, a)
        result = (ranges.power(a[0], (abs(n), abs(n))), *result[1:])
        return divide(constant(1.0), result) if n < 0 else result
    if a[0][0] <= 0:
        return (ranges.power(a[0], exponent),) if a[0][0] == 0 else _NONE
    return unary(ca.OP_EXP, multiply(constant(n), unary(ca.OP_LOG, a)))


def unary(op: int, a: Series) -> Series:
    """Return the series of one of CasADi's functions of one argument, of f."""
    value = ranges.unary(op, a[0])
    if op in (ca.OP_SIN, ca.OP_COS):
        sine, cosine = _waves(a)
        return sine if op == ca.OP_SIN else cosine
    if op == ca.OP_TAN:
        sine, cosine = _waves(a)
        return _with_value(divide(sine, cosine), value)
    if op == ca.OP_SQRT:
        return _root(a, value)
    if op == ca.OP_EXP:
        result = [value]
        for k in range(1, len(a)):
            result.append(_over(_weighted(a, result, k), k))
        return tuple(result)
    if op == ca.OP_LOG:
        return _integrated(value, a, a) if a[0][0] > 0 else (value,)
    if op == ca.OP_ATAN:
        return _integrated(value, a, add(constant(1.0), multiply(a, a)))
    if op in (ca.OP_ASIN, ca.OP_ACOS):
        if not (a[0][0] > -1 and a[0][1] < 1):
            return (value,) if a[0][1] >= -1 and a[0][0] <= 1 else _NONE
        cosine = unary(ca.OP_SQRT, subtract(constant(1.0), multiply(a, a)))
        return _integrated(value, a if op == ca.OP_ASIN else negative(a), cosine)
    if op == ca.OP_FABS and (a[0][0] >= 0 or a[0][1] <= 0):
        return a if a[0][0] >= 0 else negative(a)
    if op == ca.OP_FABS:
        return hull(a, negative(a))
    return (value,)


def arctan2(y: Series, x: Series) -> Series:
    """Return the series of the angle of (x, y), in (-π, π]; nothing is known where it jumps."""
    half = ranges.outwards(math.pi / 2, math.pi / 2)
    if x[0][0] > 0:
        value = ranges.unary(ca.OP_ATAN, ranges.multiply(y[0], ranges.reciprocal(x[0])))
    elif y[0][0] > 0 or y[0][1] < 0:
        turned = ranges.unary(ca.OP_ATAN, ranges.multiply(x[0], ranges.reciprocal(y[0])))
        value = ranges.add(half if y[0][0] > 0 else ranges.negative(half), ranges.negative(turned))
    else:
        return (ranges.outwards(-math.pi, math.pi),)
    squared = add(multiply(x, x), multiply(y, y))
    # θ' = (x y' - y x') / (x² + y²)
    count = min(len(x), len(y))
    result = [value]
    for k in range(1, count):
        rest = ranges.add(_weighted(y, x, k), ranges.negative(_weighted(x, y, k)))
        rest = ranges.add(rest, ranges.negative(_weighted(tuple(result), squared, k, last=False)))
        result.append(_over(ranges.multiply(rest, ranges.reciprocal(squared[0])), k))
    return tuple(result)


def hull(a: Series, b: Series) -> Series:
    """Return what holds for both of two functions that meet: their values, and how steep they are."""
    return tuple(ranges.hull(x, y) for x, y in list(zip(a, b, strict=False))[:2])


def polynomial(coefficients: tuple[float, ...], x: Series) -> Series:
    """Return the series of a polynomial of f, constant coefficient first."""
    result = constant(coefficients[-1])
    for c in reversed(coefficients[:-1]):
        result = add(multiply(result, x), constant(c))
    return result


def _with_value(a: Series, value: Range) -> Series:
    return (value, *a[1:])


def _dot(a: Series | list[Range], b: Series | list[Range], start: int, k: int) -> Range:
    """Return Σ a_i b_k-i for i from ``start`` to k."""
    total = ranges.ZERO
    for i in range(start, k + 1):
        if a[i] != ranges.ZERO and b[k - i] != ranges.ZERO:
            product = ranges.multiply(a[i], b[k - i])
            total = product if total == ranges.ZERO else ranges.add(total, product)
    return total


def _weighted(a: Series, b: Series | list[Range], k: int, last: bool = True) -> Range:
    """Return Σ i a_i b_k-i for i from 1 to k, or to k - 1."""
    total = ranges.ZERO
    for i in range(1, k + last):
        total = ranges.add(total, ranges.multiply((float(i), float(i)), ranges.multiply(a[i], b[k - i])))
    return total


def _over(a: Range, k: int) -> Range:
    return ranges.multiply(a, ranges.reciprocal((float(k), float(k))))


def _waves(a: Series) -> tuple[Series, Series]:
    sine, cosine = [ranges.unary(ca.OP_SIN, a[0])], [ranges.unary(ca.OP_COS, a[0])]
    for k in range(1, len(a)):
        s, c = _over(_weighted(a, cosine, k), k), _over(_weighted(a, sine, k), k)
        sine.append(s)
        cosine.append(ranges.negative(c))
    return tuple(sine), tuple(cosine)


def _root(a: Series, value: Range) -> Series:
    if a[0][0] <= 0:
        return (value,) if a[0][1] >= 0 else _NONE
    twice = ranges.reciprocal(ranges.multiply((2.0, 2.0), value))
    result = [value]
    for k in range(1, len(a)):
        rest = ranges.add(a[k], ranges.negative(_inner(result, k)))
        result.append(ranges.multiply(rest, twice))
    return tuple(result)


def _inner(result: list[Range], k: int) -> Range:
    """Return Σ c_i c_k-i for i from 1 to k - 1."""
    total = ranges.ZERO
    for i in range(1, k):
        total = ranges.add(total, ranges.multiply(result[i], result[k - i]))
    return total


def _integrated(value: Range, a: Series, divisor: Series) -> Series:
    """Return the series of y with y' = f'/g, whose value is known."""
    result = [value]
    inverse = ranges.reciprocal(divisor[0])
    for k in range(1, min(len(a), len(divisor))):
        rest = ranges.multiply((float(k), float(k)), a[k])
        rest = ranges.add(rest, ranges.negative(_weighted(tuple(result), divisor, k, last=False)))
        result.append(_over(ranges.multiply(rest, inverse), k))
    return tuple(result)
