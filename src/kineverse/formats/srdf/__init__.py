"""SRDF, the Semantic Robot Description Format of MoveIt, which accompanies a URDF."""

from .description import EndEffector, Srdf, SrdfGroup, VirtualJoint
from .reader import parse_srdf, read_srdf

__all__ = ["EndEffector", "Srdf", "SrdfGroup", "VirtualJoint", "parse_srdf", "read_srdf"]
