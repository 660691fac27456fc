"""Planar linkages: parallelograms and slider-cranks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from kineverse.articulations.limits import Limits
from kineverse.errors import InvalidValueError
from kineverse.expressions.functions import arcsin, cos, sin, sqrt
from kineverse.model.body import Pose
from kineverse.spatial import X, Y, Z, rotation_about, translation_along

from .mechanism import (
    BLUE,
    DARK,
    PALE,
    RED,
    STEEL,
    YELLOW,
    Mechanism,
    MechanismPart,
    box_shape,
    rod_shape,
    shift,
)

MOST_STAGES = 64
HALF_TURN = Pose((1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0))  # about x


@dataclass(frozen=True, kw_only=True)
class ScissorLift(Mechanism, document_kind="ScissorLift"):
    """Scissor lift: a platform on n pairs of crossed arms, one on top of the other.

    The coordinate ``name`` is the angle q of the arms above the horizontal [rad]. With arms of length L::

        slider at L cos q,      crossing i = 1 … n at (L/2 cos q, L (i - ½) sin q),      height n L sin q

    Note that the coordinate is not the height h. As functions of the angle all of these are smooth
    everywhere. As functions of the height they have infinite slopes when the arms stand upright,
    dq/dh = 1/(n L cos q); there the slider is at its end as well. So limits of the height are limits of the
    angle, arcsin(h/(n L)).

    Frames are ``base``, ``arm_1a``, ``arm_1b`` … (at the crossings, x along the arm), ``slider`` (the lower
    end of the first arm b, in the base) and ``platform`` (above the fixed pivots).

    Attributes
    ----------
    stages
        n, from 1 to 64.
    arm, width
        Length of the arms, and of the platform across [m].
    angle
        Limits of q, numbers in [0, π/2].

    Raises
    ------
    InvalidValueError
        For lengths that are not positive, a wrong number of stages, or limits beyond flat and upright.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.articulations.ScissorLift(name="lift", parent="world", stages=3, arm=1.0))
    'scissor lift lift'
    >>> model.fk("lift/platform")({"lift": np.pi / 6})[2, 3].round(3)
    np.float64(1.5)
    """

    main: ClassVar[str] = "platform"

    stages: int = 3
    arm: float = 1.0
    width: float = 0.6
    angle: Limits = Limits(0.1, 1.2, 0.2)

    def __post_init__(self) -> None:
        self.check_lengths("arm", "width")
        whole = isinstance(self.stages, int) and not isinstance(self.stages, bool)
        if not whole or not 1 <= self.stages <= MOST_STAGES:
            wanted = f"a whole number from 1 to {MOST_STAGES}"
            raise InvalidValueError(f"{self.describe('stages')} are {wanted}, not {self.stages!r}.")
        self.numeric_range("angle", 0.0, math.pi / 2)
        super().__post_init__()

    @property
    def limits(self) -> Mapping[str, Limits]:
        """Limits of q."""
        return {self.path(): self.angle}

    def parts(self) -> Mapping[str, MechanismPart]:
        """Return base, arms, slider and platform."""
        q, length, width = self.q(), self.arm, self.width
        rise, reach = length * sin(q), length * cos(q)
        thick = 0.04 * length
        deck = (1.06 * length, width, thick)
        parts = {"base": self.base(box_shape(deck, (length / 2, 0.0, -1.5 * thick), DARK))}
        for i in range(self.stages):
            middle = (translation_along(X, reach / 2), translation_along(Z, (i + 0.5) * rise))
            for letter, sign, inset, color in (("a", -1, 0.5, BLUE), ("b", 1, 0.4, STEEL)):
                size, off = (length, 0.5 * thick, thick), inset * width
                bars = box_shape(size, (0.0, -off, 0.0), color), box_shape(size, (0.0, off, 0.0), color)
                place = *middle, rotation_about(Y, sign * q)
                parts[f"arm_{i + 1}{letter}"] = MechanismPart("base", place, bars)
        axle = rod_shape((0.0, -width / 2, 0.0), (0.0, width / 2, 0.0), 0.6 * thick, RED)
        parts["slider"] = MechanismPart("base", (translation_along(X, reach),), (axle,))
        top = box_shape(deck, (length / 2, 0.0, 1.5 * thick), YELLOW)
        parts["platform"] = MechanismPart("base", (translation_along(Z, self.stages * rise),), (top,))
        return parts


@dataclass(frozen=True, kw_only=True)
class DeskLamp(Mechanism, document_kind="DeskLamp"):
    """Desk lamp on two parallelograms, which keep the orientation of its head.

    The lower arm leans by α from the vertical and the upper one rises by β from the horizontal. Each has a
    parallel bar of the same length, so elbow and head do not rotate::

        base_T_elbow = translation(L₁ sin α, 0, L₁ cos α)
        base_T_head  = base_T_elbow · translation(L₂ cos β, 0, L₂ sin β)

    The pivots of the lower parallelogram are side by side, and those of the upper one above each other. Both
    become flat at α = ±π/2 and β = ±π/2, which limits exclude.

    ================  ======================================================================
    ``name/lower``    α [rad]
    ``name/upper``    β [rad]
    frames            ``base``, ``lower_arm``, ``lower_bar``, ``elbow``, ``upper_arm``, ``upper_bar``,
                      ``head``, ``light`` (z along the light, downward)
    ================  ======================================================================

    Attributes
    ----------
    lower_arm, upper_arm
        L₁ and L₂ [m].
    offset
        Distance between an arm and its bar [m].
    lower, upper
        Limits of α and β, numbers within ±π/2.

    Raises
    ------
    InvalidValueError
        For lengths that are not positive, or limits at which a parallelogram becomes flat.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.articulations.DeskLamp(name="lamp", parent="world"))
    'desk lamp lamp'
    >>> model.degrees_of_freedom
    (lamp/lower, lamp/upper)
    >>> model.fk("lamp/head")({"lamp/lower": 0.4, "lamp/upper": 0.2})[:3, :3].round(9)
    array([[ 1.,  0.,  0.],
           [ 0.,  1.,  0.],
           [-0.,  0.,  1.]])
    """

    main: ClassVar[str] = "head"

    lower_arm: float = 0.4
    upper_arm: float = 0.38
    offset: float = 0.04
    lower: Limits = Limits(-0.8, 0.8, 1.0)
    upper: Limits = Limits(-0.9, 0.9, 1.0)

    def __post_init__(self) -> None:
        self.check_lengths("lower_arm", "upper_arm", "offset")
        for field in ("lower", "upper"):
            if max(map(abs, self.numeric_range(field, -math.pi / 2, math.pi / 2))) >= math.pi / 2:
                what = self.describe(field)
                raise InvalidValueError(f"{what} ends before ±π/2, where its parallelogram falls flat.")
        super().__post_init__()

    @property
    def limits(self) -> Mapping[str, Limits]:
        """Limits of α and β."""
        return {self.path("lower"): self.lower, self.path("upper"): self.upper}

    def parts(self) -> Mapping[str, MechanismPart]:
        """Return foot, arms, bars, elbow and head."""
        lean, rise = self.q("lower"), self.q("upper")
        first, second, off = self.lower_arm, self.upper_arm, self.offset
        foot, side, wide = 0.05, 0.0075, 0.027
        # The upper arm and its bar pass the lower ones on the other side of the elbow.
        upright = (rod_shape((0.0, -side, 0.0), (0.0, -side, first), 0.006, STEEL),)
        level = (rod_shape((0.0, side, 0.0), (second, side, 0.0), 0.006, STEEL),)
        up, out = rotation_about(Y, lean), rotation_about(Y, -rise)
        plate = rod_shape((0.0, 0.0, -foot), (0.0, 0.0, -foot / 2), 0.1, DARK)
        block = box_shape((0.02 + off, wide, foot), (off / 2, 0.0, -foot / 4), DARK)
        across = box_shape((0.02 + off, wide, 0.02), (off / 2, 0.0, 0.0), RED)
        post = box_shape((0.02, wide, 0.02 + off), (0.0, 0.0, off / 2), RED)
        shade = rod_shape((0.0, 0.0, 0.0), (0.0, 0.0, -0.05), 0.05, PALE)
        return {
            "base": self.base(plate, block),
            "lower_arm": MechanismPart("base", (up,), upright),
            "lower_bar": MechanismPart("base", (shift(off), up), upright),
            "elbow": MechanismPart("lower_arm", (shift(z=first), rotation_about(Y, -lean)), (across, post)),
            "upper_arm": MechanismPart("elbow", (out,), level),
            "upper_bar": MechanismPart("elbow", (shift(z=off), out), level),
            "head": MechanismPart("upper_arm", (shift(second), rotation_about(Y, rise)), (post, shade)),
            "light": MechanismPart("head", (shift(z=-0.05), HALF_TURN)),
        }


@dataclass(frozen=True, kw_only=True)
class PistonAndRod(Mechanism, document_kind="PistonAndRod"):
    """Slider-crank: a crank moves a piston by a rod, over the whole revolution.

    With the angle of the crank ``name``, q [rad], its radius r and the length l > r of the rod::

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

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.articulations.PistonAndRod(name="engine", parent="world", crank=0.04, rod=0.12))
    'piston and rod engine'
    >>> height = model.fk("engine/piston")[2, 3]
    >>> height({"engine": 0}).round(3), height({"engine": np.pi}).round(3)
    (np.float64(0.16), np.float64(0.08))
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
        size, middle = (0.08 * half, self.bore, 2 * r + 2 * half), top - r - half
        sides = [box_shape(size, (x * 1.08 * half, 0.0, middle), PALE) for x in (-1, 1)]
        back = 0.5 * self.bore
        web = box_shape((3 * thick, thick, r), (0.0, 2 * thick, r / 2), BLUE)
        pin = rod_shape((0.0, -2 * thick, r), (0.0, 2 * thick, r), thick, DARK)
        bar = box_shape((1.5 * thick, thick, length), (0.0, 0.0, length / 2), STEEL)
        head = rod_shape((0, 0, -0.3 * half), (0, 0, half), half, RED)
        return {
            "base": self.base(*sides, rod_shape((0.0, back, 0.0), (0.0, 4 * thick, 0.0), 1.5 * thick, DARK)),
            "crank": MechanismPart("base", (rotation_about(Y, q),), (web, pin)),
            "rod": MechanismPart("crank", (shift(z=r), rotation_about(Y, -lean - q)), (bar,)),
            "piston": MechanismPart("base", (translation_along(Z, height),), (head,)),
        }


@dataclass(frozen=True, kw_only=True)
class PedalBin(Mechanism, document_kind="PedalBin"):
    """Pedal bin: a pedal opens the lid, whose angle is a nonlinear function of the pedal's.

    The coordinate is the angle of the pedal ``name``, p [rad], 0 at rest. The pedal is a lever about a pivot
    under the bin, and a guided rod slides straight up. The rod has a horizontal slot at either end. In the
    lower one is a pin of the pedal, at distance a from its pivot, which lifts the rod by a sin p. In the
    upper one is a pin of the lid, at distance b from its hinge, which the rod lifts by b sin l, where l is
    the angle of the lid::

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

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.articulations.PedalBin(name="bin", parent="world"))
    'pedal bin bin'
    >>> lid = kv.spatial.rotation_angle(model.fk("bin/lid"))
    >>> lid({"bin": 0.1}).round(3), lid({"bin": 0.2}).round(3)
    (np.float64(0.394), np.float64(0.87))
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
        lever = box_shape((self.arm - toe, 0.02, 0.008), ((self.arm + toe) / 2, 0.0, 0.0), STEEL)
        tread = box_shape((0.05, 0.07, 0.01), (toe, 0.0, 0.004), DARK)
        bar = rod_shape((0.0, 0.0, 0.0), (0.0, 0.0, self.height - floor / 2), 0.004, STEEL)
        cover = rod_shape((-r, 0.0, 0.0), (-r, 0.0, 0.015), 1.03 * r, STEEL)
        at_pivot, at_rod = shift(pivot, 0.0, floor / 2), shift(hinge - self.lever, 0.0, floor / 2)
        return {
            "base": self.base(rod_shape((0.0, 0.0, floor), (0.0, 0.0, self.height), r, PALE)),
            "pedal": MechanismPart("base", (at_pivot, rotation_about(Y, -p)), (lever, tread)),
            "rod": MechanismPart("base", (at_rod, translation_along(Z, lift)), (bar,)),
            "lid": MechanismPart("base", (shift(hinge, 0.0, self.height), rotation_about(Y, lid)), (cover,)),
        }
