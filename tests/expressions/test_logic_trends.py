"""Trends: following them makes a condition true, and as facts conditions are constant."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.expressions import array, total_derivative
from kineverse.logic import less, logic_and, logic_not, logic_or

JOINTS = [kv.position(f"lock/{name}") for name in "abcdefgh"]
a, b, c, d = JOINTS[:4]
da, db, dc, dd = (joint.derivative() for joint in JOINTS[:4])


def D(e, at, heuristic=True):
    return {key: entry(at) for key, entry in e.gradient(heuristic).items()}


def follow(condition, at, step=0.11, most=60):
    """Go along the trend until the condition holds; return the places on the way."""
    symbols = list(condition.symbols)
    f = kv.compile([condition, condition.jacobian(symbols)], symbols, tier="interpreter")
    x = np.array([at[s] for s in symbols])
    way = [x]
    for _ in range(most):
        value, trend = f(x)
        if value > 0.99:
            return way
        x = x + step * np.clip(trend, -1, 1)
        way.append(x)
    raise AssertionError(f"After {most} steps from {at} it still does not hold; the trend is {trend}.")


LATCH, BOLT, MASTER = a > 0.5, b > 0.5, c > 0.5
STATES = [dict(zip((a, b, c), x, strict=True)) for x in itertools.product([-0.5, 0.4, 1.3], repeat=3)]


@pytest.mark.parametrize("at", STATES, ids=str)
def test_the_trend_opens_a_lock_box(at):
    """A door that opens if latch and bolt are open, or a master switch is on (2020 paper, III-C)."""
    way = follow((LATCH & BOLT) | MASTER, at)
    assert (len(way) > 1) == (not ((at[a] > 0.5 and at[b] > 0.5) or at[c] > 0.5))
    assert np.all(np.diff(way, axis=0) >= 0)
    # What was open stays where it is.
    for i, joint in enumerate((a, b, c)):
        if at[joint] > 0.5:
            assert way[-1][i] == at[joint]


@pytest.mark.parametrize("at", STATES, ids=str)
def test_the_trend_locks_it_again(at):
    assert np.all(np.diff(follow(~((LATCH & BOLT) | MASTER), at), axis=0) <= 0)


def test_the_product_rule_does_not_open_the_lock():
    at = {a: -0.5, b: -0.5}
    blind = LATCH * BOLT
    assert set(D(blind, at).values()) == {0}
    with pytest.raises(AssertionError, match="still does not hold"):
        follow(blind, at)
    follow(LATCH & BOLT, at)


@st.composite
def read_once(draw, joints=tuple(JOINTS), depth=3, wanted=True):
    """Draw a lock of locks: thresholds and windows, to be entered, of joints that each occur once."""
    kind = draw(st.sampled_from(["below", "above", "window", "and", "or", "not"]))
    if depth and kind == "not":
        return ~draw(read_once(joints, depth - 1, not wanted))
    if depth and kind in ("and", "or") and len(joints) >= 2:
        count = draw(st.integers(2, min(3, len(joints))))
        parts = [draw(read_once(joints[i::count], depth - 1, wanted)) for i in range(count)]
        return logic_and(*parts) if kind == "and" else logic_or(*parts)
    joint, threshold = joints[0], draw(st.sampled_from([-0.75, 0.0, 0.6]))
    if kind == "window" and wanted:
        return (threshold < joint) & (joint < threshold + 0.4)
    return joint < threshold if kind == "below" else threshold < joint


@settings(max_examples=attempts(50))
@given(read_once(), st.lists(st.sampled_from([-1.3, -0.3, 0.21, 1.17]), min_size=8, max_size=8))
def test_the_trend_opens_locks_of_locks(lock, point):
    follow(lock, dict(zip(JOINTS, point, strict=True)))


def test_a_window_is_entered_from_both_sides_and_has_no_preferred_way_out():
    window = (a > 0.4) & (a < 0.6)
    assert 0.4 < follow(window, {a: -0.7})[-1][0] < 0.6
    assert 0.4 < follow(window, {a: 1.7})[-1][0] < 0.6
    # Inside, one way out is as good as the other, and they cancel.
    assert D(~window, {a: 0.45}) == {da: 0}
    assert D(~window & (b > 0), {a: 0.45, b: -1.0}) == {da: 0, db: 1}


# -- facts -------------------------------------------------------------------------------------------------


def test_facts_are_constant_at_every_nesting():
    inner = less(a * b, c, contrast=2)
    at = {a: 0.3, b: 0.4, c: 0.1, d: 0.9}
    for e in [inner, ~inner, inner & d, ~(inner | d) & a, less(inner & d, a | b, contrast=3)]:
        assert e.gradient()
        assert not e.gradient(heuristic=False)
        assert total_derivative(e) == 0
        assert D(e * d, at, False) == {dd: pytest.approx(e(at))}
        assert D(np.sin(e) + d**2, at, False) == {dd: pytest.approx(1.8)}
        assert not logic_not(d.augment({da: 7})).gradient(heuristic=False)
        assert not np.any(e.jacobian([a, b, c], heuristic=False)(at))


def test_facts_through_where_minimum_and_augment():
    lock = (a < 1) & (b < 1)
    at = {a: 0.5, b: 0.5, c: 3.0, d: 0.0}
    assert D(kv.where(lock, c * c, lock), at) == {da: 0, db: 0, dc: 6}
    assert D(kv.where(lock, c * c, lock), at, False) == {dc: 6}
    assert D(kv.where(~lock, c * c, lock), at) == {da: -1, db: -1, dc: 0}
    assert D(kv.minimum(lock, c), at) == {da: -1, db: -1, dc: 0}
    assert D(kv.minimum(lock, c), at, False) == {dc: 0}
    assert D(kv.maximum(lock, d), at, False) == {dd: 0}
    assert D(lock.augment({dc: 2}), at) == {da: -1, db: -1, dc: 2}
    assert D(lock.augment({dc: 2}), at, False) == {dc: 2}
    assert D(lock.augment({dc: 2}, heuristic=True), at, False) == {}
    assert D(lock.with_gradient({dc: 2}) & (d < 1), at) == {dc: 2, dd: -1}
    assert D(kv.norm(array([lock, c])), at, False) == {dc: pytest.approx(3 / math.sqrt(10))}


def test_the_partial_derivative_is_the_true_slope():
    e = less(a, b, contrast=2.0)
    at = {a: 0.3, b: 0.5}
    slope = (1 - math.tanh(0.4) ** 2) * 2 / 2
    np.testing.assert_allclose(e.partial([a, b])(at), [-slope, slope])
    np.testing.assert_allclose((e & c).partial([b, c])({**at, c: 0.7}), [0.7 * slope, e(at)])
