"""Ratchet: a wheel with a pawl."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from kineverse.articulations.limits import FREE, Limits
from kineverse.articulations.locks import speed_lock
from kineverse.errors import InvalidValueError
from kineverse.model.constraint import ConstraintLike
from kineverse.spatial import Y, rotation_about

from .mechanism import Mechanism, MechanismPart
from .simple_bodies import DARK, RED, STEEL, box_shape, rod_shape, shift


@dataclass(frozen=True, kw_only=True)
class Ratchet(Mechanism, document_kind="Ratchet"):
    """Ratchet: a wheel that turns one way only, unless its pawl is lifted.

    ================  ======================================================================
    ``name/wheel``    q [rad]: base_T_wheel = rotation_y(q), without end stops
    ``name/pawl``     p [rad]: it turns about y by p, 0 where it lies in the teeth
    frames            ``base``, ``wheel``, ``pawl``
    ``name/lock``     -c·speed <= q̇ <= speed with c = (p > release)
    record            ``teeth``, ``pitch`` = 2π/teeth [rad]
    ================  ======================================================================

    The constraint is on the speed, so every position is valid, and the reachable positions depend on the
    history. The pawl is assumed to hold at every angle; a real one gives way by up to a tooth. Teeth that
    pass below the pawl lift it too little to release the wheel; p does not include that motion.

    Attributes
    ----------
    radius, thickness
        Dimensions of the wheel [m].
    teeth
        Number of teeth, at least 3.
    speed
        Limit of the angular speed [rad/s].
    lift
        Limits of p.
    release
        Angle p beyond which the wheel is free [rad].

    Raises
    ------
    InvalidValueError
        For lengths that are not positive, fewer than three teeth, a speed of 0, or a pawl that cannot be
        lifted beyond its release.
    """

    main: ClassVar[str] = "wheel"

    radius: float = 0.05
    thickness: float = 0.015
    teeth: int = 24
    speed: float = 10.0
    lift: Limits = Limits(0.0, 0.4, 2.0)
    release: float = 0.2

    def __post_init__(self) -> None:
        self.check_lengths("radius", "thickness", "speed")
        if isinstance(self.teeth, bool) or not isinstance(self.teeth, int) or self.teeth < 3:
            raise InvalidValueError(
                f"{self.describe('teeth')} are a whole number from 3, not {self.teeth!r}."
            )
        super().__post_init__()
        self.check_threshold("release", self.lift)

    @property
    def limits(self) -> Mapping[str, Limits]:
        """Limits of the pawl; the wheel has none."""
        return {self.path("wheel"): FREE, self.path("pawl"): self.lift}

    def locks(self) -> Mapping[str, ConstraintLike]:
        """Return the lock of the wheel."""
        lifted = self.q("pawl") > self.release
        return {"lock": speed_lock(self.q("wheel"), open_if=lifted, max_speed=self.speed, blocks="backward")}

    def dynamics(self) -> tuple[tuple[str, Any], ...]:
        """Return the number and the pitch of the teeth."""
        return (("teeth", self.teeth), ("pitch", math.tau / self.teeth))

    def parts(self) -> Mapping[str, MechanismPart]:
        """Return stand, wheel and pawl."""
        half, r = self.thickness / 2, self.radius
        angles = np.linspace(0.0, math.tau, self.teeth, endpoint=False).tolist()
        teeth = [
            rod_shape(
                (r * math.sin(a), -half, r * math.cos(a)),
                (r * math.sin(a), half, r * math.cos(a)),
                0.06 * r,
                DARK,
            )
            for a in angles
        ]
        disc = rod_shape((0.0, -half, 0.0), (0.0, half, 0.0), r, STEEL)
        stand = box_shape((0.4 * r, self.thickness, 2.2 * r), (0.0, 2 * self.thickness, -0.7 * r), DARK)
        nose = rod_shape((0.0, 0.0, 0.0), (-0.7 * r, 0.0, -0.25 * r), 0.08 * r, RED)
        return {
            "base": self.base(stand),
            "wheel": MechanismPart("base", (rotation_about(Y, self.q("wheel")),), (disc, *teeth)),
            "pawl": MechanismPart(
                "base", (shift(0.8 * r, 0.0, 1.25 * r), rotation_about(Y, self.q("pawl"))), (nose,)
            ),
        }
