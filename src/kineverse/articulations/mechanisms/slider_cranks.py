"""Slider-crank mechanisms in closed form: piston and rod, pedal bin."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from kineverse.articulations.limits import Limits
from kineverse.errors import InvalidValueError
from kineverse.expressions.functions import arcsin, cos, sin, sqrt
from kineverse.spatial import Y, Z, rotation_about, translation_along

from .mechanism import Mechanism, MechanismPart
from .simple_bodies import BLUE, DARK, PALE, RED, STEEL, box_shape, rod_shape, shift


@dataclass(frozen=True, kw_only=True)
class PistonAndRod(Mechanism, document_kind="PistonAndRod"):
    """Slider-crank: a crank moves a piston by a rod, over the whole revolution.

    With the angle of the crank ``name``, q [rad], its radius r and the length l > r of the rod:

        base_T_crank  = rotation_y(q)                                       (the pin is at r along z)
        base_T_piston = translation(0, 0, r cos q + √(l² - r² sin² q))
        rod's angle   = -arcsin(r/l sin q) about y, at the pin

    The root is positive, so all of it is smooth, dead centres included. The piston's position cannot be the
    coordinate: it is the same for q and -q.

    Frames are ``base``, ``crank``, ``rod`` (at the pin, z towards the piston) and ``piston``.

    Attributes
    ----------
    crank, rod
        r and l [m].
    bore
        Diameter of the piston [m].
    turn
        Limits of q; by default of the speed only.

    Raises
    ------
    InvalidValueError
        For lengths that are not positive, or a rod that is not longer than the crank, which cannot complete
        a revolution then.
    """

    main: ClassVar[str] = "piston"

    crank: float = 0.04
    rod: float = 0.13
    bore: float = 0.07
    turn: Limits = Limits(velocity=10.0)

    def __post_init__(self) -> None:
        self.check_lengths("crank", "rod", "bore")
        if not self.rod > self.crank:
            raise InvalidValueError(
                f"{self.describe('rod')} is longer than its crank, {self.crank:g}, and not {self.rod:g}: the "
                "crank could not go round."
            )
        super().__post_init__()

    @property
    def limits(self) -> Mapping[str, Limits]:
        """Limits of q."""
        return {self.path(): self.turn}

    def parts(self) -> Mapping[str, MechanismPart]:
        """Return crankcase, crank, rod and piston."""
        q, r, length = self.q(), self.crank, self.rod
        height = r * cos(q) + sqrt(length**2 - (r * sin(q)) ** 2)
        lean = arcsin(r / length * sin(q))
        thick, half = 0.16 * r, self.bore / 2
        top = r + length + half
        sides = [
            box_shape(
                (0.08 * half, self.bore, 2 * r + 2 * half), (x * 1.08 * half, 0.0, top - r - half), PALE
            )
            for x in (-1, 1)
        ]
        back = 0.5 * self.bore
        return {
            "base": self.base(*sides, rod_shape((0.0, back, 0.0), (0.0, 4 * thick, 0.0), 1.5 * thick, DARK)),
            "crank": MechanismPart(
                "base",
                (rotation_about(Y, q),),
                (
                    box_shape((3 * thick, thick, r), (0.0, 2 * thick, r / 2), BLUE),
                    rod_shape((0.0, -2 * thick, r), (0.0, 2 * thick, r), thick, DARK),
                ),
            ),
            "rod": MechanismPart(
                "crank",
                (shift(z=r), rotation_about(Y, -lean - q)),
                (box_shape((1.5 * thick, thick, length), (0.0, 0.0, length / 2), STEEL),),
            ),
            "piston": MechanismPart(
                "base",
                (translation_along(Z, height),),
                (rod_shape((0, 0, -0.3 * half), (0, 0, half), half, RED),),
            ),
        }


@dataclass(frozen=True, kw_only=True)
class PedalBin(Mechanism, document_kind="PedalBin"):
    """Pedal bin: a pedal opens the lid, whose angle is a nonlinear function of the pedal's.

    The coordinate is the angle of the pedal ``name``, p [rad], 0 at rest. The pedal is a lever about a pivot
    under the bin, and a guided rod slides straight up. The rod has a horizontal slot at either end. In the
    lower one is a pin of the pedal, at distance a from its pivot, which lifts the rod by a sin p. In the
    upper one is a pin of the lid, at distance b from its hinge, which the rod lifts by b sin l, where l is
    the angle of the lid:

        l = arcsin(a/b sin p)

    The slope grows towards the end, and is finite as long as a sin p < b.

    Frames are ``base`` (on the floor under the centre), ``pedal``, ``rod`` and ``lid`` (at its hinge).

    Attributes
    ----------
    radius, height
        Dimensions of the bin [m].
    arm
        a, distance from the pedal's pivot to the rod [m].
    lever
        b, distance from the lid's hinge to the rod [m].
    pedal
        Limits of p, numbers in [0, π/2).

    Raises
    ------
    InvalidValueError
        For lengths that are not positive, or an arm that lifts the rod by the lid's lever or more.
    """

    main: ClassVar[str] = "lid"

    radius: float = 0.14
    height: float = 0.4
    arm: float = 0.2
    lever: float = 0.052
    pedal: Limits = Limits(0.0, 0.25, 1.0)

    def __post_init__(self) -> None:
        self.check_lengths("radius", "height", "arm", "lever")
        _, upper = self.numeric_range("pedal", 0.0, math.pi / 2)
        lift = self.arm * math.sin(upper)
        if not lift < self.lever:
            raise InvalidValueError(
                f"{self.describe('lever')} is {self.lever:g}, and its pedal lifts the rod by {lift:.6g}, "
                "which is as far or farther: the lid would have to open beyond a right angle."
            )
        super().__post_init__()

    @property
    def limits(self) -> Mapping[str, Limits]:
        """Limits of p."""
        return {self.path(): self.pedal}

    def parts(self) -> Mapping[str, MechanismPart]:
        """Return bin, pedal, rod and lid."""
        p, r = self.q(), self.radius
        lift = self.arm * sin(p)
        lid = arcsin(lift / self.lever)
        hinge, pivot, floor = r, r - self.lever - self.arm, 0.04
        toe = min(-r - 0.04, pivot - 0.03) - pivot
        return {
            "base": self.base(rod_shape((0.0, 0.0, floor), (0.0, 0.0, self.height), r, PALE)),
            "pedal": MechanismPart(
                "base",
                (shift(pivot, 0.0, floor / 2), rotation_about(Y, -p)),
                (
                    box_shape((self.arm - toe, 0.02, 0.008), ((self.arm + toe) / 2, 0.0, 0.0), STEEL),
                    box_shape((0.05, 0.07, 0.01), (toe, 0.0, 0.004), DARK),
                ),
            ),
            "rod": MechanismPart(
                "base",
                (shift(hinge - self.lever, 0.0, floor / 2), translation_along(Z, lift)),
                (rod_shape((0.0, 0.0, 0.0), (0.0, 0.0, self.height - floor / 2), 0.004, STEEL),),
            ),
            "lid": MechanismPart(
                "base",
                (shift(hinge, 0.0, self.height), rotation_about(Y, lid)),
                (rod_shape((-r, 0.0, 0.0), (-r, 0.0, 0.015), 1.03 * r, STEEL),),
            ),
        }
