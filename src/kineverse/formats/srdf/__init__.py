"""SRDF, the Semantic Robot Description Format of MoveIt, which stands beside a URDF."""

from kineverse.formats.srdf.description import EndEffector, Srdf, SrdfGroup, VirtualJoint
from kineverse.formats.srdf.reader import parse_srdf, read_srdf

__all__ = ["EndEffector", "Srdf", "SrdfGroup", "VirtualJoint", "parse_srdf", "read_srdf"]
