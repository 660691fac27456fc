"""Mechanisms such as doors, taps, lifts and lamps: operations that write several frames."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .doors import FoldingDoor as FoldingDoor, GarageDoor as GarageDoor
    from .latched_doors import DoorWithHandle as DoorWithHandle, Latch as Latch, Microwave as Microwave
    from .linkages import (
        DeskLamp as DeskLamp,
        PedalBin as PedalBin,
        PistonAndRod as PistonAndRod,
        ScissorLift as ScissorLift,
    )
    from .machine_elements import Faucet as Faucet, Ratchet as Ratchet, ScrewAndNut as ScrewAndNut
    from .mechanism import Mechanism as Mechanism, MechanismPart as MechanismPart

lazy_face(__name__)
