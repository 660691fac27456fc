"""Outside of its inputs' limits a loop is what it is inside, continued; farther out it is an error, never a guess."""

from __future__ import annotations

import math
from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linkages import at, bar, four_bar, four_bar_by_circles, limited_four_bar, slider_crank
from loop_checks import function, record

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.errors import InvalidValueError
from kineverse.expressions.graph import dense_column
from kineverse.expressions.implicit import ImplicitFunction
from kineverse.loops.equations import WorkBudget

Array = np.ndarray

LENGTHS = (1.038953261, 0.94582034, 1.33660687, 0.94080571)
LIMITS = {"lower": -1.946, "upper": -1.546}
MIDDLE = -1.746


def home_of(crank: float, a: float, b: float, c: float, d: float, side: int) -> dict[str, float]:
    """Return the angles of a closed four-bar."""
    end = four_bar_by_circles(crank, a, b, c, d, side)
    pin = np.array([a * math.cos(crank), a * math.sin(crank)])
    coupler = math.atan2(end[1] - pin[1], end[0] - pin[0]) - crank
    return {"crank": crank, "coupler": coupler, "rocker": math.atan2(end[1], end[0] - d)}


@pytest.fixture(scope="module")
def narrow() -> kv.Model:
    """Return a four-bar with a narrow crank, which has another branch at hand farther out."""
    return four_bar(*LENGTHS, limits=LIMITS, home=home_of(MIDDLE, *LENGTHS, 1))


def function_of(model: kv.Model, follower: str) -> ImplicitFunction:
    (node,) = model.rates.dependent[kv.position(follower)]._nodes
    return node.function


def numbers(expression: kv.Expression, points: Array) -> Array:
    """Return the values of a vector of one symbol, NaN where evaluation is an error."""
    (symbol,) = expression.symbols
    return np.array(ca.Function("e", [symbol._sx], [dense_column(expression)])(points[None, :])).T


def test_beyond_the_margin_it_is_an_error_that_says_how_far_it_holds(narrow):
    text = (
        r"^'four-bar' has no solution at crank = -4\.746 that is known to be on its branch: it holds for "
        r"-2\.146 <= crank <= -1\.346, the limits it was made for and a margin around them\. "
        r"Stay within, or make it for wider limits\.$"
    )
    tip = narrow.fk("rocker_tip")
    for ask in (
        lambda: tip({"crank": -4.746}),
        lambda: narrow.jacobian("rocker_tip")({"crank": -4.746}),
        lambda: kv.compile(tip, tier="interpreter")([-4.746]),
        lambda: narrow.violations({"crank": -4.746}) and tip({"crank": -4.746}),
    ):
        with pytest.raises(kv.errors.NoSolutionError, match=text):
            ask()
    with pytest.raises(kv.errors.NoSolutionError, match=r"^Row 1: 'four-bar' has no solution at crank = 3 "):
        kv.compile(tip, tier="interpreter").batch([[-1.7], [3.0]])


@pytest.mark.compiler
def test_compiled_code_has_the_same_domain(narrow):
    tip = narrow.fk("rocker_tip")[:2, 3]
    fast = kv.compile(tip, tier="c", wait=True)
    for crank in (-2.145, -1.346, -1.7):
        assert fast([crank]).tobytes() == kv.compile(tip, tier="interpreter")([crank]).tobytes()
    for crank in (-2.15, -1.34, 4.5, math.inf):
        with pytest.raises(kv.errors.NoSolutionError, match="four-bar"):
            fast([crank])
    with pytest.raises(kv.errors.NoSolutionError, match="Row 2: 'four-bar'"):
        fast.batch([[-1.6], [-1.7], [-4.7]])


def test_within_the_margin_it_is_continued(narrow):
    points = np.linspace(-2.146, -1.346, 400)
    wanted = np.array([four_bar_by_circles(q, *LENGTHS) for q in points])
    np.testing.assert_allclose(numbers(narrow.fk("rocker_tip")[:2, 3], points), wanted, rtol=0, atol=1e-9)
    slopes = narrow.fk("rocker_tip")[:2, 3].jacobian([kv.position("crank")])[:, 0]
    steps = np.array([four_bar_by_circles(q + 1e-6, *LENGTHS) for q in points]) - [
        four_bar_by_circles(q - 1e-6, *LENGTHS) for q in points
    ]
    np.testing.assert_allclose(numbers(slopes, points), steps / 2e-6, rtol=1e-6, atol=1e-6)


def test_violations_list_a_loop_outside_of_its_domain_without_a_value(narrow):
    inside = narrow.violations({"crank": -2.1})
    assert [v.name for v in inside] == ["crank/position"]
    outside = narrow.violations({"crank": -4.746})
    assert {v.name for v in outside} == {"four-bar", "crank/position"}
    assert outside[0].name == "four-bar"
    assert math.isnan(outside[0].excess)


lengths = st.floats(0.3, 1.5)


@settings(max_examples=attempts(6))
@given(lengths, lengths, lengths, lengths, st.floats(-3, 3), st.sampled_from([0.05, 0.3, 1.0]), st.booleans())
def test_a_four_bar_is_on_its_branch_or_an_error(a, b, c, d, crank, half, up):
    side = 1 if up else -1

    def circles(angles: Array) -> Array:
        """Return where the pin is, NaN where the circles do not meet."""
        pin = np.stack([a * np.cos(angles), a * np.sin(angles)])
        way = np.array([[d], [0.0]]) - pin
        distance = np.where(np.hypot(*way) > 1e-3, np.hypot(*way), np.nan)
        along = (b * b - c * c + distance**2) / (2 * distance)
        with np.errstate(invalid="ignore"):
            across = side * np.sqrt(b * b - along**2)
        return (pin + (along * way + across * np.stack([-way[1], way[0]])) / distance).T

    if np.isnan(circles(np.linspace(crank - half, crank + half, 201))).any():
        return
    try:
        model = four_bar(
            a, b, c, d,
            limits={"lower": crank - half, "upper": crank + half},
            home=home_of(crank, a, b, c, d, side),
        )  # fmt: skip
    except kv.errors.NoSolutionError:  # too near to where the branches meet
        return
    check_everywhere(model, model.fk("rocker_tip")[:2, 3], crank, half, circles)


@settings(max_examples=attempts(4))
@given(st.floats(0.1, 1.0), st.floats(0.1, 1.5), st.floats(-1.4, 1.4), st.sampled_from([0.05, 0.3]))
def test_a_slider_crank_is_on_its_branch_or_an_error(crank, rod, middle, half):
    def slide(angles: Array) -> Array:
        with np.errstate(invalid="ignore"):
            reach = np.sqrt(rod**2 - (crank * np.sin(angles)) ** 2)
        return (crank * np.cos(angles) + reach)[:, None]

    if np.isnan(slide(np.linspace(middle - half, middle + half, 100))).any():
        return
    try:
        model = slider_crank(crank, rod, within={"crank": (middle - half, middle + half)})
    except kv.errors.NoSolutionError:
        return
    check_everywhere(model, kv.array([model.rates.carried(kv.position("piston"))]), middle, half, slide)


def check_everywhere(
    model: kv.Model, value: kv.Expression, middle: float, half: float, wanted: Callable[[Array], Array]
) -> None:
    (loop,) = {node.function for e in model.rates.dependent.values() for node in e._nodes}
    ((lower, upper),) = loop.domain
    margin = max(0.2 * 2 * half, 0.2)
    assert middle - half - margin - 1e-6 <= lower <= middle - half
    assert middle + half <= upper <= middle + half + margin + 1e-6
    points = np.concatenate([np.linspace(lower, upper, 500), np.linspace(middle - 7, middle + 7, 500)])
    found, there = numbers(value, points), wanted(points)
    inside = (lower <= points) & (points <= upper)
    assert not np.isnan(found[inside]).any()
    assert np.isnan(found[~inside]).all()
    np.testing.assert_allclose(found[inside], there[inside], rtol=0, atol=1e-7)
    # It ends within the margin only where branches meet a little farther out.
    for end, edge, sign in ((lower, middle - half, -1), (upper, middle + half, 1)):
        if abs(end - edge) < margin - 1e-6:
            beyond = edge + sign * np.linspace(0, margin, 400)
            assert np.isnan(wanted(beyond)).any() or abs(end - edge) > 0.01 * margin


def test_the_domain_ends_before_a_dead_centre():
    stop = math.acos((0.9**2 + 1 - 1.2**2) / 1.8)
    model = four_bar(0.9, 0.6, 0.6, 1.0, home={"crank": 0.7}, within={"crank": (0.3, stop - 0.1)})
    ((lower, upper),) = function_of(model, "rocker").domain
    assert lower == pytest.approx(0.1)
    assert stop - 0.05 < upper < stop
    assert record(model, "four-bar")["domain"] == ((lower, upper),)
    model.fk("rocker_tip")({"crank": upper})
    with pytest.raises(kv.errors.NoSolutionError, match="it holds for"):
        model.fk("rocker_tip")({"crank": upper + 1e-6})


def test_an_angle_without_limits_has_no_domain():
    model = limited_four_bar()
    assert function_of(model, "rocker").domain == ()
    found = numbers(model.fk("rocker_tip")[:2, 3], np.array([0.3, 0.3 + 200 * math.pi]))
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-9)


def test_a_loop_ends_where_one_that_it_is_built_on_ends():
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "crank", "world", at(0), lower=-0.5, upper=0.5)
        bar(edit, "coupler", "crank", at(0.4))
        edit.add_frame("coupler_tip", "coupler", kv.translation(1.1, 0, 0))
        bar(edit, "rocker", "world", at(1.0))
        edit.add_frame("rocker_tip", "rocker", kv.translation(0.9, 0, 0))
        edit.close_loop("coupler_tip", "rocker_tip", name="first")
        bar(edit, "rod", "rocker", at(0.9))
        edit.add_frame("rod_tip", "rod", kv.translation(1.5, 0, 0))
        edit.apply(kv.Prismatic(name="slide", parent="world", child="slide", axis=(1, 0, 0)))
        edit.close_loop("rod_tip", "slide", name="second", home={"slide": 2.5})
    ((low, high),) = function_of(model, "coupler").domain
    second = {node.function for node in model.rates.dependent[kv.position("slide")]._nodes}
    ((lower, upper),) = next(f.domain for f in second if f.name == "second")
    assert low - 1e-6 <= lower < -0.69
    assert 0.69 < upper <= high + 1e-6
    for crank in (lower, upper):
        model.fk("slide")({"crank": crank})


def test_documents_carry_the_domain_to_the_bit(narrow, tmp_path):
    narrow.save(tmp_path / "bars.kv.json")
    read = kv.load(tmp_path / "bars.kv.json")
    assert read.snapshot() == narrow.snapshot()
    assert function_of(read, "rocker").domain == function_of(narrow, "rocker").domain
    with pytest.raises(kv.errors.NoSolutionError, match="it holds for"):
        read.fk("rocker_tip")({"crank": -4.746})
    again = kv.formats.from_bytes(kv.formats.to_bytes(narrow))
    assert function_of(again, "rocker").domain == function_of(narrow, "rocker").domain


def test_rows_lead_back_from_anywhere():
    """Farther out than the loop is known, too: the rocker's limit has the row that it has at the edge."""
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "crank", "world", at(0), lower=-0.6, upper=0.9, velocity=2.0)
        bar(edit, "coupler", "crank", at(0.4))
        edit.add_frame("coupler_tip", "coupler", kv.translation(1.1, 0, 0))
        bar(edit, "rocker", "world", at(1.0), lower=0.5, upper=2.5, velocity=1.0)
        edit.add_frame("rocker_tip", "rocker", kv.translation(0.9, 0, 0))
        edit.close_loop("coupler_tip", "rocker_tip", name="four-bar")
    rows = model.velocity_rows(0.1)
    assert {"crank/position", "rocker/position", "rocker/velocity"} <= set(rows.names)
    ask = function(model, rows.matrix, rows.lower, rows.upper)
    for start in (-40.0, -3.0, -0.75, 1.15, 2.0, 40.0):
        crank = start
        for _ in range(2000):
            matrix, lower, upper = ask([crank])
            assert np.isfinite(matrix).all()
            low, high = -2.0, 2.0
            for (slope,), least, most in zip(matrix, lower, upper, strict=True):
                if slope:
                    ends = sorted((least / slope, most / slope))
                    low, high = max(low, ends[0]), min(high, ends[1])
            assert low <= high + 1e-12
            speed = min(max(0.0, low), high)
            if speed == 0.0:
                break
            crank += 0.1 * speed
        assert -0.6 - 1e-6 <= crank <= 0.9 + 1e-6
        assert len(model.violations({"crank": crank}, tolerance=1e-6)) == 0
    # Where the loop is known, holding it at the edge changes nothing.
    assert np.isfinite(model.fk("rocker_tip")({"crank": 1.1})).all()


def test_a_domain_fits_its_inputs():
    function = function_of(four_bar(limits={"lower": 0, "upper": 1}), "rocker")
    parts = [
        getattr(function, n) for n in ("name", "unknowns", "inputs", "residual", "rows", "seed", "steps")
    ]
    assert ImplicitFunction(*parts, ((-math.inf, math.inf),)).domain == ()
    assert ImplicitFunction(*parts, ((-math.inf, math.inf),)).key == ImplicitFunction(*parts).key
    assert ImplicitFunction(*parts, ((0, 1),)).key != ImplicitFunction(*parts).key
    with pytest.raises(kv.errors.ShapeError, match="has 1 inputs, and a domain for 2"):
        ImplicitFunction(*parts, ((0, 1), (0, 1)))
    for ends in ((1, 0), (math.nan, 1)):
        with pytest.raises(InvalidValueError, match="no value lies within"):
            ImplicitFunction(*parts, (ends,))


def test_work_has_an_end():
    effort = WorkBudget("ring", left=2.0)
    effort.spend(1.5)
    with pytest.raises(
        kv.errors.NoSolutionError, match=r"^Loop 'ring' is too much work: .* 150000 evaluations\. Narrow"
    ):
        effort.spend(1.0)
