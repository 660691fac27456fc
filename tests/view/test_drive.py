"""Quaternion angles, speeds, locks and closed loops on the page."""

import math
import time
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import kineverse as kv
from kineverse.errors import UnknownNameError
from kineverse.view.animation import VelocityDrive
from kineverse.view.poses import complete
from kineverse.view.sliders import QuaternionAngles, Ranges

ANGLES = st.tuples(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))


def lock():
    """A door that opens while a bolt is drawn; a ratchet that only goes up; a drawer as far as the door is open."""
    model = kv.Model()
    door, bolt, ratchet, drawer = map(kv.position, ("door", "bolt", "ratchet", "drawer"))
    with model.edit() as edit:
        for name, transform in (
            ("door", kv.rotation_z(door)),
            ("bolt", kv.translation(bolt, 0, 0)),
            ("ratchet", kv.rotation_x(ratchet)),
            ("drawer", kv.translation(0, drawer, 0)),
        ):
            edit.add_frame(name, parent="world", transform=transform)
        edit.constrain("door/range", 0, door, 1.5)
        edit.constrain("bolt/range", 0, bolt, 0.1)
        edit.constrain("drawer/range", 0, drawer, 0.2 * door)
        edit.constrain("door/lock", -(bolt > 0.05), door.derivative(), bolt > 0.05)
        edit.constrain("ratchet/teeth", 0, ratchet.derivative(), math.inf)
    return model


def planar_loop():
    """A crank that cannot go round: at most 1.3 rad either way, where it has no limits that say so."""
    model = kv.Model()
    with model.edit() as edit:
        for name, parent, x in (("crank", "world", 0.0), ("coupler", "crank", 0.4), ("rocker", "world", 1.0)):
            origin = kv.model.Pose.from_matrix(kv.translation(x, 0, 0))
            edit.apply(kv.Revolute(name=name, parent=parent, child=name, origin=origin, axis=(0, 0, 1)))
        edit.add_frame("coupler_tip", "coupler", kv.translation(0.5, 0, 0))
        edit.add_frame("rocker_tip", "rocker", kv.translation(0.3, 0, 0))
        edit.close_loop("coupler_tip", "rocker_tip", name="loop", within={"crank": (-0.4, 0.4)})
    return model


@cache
def ball():
    return kv.load("articulations/ball")


@given(ANGLES)
def test_quaternion_angles_round_trip(angles):
    model = ball()
    orientations = QuaternionAngles(model, complete(model))
    names = [f"ball/stick/{angle}" for angle in ("roll", "pitch", "yaw")]
    assert list(orientations.limits) == names
    for name, value in zip(names, angles, strict=True):
        quaternion = orientations.set_angle(name, value)
    roll, pitch, yaw = angles
    expected = (kv.rotation_z(yaw) @ kv.rotation_y(pitch) @ kv.rotation_x(roll))()
    np.testing.assert_allclose(
        model.fk("ball/stick", "ball/socket")(kv.State(quaternion))[:3, :3], expected[:3, :3], atol=1e-12
    )
    orientations.angles = dict.fromkeys(names, 0.0)
    orientations.update(quaternion)
    np.testing.assert_allclose([orientations.angles[name] for name in names], angles, atol=1e-6)


def test_only_quaternions_have_angle_sliders():
    model = kv.load("articulations/floating")
    orientations = QuaternionAngles(model, complete(model))
    names = [str(symbol) for symbol in model.degrees_of_freedom]
    assert orientations.slider_names(names) == [
        f"floating/plane/{n}" for n in ("roll", "pitch", "yaw", "x", "y", "z")
    ]
    assert QuaternionAngles(kv.load("fetch"), complete(kv.load("fetch"))).limits == {}
    # A quaternion of zero is no rotation, and no reason to fail.
    orientations.update(dict.fromkeys(names, 0.0))
    assert set(orientations.angles.values()) == {0.0}


def test_drive_integrates_and_stops_at_a_violated_constraint():
    model = kv.load("articulations/ackermann")
    driving = VelocityDrive(model)
    assert list(driving.speeds) == ["ackermann/car/drive:velocity"]
    assert driving.limits["ackermann/car/drive:velocity"] == (-1.0, 1.0)
    assert not driving.running
    driving.speeds["ackermann/car/drive:velocity"] = 1.0
    values = {**complete(model), "ackermann/car/steering": 0.4}
    for _ in range(20):
        values.update(driving.step(values, 0.1))
    expected = model.integrate(
        {**complete(model), "ackermann/car/steering": 0.4}, {"ackermann/car/drive:velocity": 1.0}, 2.0
    )
    assert values == pytest.approx({str(s): v for s, v in expected.items()})
    # However long the page slept, nothing jumps.
    assert driving.step(values, 100.0)["ackermann/car/drive"] == pytest.approx(2.2)

    ball = kv.load("articulations/ball")
    driving, values = VelocityDrive(ball), complete(ball)
    driving.speeds["ball/stick/wx:velocity"] = 2.0
    for _ in range(30):
        values.update(driving.step(values, 0.05))
    assert not driving.running
    assert not ball.violations(values)
    assert 0.6 < 2 * math.atan2(values["ball/stick/qx"], values["ball/stick/qw"]) <= 0.7


def test_a_model_without_rates_has_no_drive_speeds():
    assert VelocityDrive(kv.load("kitchen")).speeds == {}
    assert list(VelocityDrive(kv.load("fetch")).speeds) == [
        "fetch/l_wheel_joint:velocity",
        "fetch/r_wheel_joint:velocity",
    ]


def test_locked_directions_follow_speed_limits():
    ranges = Ranges(lock())
    assert ranges.lockable == ["door", "ratchet"]
    values = {"bolt": 0.0, "door": 0.3, "drawer": 0.0, "ratchet": 0.0}
    assert ranges.locked_directions(values) == {"door": (True, True), "ratchet": (True, False)}
    assert ranges.locked_directions({**values, "bolt": 0.1}) == {
        "door": (False, False),
        "ratchet": (True, False),
    }


pytest.importorskip("viser", reason="the page needs the extra 'view'")

from kineverse.view import view  # noqa: E402


def content(viewer):
    assert viewer.settled()
    return viewer._panel._status.content


def by_hand(viewer, name, value):
    """Move a slider as a user of the page does."""
    viewer._panel._sliders[name].value = value
    viewer._set_from_slider(name, value)
    assert viewer.settled()


def test_angle_sliders_turn_a_ball_joint_and_accept_a_zero_quaternion():
    with view(kv.load("articulations/ball"), port=0) as viewer:
        assert list(viewer._panel._sliders) == [f"ball/stick/{angle}" for angle in ("roll", "pitch", "yaw")]
        by_hand(viewer, "ball/stick/roll", 0.5)
        np.testing.assert_allclose(viewer.pose("ball/stick")[:3, :3], kv.rotation_x(0.5)()[:3, :3], atol=1e-9)
        assert "All constraints hold" in content(viewer)
        by_hand(viewer, "ball/stick/pitch", 1.2)
        assert "ball/stick/cone" in content(viewer)
        viewer.move({f"ball/stick/q{element}": 0.0 for element in "xyzw"})
        assert "Not finite" in content(viewer)
        by_hand(viewer, "ball/stick/yaw", 0.3)
        assert "All constraints hold" in content(viewer)
        viewer.move({"ball/stick/qz": math.sin(0.2), "ball/stick/qw": math.cos(0.2)})
        assert viewer.settled()
        assert viewer._panel._sliders["ball/stick/yaw"].value == pytest.approx(0.4, abs=1e-3)


def test_a_base_drives_until_it_is_stopped():
    with view(kv.load("articulations/differential_drive"), port=0) as viewer:
        left, right = list(viewer._panel._speeds)
        viewer.drive({left: 3.0, right: 3.0})
        until(viewer, lambda: viewer.values["differential_drive/base/x"] > 0.05)
        assert viewer._panel._speeds[left].value == 3.0
        viewer.drive({left: 0.0, kv.velocity(right.removesuffix(":velocity")): 0.0})
        assert viewer.settled()
        x = viewer.values["differential_drive/base/x"]
        assert viewer.pose("differential_drive/base")[0, 3] == pytest.approx(x)
        assert viewer.values["differential_drive/base/left_wheel"] == pytest.approx(x / 0.08)
        viewer.drive({left: 1.0})
        viewer.reset()
        assert viewer.settled()
        assert viewer.values["differential_drive/base/x"] == 0.0
        assert viewer._panel._speeds[left].value == 0.0
        with pytest.raises(UnknownNameError, match="left_wheel"):
            viewer.drive({"differential_drive/base/left_weel:velocity": 1.0})


def until(viewer, condition):
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        with viewer._change:
            viewer._change.wait(timeout=0.1)


def test_slider_ranges_and_locks_follow_the_state():
    with view(lock(), port=0) as viewer:
        sliders = viewer._panel._sliders
        assert sliders["door"].disabled
        assert sliders["door"].label == "door [rad]   0 to 1.5 · locked"
        by_hand(viewer, "bolt", 0.1)
        assert not sliders["door"].disabled
        assert sliders["door"].label == "door [rad]   0 to 1.5"
        by_hand(viewer, "door", 1.0)
        assert sliders["drawer"].max == pytest.approx(0.2)
        by_hand(viewer, "bolt", 0.0)
        assert sliders["door"].disabled
        # One way it goes, and the other way its slider is put back.
        by_hand(viewer, "ratchet", 0.4)
        by_hand(viewer, "ratchet", 0.1)
        assert viewer.values["ratchet"] == sliders["ratchet"].value == 0.4


def test_a_state_where_a_loop_does_not_close_is_reported_and_not_drawn():
    with view(planar_loop(), port=0) as viewer:
        assert list(viewer._panel._sliders) == ["crank"]
        by_hand(viewer, "crank", 0.3)
        assert "All constraints hold" in content(viewer)
        before = viewer.pose("rocker_tip")
        by_hand(viewer, "crank", 2.5)
        assert "loop" in content(viewer)
        assert "This state cannot be shown" in content(viewer)
        np.testing.assert_array_equal(viewer.pose("rocker_tip"), before)
        by_hand(viewer, "crank", 0.35)
        assert "All constraints hold" in content(viewer)
        assert np.abs(viewer.pose("rocker_tip") - before).max() > 1e-3


def test_animation_moves_unlimited_coordinates_if_none_is_limited():
    for name, path in (("four_bar", "four_bar/crank"), ("ball", "ball/stick/qx")):
        with view(kv.load(f"articulations/{name}"), port=0) as viewer:
            viewer.play()
            until(viewer, lambda viewer=viewer, path=path: abs(viewer.values[path]) > 0.01)


def test_a_rigid_model_has_a_page():
    with view(kv.load("articulations/fixed"), port=0) as viewer:
        assert "All constraints hold" in content(viewer)
