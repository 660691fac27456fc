"""Integration follows q̇ = R(q) u, and along it expressions move as their gradients say."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_models import random_speeds, random_state, random_tree
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import kineverse as kv
import time_derivative_checks
from hypothesis_profiles import attempts
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.model.rates import to_plain

x, y, z = (kv.position(n) for n in "xyz")
u, v = kv.velocity("u"), kv.velocity("v")
Rows = Mapping[kv.Symbol, Mapping[kv.Symbol, kv.Expression | float]]

BASES: dict[str, kv.Operation] = {
    "differential": kv.articulations.DifferentialDrive(
        name="base", parent="world", child="base", radius=0.2, track=0.5
    ),
    "omni": kv.articulations.OmniBase(name="base", parent="world", child="base"),
    "floating": kv.Floating(name="base", parent="world", child="base"),
    "planar": kv.Planar(name="base", parent="world", child="base", axis=(1, 2, 3)),
}


def model_of(*operations: kv.Operation, rates: Rows | None = None) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        for operation in operations:
            edit.apply(operation)
        for coordinate, row in (rates or {}).items():
            edit.set_rate(coordinate, row)
    return model


def with_arm(base: str) -> kv.Model:
    """Return a base that carries an arm: the pose of its hand is about everything."""
    return model_of(
        BASES[base],
        kv.Revolute(name="arm", parent="base", child="arm", axis=(1, 2, 3)),
        kv.Prismatic(name="hand", parent="arm", child="hand", axis=(0, 1, 1)),
    )


def state_of(values: Mapping[kv.Symbol, float]) -> kv.State:
    return kv.State(dict(values))


def oracle(
    model: kv.Model, start: Mapping[kv.Symbol, float], speeds: Mapping[kv.Symbol, float], dt: float
) -> np.ndarray:
    """Return the degrees of freedom after dt, by somebody else's integrator."""
    symbols, rates = model.degrees_of_freedom, model.rates
    rows = [
        sum((g * s for s, g in rates[q].items()), kv.Expression(0.0)) if q in rates else q.derivative() * 1.0
        for q in symbols
    ]
    flow = kv.compile(to_plain(kv.array(rows)), [*symbols, *model.speeds], tier="interpreter")
    constant = [speeds[s] for s in model.speeds]
    ends = solve_ivp(
        lambda _, q: flow(np.concatenate([q, constant])),
        (0, dt),
        [start[s] for s in symbols],
        method="DOP853",
        rtol=3e-14,
        atol=1e-14,
    )
    return np.asarray(ends.y[:, -1])


def numbers(model: kv.Model, state: Mapping[kv.Symbol, float]) -> np.ndarray:
    return np.array([state[s] for s in model.degrees_of_freedom])


# -- where it leads --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("dt", [0.02, -0.7, 3.0])
def test_trees_of_every_kind_of_joint_are_where_another_integrator_says(seed: int, dt: float) -> None:
    model = random_tree(seed, 9)
    start, speeds = random_state(model, seed), random_speeds(model, seed)
    after = model.integrate(start, speeds, dt)
    np.testing.assert_allclose(numbers(model, after), oracle(model, start, speeds, dt), rtol=0, atol=3e-11)


NONLINEAR: dict[str, Rows] = {
    "growing": {x: {u: x * x}},
    "stiff": {x: {u: np.sin(50 * x)}},
    "turning": {x: {u: 10 * y}, y: {u: -10 * x}},
    "of each other": {x: {u: np.cos(y), v: 1 / (2 + x * x)}, y: {v: x * z}},
    "of what moves freely": {x: {u: np.sin(3 * z)}, y: {z.derivative(): x}},
}


@pytest.mark.parametrize("name", NONLINEAR)
def test_rows_of_any_kind_are_followed(name: str) -> None:
    """Steps are as short as the rows ask for on the way, not only where it starts."""
    model = model_of(rates=NONLINEAR[name])
    with model.edit() as edit:
        edit.add_frame("seen", "world", kv.translation(x, y, z))
    start = {x: 1.0, y: 0.3, z: -0.4}
    speeds = dict.fromkeys(model.speeds, 0.9)
    after, expected = model.integrate(start, speeds, 1.0), oracle(model, start, speeds, 1.0)
    np.testing.assert_allclose(numbers(model, after), expected, rtol=1e-10, atol=1e-11)


@settings(max_examples=attempts(20))
@given(left=st.floats(-8, 8), right=st.floats(-8, 8), heading=st.floats(-4, 4), dt=st.floats(-2, 2))
def test_two_wheels_drive_an_arc(left: float, right: float, heading: float, dt: float) -> None:
    model = model_of(BASES["differential"])
    start = {"base/x": 1.0, "base/y": -2.0, "base/angle": heading}
    speeds = {"base/left_wheel:velocity": left, "base/right_wheel:velocity": right}
    after = model.integrate(start, speeds, dt)
    forward, turn = 0.1 * (left + right), 0.4 * (right - left)
    half = turn * dt / 2
    chord = forward * dt * np.sinc(half / np.pi)
    assert after["base/x"] == pytest.approx(1 + chord * np.cos(heading + half), abs=1e-12)
    assert after["base/y"] == pytest.approx(-2 + chord * np.sin(heading + half), abs=1e-12)
    assert after["base/angle"] == pytest.approx(heading + turn * dt, abs=1e-12)


@settings(max_examples=attempts(20))
@given(seed=st.integers(0, 10**6), dt=st.floats(-3, 3))
def test_a_quaternion_moves_by_its_exponential_and_keeps_its_length(seed: int, dt: float) -> None:
    rng, model = np.random.default_rng(seed), model_of(BASES["floating"])
    turn, omega, linear = Rotation.random(rng=rng), rng.normal(size=3), rng.normal(size=3)
    quaternion = [f"base/q{s}" for s in "xyzw"]
    start = dict(zip(quaternion, turn.as_quat(), strict=True)) | {f"base/{s}": 0.5 for s in "xyz"}
    speeds = {f"base/{s}:velocity": n for s, n in zip("xyz", linear, strict=True)}
    speeds |= {f"base/w{s}:velocity": n for s, n in zip("xyz", omega, strict=True)}
    after = model.integrate(start, speeds, dt)
    result = np.array([after[q] for q in quaternion])
    expected = (turn * Rotation.from_rotvec(omega * dt)).as_quat()
    np.testing.assert_allclose(result * np.sign(result @ expected), expected, atol=1e-12)
    assert np.linalg.norm(result) == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose([after[f"base/{s}"] for s in "xyz"], 0.5 + dt * linear, atol=1e-12)


def test_a_quaternion_is_of_unit_length_after_a_day_of_steps() -> None:
    model = model_of(BASES["floating"])
    speeds = {"base/wx:velocity": 0.7, "base/wy:velocity": -1.1, "base/wz:velocity": 0.4}
    state = model.default_state()
    for _ in range(300):
        state = model.integrate(state, speeds, 0.05)
    assert math.hypot(*(state[f"base/q{s}"] for s in "xyzw")) == pytest.approx(1, abs=1e-12)
    once = model.integrate(model.default_state(), speeds, 15.0)
    np.testing.assert_allclose(numbers(model, state), numbers(model, once), atol=1e-11)


@pytest.mark.parametrize("length", [0.5, 3.0])
def test_a_quaternion_of_another_length_keeps_it_and_turns_alike(length: float) -> None:
    model = model_of(BASES["floating"])
    speeds = {"base/wx:velocity": 0.7, "base/wz:velocity": 2.0}
    home = dict(model.default_state())
    longer = {s: value * length if "/q" in str(s) else value for s, value in home.items()}
    after, expected = model.integrate(longer, speeds, 1.3), model.integrate(home, speeds, 1.3)
    assert math.hypot(*(after[f"base/q{s}"] for s in "xyzw")) == pytest.approx(length, abs=1e-12)
    np.testing.assert_allclose(model.fk("base")(after), model.fk("base")(expected), atol=1e-12)


# -- laws ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_two_steps_are_one_and_backwards_is_back(seed: int) -> None:
    model = random_tree(seed, 9)
    start, speeds = random_state(model, seed), random_speeds(model, seed)
    halfway, whole = model.integrate(start, speeds, 0.4), model.integrate(start, speeds, 1.0)
    np.testing.assert_allclose(
        numbers(model, model.integrate(halfway, speeds, 0.6)), numbers(model, whole), atol=1e-12
    )
    back = model.integrate(whole, {s: -n for s, n in speeds.items()}, 1.0)
    np.testing.assert_allclose(numbers(model, back), numbers(model, start), atol=1e-12)
    np.testing.assert_array_equal(numbers(model, model.integrate(start, speeds, 0.0)), numbers(model, start))


def random_expression(rng: np.random.Generator, symbols: list[kv.Symbol], depth: int = 4) -> kv.Expression:
    if depth == 0:
        return symbols[rng.integers(len(symbols))] * rng.normal()
    one, other = (random_expression(rng, symbols, depth - 1) for _ in range(2))
    return (
        lambda: one + other,
        lambda: one * other,
        lambda: np.sin(one) - other,
        lambda: one / (2 + other * other),
        lambda: np.exp(-one * one) * other,
        lambda: kv.norm(kv.array([one, other, 1.0])),
        lambda: np.sqrt(1 + one * one) + np.cos(other),
    )[rng.integers(7)]()


def assert_motion_law(model: kv.Model, expressions: list[kv.Expression], seed: int) -> None:
    time_derivative_checks.assert_time_derivatives(
        model, expressions, random_state(model, seed), random_speeds(model, seed)
    )


@pytest.mark.parametrize("base", BASES)
def test_poses_on_a_base_move_as_their_gradients_say(base: str) -> None:
    model = with_arm(base)
    assert_motion_law(model, [model.fk("hand"), model.fk("base", "hand")], seed=1)


@pytest.mark.parametrize("base", BASES)
def test_jacobians_on_a_base_move_as_their_gradients_say(base: str) -> None:
    model = with_arm(base)
    assert_motion_law(
        model, [model.jacobian("hand", form=form) for form in ("world_aligned", "body")], seed=2
    )


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.sampled(2)
def test_random_expressions_on_a_base_move_as_their_gradients_say(base: str, seed: int) -> None:
    model, rng = with_arm(base), np.random.default_rng(seed)
    symbols = list(model.degrees_of_freedom)
    assert_motion_law(model, [model.rates.carry(random_expression(rng, symbols)) for _ in range(4)], seed)


@pytest.mark.parametrize("name", NONLINEAR)
def test_random_expressions_of_rows_of_any_kind_move_as_their_gradients_say(name: str) -> None:
    model = model_of(rates=NONLINEAR[name])
    with model.edit() as edit:
        edit.add_frame("seen", "world", kv.translation(x, y, z))
    rng = np.random.default_rng(7)
    # The sine of fifty times x is too steep for differences over this step.
    symbols = [y, z] if name == "stiff" else [x, y, z]
    expressions = [model.rates.carry(random_expression(rng, symbols)) for _ in range(4)]
    assert_motion_law(model, expressions, seed=3)


def test_heuristics_are_no_part_of_how_things_move() -> None:
    model = with_arm("differential")
    arm, hand = kv.position("arm"), kv.position("hand")
    hinted = model.rates.carry((np.sin(arm) * hand).augment({kv.velocity("arm"): 9.0}, heuristic=True))
    assert_motion_law(model, [hinted], seed=4)
    assert hinted.gradient()[kv.velocity("arm")]({"arm": 0.3, "hand": 0.1}) == 9
    logic = model.rates.carry(((arm < 10) & (hand < 10)) * hand)  # true all the way
    assert_motion_law(model, [logic], seed=5)


# -- what is kept and what is refused --------------------------------------------------------------------------


def test_integrate_moves_free_coordinates_linearly_and_keeps_others() -> None:
    model = with_arm("omni")
    state = kv.State({**dict.fromkeys(model.degrees_of_freedom, 0.25), kv.position("elsewhere"): 7.0})
    after = model.integrate(state, {"arm:velocity": 2.0, kv.velocity("base/x"): -1.0}, 0.5)
    assert after["arm"] == 1.25
    assert after["base/x"] == -0.25
    assert {s for s in state if after[s] != state[s]} == {kv.position("arm"), kv.position("base/x")}
    assert state["arm"] == 0.25
    assert after["elsewhere"] == 7


def test_time_goes_on() -> None:
    model = with_arm("differential")
    start = model.default_state().updated({}, stamp=12.0)
    assert model.integrate(start, {"base/left_wheel:velocity": 1.0}, 0.5).stamp == 12.5
    assert model.integrate(model.default_state(), {}, 0.5).stamp is None


def test_integrate_at_zero_speed_keeps_the_state() -> None:
    model = model_of(rates={x: {u: 1 / y}, y: {v: 1.0}})
    state = {x: 1.0, y: 0.0}
    assert dict(model.integrate(state, {}, 5.0)) == state
    assert dict(model.integrate(state, {u: 0.0}, 5.0)) == state


@pytest.mark.parametrize("dt", [math.nan, math.inf, -math.inf])
def test_time_is_finite(dt: float) -> None:
    with pytest.raises(InvalidValueError, match="finite number of seconds"):
        with_arm("omni").integrate(kv.State({}), {}, dt)


@pytest.mark.parametrize("speed", [math.nan, math.inf])
def test_speeds_are_finite(speed: float) -> None:
    model = with_arm("differential")
    with pytest.raises(InvalidValueError, match=r"arm:velocity.*finite"):
        model.integrate(model.default_state(), {"arm:velocity": speed}, 1.0)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("base/left_whel:velocity", "'base/left_wheel:velocity'"),
        ("base/x:velocity", "base/left_wheel:velocity"),  # the wheels move it
        ("arm", "'arm:velocity'"),
    ],
)
def test_a_speed_that_moves_nothing_is_an_error_with_the_right_names(name: str, hint: str) -> None:
    model = with_arm("differential")
    with pytest.raises(UnknownNameError, match="Nothing moves with") as info:
        model.integrate(model.default_state(), {name: 1.0}, 1.0)
    assert hint in str(info.value)


def test_a_coordinate_without_a_value_is_named() -> None:
    model = with_arm("differential")
    state = {s: n for s, n in model.default_state().items() if str(s) != "base/angle"}
    with pytest.raises(UnknownNameError, match="base/angle"):
        model.integrate(state, {"base/left_wheel:velocity": 1.0}, 1.0)
    state = {s: n for s, n in model.default_state().items() if str(s) != "arm"}
    with pytest.raises(UnknownNameError, match="arm"):
        model.integrate(state, {"arm:velocity": 1.0}, 1.0)


@pytest.mark.parametrize(
    ("row", "start", "dt"),
    [
        (x * x, 1.0, 2.0),
        (1 / x, -0.5, -2.0),
        (np.sqrt(1 - x), 0.9, 2.0),
        (np.exp(x), 0.0, 2.0),
        (x * x, -1.0, -2.0),
    ],
    ids=str,
)
def test_integrate_refuses_diverging_coordinates(row: kv.Expression, start: float, dt: float) -> None:
    model = model_of(rates={x: {u: row}})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InvalidValueError, match="x cannot be followed for"):
            model.integrate({x: start}, {u: 1.0}, dt)
