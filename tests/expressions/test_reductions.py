"""Sums, products and extrema over axes are numpy's, and a tie of several has the mean of their gradients."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import kineverse as kv
from kineverse.expressions.substitution import apply_substitution
from kineverse.formats.document import read_operations, to_json

SYMBOLS = [kv.position(f"x{i:02}") for i in range(24)]
ARRAY = kv.array(SYMBOLS).reshape(2, 3, 4)
AXES = [None, 0, 1, 2, -1, (0, 2), (2, 1), (0, 1, 2), np.int64(1)]


def at(numbers: np.ndarray) -> dict[kv.Symbol, float]:
    return dict(zip(SYMBOLS, numbers.ravel().tolist(), strict=False))


@pytest.mark.parametrize("axis", AXES, ids=str)
@pytest.mark.parametrize("function", [np.sum, np.prod, np.min, np.max, np.mean])
def test_reductions_along_axes_equal_numpy(function, axis) -> None:
    numbers = np.random.default_rng(1).normal(size=ARRAY.shape)
    wanted = function(numbers, axis=tuple(axis) if isinstance(axis, tuple) else axis)
    found = function(ARRAY, axis=axis)
    assert found.shape == np.shape(wanted)
    np.testing.assert_allclose(found(at(numbers)), wanted, rtol=1e-14)


def test_ufunc_reduce_along_an_axis() -> None:
    numbers = np.random.default_rng(2).normal(size=ARRAY.shape)
    for ufunc in (np.add, np.multiply, np.minimum, np.maximum):
        np.testing.assert_allclose(ufunc.reduce(ARRAY)(at(numbers)), ufunc.reduce(numbers), rtol=1e-14)
        found = ufunc.reduce(ARRAY, axis=1)
        np.testing.assert_allclose(found(at(numbers)), ufunc.reduce(numbers, axis=1), rtol=1e-14)
    with pytest.raises(kv.errors.ExpressionError, match="subtract"):
        np.subtract.reduce(ARRAY)


def test_prod_has_the_gradient_of_repeated_multiplication() -> None:
    a, b, c = SYMBOLS[:3]
    gradient = np.prod(kv.array([[a, b], [c, 2.0]]), axis=1).gradient()
    values = {a: 3, b: 5, c: 7}
    assert gradient[a.derivative()](values).tolist() == [5, 0]
    assert gradient[c.derivative()](values).tolist() == [0, 2]
    assert np.prod(kv.array([]).reshape(0))() == 1


@pytest.mark.parametrize("function", [np.sum, np.prod, np.min])
@pytest.mark.parametrize("axis", [3, "a", (0, 0), 1.5])
def test_unknown_axes_are_refused(function, axis) -> None:
    with pytest.raises(kv.KineverseError):
        function(ARRAY, axis=axis)


@given(st.lists(st.sampled_from([0.0, 1.0, 2.0]), min_size=1, max_size=7), st.sampled_from([np.min, np.max]))
def test_gradient_of_a_tie_is_the_mean(numbers, function) -> None:
    symbols = SYMBOLS[: len(numbers)]
    e = function(kv.array([(k + 1) * s for k, s in enumerate(symbols)]))
    values = {s: x / (k + 1) for k, (s, x) in enumerate(zip(symbols, numbers, strict=True))}
    scaled = np.array([(k + 1) * values[s] for k, s in enumerate(symbols)])
    won = scaled == function(scaled)
    assert e(values) == function(scaled)
    for k, (s, wins) in enumerate(zip(symbols, won, strict=True)):
        assert float(e.gradient()[s.derivative()](values)) == pytest.approx((k + 1) * wins / won.sum())


def test_extremum_of_many_is_one_node() -> None:
    a, b, c = SYMBOLS[:3]
    e = np.max(kv.array([a, 2 * b, c * c]))
    assert repr(e) == "maximum(x00, 2*x01, x02**2)"
    assert pickle.loads(pickle.dumps(e)) == e
    assert apply_substitution(e, {a: b})({"x01": 1.0, "x02": 1.0}) == 2
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("c", 0, e, 1)
    text, again = to_json(model), kv.Model()
    with again.edit() as edit:
        for tag, operation in read_operations(text):
            edit.apply(operation, tag)
    assert again.constraints["c"].expression == e
    assert to_json(again) == text
    many = np.min(kv.array([(s - k) ** 2 for k in range(50) for s in SYMBOLS]))
    assert many(dict.fromkeys(SYMBOLS, 3.25)) == 0.0625
