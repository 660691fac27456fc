"""The library of articulations: operations that connect frames."""

from .axis_joints import Continuous, Cylindrical, Prismatic, Revolute, Screw
from .bases import Ackermann, Base, DifferentialDrive, Mecanum, OmniBase
from .couplings import Cam, Coupling, Gearbox, RackAndPinion
from .free_joints import Ball, Floating, Planar, Universal
from .joint import AxialJoint, AxisJoint, Fixed, Joint
from .limits import Limits

__all__ = [
    "Ackermann",
    "AxialJoint",
    "AxisJoint",
    "Ball",
    "Base",
    "Cam",
    "Continuous",
    "Coupling",
    "Cylindrical",
    "DifferentialDrive",
    "Fixed",
    "Floating",
    "Gearbox",
    "Joint",
    "Limits",
    "Mecanum",
    "OmniBase",
    "Planar",
    "Prismatic",
    "RackAndPinion",
    "Revolute",
    "Screw",
    "Universal",
]
