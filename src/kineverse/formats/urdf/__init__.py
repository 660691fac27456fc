"""URDF, the Unified Robot Description Format of ROS."""

from kineverse.formats.urdf.description import (
    UrdfDynamics,
    UrdfJoint,
    UrdfLimits,
    UrdfLink,
    UrdfMimic,
    UrdfRobot,
    UrdfSafetyController,
)
from kineverse.formats.urdf.reader import parse_urdf, read_urdf

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
