"""``kineverse reach``: positions for a pose, as text, JSON and picture."""

import importlib.util
import json

import numpy as np
import pytest

import kineverse as kv

HAND = "fetch/gripper_link"


def test_positions_are_printed_and_hold(run, tmp_path):
    status, out, err = run("reach", "fetch", HAND, "--pose", 0.7, 0.2, 0.9, "--json")
    assert (status, err) == (0, "")
    answer = json.loads(out)
    assert answer["reached"]
    assert answer["error"] < 1e-4
    model = kv.load("fetch")
    state = model.default_state().updated(answer["positions"])
    assert np.allclose(model.fk(HAND)(state)[:3, 3], [0.7, 0.2, 0.9], atol=1e-4)
    assert not model.violations(state)
    status, out, _ = run(
        "reach", "fetch", HAND, "--pose", "70cm", "0.2", "0.9", "--picture", tmp_path / "a.png"
    )
    assert status == 0
    assert out.startswith(f"{HAND}: reached\n")
    assert "fetch/elbow_flex_joint" in out
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"


def test_orientation_still_and_first_start(run):
    words = ["reach", "fetch", HAND, "--pose", 0.7, 0.2, 0.9, 0, "90deg", 0]
    status, out, _ = run(*words, "--still", "fetch/base", "--from", "fetch/base/x=0.1", "--json")
    answer = json.loads(out)
    assert status == 0
    assert "fetch/base/x" not in answer["positions"]
    model = kv.load("fetch")
    state = model.default_state().updated({"fetch/base/x": 0.1, **answer["positions"]})
    pose = np.array(kv.translation(0.7, 0.2, 0.9)() @ kv.rpy(0, np.pi / 2, 0)())
    assert np.allclose(model.fk(HAND)(state), pose, atol=1e-4)


def test_values_below_0_have_units(run):
    model = kv.load("articulations/omni_base")
    words = ["reach", "articulations/omni_base", "omni_base/base", "--json", "--pose"]
    status, out, _ = run(*words, "-30cm", "-2e-1", 0, 0, 0, "-90deg")
    assert status == 0
    pose = model.fk("omni_base/base")(model.default_state().updated(json.loads(out)["positions"]))
    assert np.allclose(pose, (kv.translation(-0.3, -0.2, 0) @ kv.rotation_z(-np.pi / 2))(), atol=1e-4)
    status, out, _ = run(*words, "-1e200", 0, 0)
    assert status == 1
    assert json.loads(out)["error"] > 1e199


def test_missing_meshes_of_a_picture_are_reported(run, tmp_path):
    visual = '<visual><geometry><mesh filename="none.obj"/></geometry></visual>'
    joint = '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>'
    file = tmp_path / "arm.urdf"
    file.write_text(f'<robot name="r"><link name="a"/><link name="b">{visual}</link>{joint}</robot>')
    words = ["reach", file, "b", "--pose", 0, 0, 0, 1, 0, 0, "--picture", tmp_path / "arm.png"]
    status, _, err = run(*words)
    assert status == 0
    assert "shown as placeholders: none.obj" in err


def test_not_reached_ends_with_status_1_and_the_reason(run):
    words = ["reach", "fetch", HAND, "--pose", 0.7, 0.2, 4, "--still", "fetch/base"]
    status, out, _ = run(*words)
    assert status == 1
    assert "not reached. No solution was found in 16 starts" in out
    assert "fetch/torso_lift_joint/position" in out
    status, out, _ = run(*words, "--starts", 2, "--json")
    answer = json.loads(out)
    assert (status, answer["reached"], answer["starts"]) == (1, False, 2)
    assert "fetch/torso_lift_joint/position" in answer["active"]


def test_robot_reaches_a_frame_of_another_model(run):
    handle = "kitchen/oven_door_handle"
    words = ["reach", "kitchen", HAND, "--robot", "fetch", "--pose", handle, "--position-only"]
    status, out, _ = run(*words)
    assert status == 0
    assert handle not in out
    assert "kitchen/oven_door " not in out


def test_pose_relative_to_a_frame(run):
    words = ["reach", "pr2", "pr2/l_gripper_tool_frame", "--pose", 0, 0.3, 0]
    status, out, _ = run(*words, "--relative-to", "pr2/r_gripper_tool_frame", "--json")
    assert status == 0
    model = kv.load("pr2")
    state = model.default_state().updated(json.loads(out)["positions"])
    pose = model.fk("pr2/l_gripper_tool_frame", "pr2/r_gripper_tool_frame")(state)
    assert np.allclose(pose[:3, 3], [0, 0.3, 0], atol=1e-4)


@pytest.mark.skipif(importlib.util.find_spec("coal") is None, reason="distances need coal")
def test_collisions_are_respected(run):
    words = [
        "reach",
        "fetch",
        HAND,
        "--pose",
        0.7,
        0.2,
        0.9,
        "--still",
        "fetch/base",
        "--collisions",
        "--json",
    ]
    status, out, _ = run(*words)
    assert status == 0
    from kineverse.geometry import Scene

    model = kv.load("fetch")
    scene = Scene(model)
    scene.update(model.default_state().updated(json.loads(out)["positions"]))
    assert not [p for p in scene.pairs_within(0.0) if "gripper_finger" not in p.a + p.b]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["fetch", HAND, "--pose", "1", "2"], "6 with roll, pitch and yaw"),
        (["fetch", HAND, "--pose", "1", "2", "x"], "'x' is not a length"),
        (["fetch", HAND, "--pose", "1", "2", "-nan"], "'-nan' is not a length"),
        (["fetch", HAND, "--pose", "1", "2", "3", "--picture", "a.jpg"], "written as .png"),
        (["fetch", HAND, "--pose", "fetch/grippr_link"], "fetch/gripper_link"),
        (["fetch", "fetch/grippr_link", "--pose", "1", "2", "3"], "fetch/gripper_link"),
        (["fetch", HAND, "--pose", HAND], "its pose is constant"),
        (["kitchen", "kitchen/wall", "--pose", "1", "2", "3"], "its pose is constant"),
        (["fetch", HAND, "--pose", "1", "2", "3", "--from", "x"], "--from 'x': write NAME=VALUE"),
        (["fetch", HAND, "--pose", "1", "2", "3", "--from", "x=1"], "Did you mean"),
        (["fetch", HAND, "--pose", "1", "2", "3", "--still", "base"], "fetch/base"),
        (["fetch", HAND, "--pose", "1", "2", "3", "--starts", "0"], "starts"),
    ],
)
def test_wrong_words_are_refused(run, words, message):
    status, out, err = run("reach", *words)
    assert (status, out) == (2, "")
    assert message in err
    assert len(err.splitlines()) == 1


def test_a_bolted_arm_is_put_where_its_place_says(run, tmp_path):
    """A slide of 1 m along x, which is turned to y and raised: the finger reaches along it."""
    (tmp_path / "slide.urdf").write_text(
        """<robot name="slide"><link name="root"/><link name="finger"/>
        <joint name="slide" type="prismatic"><parent link="root"/><child link="finger"/><axis xyz="1 0 0"/>
        <limit lower="0" upper="1" velocity="1" effort="9"/></joint></robot>"""
    )
    (tmp_path / "room.urdf").write_text('<robot name="room"><link name="floor"/></robot>')
    words = ["reach", tmp_path / "room.urdf", "finger", "--position-only", "--json", "--robot"]
    slide = f"{tmp_path / 'slide.urdf'}@0.3,-0.4,0.5,90deg"
    status, out, _ = run(*words, slide, "--pose", 0.3, 0.2, 0.5)
    assert (status, json.loads(out)["positions"]) == (0, {"slide": pytest.approx(0.6, abs=1e-4)})
    assert run(*words, slide, "--pose", 0.9, -0.4, 0.5)[0] == 1
    status, out, _ = run(*words, slide.replace(",0.5,90deg", ",0"), "--pose", 0.9, -0.4, 0)
    assert json.loads(out)["positions"] == {"slide": pytest.approx(0.6, abs=1e-4)}


def test_angles_of_many_turns_are_noted(run):
    _, _, err = run("reach", "fetch", "fetch/gripper_link", "--pose", "0.6", "0.2", "0.9", "0", "90", "0")
    assert "90 rad is 14.3 turns; in degrees it is 90deg" in err


def test_patterns_keep_coordinates_still(run):
    words = ["reach", "pr2", "pr2/l_gripper_tool_frame", "--pose", "0.6", "0.2", "0.9", "--json", "--still"]
    status, out, _ = run(*words, "pr2/base/*", "pr2/torso*")
    assert status == 0
    assert not [name for name in json.loads(out)["positions"] if "base/" in name or "torso" in name]
    status, _, err = run(*words, "pr3/*")
    assert (status, "--still: no coordinate matches 'pr3/*'" in err) == (2, True)
