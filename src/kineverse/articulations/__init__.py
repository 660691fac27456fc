"""Library of articulations: joints, transmissions, mobile bases, mechanisms and locks."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .bases import (
        Ackermann as Ackermann,
        Base as Base,
        DifferentialDrive as DifferentialDrive,
        Mecanum as Mecanum,
        OmniBase as OmniBase,
    )
    from .joint import (
        Fixed as Fixed,
        Joint as Joint,
        OneAxisMotion as OneAxisMotion,
        OneDofJoint as OneDofJoint,
    )
    from .limits import Limits as Limits
    from .locks import (
        position_lock as position_lock,
        speed_lock as speed_lock,
        tabulated_limit as tabulated_limit,
    )
    from .mechanisms import (
        DeskLamp as DeskLamp,
        DoorWithHandle as DoorWithHandle,
        Faucet as Faucet,
        FoldingDoor as FoldingDoor,
        GarageDoor as GarageDoor,
        Latch as Latch,
        Mechanism as Mechanism,
        Microwave as Microwave,
        PedalBin as PedalBin,
        PistonAndRod as PistonAndRod,
        Ratchet as Ratchet,
        ScissorLift as ScissorLift,
        ScrewAndNut as ScrewAndNut,
    )
    from .multi_axis import Ball as Ball, Floating as Floating, Planar as Planar, Universal as Universal
    from .single_axis import (
        Continuous as Continuous,
        Cylindrical as Cylindrical,
        Prismatic as Prismatic,
        Revolute as Revolute,
        Screw as Screw,
    )
    from .transmissions import (
        Cam as Cam,
        Gearbox as Gearbox,
        RackAndPinion as RackAndPinion,
        Transmission as Transmission,
    )

lazy_face(__name__)
