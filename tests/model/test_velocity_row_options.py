"""Options of velocity rows: allowed recovery, bounds apart from rows, step and gain as parameters, extra constraints."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_models import constrained

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.errors import DuplicateNameError, InvalidValueError
from kineverse.model.velocity_constraints.velocity_rows import VelocityRows

a, b, c = (kv.position(n) for n in "abc")
va, vb, vc = (s.derivative() for s in (a, b, c))
DT = 0.1
Triples = Mapping[str, tuple[Any, Any, Any]]
SHIPPED = ("fetch", "hsr", "pr2", "kitchen", "shelf_door")


MIXED: Triples = {
    "a": (-1, a, 2),
    "a scaled": (-3, -2 * a, 1),
    "a below b": (-math.inf, a, b + 1),
    "a speed": (-0.5, va, 1),
    "a backwards": (-4, -3 * va, 0.9),
    "b": (-0.3, b, 1 + np.cos(c)),
    "b brakes": (-2, vb.derivative(), 3),
    "sum": (-0.9, a + 2 * b, 1.5),
    "level": (0.2, np.sin(a) * c, 0.2),
    "norm": (-math.inf, kv.norm(kv.array([vb, vc])), 2),
    "locked": (-(c > 0), vb, c > 0),
}


@cache
def mixed() -> kv.Model:
    return constrained(MIXED)


def values_of(rows: VelocityRows, inputs: Any, points: np.ndarray) -> tuple[np.ndarray, ...]:
    parts = [rows.matrix, rows.lower, rows.upper, rows.violation]
    return kv.compile(parts, inputs, tier="interpreter").batch(points)


# -- allowed recovery --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHIPPED)
def test_zero_speed_satisfies_rows_of_shipped_models_everywhere(name: str) -> None:
    model = kv.load(name)
    rows = model.velocity_rows(0.02, recovery="allowed")
    points = np.random.default_rng(0).uniform(-20, 20, (2000, len(model.symbols)))
    _, lower, upper, violation = values_of(rows, model.symbols, points)
    assert (lower <= 0).all()
    assert (upper >= 0).all()
    assert (violation != 0).any()


@settings(max_examples=attempts(15))
@given(seed=st.integers(0, 10**6), dt=st.floats(0.01, 1), share=st.floats(0.05, 1), size=st.floats(0.1, 100))
def test_zero_speed_satisfies_all_rows_with_allowed_recovery(
    seed: int, dt: float, share: float, size: float
) -> None:
    rows = mixed().velocity_rows(dt, gain=share / dt, recovery="allowed")
    points = np.random.default_rng(seed).normal(size=(50, 3)) * size
    _, lower, upper, _ = values_of(rows, mixed().symbols, points)
    assert (lower <= 0).all()
    assert (upper >= 0).all()


def test_allowed_recovery_is_required_recovery_inside_of_bounds() -> None:
    model = constrained({name: triple for name, triple in MIXED.items() if name != "level"})
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (200, 3))
    inside = points[[not model.violations(dict(zip((a, b, c), p, strict=True))) for p in points]]
    assert len(inside) > 50
    required, allowed = (model.velocity_rows(DT, recovery=r) for r in ("required", "allowed"))
    for one, other in zip(
        values_of(required, model.symbols, inside), values_of(allowed, model.symbols, inside), strict=True
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", ["fetch", "kitchen"])
def test_allowed_recovery_is_required_recovery_at_the_default_state(name: str) -> None:
    model = kv.load(name)
    state = model.default_state()
    required, allowed = (model.velocity_rows(DT, recovery=r) for r in ("required", "allowed"))
    np.testing.assert_array_equal(required.lower(state), allowed.lower(state))
    np.testing.assert_array_equal(required.upper(state), allowed.upper(state))
    assert not allowed.violation(state).any()


def test_an_unknown_recovery_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="'required' or 'allowed'"):
        mixed().velocity_rows(DT, recovery="soft")  # type: ignore[arg-type]


# -- violations --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("recovery", ["required", "allowed"])
def test_violation_is_the_signed_excess_of_positions(recovery: Any) -> None:
    model = mixed()
    rows = model.velocity_rows(DT, recovery=recovery)
    for point in np.random.default_rng(0).normal(size=(40, 3)) * 3:
        state = kv.State(dict(zip((a, b, c), point, strict=True)))
        expected = dict.fromkeys(rows.names, 0.0)
        for found in model.violations(state, tolerance=0.0):
            sign = 1 if found.value > found.upper else -1
            expected[found.name] += sign * found.excess
        total = dict.fromkeys(rows.names, 0.0)
        for name, value in zip(rows.names, rows.violation(state), strict=True):
            total[name] += value
        assert total == pytest.approx(expected)


def test_motion_against_the_violation_leads_back() -> None:
    """matrix @ v = -gain * violation is the rate that takes the excess to 0."""
    bound = np.cos(b)
    rows = constrained({"n": (-bound, np.sin(2 * a), bound)}).velocity_rows(DT)
    point = np.array([0.6, 1.2])
    state, excess = kv.State(dict(zip((a, b), point, strict=True))), np.sin(1.2) - np.cos(1.2)
    np.testing.assert_allclose(rows.violation(state), [0, excess])
    step, *_ = np.linalg.lstsq(rows.matrix(state)[1:], -1e-4 * rows.violation(state)[1:])
    after = point + step
    assert np.sin(2 * after[0]) - np.cos(after[1]) == pytest.approx(excess * (1 - 1e-4), abs=1e-7)


# -- bounds and general rows -------------------------------------------------------------------------------------


@settings(max_examples=attempts(15))
@given(seed=st.integers(0, 10**6), recovery=st.sampled_from(["required", "allowed"]))
def test_bounds_and_general_rows_admit_the_same_speeds(seed: int, recovery: Any) -> None:
    rows = mixed().velocity_rows(DT, recovery=recovery)
    bounds, general = rows.bounds, rows.general
    assert {*general.names} == {"a below b", "b", "sum", "level", "norm"}
    assert bounds.names == (("a speed", "a backwards", "a", "a scaled"), ("locked", "b"), ())
    rng = np.random.default_rng(seed)
    state = kv.State(dict(zip((a, b, c), rng.normal(size=3) * 2, strict=True)))
    matrix, lower, upper = rows.matrix(state), rows.lower(state), rows.upper(state)
    parts = general.matrix(state), general.lower(state), general.upper(state)
    low, high = bounds.lower(state), bounds.upper(state)
    inside = rng.uniform(np.clip(low, -3, 3), np.clip(np.maximum(low, high), -3, 3), (300, 3))
    speeds = np.where(rng.random((300, 3)) < 0.4, rng.normal(size=(300, 3)), inside)
    for v in speeds * rng.choice([0, 0.1, 1], (300, 1)):
        whole = (lower <= matrix @ v).all() and (matrix @ v <= upper).all()
        own = (low <= v).all() and (v <= high).all()
        apart = own and (parts[1] <= parts[0] @ v).all() and (parts[0] @ v <= parts[2]).all()
        margin = min(abs(matrix @ v - lower).min(), abs(matrix @ v - upper).min())
        assert whole == apart or margin < 1e-12


def test_bounds_of_a_speed_are_the_tightest_with_their_violation() -> None:
    bounds = mixed().velocity_rows(DT).bounds
    assert [str(s) for s in bounds.speeds] == ["a:velocity", "b:velocity", "c:velocity"]
    state = kv.State({"a": 4.0, "b": 0.0, "c": 0.0})
    # a <= 2 is violated by 2; -3 <= -2a, so a <= 1.5, by 2.5.
    assert bounds.violation(state)[0] == 2.5
    assert bounds.upper(state)[0] == pytest.approx(-0.3)
    assert bounds.lower(state)[2] == -math.inf
    assert bounds.upper(state)[2] == math.inf
    assert bounds.violation(kv.State({"a": -4.0, "b": 0.0, "c": 0.0}))[0] == -3.5


@pytest.mark.parametrize("order", [("a", "b"), ("b", "a")])
def test_merged_bounds_hide_no_nan(order: tuple[str, str]) -> None:
    """What has no value may not be replaced by another bound; fmin would do that."""
    ends = {"a": np.sqrt(kv.parameter("p", 1.0)), "b": np.sqrt(kv.parameter("q", 1.0))}
    bounds = constrained({n: (-ends[n], a, ends[n]) for n in order}).velocity_rows(DT).bounds
    for values in ({"p": -1.0, "q": 1.0}, {"p": 1.0, "q": -1.0}):
        at = kv.State({"a": 0.0, **values})
        assert np.isnan([bounds.lower(at)[0], bounds.upper(at)[0], bounds.violation(at)[0]]).all()
    at = kv.State({"a": 0.0, "p": 4.0, "q": 1.0})
    assert (bounds.lower(at)[0], bounds.upper(at)[0]) == (-10, 10)


def test_entries_are_the_matrix() -> None:
    model = kv.load("fetch")
    rows, state = model.velocity_rows(DT), model.default_state()
    matrix = np.zeros(rows.matrix.shape)
    for row, column, weight in rows.entries:
        matrix[row, column] = weight(state)
    np.testing.assert_array_equal(matrix, rows.matrix(state))
    assert len(rows.entries) < matrix.size / 5


def test_no_rows_have_bounds_without_ends() -> None:
    rows = constrained({}).velocity_rows(DT)
    assert not rows.entries
    assert not rows.bounds.names
    assert not rows.general.names
    assert rows.bounds.lower.shape == rows.violation.shape == (0,)


# -- step and gain as parameters ---------------------------------------------------------------------------------


@pytest.mark.parametrize("recovery", ["required", "allowed"])
@pytest.mark.parametrize("with_gain", [False, True])
def test_parameters_for_step_and_gain_give_the_same_rows(recovery: Any, with_gain: bool) -> None:
    dt, gain = kv.parameter("dt", 0.02), kv.parameter("gain", 3.0)
    model, rng = mixed(), np.random.default_rng(0)
    rows = model.velocity_rows(dt, gain=gain if with_gain else None, recovery=recovery)
    inputs = (*model.symbols, dt, gain)
    for step, factor in ((0.02, 3.0), (0.1, 7.0)):
        numbers = model.velocity_rows(step, gain=factor if with_gain else None, recovery=recovery)
        points = rng.normal(size=(30, 3)) * 2
        full = np.hstack([points, np.broadcast_to([step, factor], (30, 2))])
        assert rows.names == numbers.names
        for one, other in zip(
            values_of(rows, inputs, full), values_of(numbers, model.symbols, points), strict=True
        ):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_a_step_may_be_a_constant_expression() -> None:
    assert mixed().velocity_rows(kv.Expression(DT)).upper == mixed().velocity_rows(DT).upper
    with pytest.raises(InvalidValueError, match="positive time"):
        mixed().velocity_rows(kv.Expression(-1.0))


@pytest.mark.parametrize("wrong", [va, kv.array([a, b])])
def test_steps_and_gains_are_scalars_without_speeds(wrong: kv.Expression) -> None:
    with pytest.raises(InvalidValueError, match="step dt is a scalar that depends on no speed"):
        mixed().velocity_rows(wrong)
    with pytest.raises(InvalidValueError, match="gain is a scalar that depends on no speed"):
        mixed().velocity_rows(DT, gain=wrong)
    with pytest.raises(InvalidValueError, match=r"\(0, 1/dt\]"):
        mixed().velocity_rows(kv.parameter("dt", 0.1), gain=-1.0)


# -- extra constraints -------------------------------------------------------------------------------------------


def test_extra_constraints_are_rows_with_their_columns_and_limits() -> None:
    model = constrained({"a": (-1, a, 1), "b": (-1, b, 1), "c": (-1, c, 1), "b speed": (-2, vb, 2)})
    rows = model.velocity_rows(DT, subject=a, extra={"sum": (-1, a + b, 1)})
    assert set(rows.names) == {"a", "b", "b speed", "sum"}
    assert rows.speeds == (va, vb)
    constraint = kv.Constraint(kv.Expression(-1.0), a + b, kv.Expression(1.0))
    assert "sum" in model.velocity_rows(DT, extra={"sum": constraint}).names
    assert "sum" not in model.constraints


def test_extra_constraints_are_about_free_speeds() -> None:
    model, x = kv.load("fetch"), kv.position("fetch/base/x")
    rows = model.velocity_rows(DT, subject=x, extra={"wall": (-math.inf, x, 1.0)})
    assert {*rows.speeds} == {*model.rates[x]}
    assert "wall" in rows.general.names


def test_an_extra_constraint_needs_a_name_of_its_own() -> None:
    with pytest.raises(DuplicateNameError, match="'sum' already"):
        mixed().velocity_rows(DT, extra={"sum": (-1, a, 1)})
    with pytest.raises(InvalidValueError, match="triple"):
        mixed().velocity_rows(DT, extra={"other": (a, 1)})
