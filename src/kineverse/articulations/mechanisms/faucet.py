"""Mixer tap with one lever."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from kineverse.articulations.limits import Limits
from kineverse.expressions.expression import Expression
from kineverse.spatial import Y, Z, rotation_about

from .mechanism import Mechanism, MechanismPart
from .simple_bodies import STEEL, rod_shape, shift


@dataclass(frozen=True, kw_only=True)
class Faucet(Mechanism, document_kind="Faucet"):
    """Mixer tap: the lever is lifted for more water and turned for warmer water.

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
        return {
            "base": self.base(
                rod_shape((0.0, 0.0, 0.0), (0.0, 0.0, self.height), 0.024, STEEL),
                rod_shape((0.0, 0.0, spout), mouth, 0.012, STEEL),
            ),
            "outlet": MechanismPart("base", (shift(*mouth),)),
            "lever": MechanismPart(
                "base",
                (shift(z=self.height), rotation_about(Z, self.q("turn")), rotation_about(Y, self.q("lift"))),
                (
                    rod_shape((0.0, 0.0, -0.005), (0.0, 0.0, 0.03), 0.022, STEEL),
                    rod_shape((0.0, 0.0, 0.022), (-0.12, 0.0, 0.035), 0.007, STEEL),
                ),
            ),
        }
