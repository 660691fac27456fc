"""A model node on a small ROS in this process, with a node that listens to it and speaks to it."""

from __future__ import annotations

import numpy as np
from fake_rclpy import SECOND, FakeRos

import kineverse as kv
from kineverse.lie import quaternion, to_quaternion, transform
from kineverse_ros.model_node import ModelNode, load_model
from kineverse_ros.model_settings import ModelSettings


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
        period = 1.0 / checked.rate
        self.node.create_timer(period, self.model_node.tick)
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

    def see(self, topic, frame_id, pose, *, ago=0.0):
        """Publish a pose as PoseStamped."""
        message = self.ros.PoseStamped()
        message.header.frame_id = frame_id
        message.header.stamp = self.time(self.ros.nanoseconds - round(ago * SECOND))
        set_pose(message.pose.position, message.pose.orientation, pose)
        self.publish(topic, message)

    def send_transform(self, topic, parent, child, pose):
        """Publish a pose as a transform of TF."""
        one = self.ros.TransformStamped(child_frame_id=child)
        one.header.frame_id, one.header.stamp = parent, self.time()
        set_pose(one.transform.translation, one.transform.rotation, pose)
        self.publish(topic, self.ros.TFMessage(transforms=[one]))

    def pose(self, frame, root="world"):
        pose = np.eye(4)
        while frame != root:
            frame, step = self.poses[frame]
            pose = step @ pose
        return pose

    @property
    def warnings(self):
        return [text for level, text in self.node.logged if level == "warning"]


def assert_tf_is_fk(bench, values=(), names=None, root="world"):
    model = bench.model
    state = model.default_state().updated(dict(values))
    for frame in model.frames:
        pose = model.fk(frame)
        expected = pose({symbol: state[symbol] for symbol in pose.symbols})
        np.testing.assert_allclose(bench.pose((names or {}).get(frame, frame), root), expected, atol=1e-12)


def set_pose(place, turn, pose):
    place.x, place.y, place.z = pose[:3, 3].tolist()
    turn.x, turn.y, turn.z, turn.w = to_quaternion(pose[:3, :3]).tolist()
