"""Program of ``test_real_ros.py``: ``kineverse ros`` in a process of its own, and a node that listens to it.

It prints what it has heard as JSON, for a test that knows what there should be.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from typing import Any

from kineverse_ros.ros import import_ros
from kineverse_ros.transforms import nanoseconds, to_numbers

PATIENCE = 40.0  # [s]


class Listener:
    """Node that speaks joint states, and keeps what it hears."""

    def __init__(self, joint: str) -> None:
        self.ros = import_ros()
        self.ros.rclpy.init(args=[])
        self.node = self.ros.rclpy.create_node("listener")
        self.executor = self.ros.Executor()
        self.executor.add_node(self.node)
        self.joint, self.values = joint, {}
        self.heard: dict[str, Any] = {}
        self.poses: dict[str, tuple[str, int, list[float]]] = {}
        self.publisher = self.node.create_publisher(self.ros.JointState, "joint_states", self.ros.QUEUED)
        self.listen("/tf", self.ros.TFMessage, self.ros.QUEUED, self.take)
        self.listen("joint_states/all", self.ros.JointState, self.ros.QUEUED, self.keep("joints"))

    def listen(self, topic: str, kind: Any, quality: Any, callback: Any) -> None:
        self.node.create_subscription(kind, topic, callback, quality)

    def listen_late(self) -> None:
        """Subscribe to what is said once."""
        ros = self.ros
        self.listen("/tf_static", ros.TFMessage, ros.STATIC, self.take)
        for topic in ("robot_description", "kineverse_document"):
            self.listen(topic, ros.String, ros.LATCHED, self.keep(topic))
        self.listen("visualization_marker_array", ros.MarkerArray, ros.LATCHED, self.keep("markers"))

    def keep(self, name: str) -> Any:
        return lambda message: self.heard.update({name: message})

    def take(self, message: Any) -> None:
        for one in message.transforms:
            numbers = [*to_numbers(one.transform.translation, one.transform.rotation)]
            self.poses[one.child_frame_id] = one.header.frame_id, nanoseconds(one.header.stamp), numbers

    def speak(self, value: float) -> int:
        now = self.node.get_clock().now().nanoseconds
        message = self.ros.JointState(name=[self.joint], position=[value])
        message.header.stamp = self.ros.Time(sec=now // 10**9, nanosec=now % 10**9)
        self.publisher.publish(message)
        return now

    def spin_until(self, is_done: Any) -> None:
        end = time.monotonic() + PATIENCE
        while not is_done():
            assert time.monotonic() < end, "nothing was heard in time"
            self.executor.spin_once(timeout_sec=0.01)


def main(models: list[str], joint: str, frame: str) -> None:
    variables = {k: v for k, v in os.environ.items() if not k.startswith("_ROS_WHEELS_")}
    command = [sys.executable, "-m", "kineverse", "ros", *models, "--rate", "100"]
    child = subprocess.Popen(
        command, env=variables, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        listener = Listener(joint)
        listener.spin_until(lambda: frame in listener.poses and listener.publisher.get_subscription_count())
        start, stamp = time.monotonic(), 0
        for number in range(100):  # at 100 Hz
            stamp = listener.speak(0.001 * number)
            while time.monotonic() < start + 0.01 * (number + 1):
                listener.executor.spin_once(timeout_sec=0.005)
        listener.spin_until(lambda: listener.poses[frame][1] == stamp)
        moving = set(listener.poses)
        listener.listen_late()
        listener.spin_until(lambda: len(listener.heard) == 4 and set(listener.poses) > moving)
        child.send_signal(signal.SIGINT)
        out, errors = child.communicate(timeout=PATIENCE)
    finally:
        child.kill()
    markers = listener.heard["markers"].markers
    print(
        json.dumps(
            {
                "status": child.returncode,
                "out": out,
                "errors": errors,
                "value": 0.001 * 99,
                "poses": {name: (parent, pose) for name, (parent, _, pose) in listener.poses.items()},
                "joints": dict(
                    zip(listener.heard["joints"].name, listener.heard["joints"].position, strict=True)
                ),
                "description": listener.heard["robot_description"].data,
                "document": listener.heard["kineverse_document"].data,
                "markers": [marker.ns for marker in markers if marker.frame_locked],
            }
        )
    )


if __name__ == "__main__":
    main(sys.argv[3:], *sys.argv[1:3])
