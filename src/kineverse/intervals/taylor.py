"""Taylor series with interval coefficients.

Coefficient k of a series over an interval of x contains f⁽ᵏ⁾(x)/k! for each x of the interval (R. E. Moore,
Methods and Applications of Interval Analysis, 3.4). A series is as long as its coefficients are known: one of
a single coefficient encloses the values of the function, one of two the slopes as well.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import casadi as ca

from .arithmetic import (
    REALS,
    ZERO_INTERVAL,
    RealInterval,
    interval_add,
    interval_hull,
    interval_multiply,
    interval_negate,
    interval_power,
    interval_reciprocal,
    interval_square,
    interval_unary,
    round_outwards,
)

TaylorSeries: TypeAlias = tuple[RealInterval, ...]

TAYLOR_ORDER = 5  # the highest power of a series

ONE_INTERVAL: RealInterval = (1.0, 1.0)
_UNBOUNDED: TaylorSeries = (REALS,)


def taylor_constant(number: float) -> TaylorSeries:
    """Return the series of a constant."""
    return ((number, number), *(ZERO_INTERVAL,) * TAYLOR_ORDER)


def taylor_variable(where: RealInterval) -> TaylorSeries:
    """Return the series of x over an interval."""
    return (where, ONE_INTERVAL, *(ZERO_INTERVAL,) * (TAYLOR_ORDER - 1))


def taylor_add(a: TaylorSeries, b: TaylorSeries) -> TaylorSeries:
    """Return the series of f + g."""
    return tuple(interval_add(x, y) for x, y in zip(a, b, strict=False))


def taylor_negate(a: TaylorSeries) -> TaylorSeries:
    """Return the series of -f."""
    return tuple(map(interval_negate, a))


def taylor_subtract(a: TaylorSeries, b: TaylorSeries) -> TaylorSeries:
    """Return the series of f - g."""
    return taylor_add(a, taylor_negate(b))


def taylor_multiply(a: TaylorSeries, b: TaylorSeries) -> TaylorSeries:
    """Return the series of f·g."""
    count = min(len(a), len(b))
    result = [_dot(a, b, 0, k) for k in range(count)]
    if a is b:
        result[0] = interval_square(a[0])
    return tuple(result)


def taylor_divide(a: TaylorSeries, b: TaylorSeries) -> TaylorSeries:
    """Return the series of f/g."""
    if b[0][0] <= 0 <= b[0][1]:
        return _UNBOUNDED
    inverse = interval_reciprocal(b[0])
    result: list[RealInterval] = []
    for k in range(min(len(a), len(b))):
        rest = interval_add(a[k], interval_negate(_dot(b, result, 1, k)))
        result.append(interval_multiply(rest, inverse))
    return tuple(result)


def taylor_power(a: TaylorSeries, exponent: RealInterval) -> TaylorSeries:
    """Return the series of f to a constant power."""
    n = exponent[0]
    if exponent[0] != exponent[1]:
        return (interval_power(a[0], exponent),)
    if n == int(n) and abs(n) <= 16:
        result = taylor_constant(1.0)
        for _ in range(int(abs(n))):
            result = taylor_multiply(result, a)
        result = (interval_power(a[0], (abs(n), abs(n))), *result[1:])
        return taylor_divide(taylor_constant(1.0), result) if n < 0 else result
    if a[0][0] <= 0:
        return (interval_power(a[0], exponent),) if a[0][0] == 0 else _UNBOUNDED
    return taylor_unary(ca.OP_EXP, taylor_multiply(taylor_constant(n), taylor_unary(ca.OP_LOG, a)))


def taylor_unary(op: int, a: TaylorSeries) -> TaylorSeries:
    """Return the series of a unary CasADi operation on f."""
    if op in (ca.OP_SIN, ca.OP_COS):
        sine, cosine = _sine_and_cosine(a)
        return sine if op == ca.OP_SIN else cosine
    value = interval_unary(op, a[0])
    if op == ca.OP_TAN:
        sine, cosine = _sine_and_cosine(a)
        return _with_value(taylor_divide(sine, cosine), value)
    if op == ca.OP_SQRT:
        return _root(a, value)
    if op == ca.OP_EXP:
        result = [value]
        for k in range(1, len(a)):
            result.append(_over(_weighted(a, result, k), k))
        return tuple(result)
    if op == ca.OP_LOG:
        return _integrate(value, a, a) if a[0][0] > 0 else (value,)
    if op == ca.OP_ATAN:
        return _integrate(value, a, taylor_add(taylor_constant(1.0), taylor_multiply(a, a)))
    if op in (ca.OP_ASIN, ca.OP_ACOS):
        if not (a[0][0] > -1 and a[0][1] < 1):
            return (value,) if a[0][1] >= -1 and a[0][0] <= 1 else _UNBOUNDED
        cosine = taylor_unary(ca.OP_SQRT, taylor_subtract(taylor_constant(1.0), taylor_multiply(a, a)))
        return _integrate(value, a if op == ca.OP_ASIN else taylor_negate(a), cosine)
    if op == ca.OP_FABS and (a[0][0] >= 0 or a[0][1] <= 0):
        return a if a[0][0] >= 0 else taylor_negate(a)
    if op == ca.OP_FABS:
        return _with_value(taylor_hull(a, taylor_negate(a)), value)
    return (value,)


def taylor_arctan2(y: TaylorSeries, x: TaylorSeries) -> TaylorSeries:
    """Return the series of the angle of (x, y), in (-π, π]; the full range if it may jump."""
    half = round_outwards(math.pi / 2, math.pi / 2)
    if x[0][0] > 0:
        value = interval_unary(ca.OP_ATAN, interval_multiply(y[0], interval_reciprocal(x[0])))
    elif y[0][0] > 0 or y[0][1] < 0:
        turned = interval_unary(ca.OP_ATAN, interval_multiply(x[0], interval_reciprocal(y[0])))
        value = interval_add(half if y[0][0] > 0 else interval_negate(half), interval_negate(turned))
    else:
        return (round_outwards(-math.pi, math.pi),)
    squared = taylor_add(taylor_multiply(x, x), taylor_multiply(y, y))
    # θ' = (x y' - y x') / (x² + y²)
    count = min(len(x), len(y))
    result = [value]
    for k in range(1, count):
        rest = interval_add(_weighted(y, x, k), interval_negate(_weighted(x, y, k)))
        rest = interval_add(rest, interval_negate(_weighted(tuple(result), squared, k, last=False)))
        result.append(_over(interval_multiply(rest, interval_reciprocal(squared[0])), k))
    return tuple(result)


def taylor_hull(a: TaylorSeries, b: TaylorSeries) -> TaylorSeries:
    """Return the hulls of the values and slopes of two functions that meet."""
    return tuple(interval_hull(x, y) for x, y in list(zip(a, b, strict=False))[:2])


def taylor_minimum(a: TaylorSeries, b: TaylorSeries) -> TaylorSeries:
    """Return the series of the smaller one of f and g."""
    if a[0][1] <= b[0][0]:
        return a
    if b[0][1] <= a[0][0]:
        return b
    return _with_value(taylor_hull(a, b), (min(a[0][0], b[0][0]), min(a[0][1], b[0][1])))


def taylor_maximum(a: TaylorSeries, b: TaylorSeries) -> TaylorSeries:
    """Return the series of the larger one of f and g."""
    return taylor_negate(taylor_minimum(taylor_negate(a), taylor_negate(b)))


def taylor_polynomial(coefficients: tuple[float, ...], x: TaylorSeries) -> TaylorSeries:
    """Return the series of a polynomial of f, constant coefficient first."""
    result = taylor_constant(coefficients[-1])
    for c in reversed(coefficients[:-1]):
        result = taylor_add(taylor_multiply(result, x), taylor_constant(c))
    return result


def _with_value(a: TaylorSeries, value: RealInterval) -> TaylorSeries:
    return (value, *a[1:])


def _dot(
    a: TaylorSeries | list[RealInterval],
    b: TaylorSeries | list[RealInterval],
    start: int,
    k: int,
    last: bool = True,
) -> RealInterval:
    """Return Σ a_i b_k-i for i from ``start`` to k, or to k - 1."""
    total = ZERO_INTERVAL
    for i in range(start, k + last):
        if a[i] != ZERO_INTERVAL and b[k - i] != ZERO_INTERVAL:
            product = interval_multiply(a[i], b[k - i])
            total = product if total == ZERO_INTERVAL else interval_add(total, product)
    return total


def _weighted(
    a: TaylorSeries, b: TaylorSeries | list[RealInterval], k: int, last: bool = True
) -> RealInterval:
    """Return Σ i a_i b_k-i for i from 1 to k, or to k - 1."""
    total = ZERO_INTERVAL
    for i in range(1, k + last):
        product = interval_multiply(a[i], b[k - i])
        total = interval_add(total, interval_multiply((float(i), float(i)), product))
    return total


def _over(a: RealInterval, k: int) -> RealInterval:
    return interval_multiply(a, interval_reciprocal((float(k), float(k))))


def _sine_and_cosine(a: TaylorSeries) -> tuple[TaylorSeries, TaylorSeries]:
    sine, cosine = [interval_unary(ca.OP_SIN, a[0])], [interval_unary(ca.OP_COS, a[0])]
    for k in range(1, len(a)):
        s, c = _over(_weighted(a, cosine, k), k), _over(_weighted(a, sine, k), k)
        sine.append(s)
        cosine.append(interval_negate(c))
    return tuple(sine), tuple(cosine)


def _root(a: TaylorSeries, value: RealInterval) -> TaylorSeries:
    if a[0][0] <= 0:
        return (value,) if a[0][1] >= 0 else _UNBOUNDED
    twice = interval_reciprocal(interval_multiply((2.0, 2.0), value))
    result = [value]
    for k in range(1, len(a)):
        rest = interval_add(a[k], interval_negate(_dot(result, result, 1, k, last=False)))
        result.append(interval_multiply(rest, twice))
    return tuple(result)


def _integrate(value: RealInterval, a: TaylorSeries, divisor: TaylorSeries) -> TaylorSeries:
    """Return the series of y with y' = f'/g, for a known enclosure of its values."""
    result = [value]
    inverse = interval_reciprocal(divisor[0])
    for k in range(1, min(len(a), len(divisor))):
        rest = interval_multiply((float(k), float(k)), a[k])
        rest = interval_add(rest, interval_negate(_weighted(tuple(result), divisor, k, last=False)))
        result.append(_over(interval_multiply(rest, inverse), k))
    return tuple(result)
