"""Interval arithmetic with outward rounding.

An interval is a pair of floats and contains its ends. Results are rounded outwards, so they enclose the exact
range.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from typing import TypeAlias

import casadi as ca

RealInterval: TypeAlias = tuple[float, float]
"""A closed interval of the extended real numbers, (lower, upper)."""

REALS: RealInterval = (-math.inf, math.inf)
ZERO_INTERVAL: RealInterval = (0.0, 0.0)


def round_outwards(low: float, high: float, steps: int = 1) -> RealInterval:
    """Return an interval widened by a number of floats at both ends, to include rounding errors."""
    for _ in range(steps):
        low, high = math.nextafter(low, -math.inf), math.nextafter(high, math.inf)
    return low, high


def enclose_number(number: float | Fraction) -> RealInterval:
    """Return an interval that contains an exact number."""
    near = float(number)
    return (near, near) if near == number else round_outwards(near, near)


def interval_hull(a: RealInterval, b: RealInterval) -> RealInterval:
    """Return the smallest interval that contains both."""
    return min(a[0], b[0]), max(a[1], b[1])


def interval_add(a: RealInterval, b: RealInterval) -> RealInterval:
    """Return the range of x + y."""
    (p, q), (r, s) = a, b
    low, high = p + r, q + s
    low = math.nextafter(low, -math.inf) if low == low else -math.inf
    high = math.nextafter(high, math.inf) if high == high else math.inf
    if p >= 0 and r >= 0:
        low = max(0.0, low)
    return low, min(0.0, high) if q <= 0 and s <= 0 else high


def interval_negate(a: RealInterval) -> RealInterval:
    """Return the range of -x."""
    return -a[1], -a[0]


def interval_multiply(a: RealInterval, b: RealInterval) -> RealInterval:
    """Return the range of x·y, with 0 times infinity equal to 0."""
    (p, q), (r, s) = a, b
    if p == q == 0 or r == s == 0:
        return ZERO_INTERVAL
    ends = [p * r, p * s, q * r, q * s]
    if math.isnan(sum(ends)):
        ends = [0.0 if 0 in (x, y) else x * y for x in a for y in b]
    low, high = math.nextafter(min(ends), -math.inf), math.nextafter(max(ends), math.inf)
    if (p >= 0 and r >= 0) or (q <= 0 and s <= 0):
        return max(0.0, low), high
    if (p >= 0 and s <= 0) or (q <= 0 and r >= 0):
        return low, min(0.0, high)
    return low, high


def interval_square(a: RealInterval) -> RealInterval:
    """Return the range of x²."""
    low = 0.0 if a[0] <= 0 <= a[1] else min(abs(a[0]), abs(a[1]))
    high = max(abs(a[0]), abs(a[1]))
    return max(0.0, math.nextafter(low * low, -math.inf)), math.nextafter(high * high, math.inf)


def interval_reciprocal(a: RealInterval) -> RealInterval:
    """Return the range of 1/x for x of one sign, 0 included as an end."""
    if a[0] >= 0:
        low, high = round_outwards(1 / a[1] if a[1] else math.inf, 1 / a[0] if a[0] else math.inf)
        return max(0.0, low), high
    if a[1] <= 0:
        return interval_negate(interval_reciprocal(interval_negate(a)))
    return REALS


def interval_power(a: RealInterval, exponent: RealInterval) -> RealInterval:
    """Return the range of x**y for x >= 0, or for a single integer y."""
    if exponent[0] == exponent[1] and exponent[0] == int(exponent[0]) and abs(exponent[0]) < 64:
        n = int(exponent[0])
        if n < 0:
            return interval_reciprocal(interval_power(a, (-n, -n)))
        if n % 2 and a[0] < 0:
            return round_outwards(-_pow(-a[0], n), math.copysign(_pow(abs(a[1]), n), a[1]), 2)
        low, high = (a if a[0] >= 0 else interval_square(a)) if n % 2 else interval_square(a)
        n = n if n % 2 else n // 2
        return round_outwards(_pow(low, n), _pow(high, n), 2)
    if a[0] < 0:
        return REALS
    ends = [_pow(x, y) for x in a for y in exponent]
    return max(0.0, round_outwards(min(ends), 0.0, 4)[0]), round_outwards(0.0, max(ends), 4)[1]


def interval_unary(op: int, a: RealInterval) -> RealInterval:
    """Return the range of a unary CasADi operation."""
    if op in _INCREASING:
        low, high = _ends(_INCREASING[op], a)
        return (max(0.0, low), high) if op in (ca.OP_SQRT, ca.OP_EXP) else (low, high)
    if op == ca.OP_ACOS:
        return interval_negate(_ends(lambda x: -math.acos(max(-1.0, min(1.0, x))), a))
    if op in (ca.OP_SIN, ca.OP_COS):
        return _cosine(a, 0.0 if op == ca.OP_COS else math.pi / 2)
    if op == ca.OP_TAN:
        k = math.floor(a[0] / math.pi + 0.5) if math.isfinite(a[0]) and math.isfinite(a[1]) else None
        inside = k is not None and a[1] < (k + 0.5) * math.pi - 1e-12 and a[0] > (k - 0.5) * math.pi + 1e-12
        return _ends(math.tan, a) if inside else REALS
    if op == ca.OP_COSH:
        square = interval_square(interval_unary(ca.OP_SINH, a))
        return interval_unary(ca.OP_SQRT, interval_add((1.0, 1.0), square))
    if op == ca.OP_FABS:
        return max(0.0, a[0], -a[1]), max(-a[0], a[1])
    return REALS


def interval_slope(op: int, a: RealInterval) -> RealInterval | None:
    """Return the range of the derivative of a unary CasADi operation, None if it may not exist."""
    if op == ca.OP_SIN:
        return interval_unary(ca.OP_COS, a)
    if op == ca.OP_COS:
        return interval_negate(interval_unary(ca.OP_SIN, a))
    if op == ca.OP_TAN:
        tan = interval_unary(op, a)
        return None if tan == REALS else interval_add((1.0, 1.0), interval_square(tan))
    if op == ca.OP_TANH:
        return max(0.0, 1 - max(abs(a[0]), abs(a[1]))), 1.0
    if op == ca.OP_ATAN:
        return interval_reciprocal(interval_add((1.0, 1.0), interval_square(a)))
    if op in (ca.OP_EXP, ca.OP_EXPM1):
        return interval_unary(ca.OP_EXP, a)
    if op == ca.OP_SQRT:
        return interval_reciprocal(interval_multiply((2.0, 2.0), interval_unary(op, a)))
    if op == ca.OP_LOG:
        return interval_reciprocal((max(0.0, a[0]), max(0.0, a[1])))
    if op == ca.OP_COSH:
        return interval_unary(ca.OP_SINH, a)
    if op in _INCREASING and op not in (ca.OP_FLOOR, ca.OP_CEIL):
        return 0.0, math.inf
    return (-math.inf, 0.0) if op == ca.OP_ACOS else None


def interval_polynomial(coefficients: tuple[float, ...], a: RealInterval) -> RealInterval:
    """Return an enclosure of the range of a polynomial, constant coefficient first, by Horner's scheme."""
    result = ZERO_INTERVAL
    for coefficient in reversed(coefficients):
        point = coefficient, coefficient
        result = point if result == ZERO_INTERVAL else interval_add(interval_multiply(result, a), point)
    return result


def _pow(x: float, y: float) -> float:
    try:
        return math.pow(x, y)
    except (OverflowError, ValueError):  # 0 to a negative power is a ValueError
        return math.inf


def _ends(function: Callable[[float], float], a: RealInterval) -> RealInterval:
    """Return the range of an increasing function that is accurate to a few last digits."""
    return round_outwards(_at(function, a[0], -math.inf), _at(function, a[1], math.inf), 4)


def _at(function: Callable[[float], float], x: float, otherwise: float) -> float:
    try:
        value = function(x)
    except (OverflowError, ValueError):
        return otherwise
    return otherwise if math.isnan(value) else value


def _cosine(a: RealInterval, peak: float) -> RealInterval:
    low, high = a[0] - peak, a[1] - peak
    if not high - low < 2 * math.pi or max(abs(low), abs(high)) > 1e6:
        return -1.0, 1.0
    around = 1e-9  # above the rounding error of multiples of π
    top = math.floor((high + around) / (2 * math.pi)) * 2 * math.pi >= low - around
    bottom = (math.floor((high + around) / (2 * math.pi) - 0.5) + 0.5) * 2 * math.pi >= low - around
    ends = math.cos(low), math.cos(high)
    error = 4e-16 * max(1.0, abs(low), abs(high))
    return -1.0 if bottom else max(-1.0, min(ends) - error), 1.0 if top else min(1.0, max(ends) + error)


_INCREASING: dict[int, Callable[[float], float]] = {
    ca.OP_SQRT: lambda x: math.sqrt(max(0.0, x)),
    ca.OP_EXP: math.exp,
    ca.OP_LOG: lambda x: math.log(x) if x > 0 else -math.inf,
    ca.OP_ASIN: lambda x: math.asin(max(-1.0, min(1.0, x))),
    ca.OP_ATAN: math.atan,
    ca.OP_SINH: math.sinh,
    ca.OP_TANH: math.tanh,
    ca.OP_ASINH: math.asinh,
    ca.OP_ACOSH: lambda x: math.acosh(max(1.0, x)),
    ca.OP_ATANH: math.atanh,
    ca.OP_EXPM1: math.expm1,
    ca.OP_LOG1P: lambda x: math.log1p(x) if x > -1 else -math.inf,
    ca.OP_ERF: math.erf,
    ca.OP_FLOOR: math.floor,
    ca.OP_CEIL: math.ceil,
}
