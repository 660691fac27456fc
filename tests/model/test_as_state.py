"""Values that are given to a model: a state may know more than is asked, a plain mapping may not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import kineverse as kv
from kineverse.estimation import Tracker
from kineverse.geometry import Scene
from kineverse.view.poses import complete

a, b = kv.position("kitchen/a"), kv.position("kitchen/b")
SIZE = kv.parameter("kitchen/size", 2.0)


def kitchen() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("kitchen/door", "world", kv.rotation_z(a))
        edit.add_frame("kitchen/drawer", "world", kv.translation(b * SIZE, 0, 0))
        edit.constrain("kitchen/a/range", 0, a, 1.5 + 0 * b)
        edit.constrain("kitchen/b/speed", -1, b.derivative(), 1)
    return model


TAKERS: dict[str, Callable[[kv.Model, Any], Any]] = {
    "violations": lambda m, v: m.violations(v),
    "limits": lambda m, v: m.limits("kitchen/a", v),
    "integrate": lambda m, v: m.integrate(v, {"kitchen/a:velocity": 1.0}, 0.1),
    "a scene": lambda m, v: Scene(m).update(v),
    "a picture": complete,
}


@pytest.mark.parametrize("taker", TAKERS)
def test_a_plain_mapping_has_names_of_the_model_only(taker: str) -> None:
    model, take = kitchen(), TAKERS[taker]
    state = model.default_state()
    take(model, state)
    take(model, dict(state))
    take(model, {str(symbol): value for symbol, value in state.items()})
    take(model, state.extended({"elsewhere": 1.0}))
    for name in ("door", kv.position("door"), "kitchen/c"):
        with pytest.raises(kv.errors.UnknownNameError):
            take(model, {**state, name: 1.0})
    with pytest.raises(kv.errors.DuplicateNameError) as error:
        take(model, {**state, "kitchen/a": 1.0})
    assert str(error.value) == (
        "There are two values for 'kitchen/a', by symbol and by name. Instead of {**state, 'kitchen/a': ...} "
        "write state.updated({'kitchen/a': ...})."
    )


def test_speeds_and_estimates() -> None:
    model = kitchen()
    state = model.default_state()
    fast = state.extended({"kitchen/a:velocity": 0.5, "elsewhere:velocity": 1.0})
    assert model.integrate(state, fast, 2.0)["kitchen/a"] == 1.0
    with pytest.raises(kv.errors.UnknownNameError, match="Nothing moves with 'elsewhere:velocity'"):
        model.integrate(state, {"elsewhere:velocity": 1.0}, 2.0)
    with pytest.raises(kv.errors.DuplicateNameError, match="There are two values for 'kitchen/a:velocity'"):
        model.integrate(state, {"kitchen/a:velocity": 1.0, a.derivative(): 2.0}, 2.0)
    tracker = Tracker(model, "kitchen/drawer", inputs="kitchen/a", start={"kitchen/b": 0.2})
    assert list(map(str, tracker.symbols)) == ["kitchen/b"]
    with pytest.raises(kv.errors.UnknownNameError, match="'drawer' is not estimated"):
        Tracker(model, "kitchen/drawer", start={"drawer": 0.2})


def test_a_parameter_by_name_in_a_state() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("slide", "world", kv.translation(a * SIZE, 0, 0))
        edit.constrain("near", 0, a * SIZE, 7)
        edit.set_rate(a, {kv.velocity("motor"): SIZE})
    named = {"kitchen/a": 3.0, "kitchen/size": 5.0}
    for values in (named, kv.State(named), kv.State({a: 3.0, SIZE: 5.0})):
        assert model.fk("slide")(values)[0, 3] == kv.compile(model.fk("slide"))(values)[0, 3] == 15
        assert [v.value for v in model.violations(values)] == [15]
        assert model.integrate(values, {"motor:velocity": 1.0}, 1.0)["kitchen/a"] == pytest.approx(8)
    another = kv.State({a: 3.0, kv.parameter("kitchen/size", 9.0): 5.0})  # which has the name by chance
    assert [v.value for v in model.violations(another)] == []
    assert kv.compile(a * SIZE)(another) == 6


def test_a_constraint_on_a_speed_alone() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("a/speed", -1, a.derivative(), 1)
    state = model.default_state()
    found = model.violations(dict(state))
    assert (list(found), found.unchecked) == ([], ("a/speed",))
    found = model.violations(dict(state.extended({"kitchen/a:velocity": 3.0})))
    assert [(v.name, v.excess) for v in found] == [("a/speed", 2.0)]


def test_a_state_is_a_vector_in_the_order_of_inputs() -> None:
    state = kv.State({b: 2.0, a: 1.0, "elsewhere": 9.0})
    f = kv.compile(a - 3 * b * SIZE, [b, SIZE, a], tier="interpreter")
    np.testing.assert_array_equal(state.vector(f.inputs), [2, 2, 1])
    np.testing.assert_array_equal(state.vector([a, b]), [1, 2])
    np.testing.assert_array_equal(state.extended({"kitchen/size": 4.0}).vector(f.inputs), [2, 4, 1])
    assert f(state) == f(state.vector(f.inputs)) == -11
    assert state.vector([]).shape == (0,)
    with pytest.raises(kv.errors.UnknownNameError, match=r"No value is given for 'kitchen/a:velocity'\."):
        state.vector([a, a.derivative()])
    with pytest.raises(kv.errors.UnknownNameError, match="Not among the inputs: 'elsewhere'"):
        f(dict(state))


def test_as_state_accepts_the_default_state_of_shipped_models() -> None:
    for name in ("kitchen", "fetch"):
        model = kv.load(name)
        state = model.default_state()
        assert model.violations(dict(state)) == model.violations(state)
        assert model.integrate(dict(state), {}, 1.0) == kv.State(dict(state))


def test_rates_by_name() -> None:
    rates, x = kv.load("fetch").rates, kv.position("fetch/base/x")
    assert rates["fetch/base/x"] == rates[x] == rates.get("fetch/base/x") == rates.get(x)
    assert "fetch/base/x" in rates
    assert "fetch/base/z" not in rates
    assert rates.get("fetch/base/z") is None
    with pytest.raises(kv.errors.UnknownNameError) as error:
        rates["base/x"]
    assert str(error.value) == (
        "There is no rate 'base/x'; a coordinate without one moves freely, by its own speed. Did you mean "
        "'fetch/base/x'?"
    )
    with pytest.raises(kv.errors.UnknownNameError, match="'a' has no row: every coordinate moves freely"):
        kitchen().rates["a"]


def test_a_frame_stands_for_its_pose() -> None:
    model = kitchen()
    by_pose = model.constraints_for(model.fk("kitchen/drawer"))
    assert model.constraints_for("kitchen/drawer") == by_pose == model.constraints_for(["kitchen/drawer"])
    assert list(by_pose) == ["kitchen/b/speed"]
    assert model.velocity_rows(0.1, subject="kitchen/drawer").names == ("kitchen/b/speed",)
    with pytest.raises(kv.errors.UnknownNameError) as error:
        model.constraints_for("kitchen/a")
    assert str(error.value) == (
        "There is no frame 'kitchen/a', and the text stands for one. For the symbol of that name pass "
        "model.symbol('kitchen/a')."
    )
    with pytest.raises(
        kv.errors.UnknownNameError, match=r"There is no frame 'kitchen/dor'\. Did you mean 'kitchen/door'"
    ):
        model.velocity_rows(0.1, subject="kitchen/dor")
    for ask in (
        lambda: model.jacobian("kitchen/door", symbols="kitchen/a"),
        lambda: model.listen(print, symbols="kitchen/a"),
        lambda: model.velocity_rows(0.1, speeds="kitchen/a"),
    ):
        with pytest.raises(kv.errors.ExpressionError) as wrong:
            ask()
        assert str(wrong.value) == (
            "A sequence of symbols is wanted, not the text 'kitchen/a': [model.symbol('kitchen/a')]."
        )


def test_limits_stop_no_integration_unless_asked() -> None:
    model = kitchen()
    state = model.default_state()
    fast = {"kitchen/a:velocity": 100.0, "kitchen/b:velocity": 1.0}
    after = model.integrate(state, fast, 1.0)
    assert (after["kitchen/a"], after["kitchen/b"]) == (100.0, 1.0)
    assert [v.name for v in model.violations(after)] == ["kitchen/a/range"]
    clipped = model.integrate(state, fast, 1.0, clip=True)
    assert (clipped["kitchen/a"], clipped["kitchen/b"]) == (1.5, 1.0)
    assert model.integrate(state, {"kitchen/a:velocity": -1.0}, 1.0, clip=True)["kitchen/a"] == 0.0
    assert not model.violations(clipped)
    inside = {"kitchen/a:velocity": 0.5}
    assert model.integrate(state, inside, 1.0, clip=True) == model.integrate(state, inside, 1.0)


def test_no_default_state_is_silently_not_finite() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.Revolute(name="door", parent="world", child="door", lower=kv.parameter("least", float("inf")))
        )
    with pytest.raises(kv.errors.InvalidValueError) as error:
        model.default_state()
    assert str(error.value) == (
        "The default of 'least' is inf, which is not finite: that is its value as a parameter. Give it a finite "
        "home, limits or value."
    )
    with model.edit() as edit:
        least = kv.where(kv.position("x") > 1, 0.0, float("inf"))
        edit.replace("joint door", kv.Revolute(name="door", parent="world", child="door", lower=least))
    with pytest.raises(kv.errors.InvalidValueError) as error:
        model.default_state()
    assert str(error.value) == (
        "The default of 'door' is inf, which is not finite: it follows from articulations/door, "
        "constraints/door/position, written by 'joint door'. Give it a finite home, limits or value."
    )


@pytest.mark.parametrize(
    ("home", "message"),
    [
        (
            (0.0,) * 7,
            "The home of the articulation 'float' has the quaternion 0 0 0 0, which is no orientation; ",
        ),
        (
            (0.0,) * 6 + (float("nan"),),
            "The home of the articulation 'float' is finite, and not nan for 'float/qw'.",
        ),
        (
            (float("-inf"), *(0.0,) * 6),
            "The home of the articulation 'float' is finite, and not -inf for 'float/x'.",
        ),
    ],
)
def test_homes_without_a_pose(home: tuple[float, ...], message: str) -> None:
    from kineverse.model.basic_operations import SetHome

    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="float", parent="world", child="float"))
    with pytest.raises(kv.errors.InvalidValueError) as error, model.edit() as edit:
        edit.apply(SetHome("float", home))
    assert str(error.value).startswith(message)


def test_rows_of_coordinates_by_name() -> None:
    fetch = kv.load("fetch")
    assert fetch.rates.row("fetch/base/x") == fetch.rates["fetch/base/x"]
    assert fetch.rates.row("fetch/torso_lift_joint") is None


def test_a_listener_that_could_never_hear() -> None:
    model = kitchen()
    with pytest.raises(
        kv.errors.UnknownNameError, match=r"^'kitchen/door' is not a path into a model; it begins with"
    ):
        model.listen(print, paths=["kitchen/door"])
    with pytest.raises(kv.errors.UnknownNameError, match=r"^5 is not a path into a model"):
        model.history.readers(5)  # type: ignore[arg-type]
    with pytest.raises(
        kv.errors.ExpressionError, match=r"^A listener is called with a diff, and 5 cannot be called"
    ):
        model.listen(5)  # type: ignore[arg-type]
    heard: list[kv.model.Diff] = []
    with model.listen(heard.append, paths="frames"), model.edit() as edit:
        edit.add_frame("lamp", "world")
    assert len(heard) == 1
