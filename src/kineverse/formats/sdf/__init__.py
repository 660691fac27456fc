"""SDF, the Simulation Description Format of Gazebo."""

from kineverse.formats.sdf.description import Axis, Frame, Joint, Link, Root, Scene
from kineverse.formats.sdf.reader import parse_sdf, read_sdf

__all__ = ["Axis", "Frame", "Joint", "Link", "Root", "Scene", "parse_sdf", "read_sdf"]
