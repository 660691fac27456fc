"""URDF, the Unified Robot Description Format of ROS."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .description import (
        UrdfDynamics as UrdfDynamics,
        UrdfJoint as UrdfJoint,
        UrdfLimits as UrdfLimits,
        UrdfLink as UrdfLink,
        UrdfRobot as UrdfRobot,
        UrdfSafetyController as UrdfSafetyController,
    )
    from .reader import parse_urdf as parse_urdf, read_urdf as read_urdf

lazy_face(__name__)
