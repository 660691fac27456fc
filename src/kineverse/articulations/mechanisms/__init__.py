"""Mechanisms such as doors, taps, lifts and lamps: operations that write several frames."""

from .faucet import Faucet
from .folding_door import FoldingDoor
from .garage_door import GarageDoor
from .latched_doors import DoorWithHandle, Latch, Microwave
from .mechanism import Mechanism, MechanismPart
from .parallelograms import DeskLamp, ScissorLift
from .ratchet import Ratchet
from .screw_and_nut import ScrewAndNut
from .slider_cranks import PedalBin, PistonAndRod

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
