"""MJCF, the description format of MuJoCo, read by MuJoCo's own parser."""

from .description import MjcfJoint, MjcfLink, MjcfScene, MjcfSite
from .reader import parse_mjcf, read_mjcf

__all__ = ["MjcfJoint", "MjcfLink", "MjcfScene", "MjcfSite", "parse_mjcf", "read_mjcf"]
