"""Mechanisms such as doors, taps, lifts and lamps: operations that write several frames."""

from .doors import FoldingDoor, GarageDoor
from .latched_doors import DoorWithHandle, Latch, Microwave
from .linkages import DeskLamp, PedalBin, PistonAndRod, ScissorLift
from .machine_elements import Faucet, Ratchet, ScrewAndNut
from .mechanism import Mechanism, MechanismPart

__all__ = [
    "DeskLamp",
    "DoorWithHandle",
    "Faucet",
    "FoldingDoor",
    "GarageDoor",
    "Latch",
    "Mechanism",
    "MechanismPart",
    "Microwave",
    "PedalBin",
    "PistonAndRod",
    "Ratchet",
    "ScissorLift",
    "ScrewAndNut",
]
