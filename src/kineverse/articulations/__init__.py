"""Library of articulations: joints, transmissions, mobile bases, mechanisms and locks."""

from kineverse._synonyms import MODULE_SYNONYMS
from kineverse.errors import unknown_attribute_error

from .bases import Ackermann, Base, DifferentialDrive, Mecanum, OmniBase
from .joint import Fixed, Joint, OneAxisMotion, OneDofJoint
from .limits import Limits
from .locks import position_lock, speed_lock, tabulated_limit
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
from .multi_axis import Ball, Floating, Planar, Universal
from .single_axis import Continuous, Cylindrical, Prismatic, Revolute, Screw
from .transmissions import Cam, Gearbox, RackAndPinion, Transmission

__all__ = [
    "Ackermann",
    "Ball",
    "Base",
    "Cam",
    "Continuous",
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
    "OneAxisMotion",
    "OneDofJoint",
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
    "Transmission",
    "Universal",
    "position_lock",
    "speed_lock",
    "tabulated_limit",
]


def __getattr__(name: str) -> object:
    raise unknown_attribute_error("The package kineverse.articulations", name, __all__, MODULE_SYNONYMS)
