"""A robot is put next to furniture: its names, its base, its place, its start."""

import numpy as np
import pytest

import kineverse as kv
from kineverse.manipulation import place_robot

ARM = """<robot name="arm"><link name="foot"/><link name="hand"/>
<joint name="turn" type="revolute"><parent link="foot"/><child link="hand"/><origin xyz="0 0 1"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "my arm.urdf"
    path.write_text(ARM, encoding="utf-8")
    return path


def test_shipped_robot_stands_where_it_is_put():
    model = kv.load("kitchen")
    robot = place_robot(model, "fetch", (0.45, 0.7, 1.5))
    assert (robot.name, [s.path for s in robot.base]) == (
        "fetch",
        [f"fetch/base/{n}" for n in ("x", "y", "angle")],
    )
    state = robot.start_state(model)
    np.testing.assert_allclose(model.fk("fetch/base_link")(state)[:2, 3], [0.45, 0.7])
    assert state[model.symbol("fetch/shoulder_lift_joint")] == pytest.approx(1.4)


def test_robot_without_a_place_has_none():
    model = kv.load("kitchen")
    robot = place_robot(model, "hsr")
    assert not robot.place
    assert robot.start_state(model)[robot.base[0]] == 0.0


def test_names_without_a_prefix_get_that_of_the_file(arm):
    model = kv.load("shelf_door")
    assert place_robot(model, arm).name == "my_arm"
    assert {"my_arm/foot", "my_arm/hand"} <= {*model.frames}
    assert place_robot(kv.Model(), arm, prefix="left").name == "left"


def test_empty_prefix_keeps_the_names_of_the_description(arm):
    model = kv.load("shelf_door")
    assert place_robot(model, arm, prefix="").name == ""
    assert "hand" in model.frames


def test_robot_without_a_base_is_bolted_to_its_place(arm):
    model = kv.load("shelf_door")
    robot = place_robot(model, arm, (1.0, 2.0, 0.5, np.pi / 2))
    assert (robot.base, robot.place) == ((), {})
    pose = model.fk("my_arm/hand")({"my_arm/turn": 0.0})
    np.testing.assert_allclose(pose[:3, 3], [1.0, 2.0, 1.5])
    np.testing.assert_allclose(pose[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)


def test_omnidirectional_base_carries_the_robot(arm):
    model = kv.load("shelf_door")
    robot = place_robot(model, arm, (1.0, 2.0, np.pi), base="omni")
    pose = model.fk("my_arm/hand")(robot.start_state(model))
    np.testing.assert_allclose(pose[:3, 3], [1.0, 2.0, 1.0])
    np.testing.assert_allclose(pose[:3, 0], [-1.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("robot", "options", "message"),
    [
        ("shelf_door", {}, "begin with 'shelf_door/', too"),
        ("hsr", {"base": "omni"}, "'hsr' has a base that moves already"),
        ("hsr", {"at": (1.0, 0.0, 0.5, 0.0)}, "no height 0.5"),
        ("hsr", {"at": (1.0, 0.0)}, "A place is x, y and an angle"),
        ("hsr", {"at": (1.0, float("nan"), 0.0)}, "A place is x, y and an angle"),
    ],
)
def test_wrong_robot_is_refused_and_the_model_stays(robot, options, message):
    model = kv.load("shelf_door")
    frames, version = {*model.frames}, model.version
    with pytest.raises(kv.errors.InvalidValueError, match=message):
        place_robot(model, robot, **options)
    assert ({*model.frames}, model.version) == (frames, version)


def test_furniture_is_no_robot(tmp_path):
    box = tmp_path / "box.urdf"
    box.write_text('<robot name="box"><link name="box"/></robot>', encoding="utf-8")
    with pytest.raises(kv.errors.InvalidValueError, match=r"Nothing of .* moves, so it is no robot"):
        place_robot(kv.load("shelf_door"), box)


def test_robot_in_contact_begins_at_the_nearest_free_place():
    pytest.importorskip("coal")
    model = kv.load("shelf_drawers")
    robot = place_robot(model, "hsr")
    start, contact = robot.find_free_start(model, robot.start_state(model))
    assert "hsr/" in contact
    moved = np.hypot(*(start[s] for s in robot.base[:2]))
    assert 0.2 < moved < 1.5
    assert robot.find_free_start(model, start) == (start, "")
    put = place_robot(kv.load("shelf_drawers"), "hsr", (0.0, 0.0, 0.0))
    with pytest.raises(kv.errors.InvalidValueError, match="begins in contact"):
        put.find_free_start(model, put.start_state(model))
