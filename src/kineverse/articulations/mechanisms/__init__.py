"""Mechanisms: doors, taps, lifts and lamps, each an operation that writes several frames."""

from .cranks import PedalBin, PistonAndRod
from .faucet import Faucet
from .folding_door import FoldingDoor
from .garage_door import GarageDoor
from .latched_doors import DoorWithHandle, Latch, Microwave
from .mechanism import Mechanism, Part
from .parallelograms import DeskLamp, ScissorLift
from .ratchet import Ratchet
from .screw_and_nut import ScrewAndNut

__all__ = [
    "DeskLamp",
    "DoorWithHandle",
    "Faucet",
    "FoldingDoor",
    "GarageDoor",
    "Latch",
    "Mechanism",
    "Microwave",
    "Part",
    "PedalBin",
    "PistonAndRod",
    "Ratchet",
    "ScissorLift",
    "ScrewAndNut",
]
