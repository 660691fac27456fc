"""Mobile bases: a frame that moves over the floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kineverse.errors import ValueRejectedError
from kineverse.expressions.expression import array
from kineverse.expressions.functions import norm
from kineverse.model.constraint import ConstraintLike
from kineverse.model.operation import Effects
from kineverse.model.reader import Reader
from kineverse.spatial import rotation_z, translation
from kineverse.symbols import position, velocity

from .joint import Joint


@dataclass(frozen=True, kw_only=True)
class OmniBase(Joint):
    """An omnidirectional base: parent_T_child = origin · translation(x, y, 0) · rotation_z(θ).

    Coordinates ``name/x``, ``name/y`` [m] and ``name/angle`` [rad], all free.

    Attributes
    ----------
    speed
        Limit of the speed √(ẋ² + ẏ²) [m/s], whatever the direction; None for no limit.
    turn
        Limit of the turning speed, either way [rad/s]; None for no limit.
    """

    speed: float | None = 1.0
    turn: float | None = 0.6

    def apply(self, model: Reader) -> Effects:
        """Write the child frame and the speed limits."""
        x, y, angle = (position(f"{self.name}/{c}") for c in ("x", "y", "angle"))
        constraints: dict[str, ConstraintLike] = {}
        if self.speed is not None:
            constraints[f"{self.name}/speed"] = (0, norm(array([x.derivative(), y.derivative()])), self.speed)
        if self.turn is not None:
            constraints[f"{self.name}/turn"] = (-self.turn, angle.derivative(), self.turn)
        coordinates = (x, y, angle)
        return Effects(
            frames={self.child: (self.parent, (self.origin, translation(x, y, 0), rotation_z(angle)))},
            constraints=constraints,
            articulations={
                self.name: self.record(
                    coordinates, (0.0, 0.0, 0.0), tuple(c.derivative() for c in coordinates)
                )
            },
        )


@dataclass(frozen=True, kw_only=True)
class DifferentialDrive(Joint):
    """A base on two driven wheels: parent_T_child = origin · translation(x, y, 0) · rotation_z(θ).

    Coordinates ``name/x``, ``name/y`` [m] and ``name/angle`` [rad] move by the wheels' speeds only (2022
    paper, III-A1): with radius r and track b, ẋ = r/2 cos θ (ω_l + ω_r), ẏ = r/2 sin θ (ω_l + ω_r), θ̇ = r/b
    (ω_r - ω_l).

    Attributes
    ----------
    radius, track
        Of the wheels, and the distance between them [m].
    left, right
        Paths of the wheels' degrees of freedom; by default ``name/left_wheel`` and ``name/right_wheel``.
    wheel_speed
        Limit of the wheels' speeds [rad/s]; None for no limit.
    """

    radius: float
    track: float
    left: str = ""
    right: str = ""
    wheel_speed: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.radius > 0 and self.track > 0):
            raise ValueRejectedError(
                f"Base '{self.name}' needs a positive wheel radius and track, "
                f"not {self.radius} and {self.track}."
            )

    def apply(self, model: Reader) -> Effects:
        """Write the child frame, the rates and the limits of the wheels."""
        x, y, angle = (position(f"{self.name}/{c}") for c in ("x", "y", "angle"))
        left = velocity(self.left or f"{self.name}/left_wheel")
        right = velocity(self.right or f"{self.name}/right_wheel")
        along, about = self.radius / 2, self.radius / self.track
        constraints = {}
        if self.wheel_speed is not None:
            for side, wheel in (("left", left), ("right", right)):
                constraints[f"{self.name}/{side}_wheel_speed"] = (-self.wheel_speed, wheel, self.wheel_speed)
        return Effects(
            frames={self.child: (self.parent, (self.origin, translation(x, y, 0), rotation_z(angle)))},
            constraints=constraints,
            rates={
                x: {left: along * np.cos(angle), right: along * np.cos(angle)},
                y: {left: along * np.sin(angle), right: along * np.sin(angle)},
                angle: {left: -about, right: about},
            },
            articulations={self.name: self.record((x, y, angle), (0.0, 0.0, 0.0), (left, right))},
        )
