"""The library of articulations: operations that connect frames."""

from kineverse.vocabulary import MODULE, unknown_attribute

from .axis_joints import Continuous, Cylindrical, Prismatic, Revolute, Screw
from .bases import Ackermann, Base, DifferentialDrive, Mecanum, OmniBase
from .couplings import Cam, Coupling, Gearbox, RackAndPinion
from .free_joints import Ball, Floating, Planar, Universal
from .joint import AxialJoint, AxisJoint, Fixed, Joint
from .limits import Limits
from .mechanisms import (
    DeskLamp,
    DoorWithHandle,
    Faucet,
    FoldingDoor,
    GarageDoor,
    Latch,
    Mechanism,
    Microwave,
    PedalBin,
    PistonAndRod,
    Ratchet,
    ScissorLift,
    ScrewAndNut,
)

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
    "DeskLamp",
    "DifferentialDrive",
    "DoorWithHandle",
    "Faucet",
    "Fixed",
    "Floating",
    "FoldingDoor",
    "GarageDoor",
    "Gearbox",
    "Joint",
    "Latch",
    "Limits",
    "Mecanum",
    "Mechanism",
    "Microwave",
    "OmniBase",
    "PedalBin",
    "PistonAndRod",
    "Planar",
    "Prismatic",
    "RackAndPinion",
    "Ratchet",
    "Revolute",
    "ScissorLift",
    "Screw",
    "ScrewAndNut",
    "Universal",
]


def __getattr__(name: str) -> object:
    raise unknown_attribute("The package kineverse.articulations", name, __all__, MODULE)
