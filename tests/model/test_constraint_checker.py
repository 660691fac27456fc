"""The constraint checker of loops finds what ``model.violations`` finds."""

from __future__ import annotations

import math

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import DuplicateNameError, ShapeError

a, b = kv.position("a"), kv.position("b")


def constrained(**constraints: tuple[object, object, object]) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        for name, (lower, expression, upper) in constraints.items():
            edit.constrain(name, lower, expression, upper)
    return model


@pytest.fixture(scope="module")
def fetch() -> kv.Model:
    return kv.load("fetch")


def test_it_finds_the_violations_of_the_model(fetch: kv.Model) -> None:
    symbols = (*fetch.symbols, *fetch.speeds)
    checker = fetch.constraint_checker(symbols)
    assert set(checker.names) == set(fetch.constraints)
    assert checker.unchecked == ()
    rng = np.random.default_rng(0)
    for scale in (0.1, 1.0, 3.0):
        x = rng.normal(size=len(symbols)) * scale
        state = kv.State(dict(zip(symbols, x.tolist(), strict=True)))
        expected = fetch.violations(state)
        assert checker.violations(x) == expected
        assert checker.violations(x, 0.5) == fetch.violations(state, 0.5)
        largest = checker(x)
        assert largest == checker.excess.max()
        assert not expected or largest == expected[0].excess
        for i, name in enumerate(checker.names):
            c = fetch.constraints[name]
            numbers = [float(e(state)) for e in (c.lower, c.expression, c.upper)]
            np.testing.assert_allclose(
                [checker.lower[i], checker.values[i], checker.upper[i]], numbers, rtol=1e-14, atol=1e-14
            )
            assert checker.excess[i] == max(
                checker.lower[i] - checker.values[i], checker.values[i] - checker.upper[i]
            )


def test_speeds_are_checked_where_they_are_in_the_vector(fetch: kv.Model) -> None:
    home, checker = fetch.default_state(), fetch.constraint_checker()
    assert checker.symbols == fetch.symbols
    x = [home[s] for s in checker.symbols]
    found = checker.violations(x)
    assert found == fetch.violations(home)
    assert set(found.unchecked) == set(fetch.violations(home).unchecked) == set(checker.unchecked)
    assert set(checker.names) | set(checker.unchecked) == set(fetch.constraints)
    assert checker(x) <= 0


def test_numbers_that_are_none_violate() -> None:
    root = np.sqrt(a)
    model = constrained(value=(-1, root, 1), low=(root - 9, b, 9), high=(-9, b, root + 9), fine=(-9, b, 9))
    checker = model.constraint_checker()
    assert checker([1.0, 0.0]) == 0
    assert math.isnan(checker([-1.0, 0.0]))
    assert [v.name for v in checker.violations([-1.0, 0.0])] == ["high", "low", "value"]
    assert checker.violations([-1.0, 0.0]).__repr__() == repr(model.violations({"a": -1.0, "b": 0.0}))
    assert math.isnan(checker([math.nan, 0.0]))


def test_infinite_values_are_no_missing_ones() -> None:
    model = constrained(one=(-1, a, math.inf), other=(-math.inf, b, 1), neither=(-math.inf, a, math.inf))
    checker = model.constraint_checker()
    assert checker([math.inf, -math.inf]) == -math.inf
    assert checker([-math.inf, -math.inf]) == math.inf
    assert checker([0.0, 3.0]) == 2
    assert [v.name for v in checker.violations([-math.inf, math.inf])] == ["one", "other"]
    assert math.isnan(checker([math.nan, 0.0]))


def test_a_loop_out_of_reach_is_listed_by_its_name() -> None:
    model = kv.Model()
    with model.edit() as edit:
        for name, parent, x in (("crank", "world", 0.0), ("coupler", "crank", 1.0), ("rocker", "world", 2.5)):
            origin = kv.model.Pose.from_matrix(kv.translation(x, 0, 0))
            ends = {"lower": -0.5, "upper": 0.5} if name == "crank" else {"lower": -9, "upper": 9}
            edit.apply(
                kv.Revolute(name=name, parent=parent, child=name, origin=origin, axis=(0, 0, 1), **ends)
            )
        for name in ("coupler", "rocker"):
            edit.add_frame(f"{name} end", name, kv.translation(1.0, 0, 0))
        home = (("coupler", 1.0), ("rocker", 2.0))
        edit.apply(kv.loops.CloseLoop(name="bar", frame="coupler end", to="rocker end", home=home))
    checker = model.constraint_checker()
    assert not checker.violations([0.1])
    assert math.isnan(checker([math.pi]))
    found, expected = checker.violations([math.pi]), model.violations({"crank": math.pi})
    assert [v.name for v in found] == [v.name for v in expected]
    assert {"bar", "crank/position"} <= {v.name for v in found}


def test_parameters_have_the_value_of_the_vector_or_their_own() -> None:
    most = kv.parameter("most", 2.0)
    model = constrained(range=(0, a, most))
    assert model.constraint_checker([a])([3.0]) == 1
    assert model.constraint_checker([most, a])([2.5, 3.0]) == 0.5


def test_symbols_of_one_name_have_values_of_their_own() -> None:
    short, long = kv.parameter("width", 1.0), kv.parameter("width", 2.0)
    checker = constrained(short=(0, a, short), long=(0, b, long)).constraint_checker([a, short, b, long])
    assert checker([1.5, 1.0, 1.5, 2.0]) == 0.5
    assert checker([1.5, 1.0, 3.5, 2.0]) == 1.5


def test_a_model_without_constraints_is_content() -> None:
    checker = kv.Model().constraint_checker()
    assert checker([]) == -math.inf
    assert not checker.violations([])


def test_vectors_and_layouts_that_do_not_fit_are_refused() -> None:
    model = constrained(range=(0, a, 1))
    with pytest.raises(ShapeError):
        model.constraint_checker()([1.0, 2.0])
    with pytest.raises(DuplicateNameError):
        model.constraint_checker([a, a])


def test_an_edit_of_a_constraint_is_seen_by_the_plain_method() -> None:
    model = constrained(range=(0, a, 1))
    checker = model.constraint_checker()
    assert model.violations({"a": 2.0})[0].upper == 1
    with model.edit() as edit:
        edit.remove(model.history.writers("constraints/range")[0])
        edit.constrain("range", 0, a, 3)
    assert not model.violations({"a": 2.0})
    assert checker([2.0]) == 1


def test_a_coordinate_with_a_limit_of_its_speed_alone_is_known() -> None:
    model = constrained(speed=(-1, a.derivative(), 1))
    home = model.default_state()
    assert a in home
    for values in (home, dict(home), {"a": 0.0}):
        assert model.violations(values).unchecked == ("speed",)
    assert model.violations({"a:velocity": 3.0})[0].excess == 2


def test_rates_are_found_by_name(fetch: kv.Model) -> None:
    x = fetch.symbol("fetch/base/x")
    assert fetch.rates["fetch/base/x"] == fetch.rates[x]
    assert "fetch/base/x" in fetch.rates
    assert "fetch/torso_lift_joint" not in fetch.rates
