"""Screw and nut."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from kineverse.articulations.limits import Limits, check_speed_limit
from kineverse.errors import InvalidValueError
from kineverse.spatial import Z, rotation_about, translation_along

from .mechanism import Mechanism, MechanismPart
from .simple_bodies import DARK, STEEL, YELLOW, box_shape, rod_shape


@dataclass(frozen=True, kw_only=True)
class ScrewAndNut(Mechanism, document_kind="ScrewAndNut"):
    """Screw that rotates in a fixed place, and a nut that slides along it without rotation.

    With the angle of the screw ``name``, q [rad], its pitch p and the travel t of the nut:

        base_T_screw = rotation_z(q),       base_T_nut = translation(0, 0, s)
        s = t - p q/2π  for p > 0,          s = -p q/2π  for p < 0

    both from q = 0 to 2πt/|p|. Surprise first: turned to the left, as seen from its end at +z, a right-handed
    screw pulls the nut *towards* z = 0. So the nut of a right-handed screw starts at the far end.

    Frames are ``base``, ``screw`` and ``nut``.

    Attributes
    ----------
    pitch
        p, displacement of the nut in one revolution [m]; negative for a left-handed thread.
    travel
        t, length of the nut's path [m].
    radius
        Radius of the screw [m].
    velocity
        Limit of |q̇| [rad/s]; None for no limit.

    Raises
    ------
    InvalidValueError
        For a pitch of 0, lengths that are not positive, or a negative velocity.
    """

    main: ClassVar[str] = "nut"

    pitch: float = 0.004
    travel: float = 0.2
    radius: float = 0.01
    velocity: float | None = 20.0

    def __post_init__(self) -> None:
        self.check_lengths("travel", "radius")
        if not self.number("pitch"):
            raise InvalidValueError(f"{self.describe('pitch')} is 0, so nothing would move the nut.")
        check_speed_limit(self.velocity, self.describe("velocity"))
        super().__post_init__()

    @property
    def limits(self) -> Mapping[str, Limits]:
        """Limits of q."""
        return {self.path(): Limits(0.0, math.tau * self.travel / abs(self.pitch), self.velocity)}

    def parts(self) -> Mapping[str, MechanismPart]:
        """Return bearings, screw and nut."""
        q, r, end = self.q(), self.radius, 2.5 * self.radius
        start = self.travel if self.pitch > 0 else 0.0
        bearing = (4 * r, 4 * r, r)
        return {
            "base": self.base(*(box_shape(bearing, (0.0, 0.0, z), DARK) for z in (-end, self.travel + end))),
            "screw": MechanismPart(
                "base",
                (rotation_about(Z, q),),
                (
                    rod_shape((0.0, 0.0, -end), (0.0, 0.0, self.travel + end), r, STEEL),
                    box_shape((3 * r, 0.5 * r, 0.5 * r), (0.0, 0.0, self.travel + 1.6 * end), STEEL),
                ),
            ),
            "nut": MechanismPart(
                "base",
                (translation_along(Z, start - self.pitch / math.tau * q),),
                (box_shape((4 * r, 4 * r, 2 * r), (0, 0, 0), YELLOW),),
            ),
        }
