"""Closed loops in a model: what is free, what follows, what limits mean, and how all of it is edited and sent."""

import math

import numpy as np
import pytest
from linkages import at, bar, four_bar, four_bar_by_circles, limited_four_bar, slider_crank
from loop_checks import assert_closed, assert_moves_as_its_jacobian_says, function, record, residual

import kineverse as kv

crank, coupler, rocker = (kv.position(n) for n in ("crank", "coupler", "rocker"))


@pytest.fixture(scope="module")
def model():
    return limited_four_bar()


@pytest.fixture(scope="module")
def rocks(model):
    return function(model, model.rates.carried(rocker), model.rates.carried(rocker).jacobian([crank])[0])


# -- which coordinates, which branch -----------------------------------------------------------------------


def test_a_closed_loop_needs_values_of_free_coordinates_only(model):
    assert model.symbols == model.degrees_of_freedom == (crank,)
    assert (
        model.speeds == model.speeds_of("rocker_tip") == model.speeds_of("coupler") == (crank.derivative(),)
    )
    assert dict(model.default_state()) == {crank: 0.0}
    assert set(model.rates.dependent) == {coupler, rocker}
    assert record(model, "four-bar")["mobility"] == 1


def test_dependent_coordinates_are_chosen_from_the_ends_or_given(model, rocks):
    assert record(model, "four-bar")["dependent"] == ("coupler", "rocker")
    driven = four_bar(
        dependent=("coupler", "crank"), within={"rocker": (1.6, 1.9)}, home={"rocker": 1.8, "crank": 0.5}
    )
    assert driven.degrees_of_freedom == (rocker,)
    assert_closed_between(driven, 1.6, 1.9)
    # The same mechanism, asked the other way round.
    for angle in (1.6, 1.7, 1.8, 1.9):
        (back,) = function(driven, driven.rates.carried(crank))([angle])
        assert rocks([back])[0] == pytest.approx(angle, abs=1e-10)


def assert_closed_between(model, lower, upper):
    gaps = function(model, residual(model)).batch(np.linspace(lower, upper, 200)[:, None])[0]
    assert np.abs(gaps).max() < 1e-10


def test_the_other_branch_is_the_mirror_image():
    one, other = four_bar(), four_bar(branch=1)
    assert (record(one, "four-bar")["branch"], record(other, "four-bar")["branch"]) == (0, 1)
    assert_closed(other, 200)
    for angle in np.linspace(-9, 9, 40):
        here, there = (m.fk("coupler_tip")({"crank": angle})[:2, 3] for m in (one, other))
        assert np.abs(here - there).max() > 0.1
        mirrored = one.fk("coupler_tip")({"crank": -angle})[:2, 3] * [1, -1]
        np.testing.assert_allclose(there, mirrored, rtol=0, atol=1e-11)


@pytest.mark.parametrize("rounding", [1e-13, -1e-13])
def test_of_two_branches_that_are_equally_near_rounding_does_not_choose(rounding):
    bars = four_bar(home={"coupler": rounding, "rocker": rounding})
    assert bars.rates.carried(coupler)({"crank": 0.0}) > 0


@pytest.mark.parametrize("side", [1, -1])
def test_home_says_which(side):
    bars = four_bar(home={"crank": 0.3, "coupler": 0.6 * side, "rocker": 1.4 * side})
    for angle in (-2.0, 0.3, 5.0):
        wanted = four_bar_by_circles(angle, side=side)
        np.testing.assert_allclose(bars.fk("rocker_tip")({"crank": angle})[:2, 3], wanted, rtol=0, atol=1e-11)


def test_home_may_be_turns_away():
    bars = four_bar(home={"crank": 0.3 + 4 * np.pi, "coupler": 0.6, "rocker": 1.4 - 2 * np.pi})
    assert bars.rates.carried(rocker)({"crank": 0.3}) == pytest.approx(1.4 - 2 * np.pi, abs=0.3)
    assert_closed(bars, 100)


def test_a_range_of_its_own():
    bars = four_bar(0.9, 0.6, 0.6, 1.0, within={"crank": (0.3, 1.2)}, home={"crank": 1.0})
    assert_closed_between(bars, 0.3, 1.2)
    assert list(bars.constraints) == ["four-bar/crank"]


def test_no_mobility_at_all():
    truss = kv.Model()
    with truss.edit() as edit:
        bar(edit, "a", "world", at(0))
        edit.add_frame("a_tip", "a", kv.translation(1, 0, 0))
        bar(edit, "b", "world", at(1.2))
        edit.add_frame("b_tip", "b", kv.translation(0.8, 0, 0))
        edit.close_loop("a_tip", "b_tip", name="truss", home={"a": 0.5, "b": 2.5})
    assert record(truss, "truss")["mobility"] == 0
    assert truss.symbols == ()
    assert truss.jacobian("a_tip").shape == (6, 0)
    np.testing.assert_allclose(truss.fk("a_tip")()[:2, 3], truss.fk("b_tip")()[:2, 3], rtol=0, atol=1e-12)
    assert truss.fk("a_tip")()[0, 3] == pytest.approx((1 + 1.44 - 0.64) / 2.4)


def test_a_weld_keeps_directions():
    chain = kv.Model()
    with chain.edit() as edit:
        for name, parent, x in (("a", "world", 0), ("b", "a", 0.4), ("c", "b", 1.1), ("d", "c", 0.9)):
            bar(edit, name, parent, at(x))
        edit.add_frame("ground", "world", kv.translation(1.0, 0, 0))
        # Begun at half a turn of the last, which would be a zero of the sine, too.
        edit.close_loop(
            "d", "ground", kv.loops.close_loop.AXES, name="weld", home={"b": 1.0, "c": -2, "d": 4.0}
        )
    assert_closed(chain, 100)
    poses = function(chain, chain.fk("d")).batch(np.linspace(-4, 4, 50)[:, None])[0]
    np.testing.assert_allclose(
        poses, np.broadcast_to(kv.translation(1, 0, 0)(), poses.shape), rtol=0, atol=1e-10
    )


# -- limits and speeds -------------------------------------------------------------------------------------


def test_limits_of_dependent_coordinates_are_relevant_for_the_crank(model):
    names = {"rocker/position", "rocker/velocity", "coupler/beside"}
    for subject in ([crank], model.fk("coupler_tip"), [crank.derivative()], [rocker], model.fk("rocker")):
        assert set(model.constraints_for(subject)) == names
    assert model.constraints_for([kv.position("elsewhere")]) == {}
    # The rocker is in a bound of something else as well.
    with model.edit() as edit:
        edit.constrain("lid/range", 0, kv.position("lid"), rocker)
    try:
        assert "lid/range" not in model.constraints_for([crank])
        assert "lid/range" in model.constraints_for([crank], bounds=True)
    finally:
        with model.edit() as edit:
            edit.remove("constraint lid/range")
    assert "lid/range" not in model.constraints_for([crank], bounds=True)


def test_violations_are_about_the_crank(model, rocks):
    for angle in np.linspace(-4, 4, 33):
        angle = float(angle)
        position, slope = rocks([angle])
        broken = {v.name: v for v in model.violations({"crank": angle, "crank:velocity": 1.5})}
        assert ("rocker/position" in broken) == (not 1 <= position <= 2)
        assert ("rocker/velocity" in broken) == (abs(1.5 * slope) > 0.5)
        if "rocker/position" in broken:
            assert broken["rocker/position"].value == pytest.approx(position, abs=1e-12)
        if "rocker/velocity" in broken:
            assert broken["rocker/velocity"].value == pytest.approx(1.5 * slope, abs=1e-12)
    assert "rocker/velocity" in model.violations({"crank": 0.5}).unchecked


def test_velocity_rows_keep_the_rocker_in_its_limits(model, rocks):
    rows = model.velocity_rows(0.01, [crank])
    assert rows.speeds == (crank.derivative(),)
    assert {"rocker/position", "rocker/velocity"} <= set(rows.names)
    at_ = kv.compile([rows.matrix, rows.lower, rows.upper], [crank], tier="interpreter")
    for angle in np.linspace(-2, 2, 21):
        position, slope = rocks([angle])
        matrix, lower, upper = at_([angle])
        for i, name in enumerate(rows.names):
            if name.startswith("rocker/"):
                assert matrix[i, 0] == pytest.approx(slope, abs=1e-12)
            if name == "rocker/velocity":
                assert (lower[i], upper[i]) == pytest.approx((-0.5, 0.5))
            if name == "rocker/position" and 1.1 < position < 1.9:
                assert lower[i] <= 0 <= upper[i]
                assert upper[i] <= (2 - position) / 0.01 + 1e-9


def test_the_speed_of_a_dependent_coordinate_is_in_terms_of_the_crank(model, rocks):
    speed = model.rates.eliminate(kv.velocity("rocker") + kv.velocity("crank"))
    assert set(speed.symbols) == {crank, crank.derivative()}
    assert speed({"crank": 0.7, "crank:velocity": 2.0}) == pytest.approx(2 * rocks([0.7])[1] + 2, abs=1e-12)


def test_values_of_dependent_coordinates_are_not_needed(model):
    """Joint states of machines name every joint; what follows follows from the others."""
    told = kv.State({crank: 0.4, rocker: 9.0, coupler: -9.0})
    pose = model.fk("rocker_tip")
    assert pose(told).tobytes() == pose({"crank": 0.4}).tobytes()
    assert kv.compile(pose)(told).tobytes() == pose({"crank": 0.4}).tobytes()
    assert list(model.violations(told)) == list(model.violations({"crank": 0.4}))
    with pytest.raises(kv.errors.UnknownNameError, match="crank"):
        model.fk("rocker_tip")({"rocker": 1.5})


def test_integrating_along_the_crank(model):
    state = kv.State({crank: 0.2})
    gap = function(model, residual(model))
    for _ in range(5):
        state = model.integrate(state, {"crank:velocity": 1.3}, 0.25)
        assert set(state) == {crank}
        assert np.abs(gap([state[crank]])[0]).max() < 1e-12
    assert state[crank] == pytest.approx(0.2 + 1.3 * 1.25)
    with pytest.raises(kv.errors.UnknownNameError, match="rocker:velocity"):
        model.integrate(state, {"rocker:velocity": 1.0}, 0.1)


def test_expressions_move_as_their_gradients_say(model):
    """ė and ë of something about pose and followers, along a motion of the crank."""
    e = model.fk("coupler_tip")[0, 3] * model.rates.carried(rocker) + np.sin(model.rates.carried(coupler))
    first = e.gradient()[crank.derivative()]
    f = function(model, e, first, first.gradient()[crank.derivative()])
    for q in np.linspace(-6, 6, 25):
        before, now, after = (f([q + s]) for s in (-1e-4, 0, 1e-4))
        assert now[1] == pytest.approx((after[0] - before[0]) / 2e-4, abs=1e-6)
        assert now[2] == pytest.approx((after[1] - before[1]) / 2e-4, abs=1e-6)


def test_expressions_of_a_user_are_carried(model):
    with model.edit() as edit:
        edit.add_frame("pointer", "world", kv.rotation_z(2 * rocker))
    try:
        assert set(model.fk("pointer").symbols) == {crank}
        assert_moves_as_its_jacobian_says(model, "pointer", 10)
    finally:
        with model.edit() as edit:
            edit.remove("frame pointer")


# -- lengths that are not known ----------------------------------------------------------------------------


def test_lengths_may_be_parameters():
    rod = kv.parameter("rod", 1.1)
    bars = four_bar(coupler=rod, home={"rocker": 1.5})
    assert set(bars.symbols) == {crank, rod}
    assert bars.degrees_of_freedom == (crank,)
    tip = bars.fk("coupler_tip")[:2, 3]
    assert set(tip.gradient()) == {crank.derivative()}
    slope = tip.partial([rod, crank])
    for angle in np.linspace(-7, 7, 15):
        for length in (1.0, 1.1, 1.15):
            values = {"crank": float(angle), "rod": length}
            wanted = four_bar_by_circles(angle, b=length)
            np.testing.assert_allclose(tip(kv.State({crank: angle, rod: length})), wanted, rtol=0, atol=1e-9)
            np.testing.assert_allclose(bars.fk("rocker_tip")(values)[:2, 3], wanted, rtol=0, atol=1e-9)
            longer, shorter = (tip({**values, "rod": length + s}) for s in (1e-5, -1e-5))
            np.testing.assert_allclose(slope(values)[:, 0], (longer - shorter) / 2e-5, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(tip({"crank": 0.5}), tip({"crank": 0.5, "rod": 1.1}))
    with pytest.raises(
        kv.errors.NoSolutionError, match=r"'four-bar' has no solution at crank = 3, rod = 0\.2"
    ):
        tip({"crank": 3.0, "rod": 0.2})


# -- where it does not close -------------------------------------------------------------------------------


def double_rocker(**constraints):
    """Return a linkage whose crank cannot go round, and which may be asked about any angle of it."""
    model = four_bar(
        1.0, 1.0, 0.6, 1.3, home={"crank": 1.2, "coupler": -1, "rocker": 1.5}, within={"crank": (0.6, 1.2)}
    )
    with model.edit() as edit:
        for name, triple in constraints.items():
            edit.constrain(name, *triple)
    return model


def test_a_configuration_in_which_a_loop_does_not_close_is_not_valid():
    """Even if no constraint is about what follows."""
    model = double_rocker()
    assert not model.violations({"crank": 1.0})
    broken, beyond = model.violations({"crank": 3.0})
    assert (broken.name, beyond.name) == ("four-bar", "four-bar/crank")
    assert np.isnan(broken.value)
    assert np.isnan(broken.excess)
    assert "four-bar: -inf <= nan <= inf has no value here" in str(model.violations({"crank": 3.0}))


def test_the_range_of_a_loop_is_a_limit():
    """So whoever asks for a state, or how far a slider goes, stays where the loop closes."""
    model = double_rocker()
    assert model.limits("crank") == (0.6, 1.2)
    assert model.default_state()["crank"] == 0.6
    assert not model.violations(model.default_state())
    with model.edit() as edit:
        edit.remove("loop four-bar")
    assert model.limits("crank") == (-np.inf, np.inf)


def test_a_bound_without_a_value_holds_nothing():
    crank, rocker = kv.position("crank"), kv.position("rocker")
    model = double_rocker(
        above=(-9, crank, kv.maximum(rocker, 9)),
        chosen=(kv.where(rocker > 9, 0, -9), crank, 9),
        table=(-9, crank, kv.articulations.tabulated_limit(rocker, {0: 9, 1: 10})),
        other=(0, crank, 2.5),
    )
    assert not model.violations({crank: 1.0})
    found = model.violations({crank: 3.0})
    assert [v.name for v in found] == ["above", "chosen", "four-bar", "table", "four-bar/crank", "other"]
    assert found[-1].excess == 0.5


def test_limits_of_a_dependent_coordinate_by_name():
    model = limited_four_bar()
    assert model.limits("rocker") == (1.0, 2.0)
    assert model.limits("rocker:velocity") == (-0.5, 0.5)
    assert model.symbol("coupler") == kv.position("coupler")
    with pytest.raises(kv.errors.UnknownNameError, match="Did you mean 'rocker'"):
        model.limits("rokcer")


def test_a_coordinate_with_free_speeds_is_not_chosen_as_dependent():
    """Neither wheels nor quaternions; and a loop begins where a ball is at rest, not where it is nothing."""
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "crank", "world", at(0))
        edit.apply(kv.articulations.Ball(name="ball", parent="crank", child="rod", origin=at(0.3)))
        edit.add_frame("rod_end", "rod", kv.translation(1.0, 0, 0))
        edit.close_loop(
            "rod_end",
            name="on the line",
            mask=("y",),
            within={f"ball/q{c}": (-0.1, 0.1) if c != "w" else (0.9, 1) for c in "xyzw"},
        )
    assert dict(model.articulations["on the line"].dynamics)["dependent"] == ("crank",)
    at_rest = model.default_state()
    assert at_rest["ball/qw"] == 1
    assert model.fk("rod_end")(at_rest)[1, 3] == pytest.approx(0, abs=1e-10)


def test_many_inputs():
    """More than a grid over all of them could be sampled for: two bars of a chain of six follow four."""
    model = kv.Model()
    with model.edit() as edit:
        for k in range(6):
            limits = {"lower": 0.2, "upper": 0.35} if k < 4 else {}
            bar(edit, f"bar_{k}", "world" if k == 0 else f"bar_{k - 1}", at(0.3 if k else 0.0), **limits)
        edit.add_frame("tip", "bar_5", kv.translation(0.3, 0, 0))
        edit.add_frame("pin", "world", kv.translation(1.1, 0.9, 0))
        edit.close_loop("tip", "pin", name="ring", mask=("x", "y"), home={"bar_4": 1.0, "bar_5": 1.0})
    assert dict(model.articulations["ring"].dynamics)["mobility"] == 4
    free = model.degrees_of_freedom
    assert [str(s) for s in free] == ["bar_0", "bar_1", "bar_2", "bar_3"]
    assert_closed(model, 300)
    assert_moves_as_its_jacobian_says(model, "bar_4", 16)


def test_the_guess_is_periodic_over_full_revolutions():
    """A guess that grew by what rounding leaves of 0 would have no period."""
    (loop,) = slider_crank().rates.dependent[kv.position("piston")]._nodes
    guess = kv.compile(loop.function.seed[1])
    # Two angles that are the same number, as sine and cosine see it, but a rate of 1e-16 [m/rad] does not.
    far = 1e17
    near = math.atan2(math.sin(far), math.cos(far))
    assert guess([far]) == pytest.approx(guess([near]), abs=1e-9)


@pytest.mark.parametrize(("lower", "upper"), [(-2.354, 3.5467), (-2.2, 3.4)])
@pytest.mark.parametrize("names", [[""], ["", "other "]])
def test_branches_that_come_close_are_told_apart(names, lower, upper):
    # The bars are nearly in line on the way. Of twins no determinant shows that both change their branch.
    a, b, c = 0.5707049918, 0.9098700426, 0.6058904411
    d, model = b + c - a - 1e-5, kv.Model()
    with model.edit() as edit:
        bar(edit, "crank", "world", at(0), lower=lower, upper=upper)
        for name in names:
            bar(edit, f"{name}coupler", "crank", at(a))
            edit.add_frame(f"{name}coupler_tip", f"{name}coupler", kv.translation(b, 0, 0))
            bar(edit, f"{name}rocker", "world", at(d))
            edit.add_frame(f"{name}rocker_tip", f"{name}rocker", kv.translation(c, 0, 0))
        first, *more = ((f"{name}coupler_tip", f"{name}rocker_tip") for name in names)
        edit.close_loop(*first, name="four-bar", more=tuple(more), home={"crank": 1.5})
    tips = kv.compile([model.fk(f"{name}coupler_tip")[:2, 3] for name in names], [crank])
    cranks = np.linspace(lower, upper, 41)
    side = min((1, -1), key=lambda s: np.abs(tips([1.5])[0] - four_bar_by_circles(1.5, a, b, c, d, s)).max())
    wanted = [four_bar_by_circles(angle, a, b, c, d, side) for angle in cranks]
    for found in tips.batch(cranks[:, None]):
        np.testing.assert_allclose(found, wanted, atol=1e-6)
