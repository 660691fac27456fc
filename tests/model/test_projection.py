"""Projection on equality constraints: they hold, limits hold, little moves; or an error says what does not.

The oracle of what is nearest is sequential quadratic programming of scipy.
"""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

import kineverse as kv
from hypothesis_profiles import attempts

Z = (0, 0, 1)


def bar(edit: kv.model.Edit, name: str, parent: str, x: float, length: float, **limits: float) -> None:
    hinge = kv.model.Pose.from_matrix(kv.translation(x, 0, 0))
    edit.apply(kv.Revolute(name=name, parent=parent, child=name, origin=hinge, axis=Z, **limits))
    edit.add_frame(f"{name}_end", name, kv.translation(length, 0, 0))


def four_bar(**limits: float) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "crank", "world", 0.0, 0.4, **limits)
        bar(edit, "coupler", "crank_end", 0.0, 1.1)
        bar(edit, "rocker", "world", 1.0, 0.9, lower=0.2, upper=2.2)
        edit.apply(kv.loops.LoopConstraint(name="four-bar", frame="coupler_end", to="rocker_end"))
    return model


def residual(model: kv.Model) -> kv.Function:
    equal = [c.expression for n, c in model.constraints.items() if n.startswith("four-bar/")]
    return kv.compile(kv.array(equal), model.degrees_of_freedom, tier="interpreter")


def vector(model: kv.Model, state: kv.State) -> np.ndarray:
    return np.array([state[s] for s in model.degrees_of_freedom])


MODEL = four_bar(lower=-1.0, upper=1.0)
angle = st.floats(-1.5, 1.5)


@settings(max_examples=attempts(25))
@given(st.floats(-1.0, 1.0), angle, st.floats(0.2, 2.2))
def test_a_projected_state_is_closed_within_limits_and_as_near_as_can_be(crank, coupler, rocker):
    start = kv.State({"crank": crank, "coupler": coupler, "rocker": rocker}, stamp=3.0, source="arm")
    state = MODEL.project(start)
    assert len(MODEL.violations(state)) == 0
    assert (state.stamp, state.source) == (3.0, "arm")
    x0, x = vector(MODEL, start), vector(MODEL, state)
    limits = [
        tuple(e if math.isfinite(e) else None for e in MODEL.limits(s)) for s in MODEL.degrees_of_freedom
    ]
    closed = residual(MODEL)
    found = minimize(
        lambda q: np.sum((q - x0) ** 2),
        x,
        constraints={"type": "eq", "fun": closed},
        bounds=limits,
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 200},
    )
    if np.abs(closed(found.x)).max() < 1e-9:
        assert np.linalg.norm(x - x0) <= math.sqrt(found.fun) + 1e-5
    assert MODEL.project(state) == state


def test_project_keeps_a_feasible_state_bit_for_bit():
    closed = MODEL.project(MODEL.default_state())
    assert MODEL.project(closed) is closed
    empty = kv.Model()
    assert empty.project(empty.default_state()) == empty.default_state()


def test_fixed_coordinates_do_not_move():
    start = MODEL.default_state().updated({"crank": 0.5})
    for fixed in ("crank", ["crank"], [kv.position("crank")]):
        state = MODEL.project(start, fixed=fixed)
        assert state["crank"] == 0.5
        assert len(MODEL.violations(state)) == 0
    with pytest.raises(kv.errors.UnknownNameError, match=r"no coordinate 'cranc'.*Did you mean 'crank'"):
        MODEL.project(start, fixed="cranc")


def test_project_without_a_solution_names_the_closure_and_the_attempts():
    start = MODEL.default_state()
    text = (
        r"^The state cannot be projected: at best 'four-bar/\w' is off by 0\.\d+.*, from 13 starts\. Moved were "
        r"'rocker'.*fixed were 'coupler', 'crank'\. Begin nearer to where it closes, or let more coordinates move\.$"
    )
    with pytest.raises(kv.errors.NoSolutionError, match=text):
        MODEL.project(start, fixed=("crank", "coupler"))
    with pytest.raises(kv.errors.NoSolutionError, match="Nothing was free to move; fixed were"):
        MODEL.project(start, fixed=("crank", "coupler", "rocker"))
    narrow = four_bar(lower=3.1, upper=3.14)
    with narrow.edit() as edit:
        edit.constrain("coupler/position", 0.0, kv.position("coupler"), 0.1)
    with pytest.raises(kv.errors.NoSolutionError, match="at their limits are"):
        narrow.project(narrow.default_state())


def test_missing_and_unknown_names():
    with pytest.raises(
        kv.errors.UnknownNameError, match="No value for 'coupler', which a projection has to know"
    ):
        MODEL.project({"crank": 0.1})
    with pytest.raises(kv.errors.UnknownNameError, match="Did you mean 'crank'"):
        MODEL.project({"cranc": 0.1})
    assert len(MODEL.violations(MODEL.project({"crank": 0.1, "coupler": 0.2, "rocker": 1.0}))) == 0


def test_project_keeps_unrelated_coordinates():
    model = MODEL.copy()
    with model.edit() as edit:
        bar(edit, "lamp", "world", 5.0, 0.1, lower=-0.1, upper=0.1)
        edit.constrain("lamp/held", 0.05, kv.position("lamp"), 0.05)
    start = model.default_state().updated({"lamp": 0.05})
    speeds = kv.State({**start, kv.position("crank").derivative(): 0.3})
    state = model.project(speeds)
    assert state["lamp"] == 0.05
    assert state["crank:velocity"] == 0.3
    apart = model.project(model.project(start).updated({"lamp": 0.0}))
    assert apart["lamp"] == pytest.approx(0.05, abs=1e-12)
    assert apart["crank"] == model.project(start)["crank"]


def test_project_satisfies_other_constraints_on_moved_coordinates():
    model = MODEL.copy()
    with model.edit() as edit:
        edit.constrain("together", -math.inf, kv.position("crank") + kv.position("coupler"), 0.8)
        edit.constrain("swing", kv.position("crank"), kv.position("rocker"), math.inf)
    rng = np.random.default_rng(2)
    for _ in range(10):
        start = dict(
            zip(("crank", "coupler", "rocker"), rng.uniform((-1, -1, 0.2), (1, 1, 2.2)), strict=True)
        )
        assert len(model.violations(model.project(start))) == 0


def test_quaternions_stay_of_unit_length():
    """A rod with a ball at each end, between two arms."""
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "left", "world", 0.0, 0.3, lower=-1, upper=1)
        edit.apply(kv.articulations.Ball(name="ball", parent="left_end", child="rod"))
        edit.add_frame("rod_end", "rod", kv.translation(0, 1.0, 0))
        place = kv.model.Pose.from_matrix(kv.translation(0, 1.0, 0.1))
        edit.apply(
            kv.Revolute(
                name="right", parent="world", child="right", origin=place, axis=(0, 1, 0), lower=-1, upper=1
            )
        )
        edit.add_frame("right_end", "right", kv.translation(0.3, 0, 0))
        edit.apply(kv.loops.LoopConstraint(name="rod", frame="rod_end", to="right_end"))
    rng = np.random.default_rng(0)
    for _ in range(10):
        start = model.default_state().updated(
            {"left": rng.uniform(-0.4, 0.4), "right": rng.uniform(-0.4, 0.4)}
        )
        state = model.project(start)
        assert len(model.violations(state)) == 0
        assert np.linalg.norm([state[f"ball/q{c}"] for c in "xyzw"]) == pytest.approx(1, abs=1e-12)
    assert model.project(model.default_state().updated({"left": 0.2}), fixed=("left",))["left"] == 0.2
    with pytest.raises(kv.errors.NoSolutionError, match=r"'rod/[xyz]'"):
        model.project(model.default_state().updated({"left": 0.2}), fixed=("left", "right", "ball"))


def test_half_a_turn_is_no_solution_of_a_weld():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="table", parent="world", child="plate", axis=Z))
        edit.apply(
            kv.loops.LoopConstraint(name="bolt", frame="plate", mask=("x", "y", "z", "rx", "ry", "rz"))
        )
    assert set(model.constraints) == {"bolt/rz", "bolt/upright"}
    for angle in (3.0, math.pi, -2.0):
        turned = {"table": angle}
        assert len(model.violations(turned)) > 0
        assert math.cos(model.project(turned)["table"]) == pytest.approx(1, abs=1e-9)


def test_a_base_is_moved_sideways_by_its_coordinates():
    """What it drives by is no matter: it stands where it does not close, not where it could drive from."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="base", parent="world", child="base", radius=0.1, track=0.4
            )
        )
        edit.add_frame("hand", "base", kv.translation(0.5, 0, 0))
        edit.add_frame("handle", "world", kv.translation(0.5, 0.2, 0))
        edit.apply(kv.loops.LoopConstraint(name="grasp", frame="hand", to="handle"))
    state = model.project(
        model.default_state(), fixed=next(str(s) for s in model.rates if s.path not in ("base/x", "base/y"))
    )
    assert state["base/y"] == pytest.approx(0.2)
    assert len(model.violations(state)) == 0


def test_project_moves_a_closed_state_inside_its_limits():
    inside = MODEL.project(MODEL.default_state(), fixed="crank")
    free = four_bar()
    outside = free.project(free.default_state().updated({"crank": 1.3}), fixed="crank")
    assert [v.name for v in MODEL.violations(outside)] == ["crank/position"]
    state = MODEL.project(outside)
    assert len(MODEL.violations(state)) == 0
    assert state["crank"] == 1.0
    assert MODEL.project(inside) is inside


def test_redundant_equalities_are_no_obstacle():
    model = MODEL.copy()
    with model.edit() as edit:
        for k in range(3):
            edit.apply(kv.loops.LoopConstraint(name=f"again {k}", frame="rocker_end", to="coupler_end"))
    assert len(model.violations(model.project(model.default_state()))) == 0


def test_loops_that_are_solved_stay_solved():
    """A closure on what a solved loop determines; holding a follower holds what it follows."""
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "crank", "world", 0.0, 0.4, lower=-2, upper=2)
        bar(edit, "coupler", "crank_end", 0.0, 1.1)
        bar(edit, "rocker", "world", 1.0, 0.9)
        edit.close_loop("coupler_end", "rocker_end", name="solved")
        bar(edit, "arm", "rocker_end", 0.0, 1.0)
        bar(edit, "leg", "world", 2.0, 0.8)
        edit.apply(kv.loops.LoopConstraint(name="kept", frame="arm_end", to="leg_end"))
    for crank in (-1.9, -0.3, 1.9):
        start = model.default_state().updated({"crank": crank})
        state = model.project(start)
        assert len(model.violations(state)) == 0
        assert model.project(start, fixed="rocker")["crank"] == crank
    with pytest.raises(kv.errors.NoSolutionError, match="'solved' has no solution at crank = 9"):
        model.project(model.default_state().updated({"crank": 9.0}))


def test_equalities_whose_bounds_are_expressions():
    a, b = kv.position("a"), kv.position("b")
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("circle", 1.0, a * a + b * b, 1.0)
        edit.constrain("equal", b, a, b)
    state = model.project({"a": 1.0, "b": 0.1})
    assert state["a"] == pytest.approx(math.sqrt(0.5))
    assert state["b"] == pytest.approx(math.sqrt(0.5))


@pytest.mark.parametrize(("one", "other"), list(combinations(("crank", "coupler", "rocker"), 2)))
def test_project_is_a_function_of_the_state_alone(one, other):
    start = MODEL.default_state().updated({one: 0.3, other: 0.6})
    assert MODEL.project(start) == four_bar(lower=-1.0, upper=1.0).project(start)


def test_a_parameter_by_its_name():
    model = kv.Model()
    length, x = kv.parameter("length", 1.0), kv.position("x")
    with model.edit() as edit:
        edit.add_frame("tip", parent="world", transform=kv.translation(x, 0, 0))
        edit.constrain("as long as that", 0, x - length, 0)
    assert model.project(kv.State({"x": 0.0, "length": 3.0}))["x"] == pytest.approx(3.0)
    assert model.project({"x": 0.0, "length": 3.0})["x"] == pytest.approx(3.0)
    assert model.project({"x": 0.0})["x"] == pytest.approx(1.0)
