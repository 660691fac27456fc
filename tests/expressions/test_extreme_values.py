"""Numbers at the ends of what doubles can say: value and gradient are right there too, in every tier."""

import math
import operator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts

a, b, c = (kv.position(f"extremes/{name}") for name in "abc")
TINY, HUGE, LEAST, MOST = 1e-200, 1e200, 5e-324, 1.7976931348623157e308
INF = math.inf

# -- division ----------------------------------------------------------------------------------------------

SPECIAL = [
    0.0,
    -0.0,
    1.0,
    -1.0,
    0.1,
    -0.1,
    0.3,
    2.5,
    -7.0,
    1e-300,
    LEAST,
    -LEAST,
    1e17,
    3e200,
    -MOST,
    INF,
    -INF,
]
OPERATIONS = [operator.floordiv, operator.mod, np.fmod]


@pytest.fixture(scope="module")
def divided():
    """All quotients and remainders, as a function of both operands."""
    expressions = (
        [op(a, b) for op in OPERATIONS]
        + [op(a, 0.1) for op in OPERATIONS]
        + [op(2.5, b) for op in OPERATIONS]
    )
    expressions += [op(a, -2.0) for op in OPERATIONS] + [op(a, 0.0) for op in OPERATIONS]
    return kv.compile(expressions, [a, b], tier="c", wait=True), kv.compile(
        expressions, [a, b], tier="interpreter"
    )


def by_numpy(x, y):
    with np.errstate(all="ignore"):
        rows = [
            (x, y),
            (x, np.full_like(x, 0.1)),
            (np.full_like(x, 2.5), y),
            (x, np.full_like(x, -2.0)),
            (x, np.zeros_like(x)),
        ]
        return [op(p, q) for p, q in rows for op in (np.floor_divide, np.remainder, np.fmod)]


def bits(numbers):
    """The bits of numbers; NaN is NaN, whatever its sign."""
    numbers = np.array(numbers, dtype=float)
    numbers[np.isnan(numbers)] = np.nan
    return numbers.view(np.int64)


def check_division(functions, points):
    wanted = by_numpy(*points.T)
    native, interpreted = functions
    for found in (native.batch(points), interpreted.batch(points)):
        for one, expected in zip(found, wanted, strict=True):
            np.testing.assert_array_equal(bits(one), bits(expected))
    for k, point in enumerate(points[:8]):
        for function in functions:
            np.testing.assert_array_equal(bits(function(point)), bits([row[k] for row in wanted]))


@pytest.mark.compiler
def test_division_equals_numpy_to_the_last_bit(divided):
    check_division(divided, np.array([(x, y) for x in SPECIAL for y in SPECIAL]))
    rng = np.random.default_rng(0)
    whole = rng.integers(-60, 60, (3000, 2)) / np.array([10.0, 20.0])
    check_division(
        divided,
        np.concatenate(
            [whole, whole[:, ::-1], rng.normal(size=(3000, 2)) * 10.0 ** rng.integers(-320, 300, (3000, 2))]
        ),
    )


@pytest.mark.compiler
@settings(max_examples=attempts(40), deadline=None)
@given(st.lists(st.tuples(*[st.floats(allow_nan=True)] * 2), min_size=1, max_size=5))
def test_division_of_random_numbers_equals_numpy(divided, points):
    check_division(divided, np.array(points))


def test_one_floor_divided_by_a_tenth_is_nine():
    assert (1.0 // b)({b: 0.1}) == 1.0 // 0.1 == 9
    assert (a % 0.1)({a: 1.0}) == 1.0 % 0.1
    assert [float(e({a: -7.0})) for e in divmod(a, 2)] == [-4, 1]
    assert [float(e({a: 2.0})) for e in divmod(-7, a)] == [-4, 1]
    assert (a // b).gradient() == {}


@pytest.mark.parametrize(
    ("x", "y"), [(7.0, 2.0), (-7.0, 2.0), (7.0, -2.0), (-7.0, -2.0), (0.5, 2.0), (6.0, 2.0), (1.0, 0.1)]
)
def test_remainder_has_a_gradient_by_both_operands(x, y):
    at = {a: x, b: y}
    assert (a % b).jacobian([a, b])(at).tolist() == pytest.approx([1, -(x // y)])
    assert np.fmod(a, b).jacobian([a, b])(at).tolist() == pytest.approx(
        [1, -math.trunc(x / y)] if y != 0.1 else [1, -9]
    )


# -- rounding ----------------------------------------------------------------------------------------------


@pytest.mark.compiler
def test_rounding_equals_numpy():
    rng = np.random.default_rng(1)
    x = np.array(
        [
            *SPECIAL,
            0.5,
            -0.5,
            1.5,
            2.5,
            -2.5,
            0.49999999999999994,
            -0.49999999999999994,
            4503599627370495.5,
            *rng.normal(size=50) * 9,
        ]
    )
    expressions = [np.rint(a), np.trunc(a), np.round(a, 1)]
    for tier in ("c", "interpreter"):
        found = kv.compile(expressions, [a], tier=tier, wait=True).batch(x[:, None])
        with np.errstate(all="ignore"):
            for one, wanted in zip(found, (np.rint(x), np.trunc(x), np.round(x, 1)), strict=True):
                np.testing.assert_array_equal(bits(one), bits(wanted))


# -- norms -------------------------------------------------------------------------------------------------

SIZES = st.sampled_from(
    [0.0, LEAST, 1e-310, TINY, 1e-160, 1e-140, 1e-3, 1.0, 1e140, 1e150, 1e160, HUGE, 1e307]
)


@settings(max_examples=attempts(60), deadline=None)
@given(st.lists(st.tuples(st.floats(-1, 1), SIZES).map(math.prod), min_size=3, max_size=3))
def test_norms_neither_overflow_nor_underflow(numbers):
    at = dict(zip((a, b, c), numbers, strict=True))
    length = math.hypot(*numbers)
    assert kv.norm([a, b, c])(at) == pytest.approx(length, rel=4e-16 if length > 1e-300 else 1e-9, abs=LEAST)
    assert np.hypot(a, b)(at) == pytest.approx(math.hypot(*numbers[:2]), rel=4e-16, abs=1e-315)
    slope = kv.norm([a, b, c]).jacobian([a, b, c])(at)
    if length < 1e-300:
        assert np.isfinite(slope).all()
    else:
        np.testing.assert_allclose(slope, [x / length for x in numbers], rtol=1e-15, atol=1e-300)


@pytest.mark.compiler
@pytest.mark.parametrize("scale", [TINY, 1e-3, 1.0, HUGE])
def test_norms_are_the_same_in_every_tier(scale):
    e = kv.array([kv.norm([a, b, c]), np.hypot(a, b), *kv.norm([a, b, c]).jacobian([a, b, c])])
    points = np.random.default_rng(2).normal(size=(9, 3)) * scale
    native, plain = (kv.compile(e, [a, b, c], tier=tier, wait=True) for tier in ("c", "interpreter"))
    np.testing.assert_array_equal(native.batch(points), plain.batch(points))
    np.testing.assert_array_equal([native(p) for p in points], plain.batch(points))
    assert np.isfinite(plain.batch(points)).all()


def test_norms_of_the_largest_and_smallest_numbers():
    at = {a: INF, b: -3.0}
    assert np.hypot(a, b)(at) == INF
    assert np.hypot(a, b)({a: MOST, b: 0.0}) == MOST
    assert np.hypot(a, b)({a: LEAST, b: 0.0}) == LEAST
    second = np.hypot(a, b).jacobian([a, b]).jacobian([a, b])
    np.testing.assert_allclose(
        second({a: 3 * TINY, b: 4 * TINY}), np.array([[16, -12], [-12, 9]]) / 125 / TINY, rtol=1e-14
    )


def test_arrays_and_scalars_have_the_same_second_derivative_at_the_origin():
    at = {a: 0.0, b: 0.0}
    for e in (
        np.hypot(a, b),
        np.hypot(kv.array([a]), b)[0],
        np.linalg.norm(kv.array([[a, b]]), axis=1)[0],
        kv.norm([a, b]),
    ):
        assert e(at) == 0
        assert e.jacobian([a, b])(at).tolist() == [0, 0]
        assert e.jacobian([a, b]).jacobian([a, b])(at).tolist() == [[0, 0], [0, 0]]


# -- powers ------------------------------------------------------------------------------------------------


def test_powers_of_zero_have_the_derivatives_that_exist():
    assert (0**a).gradient()[a.derivative()]({a: 1.0}) == 0
    assert (kv.array([0.0, 2.0]) ** a).jacobian([a])({a: 1.0}).ravel().tolist() == [0, 2 * math.log(2)]
    power = a**b
    for x, y, wanted in (
        (0, 1, [1, 0]),
        (0, 2, [0, 0]),
        (0, 3.5, [0, 0]),
        (2, 0, [0, math.log(2)]),
        (-2.0, 3.0, [12, math.nan]),
    ):
        at = {a: x, b: y}
        for found in (power.jacobian([a, b]), power.partial([a, b])):
            np.testing.assert_allclose(found(at), wanted)
    assert power.jacobian([a])({a: 0.0, b: 0.0}).tolist() == [0]
    assert power.jacobian([a])({a: 0.0, b: 0.5}).tolist() == [INF]
    second = power.jacobian([a, b]).jacobian([a, b])
    np.testing.assert_array_equal(second({a: 0.0, b: 2.0}), [[2, 0], [0, 0]])
    np.testing.assert_allclose(second({a: 2.0, b: 0.0}), [[0, 0.5], [0.5, math.log(2) ** 2]])
    exponent = kv.parameter("extremes/p", 1.0)
    assert (a**exponent).partial([exponent])({a: 0.0}).tolist() == [0]


def test_powers_of_zero_in_documents():
    from kineverse.formats.document import read_operations, to_json

    model, again = kv.Model(), kv.Model()
    with model.edit() as edit:
        edit.constrain("c", 0, a**b + np.sum(kv.array([a, 0.0, 2.0]) ** kv.array([b, a, b])), 1)
    with again.edit() as edit:
        for tag, operation in read_operations(to_json(model)):
            edit.apply(operation, tag)
    assert again.constraints["c"].expression == model.constraints["c"].expression
    assert to_json(again) == to_json(model)


# -- splines and logic at infinity -------------------------------------------------------------------------


@pytest.mark.compiler
def test_splines_have_limits_at_infinity():
    flat = kv.spline(a, [0, 1, 2], [3, 5, 4])
    tilted = kv.spline(a, [0, 1, 2], [3, 5, 4], slopes=(2.0, -1.0))
    e = kv.array([flat, tilted, *flat.jacobian([a]), *tilted.jacobian([a])])
    points = np.array([[-INF], [INF], [-1.0], [3.0], [math.nan]])
    wanted = np.array([[3, -INF, 0, 2], [4, -INF, 0, -1], [3, 1, 0, 2], [4, 3, 0, -1]])
    for tier in ("c", "interpreter"):
        found = kv.compile(e, [a], tier=tier, wait=True).batch(points)
        np.testing.assert_array_equal(found[:4], wanted)
        assert np.isnan(found[4]).all()


def test_less_of_infinities():
    ends = (-INF, -MOST, 0.0, MOST, INF)
    for x in ends:
        for y in ends:
            at = {a: x, b: y}
            wanted = 1.0 if x < y else 0.0 if x > y else 0.5
            assert (a < b)(at) == kv.logic.less(a, b, contrast=100.0)(at) == wanted
            assert (~(a < b))(at) == 1 - wanted
            assert ((a < b) & (b < a))(at) == wanted * (1 - wanted)
            assert ((a < b) | (b < a))(at) == 1 - wanted * (1 - wanted)
            assert (kv.minimum(a, b)(at), kv.maximum(a, b)(at)) == (min(x, y), max(x, y))
            assert kv.where(a < b, 1, 2)(at) == (1 if wanted >= 0.5 else 2)
            assert (a < y)({a: x}) == wanted
    assert kv.logic.less(a, b, contrast=2.0).partial([a, b])({a: 1.0, b: 1.0}).tolist() == [-1, 1]
    f = kv.compile(a < b, [a, b], tier="interpreter")
    assert np.isnan(f([math.nan, 1.0]))
    assert np.isnan(f([math.nan, math.nan]))
