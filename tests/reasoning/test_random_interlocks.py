"""Random interlocks agree with evaluation; operations on boxes obey the laws of sets."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from constraint_models import model
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse import reasoning
from kineverse.reasoning import Interval, IntervalBox, interlocks
from kineverse.reasoning.boxes import intersect_boxes, merge_boxes, subtract_boxes
from kineverse.reasoning.polynomial import roots

SYMBOLS = [kv.position(name) for name in "abcd"]
NUMBERS = st.integers(-8, 8).map(lambda k: k / 8)

POLYNOMIALS = [lambda x: x, lambda x: 2 * x + 0.25, lambda x: x * x, lambda x: -x, abs]


def comparisons(functions) -> st.SearchStrategy[kv.Expression]:
    """Return comparisons of a function of one coordinate with a number."""
    return st.builds(
        lambda x, f, t, turned: kv.logic.less(t, f(x)) if turned else kv.logic.less(f(x), t),
        st.sampled_from(SYMBOLS),
        st.sampled_from(functions),
        NUMBERS,
        st.booleans(),
    )


atoms = comparisons([*POLYNOMIALS, np.sin])
sums = st.builds(lambda x, y, t: kv.logic.less(x + 2 * y, t), *[st.sampled_from(SYMBOLS)] * 2, NUMBERS)


def logic(leaves: st.SearchStrategy[kv.Expression]) -> st.SearchStrategy[kv.Expression]:
    """Return truth values composed of others."""
    return st.recursive(
        leaves,
        lambda inner: st.one_of(
            inner.map(lambda x: ~x),
            inner.map(lambda x: 1 - x),
            st.tuples(inner, inner).map(lambda p: p[0] & p[1]),
            st.tuples(inner, inner).map(lambda p: p[0] | p[1]),
            st.tuples(inner, inner).map(lambda p: p[0] * p[1]),
            st.tuples(inner, inner).map(lambda p: kv.maximum(*p)),
            st.tuples(inner, inner, inner).map(lambda p: kv.where(*p)),
        ),
        max_leaves=4,
    )


truths = logic(atoms | sums)
LIMITS = {str(x): (-1, x, 1) for x in SYMBOLS}


@settings(max_examples=attempts(8), derandomize=True)  # some examples are slow
@given(truths, truths)
def test_random_speed_locks_pass_the_checker(one: kv.Expression, other: kv.Expression) -> None:
    subject = model(**LIMITS, lock=(-0.5 * one, kv.velocity("x"), other))
    result = interlocks(subject)
    assert result.undecided == ()
    assert reasoning.contradictions(subject, result) == []


@settings(max_examples=attempts(7))
@given(truths, NUMBERS, NUMBERS)
def test_random_position_ranges_pass_the_checker(truth: kv.Expression, low: float, high: float) -> None:
    x = kv.position("x")
    bounds = kv.where(truth, low, -1), kv.where(truth, SYMBOLS[0] + high, 1)
    subject = model(**LIMITS, x=(-2, x, 2), lock=(bounds[0], x, bounds[1]))
    result = interlocks(subject)
    assert result.undecided == ()
    assert reasoning.contradictions(subject, result) == []


@settings(max_examples=attempts(8))
@given(logic(comparisons(POLYNOMIALS)), logic(comparisons(POLYNOMIALS)))
def test_de_morgan_gives_equal_interlocks(one: kv.Expression, other: kv.Expression) -> None:
    left, right = (
        interlocks(model(**LIMITS, lock=(-1, kv.velocity("x"), e))) for e in (~(one & other), ~one | ~other)
    )
    assert left == right


intervals = st.builds(
    lambda a, b, c, d: Interval(min(a, b), max(a, b) + (a == b), c, d),
    st.integers(0, 4),
    st.integers(0, 4),
    st.booleans(),
    st.booleans(),
)
boxes = st.dictionaries(st.sampled_from(SYMBOLS[:3]), intervals, max_size=3).map(IntervalBox)
points = st.lists(st.integers(-1, 12).map(lambda k: k / 2), min_size=3, max_size=3)


def holds(box: IntervalBox, point: list[float]) -> bool:
    at = dict(zip(SYMBOLS, point, strict=False))
    return all(at[axis] in side for axis, side in box.items())


@settings(max_examples=attempts(60))
@given(st.lists(boxes, max_size=5), st.lists(boxes, max_size=3), points)
def test_box_operations_obey_set_laws(
    some: list[IntervalBox], others: list[IntervalBox], point: list[float]
) -> None:
    here, there = (any(holds(box, point) for box in set_) for set_ in (some, others))
    assert any(holds(box, point) for box in merge_boxes(some)) == here
    assert any(holds(box, point) for box in subtract_boxes(some, others)) == (here and not there)
    assert any(holds(box, point) for box in intersect_boxes(some, others)) == (here and there)
    assert merge_boxes(subtract_boxes(some, [])) == merge_boxes(some)


@settings(max_examples=attempts(40))
@given(st.lists(st.integers(-12, 12).map(lambda k: Fraction(k, 4)), min_size=1, max_size=4), st.booleans())
def test_roots_finds_all_roots_of_polynomials(wanted: list[Fraction], closed: bool) -> None:
    coefficients = [Fraction(1)]
    for root in wanted:
        longer = [Fraction(0), *coefficients]
        coefficients = [a - root * b for a, b in zip(longer, [*coefficients, Fraction(0)], strict=True)]
    within = Interval(Fraction(-2), Fraction(2), closed, closed)
    expected = sorted({root for root in wanted if root in within})
    found = roots(coefficients, within)
    assert len(found) == len(expected)
    assert all(abs(a - b) < Fraction(1, 10**12) for a, b in zip(found, expected, strict=True))
