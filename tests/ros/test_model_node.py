"""The node of any model, on a small ROS in this process."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

import numpy as np
import pytest

import kineverse as kv
from fake_rclpy import SECOND, FakeRos
from kineverse.errors import KineverseError
from kineverse.lie import quaternion, transform
from kineverse_ros.model_node import ModelNode, load_model
from kineverse_ros.model_settings import ModelSettings, declare_settings


class Bench:
    """A model node, and another node that listens to it and speaks to it."""

    def __init__(self, *models: str | kv.Model, parameters=None, **settings) -> None:
        self.ros = FakeRos({"use_sim_time": False, **(parameters or {})})
        self.node = self.ros.rclpy.create_node("kineverse_model")
        model = models[0] if isinstance(models[0], kv.Model) else load_model(models)
        checked = ModelSettings.from_values({"model": ["x"], **settings})
        self.model = model
        self.model_node = ModelNode(self.ros, self.node, model, checked)
        self.model_node.join()
        self.other = self.ros.rclpy.create_node("other")
        self.poses, self.joints, self.latest = {}, [], {}
        self.transforms = []
        self.listen("/tf", self.ros.TFMessage, self.hear_transforms)
        self.listen("/tf_static", self.ros.TFMessage, self.hear_transforms)
        self.listen(self.model_node.joint_topic, self.ros.JointState, self.joints.append)
        for topic, kind in (("robot_description", "String"), ("kineverse_document", "String")):
            self.listen(topic, getattr(self.ros, kind), lambda m, topic=topic: self.latest.update({topic: m}))
        self.listen(
            "visualization_marker_array",
            self.ros.MarkerArray,
            lambda m: self.latest.update({"markers": m}),
        )
        self.publishers = {}
        self.ros.deliver()

    def listen(self, topic, kind, callback):
        self.other.create_subscription(kind, topic, callback, self.ros.QUEUED)

    def hear_transforms(self, message):
        for one in message.transforms:
            self.transforms.append(one)
            place, turn = one.transform.translation, one.transform.rotation
            pose = transform(
                quaternion(np.array([turn.x, turn.y, turn.z, turn.w])), np.array([place.x, place.y, place.z])
            )
            self.poses[one.child_frame_id] = one.header.frame_id, pose

    def publish(self, topic, message):
        if topic not in self.publishers:
            self.publishers[topic] = self.other.create_publisher(type(message), topic, self.ros.QUEUED)
        self.publishers[topic].publish(message)

    def time(self, nanoseconds=None):
        seconds, rest = divmod(self.ros.nanoseconds if nanoseconds is None else nanoseconds, SECOND)
        return self.ros.Time(sec=seconds, nanosec=rest)

    def say(self, topic="joint_states", *, ago=0.0, **positions):
        self.say_values(positions, topic, ago)

    def say_values(self, positions, topic="joint_states", ago=0.0):
        message = self.ros.JointState(name=list(positions), position=list(positions.values()))
        message.header.stamp = self.time(self.ros.nanoseconds - round(ago * SECOND))
        self.publish(topic, message)

    def pose(self, frame, root="world"):
        pose = np.eye(4)
        while frame != root:
            frame, step = self.poses[frame]
            pose = step @ pose
        return pose

    @property
    def warnings(self):
        return [text for level, text in self.node.logged if level == "warning"]


def assert_tf_is_fk(bench, values=(), names=None):
    model = bench.model
    state = model.default_state().updated(dict(values))
    for frame in model.frames:
        pose = model.fk(frame)
        expected = pose({symbol: state[symbol] for symbol in pose.symbols})
        np.testing.assert_allclose(bench.pose((names or {}).get(frame, frame)), expected, atol=1e-12)


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
    assert bench.joints[-1].name == coordinates + others
    found = dict(zip(bench.joints[-1].name, bench.joints[-1].position, strict=True))
    assert {joint: found[joint] for joint in values} == values
    state = bench.model.default_state().updated(values)
    for joint, expression in bench.model.rates.dependent.items():
        assert found[str(joint)] == pytest.approx(float(expression(state)), abs=1e-12)
    links = {one.attrib["name"] for one in ET.fromstring(bench.latest["robot_description"].data).iter("link")}
    assert links | {"world"} == set(bench.model.frames) | {"world"}
    document = kv.formats.from_bytes(bench.latest["kineverse_document"].data.encode())
    assert document.snapshot() == bench.model.snapshot()
