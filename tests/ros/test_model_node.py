"""The node of any model, on a small ROS in this process."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

import pytest
from fake_rclpy import SECOND, FakeRos
from model_bench import Bench, assert_tf_is_fk

import kineverse as kv
from kineverse.errors import KineverseError
from kineverse_ros.model_settings import declare_settings


@pytest.mark.parametrize(
    ("name", "values", "others"),
    [
        ("four_bar", {"four_bar/crank": 0.7}, ["four_bar/coupler", "four_bar/rocker"]),
        ("cam", {"cam/cam": 1.2}, ["cam/valve"]),
        ("folding_door", {"folding_door/door": 0.9}, []),
        ("gearbox", {"gearbox/first": -2.0}, ["gearbox/second", "gearbox/third"]),
        ("mimic", {"mimic/finger": 0.4}, ["mimic/middle", "mimic/tip"]),
        ("differential_drive", {"differential_drive/base/x": 0.4, "differential_drive/base/angle": 2.0}, []),
        ("fixed", {}, []),
    ],
)
def test_any_model_is_published_as_its_kinematics(name, values, others):
    bench = Bench(f"articulations/{name}")
    bench.say_values(values)
    bench.ros.advance(0.05)
    assert_tf_is_fk(bench, values)
    coordinates = list(map(str, bench.model.degrees_of_freedom))
    found = {n: p for m in bench.joints[-1:] for n, p in zip(m.name, m.position, strict=True)}
    assert list(found) == coordinates + others
    assert {joint: found[joint] for joint in values} == values
    state = bench.model.default_state().updated(values)
    for joint, expression in bench.model.rates.dependent.items():
        assert found[str(joint)] == pytest.approx(float(expression(state)), abs=1e-12)
    links = {one.attrib["name"] for one in ET.fromstring(bench.latest["robot_description"].data).iter("link")}
    assert links | {"world"} == set(bench.model.frames) | {"world"}
    document = kv.formats.from_bytes(bench.latest["kineverse_document"].data.encode())
    assert document.snapshot() == bench.model.snapshot()


def test_robot_and_furniture_have_names_of_their_own():
    rules = {"robot": "cam", "joint_names": ["prismatic/drawer=slide"], "frame_names": ["world=map"]}
    bench = Bench("articulations/cam", "articulations/prismatic", frame_prefix="a/", **rules)
    bench.say(cam=0.2, slide=0.1, caster_rotation_joint=1.0)
    bench.ros.advance(0.05)
    names = {frame: f"a/{frame}" for frame in bench.model.frames}
    assert_tf_is_fk(bench, {"cam/cam": 0.2, "prismatic/drawer": 0.1}, names, "a/map")
    assert bench.joints[-1].name == ["cam", "slide", "valve"]
    assert bench.warnings == [
        "/joint_states of /other has names that are no joints of the model: caster_rotation_joint."
    ]
    joints = ET.fromstring(bench.latest["robot_description"].data).iter("joint")
    assert {"cam", "slide"} <= {one.attrib["name"] for one in joints}


def test_stamps_are_those_of_readings_and_the_present_where_nothing_is_read():
    bench = Bench("articulations/cam", "articulations/prismatic")
    bench.ros.advance(0.1)
    bench.transforms.clear()
    for _ in range(20):
        bench.say_values({"cam/cam": 0.3}, ago=0.005)
        bench.ros.advance(0.01)
    stamps = {}
    for one in bench.transforms:
        stamp = one.header.stamp.sec * SECOND + one.header.stamp.nanosec
        stamps.setdefault(one.child_frame_id, []).append(stamp)
    for of_frame in stamps.values():
        assert of_frame == sorted(set(of_frame))  # never twice, never back
    assert all(stamp % (SECOND // 100) == SECOND // 200 for stamp in stamps["cam/valve"])
    assert all(stamp % (SECOND // 50) == 0 for stamp in stamps["prismatic/drawer"])
    bench.transforms.clear()
    bench.ros.advance(2.0)
    assert {one.child_frame_id for one in bench.transforms} == {"prismatic/drawer"}  # the other is silent
    assert bench.joints[-1].name == ["prismatic/drawer"]


@pytest.mark.parametrize(
    ("positions", "ago", "complaint"),
    [
        ({"cam/cam": math.nan}, 0.0, "no numbers: cam/cam"),
        ({"cam/cam": 0.5}, 5.0, "5 s old"),
        ({"cam/cam": 0.5}, -5.0, "5 s ahead of the clock"),
        ({"unknown": 0.5}, 0.0, "no joints of the model: unknown"),
    ],
)
def test_bad_joint_states_move_nothing_and_are_named_once_a_second(positions, ago, complaint):
    bench = Bench("articulations/cam")
    for _ in range(150):
        bench.say_values(positions, ago=ago)
        bench.ros.advance(0.01)
    assert_tf_is_fk(bench)
    assert 1 <= len(bench.warnings) <= 2
    assert all(complaint in text for text in bench.warnings)


def test_a_loop_that_cannot_be_closed_keeps_the_last_poses_and_is_named():
    bench = Bench("articulations/parallel_gripper")
    bench.say_values({"parallel_gripper/left_inner": 0.5})
    bench.ros.advance(0.05)
    before = bench.poses["parallel_gripper/left_outer"]
    bench.say_values({"parallel_gripper/left_inner": 3.0})
    bench.ros.advance(0.05)
    assert bench.poses["parallel_gripper/left_outer"][1] is before[1]
    assert "parallel_gripper/left_outer" not in bench.joints[-1].name
    assert "left_parallelogram' has no solution" in bench.warnings[0]


def test_a_clock_that_is_set_back_starts_transforms_anew():
    bench = Bench("articulations/cam")
    bench.say_values({"cam/cam": 0.5})
    bench.ros.advance(0.5)
    bench.ros.nanoseconds -= 500 * SECOND
    for timer in bench.node.timers:
        timer.due = bench.ros.nanoseconds
    bench.transforms.clear()
    bench.say_values({"cam/cam": 0.7})
    bench.ros.advance(0.1)
    assert_tf_is_fk(bench, {"cam/cam": 0.7})
    assert {one.header.stamp.sec for one in bench.transforms} == {500}


def test_a_node_without_a_clock_publishes_nothing_and_says_so():
    bench = Bench("articulations/cam")
    bench.transforms.clear()
    bench.ros.nanoseconds = 0
    bench.model_node.inputs.check()
    bench.model_node.tick()
    assert not bench.transforms
    assert bench.warnings == ["The time is 0: use_sim_time is set, and nobody serves /clock."]


def test_frames_of_somebody_else_are_left_out():
    bench = Bench("articulations/cam", "articulations/prismatic", omit=["cam/"])
    bench.ros.advance(0.1)
    assert set(bench.poses) == {frame for frame in bench.model.frames if not frame.startswith("cam/")}
    robot = ET.fromstring(bench.latest["robot_description"].data)
    assert not robot.findall("link[@name='cam/cam']/visual")
    assert robot.findall("link[@name='prismatic/drawer']/visual")
    assert not any(one.ns.startswith("cam/") for one in bench.latest["markers"].markers)


def test_markers_ride_on_transforms_and_replace_those_before():
    bench = Bench("articulations/desk_lamp")
    first, *others = bench.latest["markers"].markers
    marker = bench.ros.Marker
    assert first.action == marker.DELETEALL
    assert {one.ns for one in others} == {name for name, body in bench.model.bodies.items() if body.visuals}
    assert all(one.frame_locked and one.header.frame_id == one.ns for one in others)
    assert all(one.header.stamp == bench.ros.Time() for one in others)
    assert len({(one.ns, one.id) for one in others}) == len(others)


def test_latched_messages_reach_a_late_node():
    bench = Bench("articulations/cam")
    heard = []
    late = bench.ros.rclpy.create_node("late")
    for topic, kind in (
        ("/tf_static", "TFMessage"),
        ("robot_description", "String"),
        ("kineverse_document", "String"),
        ("visualization_marker_array", "MarkerArray"),
    ):
        late.create_subscription(getattr(bench.ros, kind), topic, heard.append, bench.ros.LATCHED)
    bench.ros.advance()
    assert len(heard) == 4


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"joint_names": ["cam/kam=a"]}, "has 'cam/kam', which names nothing. Did you mean 'cam/cam'"),
        ({"frame_names": ["cam/cam=cam/stand"]}, "would both be 'cam/stand'"),
        ({"frame_names": ["cam/"]}, "'cam/', which is not of the form"),
        ({"frame_names": ["cam/cam=a", "cam/cam=b"]}, "'cam/cam' twice"),
        ({"frame_names": ["cam/cam="]}, "would be '' in ROS"),
        ({"omit": ["pr2/"]}, "omit has 'pr2/', which names nothing"),
        ({"omit": ["cam/"]}, "There is nothing to publish"),
        ({"rate": 0.0}, "rate is a positive number"),
        ({"rate": "fast"}, "rate is a positive number"),
        ({"robot": "pr2"}, "robot is 'pr2', and no joint of the model is below that name"),
        ({"robot": 7}, "robot is a text"),
        ({"sources": 7}, "sources is a list of texts"),
        ({"sources": ["a", "/a"]}, "a topic is there twice"),
        ({"sources": ["/joint_states", "joint_states/all"]}, "where this node says itself what it reads"),
        ({"sources": ["joint states"]}, "'joint states' is no name of a topic"),
        ({"observed": ["door=/door"]}, "no frame 'door' to be observed"),
        ({"observed": ["cam/cam=tf:cam/cam"]}, "where this node publishes it"),
        ({"observed": ["cam/cam=7up"]}, "'7up' is no name of a topic"),
        ({"observed": ["cam/cam=/a", "cam/valve=/a"]}, "has the source '/a' twice"),
        ({"position_noise": -1.0}, "position_noise is a positive number"),
        ({"model": []}, "model is not given"),
        ({"share": "ros"}, "share is for a live model"),
    ],
)
def test_settings_that_do_not_fit_are_one_error(settings, message):
    with pytest.raises(KineverseError, match=message.replace("(", r"\(")):
        Bench("articulations/cam", **settings)


def test_parameters_are_settings_and_others_are_refused():
    ros = FakeRos({"rate": 10, "model": "kitchen pr2", "use_sim_time": True})
    settings = declare_settings(ros, ros.rclpy.create_node("a"), {"rate": 20.0, "robot": "pr2"})
    assert (settings.rate, settings.model, settings.robot) == (10, ("kitchen", "pr2"), "pr2")
    assert settings.sources == ("joint_states",)
    ros.parameters["raet"] = 3
    with pytest.raises(KineverseError, match=r"no parameter 'raet'.*'rate'"):
        declare_settings(ros, ros.rclpy.create_node("a"), {})
