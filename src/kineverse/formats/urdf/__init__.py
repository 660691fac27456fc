"""URDF, the Unified Robot Description Format of ROS."""

from kineverse.formats.urdf.description import Dynamics, Joint, Limits, Link, Mimic, Robot, Safety
from kineverse.formats.urdf.reader import parse_urdf, read_urdf

__all__ = ["Dynamics", "Joint", "Limits", "Link", "Mimic", "Robot", "Safety", "parse_urdf", "read_urdf"]
