"""MJCF, the description format of MuJoCo, read by MuJoCo's own parser."""

from kineverse.formats.mjcf.description import MjcfJoint, MjcfLink, MjcfScene, MjcfSite
from kineverse.formats.mjcf.reader import parse_mjcf, read_mjcf

__all__ = ["MjcfJoint", "MjcfLink", "MjcfScene", "MjcfSite", "parse_mjcf", "read_mjcf"]
