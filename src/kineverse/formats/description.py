"""Robot description as a tree of links and joints, shared by the writers; connectivity of frames."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.model.body import NO_BODY, Body, Vector3
from kineverse.model.registry import FrameDeviation
from kineverse.symbols import Symbol

Matrix: TypeAlias = npt.NDArray[np.float64]
Coefficients: TypeAlias = tuple[float, ...]  # coefficients of the powers of a coordinate, constant first

IDENTITY_COEFFICIENTS: Coefficients = (0.0, 1.0)
_SPACE = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def dynamics_number(dynamics: Mapping[str, Any], key: str) -> float | None:
    """Return a number of the dynamics of a joint; None if there is none, or no number."""
    value = dynamics.get(key)
    return float(value) if isinstance(value, (int, float)) and not math.isnan(value) else None


@dataclass
class JointBounds:
    """Limits of a joint's position and velocity, and the soft limits of its safety controller.

    ``lower`` and ``upper`` bound the position [rad] or [m], ``min_velocity`` and ``max_velocity`` the
    velocity [rad/s] or [m/s]. ``soft`` is the range that a safety controller keeps; None if there is none.
    """

    lower: float = -math.inf
    upper: float = math.inf
    min_velocity: float = -math.inf
    max_velocity: float = math.inf
    soft: tuple[float, float] | None = None

    @property
    def home(self) -> float:
        """Position at which a joint without a stated home begins: the one nearest to 0."""
        return min(max(0.0, self.lower), self.upper)

    @property
    def is_unbounded(self) -> bool:
        """True if the position has no limits."""
        return self.lower == -math.inf and self.upper == math.inf


@dataclass
class JointDescription:
    """Rotation about, or translation along, a line in the frame of its link."""

    name: str  # unique name; that of the coordinate if the joint is independent
    is_rotation: bool  # True for a rotation, False for a translation
    axis: Vector3  # direction of the line, a unit vector
    point: Vector3
    symbol: Symbol  # coordinate [rad] or [m]
    coefficients: Coefficients = IDENTITY_COEFFICIENTS
    bounds: JointBounds = field(default_factory=JointBounds)  # limits of position and velocity
    dynamics: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_independent(self) -> bool:
        """True if the joint's position is a coordinate, False if it follows one."""
        return self.coefficients == IDENTITY_COEFFICIENTS and self.name == self.symbol.path


@dataclass
class BallJointDescription:
    """Rotation by a unit quaternion with the coordinates ``name/qx`` … ``name/qw``."""

    name: str
    point: Vector3
    dynamics: Mapping[str, Any] = field(default_factory=dict)


@dataclass
class LinkDescription:
    """Link of a robot description: its pose in its parent, and the joints that move it from there."""

    name: str  # name of the frame
    parent: str
    pose: Matrix  # parent_T_frame while all of its joints are at 0
    joints: list[JointDescription | BallJointDescription] = field(default_factory=list)
    body: Body = NO_BODY  # inertia, visuals and collision shapes
    fixed_joint_name: str = ""  # name of the fixed joint to the parent, if nothing moves
    is_articulation: bool = False  # True if an articulation of the model has that name
    dynamics: Mapping[str, Any] = field(default_factory=dict)
    is_loose: bool = False  # True if it moves as no joint of the format; the pose is that at home

    @property
    def free_motion(self) -> str:
        """Name of its motion if it moves freely in its parent, ``name/x`` … ``name/qw``; else empty."""
        if len(self.joints) != 4:
            return ""
        *slides, ball = self.joints
        if not isinstance(ball, BallJointDescription) or any(ball.point) or ball.dynamics:
            return ""
        for joint, (c, axis) in zip(slides, _SPACE.items(), strict=True):
            if not isinstance(joint, JointDescription) or joint.is_rotation or joint.axis != axis:
                return ""
            if joint.name != f"{ball.name}/{c}" or not joint.is_independent or joint.dynamics:
                return ""
            if joint.bounds != JointBounds():
                return ""
        return ball.name


@dataclass(frozen=True)
class SumLimit:
    """Constraint on a linear combination of coordinates: lower <= Σ factor · coordinate <= upper."""

    name: str
    factors: Mapping[Symbol, float]
    lower: float
    upper: float


@dataclass(frozen=True)
class LoopJoint:
    """Joint that closes a loop: pairs of frames with equal origins (``connect``) or equal poses (``weld``).

    ``free`` and ``dependent`` are the names of the independent and the dependent coordinates in the loop.
    ``constraints`` are the names of the constraints that keep it closed, where no coordinate is dependent.
    """

    name: str
    kind: Literal["connect", "weld"]
    ends: tuple[tuple[str, str], ...]
    free: tuple[str, ...]
    dependent: tuple[str, ...]
    constraints: tuple[str, ...] = ()


@dataclass
class RobotDescription:
    """Robot as a tree of links and joints, with constraints between its coordinates."""

    links: list[LinkDescription]  # links, parents first, without the world
    world_body: Body  # body of the world frame
    sum_limits: list[SumLimit] = field(default_factory=list)
    loops: list[LoopJoint] = field(default_factory=list)  # joints that close loops
    remarks: list[str] = field(default_factory=list)
    errors: dict[str, FrameDeviation] = field(default_factory=dict)

    @property
    def error_lines(self) -> list[str]:
        """Bounds of the pose errors as lines for the file, the largest position first."""
        order = sorted(self.errors, key=lambda name: -self.errors[name].position)
        return [f"approximated: '{name}' is off by {self.errors[name]} at most" for name in order]

    @property
    def joints(self) -> list[JointDescription]:
        """All rotational and translational joints."""
        return [joint for link in self.links for joint in link.joints if isinstance(joint, JointDescription)]

    def has_followers(self, link: LinkDescription) -> bool:
        """Return whether another joint follows one of a link: then each of these has to be a joint."""
        own = {joint.name for joint in link.joints}
        return any(joint.symbol.path in own for joint in self.joints if not joint.is_independent)


@dataclass(frozen=True)
class WrittenFile:
    """Content of a file to be written, and its differences from the model."""

    content: bytes  # text of the file
    remarks: tuple[str, ...]  # as of RobotDescription
    errors: Mapping[str, FrameDeviation]
    left_out: Mapping[str, str] = field(default_factory=dict)
    companion_files: Mapping[Path, bytes] = field(default_factory=dict)


class DisjointSets:
    """Disjoint sets of names (union-find with path compression)."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}

    def find(self, name: str) -> str:
        """Return the representative of the set that a name is in."""
        parents = self._parents
        root = name
        while root in parents:
            root = parents[root]
        while name != root:
            parents[name], name = root, parents[name]
        return root

    def union(self, a: str, b: str) -> bool:
        """Merge the sets of two names; return True if they were different."""
        first, second = self.find(a), self.find(b)
        if first == second:
            return False
        self._parents[second] = first
        return True


def path_between(a: str, b: str, parents: Mapping[str, str]) -> list[str]:
    """Return the frames on the path between two frames, without their lowest common ancestor.

    First from ``a`` upwards, then from ``b`` upwards. Roots have no parent.
    """

    def chain(end: str) -> Iterator[str]:
        while end in parents:
            yield end
            end = parents[end]

    names = Counter((*chain(a), *chain(b)))
    return [name for name, count in names.items() if count == 1]
