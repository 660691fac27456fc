"""ROS 2, imported when it is used, and the qualities of service of its topics."""

from __future__ import annotations

import importlib
import os
from functools import cache
from types import SimpleNamespace
from typing import Any

from kineverse.errors import MissingDependencyError

_MESSAGES = {
    "builtin_interfaces": ("Time",),
    "geometry_msgs": ("Point", "PoseStamped", "Transform", "TransformStamped", "Twist"),
    "rcl_interfaces": ("ParameterDescriptor",),
    "sensor_msgs": ("JointState",),
    "std_msgs": ("Float64MultiArray", "String"),
    "tf2_msgs": ("TFMessage",),
    "trajectory_msgs": ("JointTrajectory", "JointTrajectoryPoint"),
    "visualization_msgs": ("Marker", "MarkerArray"),
}


@cache
def import_ros() -> Any:
    """Return ROS 2 as one namespace: ``rclpy``, the classes of messages by name, and qualities of service.

    Without one, or with a part of one, that is a MissingDependencyError with what helps.
    """
    # The wheels send to the whole network unless told otherwise; a ROS that is sourced is set up by its user.
    if "ROS_DISTRO" not in os.environ:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    try:
        rclpy = importlib.import_module("rclpy")
        qos = importlib.import_module("rclpy.qos")
        clock = importlib.import_module("rclpy.clock")
        executors = importlib.import_module("rclpy.executors")
        serialization = importlib.import_module("rclpy.serialization")
        signals = importlib.import_module("rclpy.signals")
        messages = {
            name: getattr(importlib.import_module(f"{package}.msg"), name)
            for package, names in _MESSAGES.items()
            for name in names
        }
    except ImportError as error:
        raise MissingDependencyError(
            f"ROS 2 cannot be imported ({error}). With an installed ROS 2, source it: "
            "source /opt/ros/DISTRO/setup.bash, in an environment of the same Python. Without one, in a "
            "checkout on Linux x86-64: make ros, then .venv/ros/bin/python -m kineverse ros ..."
        ) from None
    latched = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
    static = qos.QoSProfile(depth=100, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)  # of many publishers
    queued = qos.QoSProfile(depth=100)
    return SimpleNamespace(
        rclpy=rclpy,
        Executor=executors.SingleThreadedExecutor,
        LATCHED=latched,
        NO_SIGNALS=signals.SignalHandlerOptions.NO,
        QUEUED=queued,
        STATIC=static,
        serialize=serialization.serialize_message,
        STEADY=clock.Clock(clock_type=clock.ClockType.STEADY_TIME),
        **messages,
    )
