"""minimum, maximum and what is made of them: NaN where numpy has NaN, in every tier, with its gradient."""

from __future__ import annotations

import itertools

import casadi as ca
import numpy as np
import pytest

import kineverse as kv

a, b = kv.position("a"), kv.position("b")
VALUES = (0.0, -0.0, 1.0, -2.0, 0.5, np.inf, -np.inf)
PAIRS = np.array(list(itertools.product(VALUES, VALUES)))

# Some of them are never negative, of which CasADi concludes that 0 <= f.
INNER = [np.sqrt, np.log, np.arccos, np.square, lambda x: 1.0 * x]


def extrema(minimum, maximum, clip, inner):
    """Return a function of x and y to what numpy and Kineverse have to agree on."""
    return lambda x, y: [
        minimum(inner(x), y),
        maximum(y, inner(x)),
        minimum(inner(x), 0.0),
        maximum(0.0, inner(x)),
        minimum(y, y + inner(x)),
        maximum(inner(x), inner(y)),
        clip(inner(x), 0, 1),
        clip(y, -np.inf, inner(x)),
    ]


def everything() -> tuple[list[kv.Expression], np.ndarray]:
    """Return expressions of a and b, and what they are worth at the pairs."""
    outputs, expected = [], []
    with np.errstate(all="ignore"):
        for inner in INNER:
            outputs += extrema(kv.minimum, kv.maximum, kv.clip, inner)(a, b)
            numbers = extrema(np.minimum, np.maximum, np.clip, inner)
            expected.append([numbers(x, y) for x, y in PAIRS])
    return outputs, np.concatenate(expected, axis=1)


OUTPUTS, EXPECTED = everything()
GRADIENTS = [
    e.gradient().get(s.derivative(), kv.Expression(0.0)) for e in OUTPUTS for s in (a, b)
]  # fmt: skip


def test_extrema_of_nan_equal_numpy() -> None:
    f = kv.compile([kv.array(OUTPUTS)], [a, b], tier="interpreter")
    np.testing.assert_allclose(np.array([f(x)[0] for x in PAIRS]), EXPECTED, rtol=1e-15)


def test_gradients_of_nan_are_nan() -> None:
    f = kv.compile([kv.array(GRADIENTS)], [a, b], tier="interpreter")
    found = np.array([f(x)[0] for x in PAIRS]).reshape(len(PAIRS), len(OUTPUTS), 2)
    for k, e in enumerate(OUTPUTS):
        keys = e.gradient()
        wanted = [i for i, s in enumerate((a, b)) if s.derivative() in keys]
        for i in wanted:
            assert np.isnan(found[np.isnan(EXPECTED[:, k]), k, i]).all(), (e, i)


def test_the_review() -> None:
    e = kv.clip(np.arccos(a), 0, 1)
    assert np.isnan(e({"a": 2.0}))
    assert np.isnan(e.gradient()[a.derivative()]({"a": 2.0}))
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("c", 0, e, 1)
    assert [v.name for v in model.violations({"a": 2.0})] == ["c"]
    assert np.isnan(np.max(kv.array([a, np.sqrt(b), 3.0]))({"a": 1, "b": -1}))
    assert np.isnan(np.min(kv.array([[a, np.sqrt(b)]]), axis=1)({"a": 1, "b": -1})[0])


@pytest.mark.parametrize("function", [np.fmin, np.fmax])
def test_fmin_of_a_number_and_nan_is_the_number(function) -> None:
    e = kv.array([function(np.sqrt(a), b), function(b, np.sqrt(a)), function(np.sqrt(a), np.sqrt(b))])
    with np.errstate(all="ignore"):
        for x, y in PAIRS:
            u, v = np.sqrt(x), np.sqrt(y)
            expected = [function(u, y), function(y, u), function(u, v)]
            np.testing.assert_array_equal(e({"a": x, "b": y}), expected)
    gradient = function(np.log(a), b).gradient()
    at = {"a": -1.0, "b": 3.0}
    assert (gradient[a.derivative()](at), gradient[b.derivative()](at)) == (0, 1)
    assert function(2 * a, b).gradient()[b.derivative()]({"a": 1.0, "b": 2.0}) == 0.5


def test_casadi_keeps_the_test_for_nan() -> None:
    # and not of a function that is never negative, either
    for inner in (ca.sqrt, ca.fabs, ca.exp, ca.sumsqr):
        x = ca.SX.sym("x")
        assert not ca.SX.binary(ca.OP_LE, ca.fabs(inner(x)), np.inf).is_constant()


@pytest.mark.compiler
def test_tiers_agree_to_the_bit() -> None:
    both = [kv.array(OUTPUTS), kv.array(GRADIENTS)]
    slow = kv.compile(both, [a, b], tier="interpreter")
    fast = kv.compile(both, [a, b], tier="c", wait=True)
    rows = fast.batch(np.tile(PAIRS, (40, 1)))
    for k, x in enumerate(PAIRS):
        for i, (expected, found) in enumerate(zip(slow(x), fast(x), strict=True)):
            one = np.isnan(expected)
            np.testing.assert_array_equal(np.isnan(found), one)
            assert expected[~one].tobytes() == found[~one].tobytes()
            np.testing.assert_array_equal(np.isnan(rows[i][k]), one)
