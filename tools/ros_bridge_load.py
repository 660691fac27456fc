"""Load of the node that publishes a model in ROS 2: ``.venv/ros/bin/python tools/ros_bridge_load.py``.

Kitchen and PR2 are published at 100 Hz by a process of its own, while joint states of the PR2 come at 100 Hz
from here. Printed are the part of a core that it takes, how far transforms here are from forward kinematics,
and how many joint states were lost after the first.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from typing import Any

import numpy as np

import kineverse as kv
from kineverse.lie import quaternion, transform
from kineverse_ros.model_node import ALL_JOINT_STATES, ModelNode, load_model, run_model_node
from kineverse_ros.ros import import_ros

MODELS, ROBOT, RATE = ("kitchen", "pr2"), "pr2", 100.0
STARTED = "started"


def measure(seconds: float) -> dict[str, Any]:
    """Return what was measured over a time [s]."""
    ros = import_ros()
    # The wheels restart each Python once; a child that finds this done would not find their libraries.
    variables = {k: v for k, v in os.environ.items() if not k.startswith("_ROS_WHEELS_")}
    child = subprocess.Popen(
        [sys.executable, __file__, "--node"],
        env=variables,
        stdout=subprocess.PIPE,
        text=True,
        encoding="utf-8",
    )
    try:
        assert child.stdout is not None
        assert child.stdout.readline().strip() == STARTED
        listener = Listener(ros, load_model(MODELS))
        listener.speak_for(2.0)
        heard, before, start = listener.heard, cpu_seconds(child.pid), time.monotonic()
        listener.speak_for(seconds)
        took = time.monotonic() - start
        share, rate = (cpu_seconds(child.pid) - before) / took, (listener.heard - heard) / took
        child.send_signal(signal.SIGINT)
        counted = json.loads(child.stdout.read())
    finally:
        child.kill()
        child.wait()
    return {
        "seconds": seconds,
        "core": share,
        "transforms": len(listener.compared),
        "difference": max(listener.compared),
        "rate": rate,
        **counted,
    }


class Listener:
    """Node that publishes joint states, and compares transforms with the values of their stamps."""

    def __init__(self, ros: Any, model: kv.Model) -> None:
        self._ros = ros
        ros.rclpy.init(args=[])
        self._node = ros.rclpy.create_node("driver")
        self._publisher = self._node.create_publisher(ros.JointState, "joint_states", ros.QUEUED)
        self._joints = [str(s) for s in model.degrees_of_freedom if str(s).startswith(f"{ROBOT}/")]
        self._frames = {f: frame.parent for f, frame in model.frames.items() if f.startswith(f"{ROBOT}/")}
        functions = {name: kv.compile(model.fk(name, parent)) for name, parent in self._frames.items()}
        self._functions = functions
        self._start = {str(symbol): value for symbol, value in model.default_state().items()}
        self._said: dict[int, dict[str, float]] = {}
        self.compared: list[float] = []
        self.sent = self.heard = 0
        self._node.create_subscription(ros.TFMessage, "/tf", self._hear, ros.QUEUED)
        self._node.create_subscription(ros.JointState, ALL_JOINT_STATES, self._hear_joints, ros.QUEUED)
        self._node.create_timer(1.0 / RATE, self._speak)
        self._executor = ros.Executor()
        self._executor.add_node(self._node)

    def speak_for(self, seconds: float) -> None:
        """Run for a time [s]."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.1)

    def _speak(self) -> None:
        self.sent += 1
        now = self._node.get_clock().now().nanoseconds
        values = {
            name: self._start[name] + 0.1 * float(np.sin(0.01 * self.sent + place))
            for place, name in enumerate(self._joints)
        }
        self._said[now] = values
        message = self._ros.JointState(
            name=[name.removeprefix(f"{ROBOT}/") for name in values], position=[*values.values()]
        )
        message.header.stamp = self._ros.Time(sec=now // 10**9, nanosec=now % 10**9)
        self._publisher.publish(message)

    def _hear_joints(self, message: Any) -> None:
        self.heard += 1

    def _hear(self, message: Any) -> None:
        """Compare one of the transforms, another one each time, so that this takes little."""
        own = [one for one in message.transforms if one.child_frame_id in self._functions]
        if not own:
            return
        one = own[len(self.compared) % len(own)]
        values = self._said.get(one.header.stamp.sec * 10**9 + one.header.stamp.nanosec)
        if values is None:
            return
        function = self._functions[one.child_frame_id]
        expected = function([values.get(name, self._start[name]) for name in function.names])
        place, turn = one.transform.translation, one.transform.rotation
        rotation = quaternion(np.array([turn.x, turn.y, turn.z, turn.w]))
        found = transform(rotation, np.array([place.x, place.y, place.z]))
        self.compared.append(float(np.abs(found - expected).max()))


def cpu_seconds(pid: int) -> float:
    """Return the time that all threads of a process have computed [s] (Linux)."""
    with open(f"/proc/{pid}/stat", encoding="utf-8") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run_node() -> None:
    """Run the node, and print at the end what it has received."""
    nodes: list[ModelNode] = []

    def started(node: ModelNode) -> None:
        nodes.append(node)
        node.join()
        print(STARTED, flush=True)

    run_model_node({"model": list(MODELS), "robot": ROBOT, "rate": RATE}, [], started)
    inputs = nodes[0].inputs
    print(json.dumps({"received": inputs.received.total(), "lost": inputs.lost.total()}))


def main() -> None:
    """Measure, and print the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="time to measure [s] (10)")
    parser.add_argument("--json", action="store_true", help="as one JSON object")
    parser.add_argument("--node", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.node:
        run_node()
        return
    result = measure(arguments.seconds)
    if arguments.json:
        print(json.dumps(result))
        return
    print(
        f"{' + '.join(MODELS)} at {RATE:g} Hz ({result['rate']:.0f} were reached) for {result['seconds']:g} s"
    )
    print(f"  {100 * result['core']:.1f} % of a core")
    print(f"  {result['transforms']} transforms, at most {result['difference']:.1e} from fk")
    print(f"  {result['received']} joint states of the robot received since the first, {result['lost']} lost")


if __name__ == "__main__":
    main()
