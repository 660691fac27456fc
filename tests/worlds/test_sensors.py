"""Sensors: the distribution of readings, their times, and visibility, against the settings."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import kineverse as kv
from cupboards import cupboard, state
from kineverse.errors import DuplicateNameError, InvalidValueError, UnknownNameError
from kineverse.lie import inverse, log_so3
from kineverse.worlds import Contact, Observation, Sensors, SensorSampler

NOISY = Sensors.parse(
    "3mm+3mm/m,0.5deg,drop=0.2,outliers=0.1,reach=1m,encoders=1e-3,odometry=20mm/m,turn=2deg"
)


@pytest.fixture(scope="module")
def model() -> kv.Model:
    return cupboard()


def readings(sampler: SensorSampler, at: kv.State, count: int, step: float = 1 / 30) -> list[Observation]:
    return [sampler.observe(k * step, at) for k in range(count)]


def test_without_settings_readings_are_exact_and_complete(model):
    at = state(model, robot__base__x=0.3, robot__pan=0.4, cupboard__door=0.5)
    sampler = SensorSampler(Sensors(), model, "robot")
    assert sampler.camera == "robot/head_tilt_link"
    assert sampler.marked == ("cupboard", "cupboard/panel", "cupboard/drawer")
    seen = sampler.observe(0.0, at)
    assert {str(s): v for s, v in seen.joints.items()} == {
        str(s): v for s, v in at.items() if str(s).startswith("robot/")
    }
    for name in sampler.marked:
        np.testing.assert_allclose(seen.poses[name], kv.compile(model.fk(name))(at), atol=1e-14)


def test_noise_has_the_deviations_that_are_stated(model):
    """Each at its own distance: 2.06 m to the cupboard's frame, 2.36 m to the drawer."""
    at = state(model)
    every = readings(SensorSampler(replace(NOISY, outliers=0.0), model, "robot", seed=3), at, 1500)
    assert len({o.stamp for o in every}) == len(every)
    for name, distance in (("cupboard", 2.0), ("cupboard/drawer", 2.3)):
        poses = np.array([o.poses[name] for o in every if name in o.poses])
        assert len(poses) == pytest.approx(1200, abs=5 * math.sqrt(1500 * 0.2 * 0.8))
        truth = kv.compile(model.fk(name))(at)
        moved = poses[:, :3, 3] - truth[:3, 3]
        turned = log_so3(truth[:3, :3].T @ poses[:, :3, :3])
        # The pose in the world has the encoder's error of the pan as well.
        camera = truth[:3, 3] - (0, 0, 1)
        expected = np.hypot(0.003 + 0.003 * (distance - 0.5), [1e-3 * abs(camera[1]), 1e-3 * camera[0], 0])
        np.testing.assert_allclose(moved.std(axis=0), expected, rtol=0.1)
        np.testing.assert_allclose(turned.std(axis=0), math.radians(0.5), rtol=0.1)
        assert abs(moved.mean(axis=0)).max() < 5 * 0.0085 / math.sqrt(len(poses))
    assert np.std([o.joints[model.symbol("robot/pan")] for o in every]) == pytest.approx(1e-3, rel=0.1)


def test_outliers_fill_a_cube_about_the_marker(model):
    sampler = SensorSampler(Sensors(outliers=0.5, reach=1.0), model, "robot")
    truth = kv.compile(model.fk("cupboard"))(model.default_state())
    poses = np.array([o.poses["cupboard"] for o in readings(sampler, state(model), 1000)])
    off = poses[:, :3, 3] - truth[:3, 3]
    stray = off.any(axis=1)
    assert stray.mean() == pytest.approx(0.5, abs=0.08)
    assert abs(off).max() < 0.5
    np.testing.assert_allclose(off[stray].std(axis=0), 1 / math.sqrt(12), rtol=0.1)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0, atol=1e-12)
    assert abs(poses[stray, :3, :3].mean(axis=0)).max() < 0.15  # any orientation


@pytest.mark.parametrize("steps", [4, 8, pytest.param(20, marks=pytest.mark.long)])
def test_odometry_drifts_with_the_way_not_with_the_steps(model, steps):
    """After 2 m straight ahead: sd of x and heading = settings times √2; y has what the heading adds."""
    ends = []
    for seed in range(100):
        sampler = SensorSampler(Sensors(odometry=0.02, turn=0.03), model, "robot", seed)
        for k in range(steps + 1):
            seen = sampler.observe(0.1 * k, state(model, robot__base__x=2 * k / steps))
        ends.append([seen.joints[model.symbol(f"robot/base/{c}")] for c in ("x", "y", "angle")])
    x, y, angle = np.std(ends, axis=0)
    assert (x, angle) == pytest.approx((0.02 * math.sqrt(2), 0.03 * math.sqrt(2)), rel=0.2)
    # A random walk of the heading, integrated over the way L: variance turn² L³ / 3.
    assert y == pytest.approx(math.hypot(0.02 * math.sqrt(2), 0.03 * math.sqrt(8 / 3)), rel=0.25)


def test_drift_leaves_what_the_camera_sees_relative_to_itself(model):
    sampler = SensorSampler(Sensors(odometry=0.1, turn=0.1), model, "robot", seed=1)
    sampler.observe(0.0, state(model))
    at = state(model, robot__base__x=1.0, robot__base__y=0.5, robot__base__angle=0.3)
    seen, camera = sampler.observe(0.1, at), kv.compile(model.fk("robot/head_tilt_link"))
    read = camera({s: seen.joints[s] for s in camera.inputs})
    assert abs(read - camera(at)).max() > 1e-2
    expected = inverse(camera(at)) @ kv.compile(model.fk("cupboard"))(at)
    np.testing.assert_allclose(inverse(read) @ seen.poses["cupboard"], expected, atol=1e-12)


def test_readings_arrive_after_the_delay_with_their_stamp(model):
    sampler = SensorSampler(Sensors(delay=0.05, rate=50.0), model, "robot")
    pan, stamps, pictures = model.symbol("robot/pan"), [], []
    for k in range(20):
        seen = sampler.observe(0.01 * k, state(model, robot__pan=0.01 * k))
        assert seen.joints[pan] == pytest.approx(seen.stamp, abs=1e-12)
        stamps.append(seen.stamp)
        pictures += [seen.stamp] if seen.poses else []
    assert stamps == pytest.approx([max(0.0, 0.01 * k - 0.05) for k in range(20)], abs=1e-12)
    assert pictures == pytest.approx([0.02 * k for k in range(8)], abs=1e-12)
    # The same time again: nothing new. After a long step: the picture that came last, and it alone.
    assert not sampler.observe(0.19, state(model)).poses
    late = sampler.observe(0.5, state(model))
    assert (late.stamp, len(late.poses)) == (pytest.approx(0.18), 3)


def test_the_camera_has_its_rate_and_joints_that_of_the_world(model):
    every = readings(SensorSampler(Sensors(rate=30.0), model, "robot"), state(model), 101, step=0.01)
    assert sum(bool(o.poses) for o in every) == 31
    assert [o.stamp for o in every] == pytest.approx([0.01 * k for k in range(101)])


def test_equal_seeds_give_equal_readings_and_a_reset_begins_anew(model):
    first = SensorSampler(NOISY, model, "robot", seed=5)

    def run(sampler: SensorSampler) -> list[float]:
        every = [sampler.observe(k / 30, state(model, robot__base__x=0.01 * k)) for k in range(20)]
        return [float(v) for o in every for v in (*o.joints.values(), *np.ravel(list(o.poses.values())))]

    once = run(first)
    with pytest.raises(InvalidValueError, match="reset"):
        first.observe(0.1, state(model))
    first.reset()
    assert run(first) == once
    assert run(SensorSampler(NOISY, model, "robot", seed=6)) != once


def test_markers_outside_of_the_field_of_view_are_not_seen(model):
    sampler = SensorSampler(Sensors(field_of_view=math.radians(40)), model, "robot")

    def seen(time: float, pan: float) -> set[str]:
        return set(sampler.observe(time, state(model, robot__pan=pan)).poses)

    assert seen(0.0, math.radians(19)) >= {"cupboard", "cupboard/drawer"}
    assert not seen(1.0, math.radians(21)) & {"cupboard", "cupboard/drawer"}


def test_a_door_hides_the_drawer_behind_it(model):
    """The neck, around the camera, hides nothing. The cupboard's back is behind the door as well."""
    sampler = SensorSampler(Sensors(sight=True), model, "robot")
    assert set(sampler.observe(0.0, state(model)).poses) == {"cupboard/panel"}
    assert set(sampler.observe(1.0, state(model, cupboard__door=1.5)).poses) == set(sampler.marked)


def test_touch_is_a_force_or_else_a_gap(model):
    def contact(a: str, distance: float, force: float) -> Contact:
        return Contact(a, "cupboard/panel", np.zeros(3), np.array([1.0, 0, 0]), distance, force)

    given = [
        contact("robot/neck", 5e-5, math.nan),
        contact("robot/base", 5e-4, math.nan),
        contact("robot/head_tilt_link", -1e-3, 0.1),
        contact("wall", -1e-3, 50.0),
    ]
    sampler = SensorSampler(Sensors(), model, "robot")
    assert sampler.observe(0.0, state(model), given).touching == {"robot/neck"}
    hard = [contact("robot/head_tilt_link", 1e-3, 5.0)]
    assert sampler.observe(0.1, state(model), hard).touching == {"robot/head_tilt_link"}
    assert not SensorSampler(Sensors(touch=False), model, "robot").observe(0.0, state(model), hard).touching


@pytest.mark.parametrize("robot", ["pr2", "fetch", "hsr"])
def test_shipped_robots_have_a_camera_and_a_base(robot):
    model = kv.load(robot)
    model.include("kitchen", prefix="kitchen")
    sampler = SensorSampler(Sensors(odometry=0.1), model, robot)
    assert sampler.camera == f"{robot}/head_tilt_link"
    assert {"kitchen/fridge", "kitchen/fridge_door", "kitchen/fridge_door_handle"} <= set(sampler.marked)
    assert not {"kitchen/wall", "kitchen/hood", "kitchen/stools"} & set(sampler.marked)
    at = model.default_state()
    sampler.observe(0.0, at)
    moved = at.updated({f"{robot}/base/x": 1.0})
    seen = sampler.observe(1.0, moved)
    off = {str(s) for s, value in seen.joints.items() if value != moved[s]}
    assert off == {f"{robot}/base/x", f"{robot}/base/y"}


def test_parse_reads_what_str_writes():
    texts = (
        "30Hz",
        "3mm+3mm/m,0.5deg,30Hz,drop=0.1,outliers=0.05,delay=30ms",
        "0mm+2mm/m,25Hz,reach=3m,encoders=0.0001,odometry=5mm/m,turn=1deg,camera=a/b,fov=70deg,sight,notouch",
    )
    for text in texts:
        assert str(Sensors.parse(text)) == text
    assert Sensors.parse(" 0.3 cm + 0.003m/m, 0.01rad,outliers=5%, delay=.03s ") == Sensors(
        position=0.003, position_per_metre=0.003, orientation=0.01, outliers=0.05, delay=0.03
    )
    assert Sensors.parse("none") == Sensors()


@pytest.mark.parametrize(
    ("text", "error", "says"),
    [
        ("3", InvalidValueError, "units are mm"),
        ("3mm+1deg", InvalidValueError, "not readable"),
        ("-3mm", InvalidValueError, "not readable"),
        ("drop=3mm", InvalidValueError, "drop=0.1"),
        ("drop=2", InvalidValueError, "from 0 to 1"),
        ("0Hz", InvalidValueError, "positive"),
        ("fov=400deg", InvalidValueError, "6.283"),
        ("3mm,,1deg", InvalidValueError, "not readable"),
        ("3mm,4mm", DuplicateNameError, "twice"),
        ("dorp=0.1", UnknownNameError, "'drop'"),
        ("sigth", UnknownNameError, "'sight'"),
    ],
)
def test_texts_that_cannot_be_read_are_refused(text, error, says):
    with pytest.raises(error, match=says):
        Sensors.parse(text)


def test_unknown_names_are_refused(model):
    with pytest.raises(UnknownNameError, match="robot"):
        SensorSampler(Sensors(), model, "robto")
    with pytest.raises(UnknownNameError, match="cupboard/panel"):
        SensorSampler(Sensors(marked=("cupboard/pannel",)), model, "robot")
    with pytest.raises(UnknownNameError, match="robot/neck"):
        SensorSampler(Sensors(camera="robot/nek"), model, "robot")
    with pytest.raises(InvalidValueError, match="camera="):
        SensorSampler(Sensors(sight=True), model, "cupboard")
