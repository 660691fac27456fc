"""Splines against scipy's, in every tier; their gradients by the law, knots included."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

import kineverse as kv
from hypothesis_profiles import attempts

x, y = kv.position("x"), kv.position("y")


def profile(seed: int, n: int, periodic: bool) -> tuple[list[float], list[float]]:
    rng = np.random.default_rng(seed)
    knots, values = np.cumsum(rng.uniform(0.05, 1.0, n)) - 2, rng.normal(size=n)
    if periodic:
        values[-1] = values[0]
    return knots.tolist(), values.tolist()


def derivatives(e: kv.Expression) -> list[kv.Expression]:
    """Return the value and two derivatives by x."""
    first = e.jacobian([x])
    return [e, first, first.jacobian([x])]


@settings(max_examples=attempts(40), derandomize=True)
@given(seed=st.integers(0, 10**6), n=st.integers(2, 40), periodic=st.booleans())
def test_values_and_derivatives_equal_scipy(seed: int, n: int, periodic: bool) -> None:
    knots, values = profile(seed, n, periodic)
    oracle = CubicSpline(knots, values, bc_type="periodic" if periodic else "clamped")
    inside = np.random.default_rng(seed).uniform(knots[0], knots[-1], 50)
    points = np.concatenate([inside, knots[:-1]])
    if periodic:  # and elsewhere, periods away
        points = np.concatenate([points, inside - 7 * (knots[-1] - knots[0])])
    found = kv.compile(derivatives(kv.spline(x, knots, values, periodic)), [x], tier="interpreter")
    for order, numbers in enumerate(found.batch(points[:, None])):
        expected = oracle(points, order)
        size = max(1.0, float(np.abs(expected).max()))
        np.testing.assert_allclose(numbers.ravel(), expected.ravel(), rtol=0, atol=1e-11 * size)


def test_spline_interpolates_its_points_and_is_straight_outside() -> None:
    knots, values = profile(3, 6, False)
    e = kv.spline(x, knots, values)
    np.testing.assert_allclose([e({x: t}) for t in knots], values, atol=1e-15)
    assert e({x: knots[0] - 5}) == values[0]
    assert e({x: knots[-1] + 5}) == values[-1]
    bent = kv.spline(x, knots, values, slopes=(0.5, -2.0))
    assert bent({x: knots[0] - 2}) == pytest.approx(values[0] - 1.0)
    assert bent({x: knots[-1] + 2}) == pytest.approx(values[-1] - 4.0)
    oracle = CubicSpline(knots, values, bc_type=((1, 0.5), (1, -2.0)))
    between = np.linspace(knots[0], knots[-1], 50)
    np.testing.assert_allclose(
        kv.spline(between, knots, values, slopes=(0.5, -2.0))(), oracle(between), atol=1e-14
    )


def test_batches_give_the_same_numbers() -> None:
    knots, values = profile(4, 9, True)
    outputs = derivatives(kv.spline(x, knots, values, True))
    points = np.random.default_rng(1).uniform(-9, 9, (200, 1))
    slow = kv.compile(outputs, [x], tier="interpreter")
    batches = slow.batch(points)
    for i, point in enumerate(points):
        for one, many in zip(slow(point), batches, strict=True):
            np.testing.assert_allclose(np.asarray(one).ravel(), many[i].ravel(), rtol=1e-14, atol=1e-14)


@pytest.mark.compiler
def test_compiled_code_gives_the_same_bits_as_the_interpreter() -> None:
    knots, values = profile(4, 9, False)
    outputs = derivatives(kv.spline(x, knots, values))
    fast, slow = (kv.compile(outputs, [x], tier=tier, wait=True) for tier in ("c", "interpreter"))
    for point in np.random.default_rng(1).uniform(-4, 4, (100, 1)):
        for one, other in zip(fast(point), slow(point), strict=True):
            assert np.asarray(one).tobytes() == np.asarray(other).tobytes()


def test_gradients_obey_the_chain_rule() -> None:
    knots, values = profile(5, 7, True)
    wheel, oracle = kv.velocity("wheel"), CubicSpline(knots, values, bc_type="periodic")
    e = kv.spline((x * np.sin(y)).augment({wheel: 4 * x, y.derivative(): 3.0}), knots, values, True) * x
    at = {x: 0.7, y: 1.1}
    u = 0.7 * np.sin(1.1)
    s, ds = float(oracle(u)), float(oracle(u, 1))
    assert {key: entry(at) for key, entry in e.gradient().items()} == pytest.approx(
        {x.derivative(): s + 0.7 * ds * np.sin(1.1), y.derivative(): 0.7 * ds * 3, wheel: 0.7 * ds * 2.8}
    )
    assert e.partial([y])(at)[0] == pytest.approx(0.7 * ds * 0.7 * np.cos(1.1))
    heuristic = kv.spline(x.augment({wheel: 1}, heuristic=True), knots, values, True)
    assert set(heuristic.gradient(heuristic=False)) == {x.derivative()}
    assert e.substitute({y: 2 * y})({x: 0.7, y: 0.55}) == pytest.approx(0.7 * s)


def test_arrays_are_taken_element_by_element() -> None:
    knots, values = profile(6, 5, False)
    e = kv.spline(kv.array([[x, 2 * x, 0.1], [y, 0.0, x * y]]), knots, values)
    at = {x: 0.4, y: -0.9}
    expected = CubicSpline(knots, values, bc_type="clamped")
    where = np.clip([[0.4, 0.8, 0.1], [-0.9, 0, -0.36]], knots[0], knots[-1])
    np.testing.assert_allclose(e(at), expected(where), atol=1e-14)
    assert e.gradient()[x.derivative()].shape == (2, 3)
    assert kv.spline(np.zeros((0, 2)), knots, values).shape == (0, 2)


def test_equal_splines_are_equal_and_can_be_pickled() -> None:
    knots, values = profile(7, 5, True)
    e = kv.spline(x, knots, values, True)
    assert e == kv.spline(x, np.array(knots), tuple(values), periodic=True)
    assert e != kv.spline(x, knots, values, False)
    assert pickle.loads(pickle.dumps(e)) == e
    assert pickle.loads(pickle.dumps(e.jacobian([x]))) == e.jacobian([x])
    assert kv.spline(x, (0, 1), (2, 2), True).gradient() == {}


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"knots": [0], "values": [1]}, "at least two knots"),
    ({"knots": [0, 1, 1], "values": [1, 2, 3]}, "knot 2 is 1, and knot 1 is 1"),
    ({"knots": [0, 2, 1], "values": [1, 2, 3]}, "Knots increase"),
    ({"knots": [0, 1], "values": [1, 2, 3]}, "not 3 for 2"),
    ({"knots": [0, float("nan")], "values": [1, 2]}, "knot is a finite number, and number 1 is nan"),
    ({"knots": [0, 1], "values": [1, float("inf")]}, "value is a finite number"),
    ({"knots": "ab", "values": [1, 2]}, "Every knot is a number"),
    ({"knots": [0, 1], "values": None}, "Every value is a number"),
    ({"knots": [0, 1], "values": [1, 2], "periodic": True}, "last value 2 is not its first, 1"),
    ({"knots": [0, 1], "values": [1, 1], "periodic": True, "slopes": (0, 0)}, "no ends"),
    ({"knots": [0, 1], "values": [1, 1], "slopes": (0, float("nan"))}, "slope is a finite"),
    ({"knots": [0, 1], "values": [1, 1], "slopes": (0, 1, 2)}, "two slopes"),
]


@pytest.mark.parametrize(("given", "words"), WRONG)
def test_invalid_points_are_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(kv.errors.InvalidValueError, match=words):
        kv.spline(x, **given)
