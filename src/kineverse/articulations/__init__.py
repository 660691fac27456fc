"""The library of articulations: operations that connect frames."""

from .axis_joints import Continuous, Prismatic, Revolute
from .bases import DifferentialDrive, OmniBase
from .free_joints import Floating, Planar
from .joint import AxisJoint, Fixed, Joint

__all__ = [
    "AxisJoint",
    "Continuous",
    "DifferentialDrive",
    "Fixed",
    "Floating",
    "Joint",
    "OmniBase",
    "Planar",
    "Prismatic",
    "Revolute",
]
