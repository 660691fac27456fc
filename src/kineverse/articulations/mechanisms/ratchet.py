"""A wheel that turns one way."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from kineverse.articulations.limits import FREE, Limits
from kineverse.errors import ValueRejectedError
from kineverse.expressions.expression import Expression
from kineverse.motions import Y, turn

from .mechanism import Mechanism, Part
from .solids import DARK, RED, STEEL, box, rod, shift


@dataclass(frozen=True, kw_only=True)
class Ratchet(Mechanism):
    """A wheel with a pawl, which does not turn back: base_T_wheel = rotation_y(q), q = ``name`` [rad].

    It has no end stops. What is one-sided is its speed,

        ``name/pawl``:      0 <= q̇ <= speed

    so where it may be depends on where it has been, and every position is valid. The pawl is taken to hold
    anywhere; a real one gives way by up to a tooth, and how wide that is stands in the record.

    Frames are ``base``, ``wheel`` and ``pawl``, which stands still. The record has ``teeth`` and ``pitch``,
    2π/teeth [rad].

    Attributes
    ----------
    radius, thickness
        Of the wheel [m].
    teeth
        How many, at least 3.
    speed
        How fast it may turn [rad/s].

    Raises
    ------
    ValueRejectedError
        For lengths that are not positive, fewer than three teeth, or a speed of 0.
    """

    main: ClassVar[str] = "wheel"

    radius: float = 0.05
    thickness: float = 0.015
    teeth: int = 24
    speed: float = 10.0

    def __post_init__(self) -> None:
        self.lengths("radius", "thickness", "speed")
        if isinstance(self.teeth, bool) or not isinstance(self.teeth, int) or self.teeth < 3:
            raise ValueRejectedError(f"{self.its('teeth')} are a whole number from 3, not {self.teeth!r}.")
        super().__post_init__()

    @property
    def limits(self) -> Mapping[str, Limits]:
        """None of q."""
        return {self.path(): FREE}

    def locks(self) -> Mapping[str, tuple[float, Expression, float]]:
        """Return what the pawl does."""
        return {"pawl": (0.0, self.q().derivative(), self.speed)}

    def known(self) -> tuple[tuple[str, Any], ...]:
        """Return the teeth."""
        return (("teeth", self.teeth), ("pitch", math.tau / self.teeth))

    def parts(self) -> Mapping[str, Part]:
        """Return stand, wheel and pawl."""
        half, r = self.thickness / 2, self.radius
        angles = np.linspace(0.0, math.tau, self.teeth, endpoint=False).tolist()
        teeth = [
            rod(
                (r * math.sin(a), -half, r * math.cos(a)),
                (r * math.sin(a), half, r * math.cos(a)),
                0.06 * r,
                DARK,
            )
            for a in angles
        ]
        disc = rod((0.0, -half, 0.0), (0.0, half, 0.0), r, STEEL)
        stand = box((0.4 * r, self.thickness, 2.2 * r), (0.0, 2 * self.thickness, -0.7 * r), DARK)
        nose = rod((0.0, 0.0, 0.0), (-0.7 * r, 0.0, -0.25 * r), 0.08 * r, RED)
        return {
            "base": self.base(stand),
            "wheel": Part("base", (turn(Y, self.q()),), (disc, *teeth)),
            "pawl": Part("base", (shift(0.8 * r, 0.0, 1.25 * r),), (nose,)),
        }
