"""SDF, the Simulation Description Format of Gazebo."""

from kineverse.formats.sdf.description import SdfAxis, SdfFrame, SdfJoint, SdfLink, SdfRoot, SdfScene
from kineverse.formats.sdf.reader import parse_sdf, read_sdf

__all__ = ["SdfAxis", "SdfFrame", "SdfJoint", "SdfLink", "SdfRoot", "SdfScene", "parse_sdf", "read_sdf"]
