"""MJCF, the description format of MuJoCo, read by MuJoCo's own parser."""

from kineverse.formats.mjcf.description import Joint, Link, Scene, Site
from kineverse.formats.mjcf.reader import parse_mjcf, read_mjcf

__all__ = ["Joint", "Link", "Scene", "Site", "parse_mjcf", "read_mjcf"]
