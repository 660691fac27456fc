"""Machine elements: screw and nut, ratchet, faucet."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from kineverse.articulations.limits import FREE, Limits, check_speed_limit
from kineverse.articulations.locks import speed_lock
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression
from kineverse.model.constraint import ConstraintLike
from kineverse.spatial import Y, Z, rotation_about, translation_along

from .mechanism import DARK, RED, STEEL, YELLOW, Mechanism, MechanismPart, box_shape, rod_shape, shift


@dataclass(frozen=True, kw_only=True)
class ScrewAndNut(Mechanism, document_kind="ScrewAndNut"):
    """Screw that rotates in a fixed place, and a nut that slides along it without rotation.

    With the angle of the screw ``name``, q [rad], its pitch p and the travel t of the nut::

        base_T_screw = rotation_z(q),       base_T_nut = translation(0, 0, s)
        s = t - p q/2π  for p > 0,          s = -p q/2π  for p < 0

    both from q = 0 to ``2πt/|p|``. Turned to the left, as seen from its end at +z, a right-handed screw pulls
    the nut *towards* z = 0. So the nut of a right-handed screw starts at the far end.

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
        Limit of ``|q̇|`` [rad/s]; None for no limit.

    Raises
    ------
    InvalidValueError
        For a pitch of 0, lengths that are not positive, or a negative velocity.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(
    ...         kv.articulations.ScrewAndNut(name="vice", parent="world", pitch=0.01, travel=0.1)
    ...     )
    'screw and nut vice'
    >>> model.fk("vice/nut")({"vice": 2 * np.pi})[2, 3].round(4)  # one turn
    np.float64(0.09)
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
        shaft = rod_shape((0.0, 0.0, -end), (0.0, 0.0, self.travel + end), r, STEEL)
        mark = box_shape((3 * r, 0.5 * r, 0.5 * r), (0.0, 0.0, self.travel + 1.6 * end), STEEL)
        block = box_shape((4 * r, 4 * r, 2 * r), (0, 0, 0), YELLOW)
        slide = translation_along(Z, start - self.pitch / math.tau * q)
        return {
            "base": self.base(*(box_shape(bearing, (0.0, 0.0, z), DARK) for z in (-end, self.travel + end))),
            "screw": MechanismPart("base", (rotation_about(Z, q),), (shaft, mark)),
            "nut": MechanismPart("base", (slide,), (block,)),
        }


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

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.articulations.Ratchet(name="winch", parent="world"))
    'ratchet winch'
    >>> for pawl in (0.0, 0.3):
    ...     print(model.limits("winch/wheel:velocity", {"winch/pawl": pawl}))
    (0.0, 10.0)
    (-10.0, 10.0)
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
            what = self.describe("teeth")
            raise InvalidValueError(f"{what} are a whole number from 3, not {self.teeth!r}.")
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
        tips = [(r * math.sin(a), r * math.cos(a)) for a in angles]
        teeth = [rod_shape((x, -half, z), (x, half, z), 0.06 * r, DARK) for x, z in tips]
        disc = rod_shape((0.0, -half, 0.0), (0.0, half, 0.0), r, STEEL)
        stand = box_shape((0.4 * r, self.thickness, 2.2 * r), (0.0, 2 * self.thickness, -0.7 * r), DARK)
        nose = rod_shape((0.0, 0.0, 0.0), (-0.7 * r, 0.0, -0.25 * r), 0.08 * r, RED)
        pivot = shift(0.8 * r, 0.0, 1.25 * r)
        return {
            "base": self.base(stand),
            "wheel": MechanismPart("base", (rotation_about(Y, self.q("wheel")),), (disc, *teeth)),
            "pawl": MechanismPart("base", (pivot, rotation_about(Y, self.q("pawl"))), (nose,)),
        }


@dataclass(frozen=True, kw_only=True)
class Faucet(Mechanism, document_kind="Faucet"):
    """Mixer tap: the lever is lifted for more water and turned for warmer water.

    With the lift l and the turn t::

        base_T_lever = translation(0, 0, height) · rotation_z(t) · rotation_y(l)

    ================  ======================================================================
    ``name/lift``     l [rad], shut at its lower limit; raises the lever, which points to -x
    ``name/turn``     t [rad], cold at its lower limit and hot at its upper one
    frames            ``base``, ``lever``, ``outlet`` (at the mouth of the spout, z up)
    data              ``name/flow``, flow·(l - l₀)/(l₁ - l₀) [m³/s], and ``name/hot``, the fraction of hot
                      water (t - t₀)/(t₁ - t₀): expressions
    ================  ======================================================================

    Attributes
    ----------
    height, reach
        Height of the tap, and length of its spout [m].
    lift
        Limits of l, numbers from l₀ to l₁ within ±π/2.
    turn
        Limits of t, numbers from t₀ to t₁ within ±π.
    flow
        Flow of the open tap [m³/s].

    Raises
    ------
    InvalidValueError
        For lengths or a flow that are not positive, or ranges that are missing or empty.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.articulations.Faucet(name="tap", parent="world"))
    'faucet tap'
    >>> lift, turn = model.limits("tap/lift"), model.limits("tap/turn")
    >>> model.data["tap/hot"]({"tap/turn": turn[1]})
    np.float64(1.0)
    >>> model.data["tap/flow"]({"tap/lift": lift[0]})
    np.float64(0.0)
    """

    main: ClassVar[str] = "lever"

    height: float = 0.16
    reach: float = 0.18
    lift: Limits = Limits(0.0, 0.5, 1.5)
    turn: Limits = Limits(-0.8, 0.8, 2.0)
    flow: float = 1.5e-4

    def __post_init__(self) -> None:
        self.check_lengths("height", "reach", "flow")
        self.numeric_range("lift", -math.pi / 2, math.pi / 2)
        self.numeric_range("turn", -math.pi, math.pi)
        super().__post_init__()

    @property
    def limits(self) -> Mapping[str, Limits]:
        """Limits of l and t."""
        return {self.path("lift"): self.lift, self.path("turn"): self.turn}

    def data(self) -> Mapping[str, Expression]:
        """Return the flow, and the fraction of hot water."""
        return {"flow": self.flow * self._fraction("lift"), "hot": self._fraction("turn")}

    def _fraction(self, name: str) -> Expression:
        """Return the position of a coordinate in its range, from 0 to 1."""
        lower, upper = self.numeric_range(name, -math.pi, math.pi)
        return (self.q(name) - lower) / (upper - lower)

    def parts(self) -> Mapping[str, MechanismPart]:
        """Return the tap, its lever and its outlet."""
        spout = 0.6 * self.height
        mouth = (-self.reach, 0.0, 0.75 * self.height)
        column = rod_shape((0.0, 0.0, 0.0), (0.0, 0.0, self.height), 0.024, STEEL)
        pipe = rod_shape((0.0, 0.0, spout), mouth, 0.012, STEEL)
        head = rod_shape((0.0, 0.0, -0.005), (0.0, 0.0, 0.03), 0.022, STEEL)
        stick = rod_shape((0.0, 0.0, 0.022), (-0.12, 0.0, 0.035), 0.007, STEEL)
        moves = rotation_about(Z, self.q("turn")), rotation_about(Y, self.q("lift"))
        return {
            "base": self.base(column, pipe),
            "outlet": MechanismPart("base", (shift(*mouth),)),
            "lever": MechanismPart("base", (shift(z=self.height), *moves), (head, stick)),
        }
