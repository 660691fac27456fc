"""Robot description as a tree of links and joints, shared by the writers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.model.body import Body, Vector3
from kineverse.model.registry import FrameDeviation
from kineverse.symbols import Symbol

Matrix: TypeAlias = npt.NDArray[np.float64]
Coefficients: TypeAlias = tuple[float, ...]
"""Coefficients of the powers of a coordinate, constant first."""

IDENTITY_COEFFICIENTS: Coefficients = (0.0, 1.0)
NO_BODY = Body()


@dataclass
class JointBounds:
    """What limits a joint: its position, its speed, and where a safety controller defends it.

    ``lower`` and ``upper`` are of the position [rad] or [m], ``slowest`` and ``fastest`` of the speed.
    """

    lower: float = -math.inf
    upper: float = math.inf
    slowest: float = -math.inf
    fastest: float = math.inf
    soft: tuple[float, float] | None = None

    def keep(self, lower: float, upper: float) -> None:
        """Limit the position further."""
        self.lower, self.upper = max(self.lower, lower), min(self.upper, upper)

    def slow(self, slowest: float, fastest: float) -> None:
        """Limit the speed further."""
        self.slowest, self.fastest = max(self.slowest, slowest), min(self.fastest, fastest)

    @property
    def open(self) -> bool:
        """Whether the position is not limited."""
        return self.lower == -math.inf and self.upper == math.inf


@dataclass
class JointDescription:
    """A rotation about, or a translation along, a line in the frame of its link.

    Attributes
    ----------
    name
        Unique among joints; the coordinate's own if the joint is one.
    turns, axis, point
        Whether it is a rotation, a unit vector, and a point of the line [m].
    symbol, amount
        The coordinate and the polynomial of it that is the joint's position [rad] or [m].
    """

    name: str
    turns: bool
    axis: Vector3
    point: Vector3
    symbol: Symbol
    amount: Coefficients = IDENTITY_COEFFICIENTS
    bounds: JointBounds = field(default_factory=JointBounds)
    dynamics: Mapping[str, Any] = field(default_factory=dict)

    @property
    def leads(self) -> bool:
        """Whether the joint is a coordinate, rather than what follows one."""
        return self.amount == IDENTITY_COEFFICIENTS and self.name == self.symbol.path


@dataclass
class BallJointDescription:
    """A rotation by a quaternion: coordinates ``name/qx`` and so on."""

    name: str
    point: Vector3
    dynamics: Mapping[str, Any] = field(default_factory=dict)


@dataclass
class LinkDescription:
    """A frame: where it is in its parent while all of its joints are at 0, and what moves it from there."""

    name: str
    parent: str
    pose: Matrix
    joints: list[JointDescription | BallJointDescription] = field(default_factory=list)
    body: Body = NO_BODY
    label: str = ""
    """What the connection to the parent is called, if nothing moves."""
    recorded: bool = False
    """Whether that is the name of an articulation."""


@dataclass(frozen=True)
class SumLimit:
    """A constraint on a sum of multiples of coordinates: lower <= Σ factor · coordinate <= upper."""

    name: str
    factors: Mapping[Symbol, float]
    lower: float
    upper: float


@dataclass(frozen=True)
class LoopJoint:
    """Pairs of frames that are tied: their origins coincide (``connect``), or all of them does (``weld``).

    ``free`` and ``dependent`` are the names of the coordinates in the loop, those that follow last, or
    ``constraints`` those of what keeps it closed where none follows.
    """

    name: str
    kind: Literal["connect", "weld"]
    ends: tuple[tuple[str, str], ...]
    free: tuple[str, ...]
    dependent: tuple[str, ...]
    constraints: tuple[str, ...] = ()


@dataclass
class RobotDescription:
    """A model as links, parents first, and what else is to be said.

    Attributes
    ----------
    links
        Without the world.
    world
        What is attached to the world itself.
    sums
        Constraints on sums of several coordinates.
    loops
        Ties that close loops.
    remarks
        What is written other than it was, or left out: for people.
    errors
        Of frames that are not quite where they should be.
    """

    links: list[LinkDescription]
    world: Body
    sums: list[SumLimit] = field(default_factory=list)
    loops: list[LoopJoint] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    errors: dict[str, FrameDeviation] = field(default_factory=dict)

    @property
    def error_lines(self) -> list[str]:
        """The errors as lines for the file, the largest position first."""
        order = sorted(self.errors, key=lambda name: -self.errors[name].position)
        return [f"approximated: '{name}' is off by {self.errors[name]} at most" for name in order]

    @property
    def joints(self) -> list[JointDescription]:
        """The joints that move along or about a line."""
        return [joint for link in self.links for joint in link.joints if isinstance(joint, JointDescription)]


@dataclass(frozen=True)
class WrittenFile:
    """The text of a file, and what it says other than the model.

    Attributes
    ----------
    content
        The text.
    remarks, errors
        As of the plan.
    left_out
        Why something of the model is not said, by name.
    beside
        Files that belong to it.
    """

    content: bytes
    remarks: tuple[str, ...]
    errors: Mapping[str, FrameDeviation]
    left_out: Mapping[str, str] = field(default_factory=dict)
    beside: Mapping[Path, bytes] = field(default_factory=dict)
