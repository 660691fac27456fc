"""SDF, the Simulation Description Format of Gazebo."""

from .description import SdfAxis, SdfFrame, SdfJoint, SdfLink, SdfRoot, SdfScene
from .reader import parse_sdf, read_sdf

__all__ = ["SdfAxis", "SdfFrame", "SdfJoint", "SdfLink", "SdfRoot", "SdfScene", "parse_sdf", "read_sdf"]
