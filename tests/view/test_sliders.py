import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from small_models import cabinet, dependent

import kineverse as kv
from kineverse.model.kinematics import infer_units
from kineverse.view.animation import RangeAnimation
from kineverse.view.html import MOST_LINES, format_failure, format_significant, format_violations
from kineverse.view.poses import FramePoses, complete, roll_pitch_yaw, to_wxyz
from kineverse.view.sliders import (
    DisplayUnits,
    Ranges,
    choose_slider_range,
    choose_slider_step,
)

INF = math.inf
LIMIT = st.one_of(st.floats(-10, 10), st.just(INF), st.just(-INF))


def test_state_dependent_limits_follow_the_state():
    ranges = Ranges(dependent())
    assert ranges.names == ["door", "drawer"]
    assert ranges.varying == ["drawer"]
    assert ranges.limits_at({"door": 0.0, "drawer": 0.0})["drawer"] == (0.0, 0.0)
    assert ranges.limits_at({"door": 0.8, "drawer": 0.0}) == {"door": (0.0, 1.0), "drawer": (0.0, 0.4)}


def test_limits_are_those_of_the_degrees_of_freedom_without_parameters():
    model = cabinet()
    with model.edit() as edit:
        tilt = kv.parameter("tilt", 0.2)
        edit.add_frame("shelf", parent="world", transform=kv.rotation_x(tilt))
    ranges = Ranges(model)
    assert ranges.varying == []
    assert ranges.limits_at(complete(model)) == {
        "cabinet/door": (0.0, 1.5),
        "cabinet/drawer": (0.0, 0.4),
        "cabinet/knob": (-INF, INF),
    }


@given(LIMIT, LIMIT, st.floats(-20, 20), st.sampled_from(["rad", "m", ""]), st.sampled_from([0.0, 0.2]))
def test_slider_ranges_are_finite_and_contain_value_and_limits(a, b, value, unit, beyond):
    lower, upper = min(a, b), max(a, b)
    assume(lower < INF and upper > -INF)
    low, high = choose_slider_range((lower, upper), value, unit, beyond)
    assert math.isfinite(low)
    assert math.isfinite(high)
    assert low <= value <= high
    assert low < high
    for limit in (lower, upper):
        if math.isfinite(limit):
            assert low <= limit + 1e-9
            assert limit <= high + 1e-9
    assert 900 <= (high - low) / choose_slider_step((low, high)) <= 11_000


def test_slider_ranges_exceed_limits_only_on_demand():
    assert choose_slider_range((0.0, 1.5), 0.3, "rad") == (0.0, 1.5)
    assert choose_slider_range((0.0, 1.5), 0.3, "rad", 0.2) == (-0.3, 1.8)
    assert choose_slider_range((-INF, INF), 0.0, "rad") == (-math.pi, math.pi)
    assert choose_slider_range((-INF, INF), 0.0, "m") == (-2.0, 2.0)


def test_units_are_inferred_from_the_motion():
    model = cabinet()
    rope, screw, mimic = kv.position("rope"), kv.position("screw"), kv.position("mimic")
    with model.edit() as edit:
        edit.add_frame(
            "garage",
            parent="world",
            transform=kv.translation(0, 0, 2 - rope) @ kv.rotation_y(np.arccos(rope / 2)),
        )
        edit.add_frame(
            "nut", parent="world", transform=kv.translation(0, 0, 0.001 * screw) @ kv.rotation_z(2 * screw)
        )
        # One finger follows at half the way; the other says what the coordinate is.
        edit.add_frame("finger", parent="world", transform=kv.translation(0.5 * mimic, 0, 0))
        edit.add_frame("other", parent="world", transform=kv.translation(mimic, 0, 0))
    values = {**complete(model), "rope": 0.5}
    assert infer_units(model, values, [str(symbol) for symbol in model.degrees_of_freedom]) == {
        "cabinet/door": "rad",
        "cabinet/drawer": "m",
        "cabinet/knob": "rad",
        "mimic": "m",
        "rope": "",
        "screw": "",
    }
    assert infer_units(kv.Model(), {}, []) == {}


def test_frame_poses_are_those_of_the_model():
    model = cabinet()
    poses = FramePoses(model)
    values = {**complete(model), "cabinet/door": 0.7, "cabinet/drawer": 0.1}
    at = dict(zip(poses.names, poses.evaluate(values), strict=True))
    np.testing.assert_array_equal(at["world"], np.eye(4))
    for name in model.frames:
        np.testing.assert_allclose(at[name], model.fk(name)(kv.State(values)), atol=1e-12)
    rows = np.array([[values[name] for name in poses.inputs]] * 3)
    for name, batch in zip(poses.moving, poses.batch(rows), strict=True):
        np.testing.assert_allclose(batch, np.tile(at[name], (3, 1, 1)), atol=1e-12)


def test_frame_poses_of_an_empty_model_are_the_world():
    assert FramePoses(kv.Model()).evaluate({}).tolist() == [np.eye(4).tolist()]


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_quaternions_round_trip(numbers):
    w, x, y, z = q = np.array(numbers) / np.linalg.norm(numbers)
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    found = to_wxyz(matrix[None])[0]
    assert abs(found @ q) == pytest.approx(1.0, abs=1e-9)
    assert found[0] >= 0.0


@given(*[st.floats(-3.1, 3.1)] * 3)
def test_roll_pitch_yaw_round_trip(roll, pitch, yaw):
    def matrix(angles):
        r, p, y = angles
        return np.array((kv.rotation_z(y) @ kv.rotation_y(p) @ kv.rotation_x(r))())

    expected = matrix((roll, pitch, yaw))
    np.testing.assert_allclose(matrix(roll_pitch_yaw(expected)), expected, atol=1e-9)


def test_roll_pitch_yaw_at_the_singularity_has_roll_zero():
    upright = np.array((kv.rotation_z(0.3) @ kv.rotation_y(math.pi / 2) @ kv.rotation_x(0.1))())
    roll, pitch, yaw = roll_pitch_yaw(upright)
    assert (roll, pitch) == (0.0, pytest.approx(math.pi / 2))
    assert yaw == pytest.approx(0.2, abs=1e-6)


@given(st.floats(0, 1), st.floats(0, 100))
def test_animation_starts_at_the_state_and_stays_within_the_limits(share, now):
    limits = {"a": (-1.0, 2.0), "b": (0.0, 0.4)}
    start = {name: low + share * (high - low) for name, (low, high) in limits.items()}
    show = RangeAnimation(start, limits, now=50.0)
    assert show.values_at(50.0) == pytest.approx(start)
    for name, value in show.values_at(50.0 + now).items():
        assert limits[name][0] - 1e-9 <= value <= limits[name][1] + 1e-9


def test_animation_reaches_both_limits():
    show = RangeAnimation({"a": 0.0}, {"a": (-1.0, 2.0)}, now=0.0)
    values = [show.values_at(t)["a"] for t in np.linspace(2.0, 12.0, 400)]
    assert min(values) == pytest.approx(-1.0, abs=0.01)
    assert max(values) == pytest.approx(2.0, abs=0.01)


def test_violations_are_listed_with_value_bounds_and_excess():
    model = cabinet()
    found = model.violations({**complete(model), "cabinet/door": 1.9})
    text = format_violations(found, found.unchecked)
    assert "2 constraints violated" in text
    assert "cabinet/door/range" in text
    assert "1.9 is not in [0, 1.5], by 0.4" in text
    assert "All constraints hold" in format_violations(())


def test_long_reports_are_cut_and_names_are_escaped():
    from kineverse.model.violations import Violation

    many = [Violation(f"<script>{k}", 2.0, -INF, 1.0, 1.0) for k in range(MOST_LINES + 3)]
    text = format_violations(many, ["a", "b"])
    assert "<script>" not in text
    assert "and 3 more" in text
    assert "2 on speeds not checked" in text
    assert "[−∞, 1]" in text
    assert "&lt;b&gt;" in format_failure("<b>")


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (-8.8e-20, "0"),
        (0.0, "0"),
        (-0.471234, "−0.4712"),
        (85.943669, "85.94"),
        (0.69, "0.69"),
        (1e-5, "0.00001"),
        (-12345.6, "−12350"),
        (INF, "∞"),
        (-INF, "−∞"),
        (3e9, "3e+09"),
    ],
)
def test_numbers_have_four_significant_digits(value, text):
    assert format_significant(value) == text


@given(st.floats(1e-8, 1e8) | st.floats(-1e8, -1e-8))
def test_formatted_numbers_are_near_the_number(value):
    assert float(format_significant(value).replace("−", "-")) == pytest.approx(value, rel=5.1e-4)


def test_numbers_are_shown_in_the_chosen_units():
    display = DisplayUnits()
    assert display.format(0.5, "rad") == "0.5 rad"
    display.degrees = display.centimetres = True
    assert display.format(math.pi / 2, "rad") == "90 °"
    assert display.format(0.0345, "m") == "3.45 cm"
    assert display.scale("m/s") == (100.0, "cm/s")
    assert display.format(3.0, "") == "3"
