"""Interval operations enclose the values of numbers from the intervals."""

import math
from fractions import Fraction

import casadi as ca
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from kineverse.intervals.arithmetic import (
    REALS,
    ZERO_INTERVAL,
    enclose_number,
    interval_add,
    interval_hull,
    interval_multiply,
    interval_negate,
    interval_polynomial,
    interval_power,
    interval_reciprocal,
    interval_slope,
    interval_square,
    interval_unary,
    round_outwards,
)

NUMBERS = st.floats(-1e6, 1e6)
SHARES = st.floats(0, 1)
FUNCTIONS = {
    ca.OP_SIN: math.sin,
    ca.OP_COS: math.cos,
    ca.OP_TAN: math.tan,
    ca.OP_EXP: math.exp,
    ca.OP_SQRT: math.sqrt,
    ca.OP_LOG: math.log,
    ca.OP_ASIN: math.asin,
    ca.OP_ACOS: math.acos,
    ca.OP_ATAN: math.atan,
    ca.OP_SINH: math.sinh,
    ca.OP_COSH: math.cosh,
    ca.OP_TANH: math.tanh,
    ca.OP_FABS: abs,
    ca.OP_FLOOR: math.floor,
}
BOUNDS = {ca.OP_SQRT: (0, 50), ca.OP_LOG: (1e-9, 50), ca.OP_ASIN: (-1, 1), ca.OP_ACOS: (-1, 1)}


@st.composite
def intervals(draw, low=-1e6, high=1e6):
    return tuple(sorted((draw(st.floats(low, high)), draw(st.floats(low, high)))))


def member(interval, share):
    low, high = interval
    return min(max(low + share * (high - low), low), high)


def contains(interval, number):
    return interval[0] <= number <= interval[1]


@given(intervals(), intervals(), SHARES, SHARES)
def test_sums_and_products_enclose_the_exact_ones(a, b, s, t):
    x, y = Fraction(member(a, s)), Fraction(member(b, t))
    assert contains(interval_add(a, b), x + y)
    assert contains(interval_multiply(a, b), x * y)
    assert contains(interval_negate(a), -x)
    assert contains(interval_square(a), x * x)
    assert contains(interval_hull(a, b), x)
    assert contains(interval_hull(a, b), y)


@given(intervals(), SHARES)
def test_reciprocals_enclose_the_exact_ones(a, s):
    x = member(a, s)
    assume(x)
    assert contains(interval_reciprocal(a), 1 / Fraction(x))


def test_reciprocals_across_zero_are_unbounded():
    assert interval_reciprocal((-1.0, 1.0)) == REALS
    assert interval_reciprocal((0.0, 2.0))[1] == math.inf


@given(intervals(-30, 30), SHARES, st.integers(0, 7))
def test_integer_powers_enclose_the_exact_ones(a, s, n):
    assert contains(interval_power(a, (float(n), float(n))), Fraction(member(a, s)) ** n)


@given(intervals(0, 30), intervals(-3, 3), SHARES, SHARES)
def test_real_powers_enclose_those_of_numbers(a, b, s, t):
    x, y = member(a, s), member(b, t)
    assume(x > 1e-50)
    assert contains(interval_power(a, b), math.pow(x, y))


@pytest.mark.parametrize("op", FUNCTIONS, ids=lambda op: FUNCTIONS[op].__name__)
@given(data=st.data())
def test_functions_enclose_those_of_numbers(op, data):
    a = data.draw(intervals(*BOUNDS.get(op, (-20, 20))))
    x = member(a, data.draw(SHARES))
    assert contains(interval_unary(op, a), FUNCTIONS[op](x))


@pytest.mark.parametrize("op", set(FUNCTIONS) - {ca.OP_FLOOR}, ids=lambda op: FUNCTIONS[op].__name__)
@given(data=st.data())
@pytest.mark.sampled(2)
def test_slopes_enclose_difference_quotients(op, data):
    low, high = BOUNDS.get(op, (-20, 20))
    a = data.draw(intervals(low, high))
    x, y = member(a, data.draw(SHARES)), member(a, data.draw(SHARES))
    assume(abs(x - y) > 1e-3)
    slope = interval_slope(op, a)
    if slope is not None:
        quotient = (FUNCTIONS[op](x) - FUNCTIONS[op](y)) / (x - y)
        error = 1e-9 * max(1.0, abs(quotient))
        assert slope[0] - error <= quotient <= slope[1] + error


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=5), intervals(-10, 10), SHARES)
def test_polynomials_enclose_the_exact_values(coefficients, a, s):
    x = Fraction(member(a, s))
    exact = sum(Fraction(c) * x**k for k, c in enumerate(coefficients))
    assert contains(interval_polynomial(tuple(coefficients), a), exact)


@given(NUMBERS)
def test_floats_are_enclosed_by_themselves_and_fractions_by_neighbours(x):
    assert enclose_number(x) == (x, x)
    low, high = enclose_number(Fraction(1, 3))
    assert low < Fraction(1, 3) < high
    assert contains(round_outwards(x, x), x)


def test_zero_times_unbounded_is_zero():
    assert interval_multiply(ZERO_INTERVAL, REALS) == ZERO_INTERVAL
