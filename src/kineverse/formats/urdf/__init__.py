"""URDF, the Unified Robot Description Format of ROS."""

from .description import (
    UrdfDynamics,
    UrdfJoint,
    UrdfLimits,
    UrdfLink,
    UrdfMimic,
    UrdfRobot,
    UrdfSafetyController,
)
from .reader import parse_urdf, read_urdf

__all__ = [
    "UrdfDynamics",
    "UrdfJoint",
    "UrdfLimits",
    "UrdfLink",
    "UrdfMimic",
    "UrdfRobot",
    "UrdfSafetyController",
    "parse_urdf",
    "read_urdf",
]
