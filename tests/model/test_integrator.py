"""The integrator of loops goes where ``model.integrate`` goes, for any layout of its vectors."""

from __future__ import annotations

import math

import numpy as np
import pytest
from random_models import random_speeds, random_state, random_tree

import kineverse as kv
from kineverse.errors import (
    DuplicateNameError,
    ExpressionError,
    InvalidValueError,
    ShapeError,
    UnknownNameError,
)

u = kv.velocity("u")


def driven(row: kv.Expression, *, free: str = "z") -> kv.Model:
    """Return a model with x driven by u, and a free coordinate."""
    model = kv.Model()
    with model.edit() as edit:
        edit.set_rate(kv.position("x"), {u: row})
        edit.add_frame("seen", "world", kv.translation(kv.position("x"), kv.position(free), 0))
    return model


@pytest.fixture(scope="module")
def diff_drive() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="base", parent="world", child="base", radius=0.2, track=0.5
            )
        )
        edit.apply(kv.Revolute(name="arm", parent="base", child="arm", axis=(0, 1, 0)))
    return model


@pytest.mark.parametrize("seed", range(3))
def test_vectors_go_where_states_go_and_rows_of_a_batch_too(seed: int) -> None:
    model = random_tree(seed, 9)
    integrator = model.integrator()
    assert integrator.symbols == model.symbols
    assert integrator.speeds == model.speeds
    starts, speeds = [], []
    for k in range(4):
        state, given = random_state(model, 10 * seed + k), random_speeds(model, 10 * seed + k)
        q = np.array([state[s] for s in integrator.symbols])
        v = np.array([given[s] for s in integrator.speeds])
        for dt in (0.0, 0.02, -0.7, 3.0):
            after = model.integrate(state, given, dt)
            np.testing.assert_allclose(
                integrator(q, v, dt), [after[s] for s in integrator.symbols], rtol=0, atol=1e-12
            )
        starts.append(q)
        speeds.append(v)
    q, v = np.array(starts), np.array(speeds)
    for dt in (0.02, 3.0):
        expected = [integrator(*pair, dt) for pair in zip(q, v, strict=True)]
        np.testing.assert_allclose(integrator.batch(q, v, dt), expected, rtol=0, atol=1e-13)
    times = np.array([0.1, 0.2, -0.3, 2.0])
    expected = [integrator(q[0], v[0], dt) for dt in times]
    np.testing.assert_allclose(integrator.batch(q[0], v[0], times), expected, rtol=0, atol=1e-13)


def test_a_subset_moves_and_the_rest_stays(diff_drive: kv.Model) -> None:
    whole = diff_drive.integrator()
    q = np.random.default_rng(0).uniform(-1, 1, len(whole.symbols))
    symbols, wheel = whole.symbols[::-1], diff_drive.symbol("base/right_wheel:velocity")
    part = diff_drive.integrator([wheel], symbols)
    assert part.symbols == symbols
    assert set(map(str, part.moving)) == {"base/x", "base/y", "base/angle"}
    v = np.where([s == wheel for s in whole.speeds], 0.8, 0.0)
    np.testing.assert_allclose(part(q[::-1], [0.8], 0.3)[::-1], whole(q, v, 0.3), rtol=0, atol=1e-15)
    arm = diff_drive.symbol("arm")
    assert diff_drive.integrator([arm.derivative()], [arm])([0.25], [2.0], 0.5) == 1.25
    heading = diff_drive.symbol("base/angle")
    np.testing.assert_allclose(diff_drive.integrator([wheel], [heading])([0.0], [1.0], 1.0), [0.4])


def test_the_result_is_new_or_in_the_given_array(diff_drive: kv.Model) -> None:
    integrator = diff_drive.integrator()
    q, v = np.full(4, 0.2), np.array([0.5, 1.0, -1.0])
    start, after = q.copy(), integrator(q, v, 0.1)
    np.testing.assert_array_equal(q, start)
    assert integrator(q, v, 0.1) is not after
    assert integrator(q, v, 0.1, out=q) is q
    np.testing.assert_array_equal(q, after)
    np.testing.assert_array_equal(integrator(list(start), tuple(v), 0.1), after)


def test_a_step_of_a_second_is_a_retraction_of_the_floating_base() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="base", parent="world", child="base"))
    integrator, home = model.integrator(), model.default_state()
    q = np.array([home[s] for s in integrator.symbols])
    for turn in (1e-3, 0.5, 3.0, 30.0):
        v = np.array([turn if str(s) == "base/wz:velocity" else 0.0 for s in integrator.speeds])
        after = dict(zip(map(str, integrator.symbols), integrator(q, v, 1.0), strict=True))
        assert after["base/qz"] == pytest.approx(math.sin(turn / 2), abs=1e-11)
        assert after["base/qw"] == pytest.approx(math.cos(turn / 2), abs=1e-11)


def test_parameters_have_the_value_of_the_vector_or_their_own() -> None:
    radius = kv.parameter("radius", 0.5)
    model = driven(radius * np.cos(kv.position("x")))
    assert radius in model.symbols
    x = kv.position("x")
    own = model.integrator([u], [x])([0.0], [1.0], 0.4)
    given = model.integrator([u], [radius, x])
    np.testing.assert_allclose(given([0.5, 0.0], [1.0], 0.4)[1:], own, rtol=0, atol=1e-15)
    np.testing.assert_allclose(given([1.0, 0.0], [1.0], 0.4)[1], math.asin(math.tanh(0.4)), atol=1e-13)


def test_vectors_of_other_sizes_are_refused(diff_drive: kv.Model) -> None:
    integrator = diff_drive.integrator()
    with pytest.raises(ShapeError, match=r"has 4 coordinates.*\(3,\)"):
        integrator(np.zeros(3), np.zeros(3), 0.1)
    with pytest.raises(ShapeError, match="3 speeds"):
        integrator(np.zeros(4), np.zeros((1, 3)), 0.1)
    with pytest.raises(ShapeError, match="vector of numbers"):
        integrator(np.zeros(4), "fast", 0.1)  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match=r"\(N, 4\)"):
        integrator.batch(np.zeros((2, 3)), np.zeros((2, 3)), 0.1)
    with pytest.raises(ShapeError, match="different lengths"):
        integrator.batch(np.zeros((2, 4)), np.zeros((3, 3)), 0.1)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_is_named(diff_drive: kv.Model, bad: float) -> None:
    integrator = diff_drive.integrator()
    q, v = np.zeros(4), np.zeros(3)
    with pytest.raises(InvalidValueError, match="speed 'arm:velocity'"):
        integrator(q, np.array([bad, 0, 0]), 0.1)
    with pytest.raises(InvalidValueError, match="value 'base/y'"):
        integrator(np.array([0, 0, 0, bad]), v, 0.1)
    with pytest.raises(InvalidValueError, match="finite number of seconds"):
        integrator(q, v, bad)
    with pytest.raises(InvalidValueError, match="value 'base/y'"):
        integrator.batch(np.array([[0, 0, 0, 0], [0, 0, 0, bad]]), v, 0.1)


def test_what_runs_away_is_refused() -> None:
    x = kv.position("x")
    model = driven(x * x)
    integrator = model.integrator([u], [x])
    with pytest.raises(InvalidValueError, match="x cannot be followed for 2 s"):
        integrator([1.0], [1.0], 2.0)
    assert integrator([1.0], [1.0], 0.5) == pytest.approx(2.0, abs=1e-11)
    free = model.integrator([kv.velocity("z")], [kv.position("z")])
    with pytest.raises(InvalidValueError, match="'z' runs to inf"):
        free([1e308], [1e308], 10.0)


def test_layouts_that_cannot_be_are_refused(diff_drive: kv.Model) -> None:
    x, wheel = diff_drive.symbol("base/x"), diff_drive.symbol("base/left_wheel:velocity")
    arm = diff_drive.symbol("arm")
    with pytest.raises(UnknownNameError, match="depends on 'base/angle'"):
        diff_drive.integrator([wheel], [x])
    with pytest.raises(UnknownNameError, match="moves none"):
        diff_drive.integrator([wheel], [arm])
    with pytest.raises(UnknownNameError, match="no speed 'base/x:velocity'"):
        diff_drive.integrator([x.derivative()])
    with pytest.raises(UnknownNameError, match="no symbol 'elsewhere'"):
        diff_drive.integrator(symbols=[kv.position("elsewhere")])
    with pytest.raises(DuplicateNameError):
        diff_drive.integrator([arm.derivative()], [arm, arm])
    with pytest.raises(ExpressionError):
        diff_drive.integrator("arm")  # type: ignore[arg-type]


def test_edits_leave_an_integrator_as_it_was(diff_drive: kv.Model) -> None:
    model = diff_drive.copy()
    integrator = model.integrator()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="second", parent="arm", child="second", axis=(0, 1, 0)))
    assert len(integrator.symbols) == 4
    state = model.default_state()
    assert model.integrate(state, {"second:velocity": 1.0}, 0.5)["second"] == 0.5
    with model.edit() as edit:
        edit.remove("joint second")
    with pytest.raises(UnknownNameError, match="Nothing moves with"):
        model.integrate(state, {"second:velocity": 1.0}, 0.5)


def test_a_model_at_rest_has_an_integrator() -> None:
    integrator = kv.Model().integrator()
    assert integrator([], [], 1.0).shape == (0,)
    assert integrator.batch(np.zeros((3, 0)), np.zeros((3, 0)), 1.0).shape == (3, 0)
