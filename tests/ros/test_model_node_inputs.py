"""What moves the model of a node beside joint states: observed poses, and a model server."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from fake_rclpy import SECOND
from model_bench import Bench, assert_tf_is_fk

import kineverse as kv
from kineverse.lie import translation
from kineverse.model.basic_operations import SetBody

LONG = 20.0  # longest time that anything is waited for [s]
HINGE = "revolute/door"


def pose_of(model, frame, relative_to="world", **values):
    pose = model.fk(frame, relative_to)
    state = model.default_state().updated({name.replace("__", "/"): v for name, v in values.items()})
    return pose({symbol: state[symbol] for symbol in pose.symbols})


def value_of(bench, joint):
    message = bench.joints[-1]
    return dict(zip(message.name, message.position, strict=True)).get(joint)


def test_observed_poses_move_the_model():
    bench = Bench("articulations/revolute", observed=[f"{HINGE}=door_pose"])
    for angle in np.linspace(0.5, 0.8, 20):
        bench.see("door_pose", "world", pose_of(bench.model, HINGE, revolute__door=angle), ago=0.02)
        bench.ros.advance(0.02)
    assert value_of(bench, HINGE) == pytest.approx(0.8, abs=0.02)
    (stamp,) = {
        one.header.stamp.sec * SECOND + one.header.stamp.nanosec
        for one in bench.transforms[-1:]
        if one.child_frame_id == HINGE
    }
    assert stamp <= bench.ros.nanoseconds - SECOND // 50
    assert not [text for text in bench.warnings if "Nobody publishes" not in text]


def test_frames_of_tf_are_observed_by_way_of_frames_that_are_not_in_the_model():
    bench = Bench("articulations/revolute", observed=[f"{HINGE}=tf:marker"], frame_names=["world=map"])
    seen = pose_of(bench.model, HINGE, revolute__door=0.6)
    camera = translation(np.array([0.3, 0.2, 0.1]))
    bench.send_transform("/tf_static", "map", "camera", camera)
    bench.ros.advance()
    for _ in range(20):
        bench.send_transform("/tf", "camera", "marker", np.linalg.inv(camera) @ seen)
        bench.ros.advance(0.02)
    assert value_of(bench, HINGE) == pytest.approx(0.6, abs=1e-3)


def test_what_is_read_is_an_input_of_what_is_observed():
    """A camera on a robot sees a door, where the robot's joints tell it to be."""
    bench = Bench("articulations/revolute", "articulations/desk_lamp", observed=[f"{HINGE}=/seen"])
    camera = list(bench.model.frames)[-1]
    joints = {str(s): 0.2 for s in bench.model.symbols_of(camera)}
    state = bench.model.default_state().updated({**joints, HINGE: 0.7})
    pose = bench.model.fk(HINGE, camera)
    for _ in range(20):
        bench.say_values(joints)
        bench.see("/seen", camera, pose({symbol: state[symbol] for symbol in pose.symbols}))
        bench.ros.advance(0.02)
    assert value_of(bench, HINGE) == pytest.approx(0.7, abs=1e-3)
    assert {joint: value_of(bench, joint) for joint in joints} == joints


@pytest.mark.parametrize(
    ("frame_id", "scale", "ago", "complaint"),
    [
        ("camera", 1.0, 0.0, "its frame_id 'camera' is no frame of the model"),
        ("world", np.nan, 0.0, "no numbers, or a quaternion that is none"),
        ("world", 1.0, 3.0, "3 s old"),
    ],
)
def test_bad_poses_move_nothing_and_are_named_once_a_second(frame_id, scale, ago, complaint):
    bench = Bench("articulations/revolute", observed=[f"{HINGE}=door_pose"])
    for _ in range(60):
        bench.see("door_pose", frame_id, scale * pose_of(bench.model, HINGE, revolute__door=0.8), ago=ago)
        bench.ros.advance(0.02)
    assert value_of(bench, HINGE) == 0.0
    said = [text for text in bench.warnings if "Nobody publishes" not in text]
    assert 1 <= len(said) <= 2
    assert all(complaint in text for text in said)


# -- live models ---------------------------------------------------------------------------------------------


@pytest.fixture
def serve_home(sockets, tmp_path):
    """Function that starts the server ``home`` in a process of its own, with the same store each time."""
    pytest.importorskip("zenoh")
    running = []

    def start(*models):
        command = [sys.executable, "-m", "kineverse", "serve", *models, "--name", "home"]
        process = subprocess.Popen(
            [*command, "--store", tmp_path / "home.db"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        running.append(process)
        assert process.stdout.readline().startswith("home")
        return process

    yield start
    for process in running:
        process.kill()
        process.wait()
        process.stdout.close()


def until(bench, is_so):
    end = time.monotonic() + LONG
    while not is_so():
        assert time.monotonic() < end, bench.warnings
        bench.ros.advance(0.02)
        bench.model_node.join()
        time.sleep(0.005)


def test_a_live_model_is_followed_through_edits_and_the_end_of_its_server(serve_home):
    server = serve_home("articulations/revolute", "articulations/cam")
    with kv.load("live:home") as model, kv.load("live:home") as other:
        options = {"parameters": {"use_sim_time": True}, "share": "ros", "frame_names": ["cam/cam=nocke"]}
        bench = Bench(model, **options)
        with other.edit() as edit:
            edit.add_frame("handle", HINGE, kv.translation(0.1, 0.2, 0.3))
            edit.apply(kv.Prismatic(name="drawer", parent="world", child="drawer", lower=0.0, upper=1.0))
            box = kv.model.Shape(kv.model.Box((1.0, 1.0, 1.0)))
            edit.apply(SetBody("drawer", kv.model.Body(visuals=(box,))))
        until(bench, lambda: {"handle", "drawer"} <= bench.poses.keys())
        until(bench, lambda: "drawer" in bench.latest["robot_description"].data)
        assert "drawer" in {marker.ns for marker in bench.latest["markers"].markers}
        # What ROS says goes to the server's other clients, and what its other sources say comes to ROS.
        reader, arm = other.exchange.reader(), other.exchange.publisher("arm", ["drawer", "nonsense"])

        def is_exchanged():
            bench.say_values({HINGE: 0.4})
            arm.put([0.25, 1.0])
            bench.ros.advance(0.02)
            shared = {str(symbol): value for symbol, value in reader.state.items()}
            return shared.get(HINGE) == 0.4 and value_of(bench, "drawer") == 0.25

        until(bench, is_exchanged)
        assert_tf_is_fk(bench, {HINGE: 0.4, "drawer": 0.25}, {"cam/cam": "nocke"})
        for _ in range(60):  # what is read no longer is shared no longer
            bench.say_values({"cam/cam": 0.1})
            bench.ros.advance(0.02)
        (shared,) = [one for one in other.exchange.status().sources if one.source == "ros"]
        assert shared.coordinates == ("cam/cam",)
        server.send_signal(signal.SIGKILL)
        server.wait()
        until(bench, lambda: not model.exchange.is_online)
        bench.say_values({HINGE: 0.5})
        until(bench, lambda: value_of(bench, HINGE) == 0.5)
        serve_home()
        until(bench, lambda: other.exchange.is_online)
        with other.edit() as edit:
            edit.remove("body drawer")
            edit.remove("joint drawer")
        until(bench, lambda: "drawer" not in {marker.ns for marker in bench.latest["markers"].markers})
        bench.transforms.clear()
        bench.say_values({"cam/cam": 0.2})
        until(bench, lambda: {one.child_frame_id for one in bench.transforms} >= {"nocke"})
        assert "drawer" not in {one.child_frame_id for one in bench.transforms}
        assert any("no joints of the model: nonsense" in text for text in bench.warnings)
        with other.edit() as edit:
            for tag in [
                tag for tag in reversed(other.history.tags) if "cam/" in tag
            ]:  # which the map of names has
                edit.remove(tag)
        until(bench, lambda: any("is not published" in text for text in bench.warnings))
        assert any("The map of names has 'cam/cam', which names nothing" in t for t in bench.warnings)
