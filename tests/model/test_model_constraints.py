"""Constraints: what they accept, which matter for what, which are broken, and where to start from."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import kineverse as kv
from kineverse.articulations import position_lock, speed_lock
from kineverse.expressions.expression import as_expression
from kineverse.model.constraint import Constraint, as_constraint

a, b, c, d = (kv.position(n) for n in "abcd")
INF = math.inf


def constrained(**triples: Any) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        for name, triple in triples.items():
            edit.constrain(name, *triple)
    return model


# -- one constraint ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("triple", "error", "words"),
    [
        ((0, kv.array([a, b]), 1), kv.errors.ShapeError, "scalar"),
        (([0, 1], a, 1), kv.errors.ShapeError, "lower bound"),
        ((0, a, np.ones((2, 2))), kv.errors.ShapeError, "upper bound"),
        ((0, 0.5, 1), kv.errors.InvalidValueError, "depends on no symbol"),
        ((0, kv.Expression(1) * 2, a), kv.errors.InvalidValueError, "lower, expression, upper"),
        ((1, a, 0), kv.errors.InvalidValueError, "No value lies between"),
        ((INF, a, INF), kv.errors.InvalidValueError, "No value lies between"),
        ((-INF, a, -INF), kv.errors.InvalidValueError, "No value lies between"),
        ((float("nan"), a, 1), kv.errors.InvalidValueError, "NaN"),
        ((0, a, float("nan")), kv.errors.InvalidValueError, "NaN"),
        (("zero", a, 1), kv.KineverseError, None),
        ((None, a, 1), kv.KineverseError, None),
    ],
)
def test_invalid_constraints_are_refused(triple: Any, error: type[Exception], words: str | None) -> None:
    with pytest.raises(error, match=words):
        kv.Constraint.from_expressions(*triple)
    model = constrained(known=(0, a, 1))
    before = model.snapshot()
    with pytest.raises(error), model.edit() as edit:
        edit.constrain("wrong", *triple)
    assert model.snapshot() == before


@pytest.mark.parametrize("value", [a, (0, a), (0, a, 1, 2), 3, None])
def test_constraints_that_are_no_triples_are_refused(value: Any) -> None:
    with pytest.raises(kv.KineverseError):
        as_constraint(value)


def test_bounds_may_be_equal_infinite_or_expressions() -> None:
    for triple in ((1, a, 1), (-INF, a, INF), (b, a, 0), (0, a, -b), (b, a, b)):
        constraint = kv.Constraint.from_expressions(*triple)
        assert as_constraint(constraint) is constraint
        assert as_constraint(list(triple)) == constraint
    assert kv.Constraint.from_expressions(b, a.derivative(), c).symbols == (a.derivative(), b, c)
    assert kv.Constraint.from_expressions(0, a.derivative() + b, 1).order == 1


def test_a_constraint_made_of_bare_numbers_is_made_whole() -> None:
    class Bare(kv.Operation):
        def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
            return kv.model.Writes(constraints={"c": kv.Constraint(0, a, 1)})

    model = kv.Model()
    with model.edit() as edit:
        edit.apply(Bare())
    assert model.constraints["c"] == kv.Constraint.from_expressions(0, a, 1)


# -- relevance -----------------------------------------------------------------------------------------

LIMITS: dict[str, Any] = {
    "a": (0, a, 1),
    "a_speed": (-1, a.derivative(), 1),
    "a_jerk": (-1, kv.symbols.symbol("a", 3), 1),
    "b": (0, b, c),
    "ab": (0, a + b, 1),
    "c_lock": (-d, c.derivative(), d),
    "d": (0, d, 1),
}


def names(model: kv.Model, subject: Any, **options: bool) -> list[str]:
    return list(model.constraints_for(subject, **options))


def test_constraints_for_compares_coordinates_of_any_order() -> None:
    model, about_a = constrained(**LIMITS), ["a", "a_jerk", "a_speed", "ab"]
    assert (
        names(model, a)
        == names(model, [a])
        == names(model, a.derivative())
        == names(model, 2 * np.sin(a))
        == about_a
    )
    assert names(model, [b, kv.position("nobody")]) == ["ab", "b"]
    assert names(model, kv.Expression(1.0)) == names(model, []) == []
    assert names(model, d.augment({c.derivative(): 1})) == ["c_lock", "d"]
    assert names(model, d.with_gradient({a.derivative(): 1})) == [*about_a, "d"]
    assert model.constraints_for([a]) == {name: model.constraints[name] for name in about_a}


def test_the_formula_of_the_papers() -> None:
    model = constrained(**LIMITS)
    assert names(model, a, exact=True) == ["a", "ab"]
    assert names(model, [a.derivative()], exact=True) == ["a_speed"]
    assert names(model, d.augment({c.derivative(): 1}), exact=True) == ["d"]
    assert names(model, d, exact=True, bounds=True) == ["c_lock", "d"]
    assert names(model, a, exact=True, closure=True) == ["a", "ab", "b"]
    assert names(model, d, exact=True, bounds=True, closure=True) == ["c_lock", "d"]


def test_bounds_and_closures() -> None:
    model = constrained(**LIMITS)
    assert names(model, c) == ["c_lock"]
    assert names(model, c, bounds=True) == ["b", "c_lock"]
    assert names(model, a, closure=True) == ["a", "a_jerk", "a_speed", "ab", "b"]
    assert names(model, d, bounds=True) == ["c_lock", "d"]
    assert names(model, a, bounds=True, closure=True) == sorted(LIMITS)


def test_wheels_from_a_gripper_and_a_lock_from_a_pose() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="base", parent="world", child="base", radius=0.1, track=0.5, wheel_speed=4
            )
        )
        edit.apply(
            kv.Revolute(
                name="arm", parent="base", child="gripper", axis=(0, 1, 0), lower=-1, upper=1, velocity=2
            )
        )
        edit.apply(kv.Revolute(name="door", parent="world", child="door", axis=(0, 0, 1), lower=0, upper=1))
        edit.constrain("lock", -b, kv.velocity("door"), b)
    expected = ["arm/position", "arm/velocity", "base/left_wheel_speed", "base/right_wheel_speed"]
    assert names(model, model.fk("gripper")) == expected
    assert names(model, model.fk("gripper")[0, 0]) == expected
    assert names(model, model.fk("gripper"), exact=True) == ["arm/position"]
    assert names(model, model.fk("door")) == ["door/position", "lock"]


def test_relevance_follows_edits() -> None:
    model = constrained(**LIMITS)
    names(model, a)
    with model.edit() as edit:
        edit.remove("constraint ab")
        edit.remove("constraint b")
        assert names(model, b) == []
    assert names(model, a) == ["a", "a_jerk", "a_speed"]
    assert names(model, c, bounds=True) == ["c_lock"]
    with pytest.raises(ZeroDivisionError), model.edit() as edit:
        edit.constrain("more", 0, a, 2)
        assert names(model, a) == ["a", "a_jerk", "a_speed", "more"]
        raise ZeroDivisionError
    assert names(model, a) == ["a", "a_jerk", "a_speed"]


@pytest.mark.parametrize("subject", ["a", ["a"], [1.0], None, 3])
def test_wrong_subjects(subject: Any) -> None:
    with pytest.raises(kv.KineverseError):
        constrained(**LIMITS).constraints_for(subject)


# -- violations ----------------------------------------------------------------------------------------


def test_violations_are_sorted_by_excess() -> None:
    model = constrained(a=(0, a, 1), b=(-2, b, a), unbounded=(-INF, b, INF))
    found = model.violations({"a": 1.25, "b": -7})
    assert [tuple(v) for v in found] == [("b", -7, -2, 1.25, 5), ("a", 1.25, 0, 1, 0.25)]
    assert found[0].name == "b"
    assert found.unchecked == ()
    assert "b: -2 <= -7 <= 1.25 is off by 5" in repr(found)
    assert repr(model.violations({a: 0.5, b: 0})) == "none violated"
    assert list(model.violations({a: 1 + 1e-12, b: 0})) == []
    assert [v.name for v in model.violations({a: 1 + 1e-12, b: 0}, tolerance=0)] == ["a"]


def test_a_missing_position_is_an_error_a_missing_speed_is_not() -> None:
    model = constrained(
        ab=(0, a + b, 1), lock=(-b, a.derivative(), b), far=(0, d, 1), both=(0, a + c.derivative(), 1)
    )
    with pytest.raises(kv.errors.UnknownNameError, match="No value for 'b', which constraint 'ab'"):
        model.violations({"a": 0.5})
    found = model.violations({"a": 0.5, "b": 2.0})
    assert [v.name for v in found] == ["ab"]
    assert found.unchecked == ("lock", "far", "both")
    found = model.violations({"a": 0.5, "b": 0.25, "a:velocity": -1})
    assert [tuple(v) for v in found] == [("lock", -1, -0.25, 0.25, 0.75)]


def test_a_missing_position_is_reported_before_a_missing_speed() -> None:
    model = constrained(lock=(-b, a.derivative(), b), sum=(0, a + c.derivative(), 1), far=(0, d, 1))
    with pytest.raises(kv.errors.UnknownNameError, match="No value for 'a', which constraint 'sum'"):
        model.violations({"b": 1.0, "c:velocity": 0.5})
    with pytest.raises(kv.errors.UnknownNameError, match="No value for 'b', which constraint 'lock'"):
        model.violations(kv.State({"a": 1.0, "a:velocity": 0.5}))
    assert model.violations({"d": 0.5}).unchecked == ("lock", "sum")
    assert model.violations(model.default_state()).unchecked == ("lock", "sum")


def test_two_values_for_one_symbol_are_refused() -> None:
    width, narrow = kv.parameter("width", 0.5), kv.parameter("width", 0.25)
    model = constrained(a=(0, a, width))
    with pytest.raises(kv.errors.DuplicateNameError, match="two values for 'a'"):
        model.violations({a: 0.5, "a": 0.75})
    with pytest.raises(kv.errors.UnknownNameError, match="'width'"):
        model.violations({a: 0.5, narrow: 1.0})
    with model.edit() as edit:
        edit.constrain("narrow", 0, a, narrow)
    assert [v.excess for v in model.violations({a: 0.5, width: 1.0})] == [0.25]
    with pytest.raises(kv.errors.DuplicateNameError, match="Several symbols have the name 'width'"):
        model.violations({a: 0.5, "width": 1.0})


@pytest.mark.parametrize("values", [None, 3, [0.5], "a", {("a", 1)}])
def test_violations_refuses_values_that_are_no_mapping(values: Any) -> None:
    with pytest.raises(kv.errors.ExpressionError, match="mapping"):
        constrained(a=(0, a, 1)).violations(values)


def test_unknown_names_are_errors_in_mappings_and_not_in_states() -> None:
    model = constrained(a=(0, a, 1))
    with pytest.raises(kv.errors.UnknownNameError, match=r"Did you mean|Available"):
        model.violations({"aa": 3})
    with pytest.raises(kv.errors.UnknownNameError, match="default_state"):
        model.violations({})
    state = kv.State({"a": 3, "nobody": 1})
    assert [v.excess for v in model.violations(state)] == [2]
    assert model.violations(kv.State({"a:velocity": 1})).unchecked == ("a",)
    with pytest.raises(
        kv.errors.UnknownNameError, match=r"no value for anything in this model\. It knows 'nobody'"
    ):
        model.violations(kv.State({"nobody": 1}))
    with pytest.raises(kv.errors.InvalidValueError, match="NaN"):
        model.violations({"a": float("nan")})
    with pytest.raises(kv.errors.InvalidValueError, match="not a number"):
        model.violations({"a": "much"})


def test_parameters_have_their_own_values_unless_others_are_given() -> None:
    width = kv.parameter("width", 0.5)
    model = constrained(a=(0, a, width))
    assert [v.excess for v in model.violations({"a": 0.75})] == [0.25]
    assert list(model.violations({"a": 0.75, width: 1.0})) == []


def test_a_value_that_is_none_is_a_violation() -> None:
    model = constrained(root=(0, np.sqrt(a), 1))
    assert [v.name for v in model.violations({"a": -1})] == ["root"]


def test_violations_without_symbols_needs_no_values() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("post", "world", kv.translation(1, 0, 0))
    assert not model.violations({})


def test_violations_follow_edits_and_rates() -> None:
    model = constrained(a=(0, a, 1))
    assert len(model.violations({"a": 2})) == 1
    with model.edit() as edit:
        edit.constrain("tighter", 0, a, 0.5)
        assert len(model.violations({"a": 2})) == 2
        edit.remove("constraint a")
    assert [v.name for v in model.violations({"a": 2})] == ["tighter"]


# -- limits and the default state ----------------------------------------------------------------------


def test_limits_of_a_symbol_are_the_tightest() -> None:
    model = constrained(
        one=(-1, a, 3),
        two=(-5, a, 2),
        speed=(-4, a.derivative(), 4),
        twice=(0, 2 * b, 1),
        dependent=(b, c, 1 + b),
    )
    assert model.limits("a") == model.limits(a) == (-1, 2)
    assert model.limits("a:velocity") == (-4, 4)
    assert model.limits(b) == (-INF, INF)
    assert model.limits(c, {"b": 0}) == (0, 1)
    assert model.limits(c) == (0, 1.5)
    assert model.limits(c, {"b": 0.5}) == (0.5, 1.5)
    assert model.limits(c, kv.State({"b": 2.5, "z": 1})) == (2.5, 3.5)
    assert model.limits(c, {"a": 0}) == (-INF, INF)
    with pytest.raises(kv.errors.UnknownNameError, match="no symbol"):
        model.limits("aa")


@pytest.mark.parametrize(
    ("low", "high"),
    [
        (0, kv.where(b < 0.3, 0.0, 2.0)),
        (kv.where(b > 0.3, -1.0, -4 * a**2), 1 + b**2),
        (-1.5 * (b < 0.3), 1.5 * ((b < 0.3) | (a > 0.2))),
        (-np.exp(-b) + a, np.sin(3 * b) * a + 2),
        (-2, kv.spline(b, [0.0, 0.5, 1.0], [1.0, 3.0, 2.0])),
        (-kv.maximum(a, b - 1), kv.maximum(0.3 * a, 2 - b)),
        (kv.minimum(a, -b), kv.clip(a + b, 0.5, 2.5)),
    ],
)
def test_limits_at_any_state_are_within_those_at_all(low, high) -> None:
    model = constrained(a=(-1, a, 1), b=(-0.5, 2 * b, 4), c=(low, c, high))
    least, most = model.limits(c)
    states = [{"a": x, "b": y} for x, y in np.random.default_rng(0).uniform([-1, -0.25], [1, 2], (200, 2))]
    at = np.array([model.limits(c, state) for state in states])
    assert (at[:, 0] >= least).all()
    assert (at[:, 1] <= most).all()
    assert least > at[:, 0].min() - 1.0
    assert most < at[:, 1].max() + 1.0


@pytest.mark.parametrize("blocks", ["both", "forward", "backward"])
def test_limits_of_a_locked_coordinate_are_those_of_its_open_lock(blocks) -> None:
    model = constrained(
        a=(0, a, 1.5),
        b=(0, b, 1),
        shut=position_lock(a, open_if=b > 0.5, lower=0.0, upper=0.0),
        lock=speed_lock(a, open_if=b > 0.5, max_speed=2.0, blocks=blocks),
    )
    assert model.limits(a) == (0.0, 1.5)
    assert model.limits(a.derivative()) == (-2.0, 2.0)
    shut, opened = {"a": 0.0, "b": 0.0}, {"a": 0.0, "b": 1.0}
    assert model.limits(a, shut) == (0.0, 0.0)
    assert model.limits(a, opened) == (0.0, 1.5)
    assert model.limits(a.derivative(), shut) == (-2.0 * (blocks == "forward"), 2.0 * (blocks == "backward"))
    assert model.limits(a.derivative(), opened) == (-2.0, 2.0)


def test_limits_follow_parameters_dependent_coordinates_and_edits() -> None:
    p = kv.parameter("p", 0.25)
    model = constrained(a=(0, a, 2), c=(-p, c, p + a))
    assert model.limits(c) == (-0.25, 2.25)
    with model.edit() as edit:
        edit.constrain("tighter", 0, a, 1)
    assert model.limits(c) == (-0.25, 1.25)
    assert constrained(c=(0, c, d)).limits(c) == (0, INF)


def test_the_default_state_is_zero_within_limits() -> None:
    p = kv.parameter("p", 4.0)
    model = constrained(a=(0.5, a, 2), b=(-3, b, -1), c=(-1, c, 1), p=(0, d, p))
    state = model.default_state()
    assert dict(state) == {a: 0.5, b: -1, c: 0, d: 0, p: 4}
    assert not model.violations(state)


def test_the_default_state_keeps_limits_on_lines_over_one_symbol() -> None:
    # a joint that a follows backwards, one that is turned around, and one that has several such limits
    model = constrained(
        mimic=(-1, -2 * a + 3, 1),
        back=(1, -b, 2),
        one=(0.5, 4 * c, 9),
        two=(-INF, 2 - c, 1.5),
        free=(-INF, 3 * d, INF),
    )
    state = model.default_state()
    assert dict(state) == {a: 1, b: -1, c: 0.5, d: 0}
    assert not model.violations(state)
    about_others = constrained(a=(b, 2 * a - 1, 100), b=(3, -2 * b, 4))
    state = about_others.default_state()
    assert dict(state) == {a: 0, b: -1.5}
    assert constrained(a=(b, 2 * a, 100), b=(3, b, 4)).default_state()[a] == 1.5
    with about_others.edit() as edit:
        edit.remove("constraint b")
    assert dict(about_others.default_state()) == {a: 0.5, b: 0}


def test_other_limits_are_not_looked_at_by_the_default_state() -> None:
    p = kv.parameter("p", 2.0)
    model = constrained(
        sum=(1, a + b, 2), square=(1, c * c, 4), scaled=(1, p * d, 2), root=(1, np.sqrt(d + 1), 2)
    )
    assert dict(model.default_state()) == {a: 0, b: 0, c: 0, d: 0, p: 2}
    assert {v.name for v in model.violations(model.default_state())} == {"sum", "square", "scaled"}


def test_a_joint_that_follows_another_starts_within_its_limits(tmp_path: Any) -> None:
    limit = '<limit lower="{}" upper="{}" effort="1" velocity="1"/>'
    (tmp_path / "mimic.urdf").write_text(
        '<robot name="r"><link name="x"/><link name="y"/><link name="z"/>'
        '<joint name="j" type="revolute"><parent link="x"/><child link="y"/>'
        + limit.format(0, 2)
        + '</joint><joint name="k" type="revolute"><parent link="y"/><child link="z"/>'
        '<mimic joint="j" multiplier="-2" offset="3"/>' + limit.format(-1, 1) + "</joint></robot>"
    )
    model = kv.load(tmp_path / "mimic.urdf")
    assert model.default_state()["j"] == 1
    assert not model.violations(model.default_state())


def test_bounds_that_are_about_other_symbols_are_kept_too() -> None:
    # in the order of names, every bound looks at one that is clipped later
    model = constrained(a=(b + 1, a, 100), b=(c + 1, b, 100), c=(d, c, 100), d=(3, d, 9))
    state = model.default_state()
    assert dict(state) == {d: 3, c: 3, b: 4, a: 5}
    assert not model.violations(state)
    assert set(constrained(a=(b + 1, a, 100), b=(a + 1, b, 100)).default_state()) == {a, b}
    assert dict(constrained(a=(b.derivative(), a, 1)).default_state()) == {a: 0, b: 0}


def test_home_of_articulations() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="free", parent="world", child="free"))
        edit.apply(kv.Revolute(name="hinge", parent="free", child="hinge", lower=0.5, upper=1))
    state = model.default_state()
    assert {str(s): value for s, value in state.items()} == {
        "free/x": 0,
        "free/y": 0,
        "free/z": 0,
        "free/qx": 0,
        "free/qy": 0,
        "free/qz": 0,
        "free/qw": 1,
        "hinge": 0.5,
    }
    assert np.isfinite(model.fk("hinge")(state)).all()
    assert state.source == "default"


D, V = kv.position("d"), kv.velocity("v")
NEAR = D < 0.1


@pytest.mark.parametrize(
    "bound",
    [
        np.inf * NEAR,
        NEAR * np.inf,
        np.inf * (1 - NEAR) + 2,
        np.inf * (NEAR & (D > 0)),
        np.inf * D,
        kv.where(NEAR, np.inf * (D + 1), 3),
        np.maximum(np.inf * NEAR, 0),
        1e308 * 10 * NEAR,
    ],
    ids=str,
)
def test_bounds_that_are_infinity_times_nothing_are_refused_with_what_to_write(bound: kv.Expression) -> None:
    model = kv.Model()
    for lower, upper, side in ((-1, bound, "upper"), (-bound, 1, "lower")):
        with (
            pytest.raises(
                kv.errors.InvalidValueError, match=rf"(?s)The {side} bound .* kv\.where\(condition"
            ) as info,
            model.edit() as edit,
        ):
            edit.constrain("still", lower, V, upper)
        assert "infinity times something that can be 0" in str(info.value)
        with pytest.raises(kv.errors.InvalidValueError, match="infinity times"):
            as_constraint(Constraint(*map(as_expression, (lower, V, upper))))
        with pytest.raises(kv.errors.InvalidValueError, match="infinity times"):
            kv.control.Keep(lower, V, upper)


def test_a_bound_that_is_infinite_where_a_condition_holds_is_a_number_everywhere() -> None:
    model = kv.Model()
    free = kv.where(NEAR, np.inf, 0)  # eq. 10 and 11: v is 0 unless d is small
    with model.edit() as edit:
        edit.constrain("still", -free, V, free)
    assert not model.violations({"d": 0.0, "v:velocity": 7.0})
    assert [(v.lower, v.upper, v.excess) for v in model.violations({"d": 0.2, "v:velocity": 7.0})] == [
        (0, 0, 7)
    ]
    assert kv.formats.from_bytes(kv.formats.to_bytes(model)).constraints == model.constraints
