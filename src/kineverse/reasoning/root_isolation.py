"""Root isolation of a function of one symbol, by interval arithmetic and monotonicity."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import casadi as ca

from kineverse.intervals.arithmetic import (
    ZERO_INTERVAL,
    RealInterval,
    interval_add,
    interval_hull,
    interval_multiply,
    interval_negate,
    interval_power,
    interval_reciprocal,
    interval_slope,
    interval_square,
)
from kineverse.intervals.graph import Term
from kineverse.symbols import Symbol

from .abstract_values import AbstractValue, Signs, enclose_loop, live_arguments

RangeFunction = Callable[[float, float], tuple[RealInterval, RealInterval | None]]
"""Ranges of a function and of its slope on an interval; the slope is None at possible jumps."""

MAX_EVALUATIONS = 3000
_WIDTH = 1e-13
_CLOSE = 1e-9


def slope_ranges(
    order: Sequence[Term], values: dict[int, AbstractValue], sign: Signs, symbol: Symbol
) -> dict[int, RealInterval | None]:
    """Return the ranges of the derivatives of terms, None where there may be jumps."""
    result: dict[int, RealInterval | None] = {}
    for term in order:
        if symbol not in values[term.index].live:
            result[term.index] = ZERO_INTERVAL
        elif term.op == ca.OP_PARAMETER:
            result[term.index] = (1.0, 1.0)
        else:
            result[term.index] = _slope(term, values, sign, result)
    return result


def _slope(
    term: Term, values: dict[int, AbstractValue], sign: Signs, found: dict[int, RealInterval | None]
) -> RealInterval | None:
    chosen = live_arguments(term, values, sign)
    inner = []
    for argument in chosen:
        rate = found[argument.index]
        if rate is None:
            return None
        inner.append(rate)
    spans = [values[a.index].range for a in term.args]
    op = term.op
    if op in ("select", ca.OP_IF_ELSE_ZERO, ca.OP_FMIN, ca.OP_FMAX):
        if len(inner) == 1 and sign(term.deciders[0]) is not None:
            return inner[0]
        return interval_hull(*inner) if op in (ca.OP_FMIN, ca.OP_FMAX) else None
    if op in (ca.OP_ADD, ca.OP_SUB):
        return interval_add(inner[0], inner[1] if op == ca.OP_ADD else interval_negate(inner[1]))
    if op == ca.OP_MUL:
        return interval_add(interval_multiply(inner[0], spans[1]), interval_multiply(spans[0], inner[1]))
    if op == ca.OP_DIV:
        inverse = interval_reciprocal(spans[1])
        over = interval_multiply(interval_multiply(spans[0], inner[1]), interval_square(inverse))
        return interval_add(interval_multiply(inner[0], inverse), interval_negate(over))
    if op == ca.OP_POW and inner[1] == ZERO_INTERVAL and spans[1][0] == spans[1][1]:
        n = spans[1][0]
        rate = interval_power(spans[0], (n - 1, n - 1))
        return interval_multiply(interval_multiply((n, n), rate), inner[0])
    if op == ca.OP_NEG:
        return interval_negate(inner[0])
    if op == ca.OP_FABS:
        return interval_hull(inner[0], interval_negate(inner[0]))
    if op == "implicit":
        series = enclose_loop(term, list(zip(spans, inner, strict=True)))
        return series[1] if len(series) > 1 else None
    if len(term.args) == 1 and isinstance(op, int):
        outer = interval_slope(op, spans[0])
        return None if outer is None else interval_multiply(outer, inner[0])
    return None


def isolate_roots(
    ranges: RangeFunction, low: float, high: float, most: int = MAX_EVALUATIONS
) -> list[float] | None:
    """Return the isolated roots in an interval, to 1e-9; None if ``most`` evaluations do not isolate them.

    Between the roots, and between them and the ends, the sign is constant.
    """
    if math.isinf(low) or math.isinf(high):
        span, rate = ranges(low, high)
        if not (_has_sign(span) or _is_monotone(rate)):
            return None
    stack, result, evaluations = [(low, high)], list[float](), 0
    while stack:
        a, b = stack.pop()
        evaluations += 1
        span, rate = ranges(a, b)
        if _has_sign(span):
            continue
        if _is_monotone(rate):
            zero = _crossing(ranges, a, b)
            if zero is None:
                return None
            result += zero
            continue
        if evaluations > most or b - a < _CLOSE * max(1.0, abs(a), abs(b)):
            return None
        middle = _middle(a, b)
        stack += [(a, middle), (middle, b)]
    result.sort()
    return [z for k, z in enumerate(result) if not k or z - result[k - 1] > _CLOSE * max(1.0, abs(z))]


def _crossing(ranges: RangeFunction, low: float, high: float) -> list[float] | None:
    """Return the root of a monotone function, if there is one; None if it may be zero on an interval."""
    first, last = _sign_at(ranges, low), _sign_at(ranges, high)
    if first and first == last:
        return []
    if (math.isinf(low) and not first) or (math.isinf(high) and not last):
        return None
    a, b = low, high
    if not first and not last:
        return None
    while math.isinf(b - a) or b - a > _WIDTH * max(1.0, abs(a), abs(b)):
        middle = _middle(a, b)
        if not a < middle < b:
            break
        here = _sign_at(ranges, middle)
        if not here:
            # Rounding hides the sign; the signs a little further on each side decide below.
            a = b = middle
        elif first:
            a, b = (middle, b) if here == first else (a, middle)
        else:
            a, b = (a, middle) if here == last else (middle, b)
    zero = a if not first and a == low else b if not last and b == high else _middle(a, b)
    near = _CLOSE * max(1.0, abs(zero))
    below, above = _sign_at(ranges, max(low, zero - near)), _sign_at(ranges, min(high, zero + near))
    wrong_below = zero > low and (not below or (first and below != first))
    wrong_above = zero < high and (not above or (last and above != last))
    return None if wrong_below or wrong_above else [zero]


def _sign_at(ranges: RangeFunction, x: float) -> int:
    span, _ = ranges(x, x)
    return 1 if span[0] > 0 else -1 if span[1] < 0 else 0


def _has_sign(span: RealInterval) -> bool:
    return span[0] > 0 or span[1] < 0


def _is_monotone(rate: RealInterval | None) -> bool:
    return rate is not None and (rate[0] >= 0 or rate[1] <= 0)


def _middle(a: float, b: float) -> float:
    if math.isinf(a) and math.isinf(b):
        return 0.0
    if math.isinf(a):
        return b * 2 - 1 if b <= 0 else -1.0
    if math.isinf(b):
        return a * 2 + 1 if a >= 0 else 1.0
    return a / 2 + b / 2
