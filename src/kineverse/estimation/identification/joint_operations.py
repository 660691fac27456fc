"""Operations that write identified joints.

A joint of :mod:`kineverse.articulations` has its child frame on the axis. The frame of an observed part is
elsewhere, so the joints of this module have a mount: joint_T_child = motion(q) · mount.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kineverse.articulations import (
    Ball,
    Cylindrical,
    Fixed,
    Floating,
    Joint,
    Limits,
    Planar,
    Prismatic,
    Revolute,
    Screw,
)
from kineverse.articulations.limits import FREE
from kineverse.expressions.expression import Expression
from kineverse.lie import Array, mean_rotation
from kineverse.model.body import Pose
from kineverse.model.constraint import Constraint
from kineverse.model.operation import Operation, Writes
from kineverse.model.read_recorder import ReadRecorder
from kineverse.spatial import translation
from kineverse.symbols import Symbol, position

from .curve import CurveMotion
from .families import Family, FamilyMotion, GroupMotion
from .motion_functions import FamilyMember

_Z = (0.0, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Mounted(Joint):
    """Base class of joints with a child frame off the axis."""

    mount: Pose = Pose()  # joint_T_child at joint value 0

    @property
    def kind(self) -> str:
        """Kind of the joint without its mount."""
        return re.sub("^mounted", "", super().kind)

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the effects of the joint, with the mount in the pose of the child."""
        effects = super().apply(model)  # type: ignore[safe-super]
        parent, factors = effects.frames[self.child]  # type: ignore[misc]
        frames = {**effects.frames, self.child: (parent, (*factors, self.mount))}  # type: ignore[misc]
        return replace(effects, frames=frames)


@dataclass(frozen=True, kw_only=True)
class MountedRevolute(Mounted, Revolute, document_kind="MountedRevolute"):
    """Revolute joint with a mount: parent_T_child = origin · rotation(axis, q) · mount."""


@dataclass(frozen=True, kw_only=True)
class MountedScrew(Mounted, Screw, document_kind="MountedScrew"):
    """Screw joint with a mount: parent_T_child = origin · screw(axis, q) · mount."""


@dataclass(frozen=True, kw_only=True)
class MountedCylindrical(Mounted, Cylindrical, document_kind="MountedCylindrical"):
    """Cylindrical joint with a mount: parent_T_child = origin · cylindrical(axis, s, φ) · mount."""


@dataclass(frozen=True, kw_only=True)
class MountedBall(Mounted, Ball, document_kind="MountedBall"):
    """Spherical joint with a mount: parent_T_child = origin · rotation(quaternion) · mount."""


@dataclass(frozen=True, kw_only=True)
class SlidingPoint(Joint, document_kind="SlidingPoint"):
    """Translation of a point in a plane or in space: parent_T_child = origin · translation(x, y, z).

    Coordinates are ``name/x``, ``name/y`` and, in space, ``name/z`` [m].
    """

    ranges: tuple[tuple[float, float], ...]  # observed range of each coordinate [m]; home is in the middle
    limited: bool = True  # True if the coordinates are limited to the range

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame, the coordinates and their limits."""
        names = [f"{self.name}/{axis}" for axis in "xyz"[: len(self.ranges)]]
        return _writes(self, model, names, lambda q: translation(*q, *([0.0] * (3 - len(q)))))


@dataclass(frozen=True, kw_only=True)
class FamilyJoint(Joint, document_kind="FamilyJoint"):
    """Joint of a custom family: parent_T_child = origin · transform.

    A single coordinate is ``name``. Several are named like the joints of the family, below ``name``.
    """

    motion: FamilyMotion
    ranges: tuple[tuple[float, float], ...]  # observed range of its joint values; home is in the middle
    limited: bool = True  # True if the joint values are limited to the range

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame, the coordinates and their limits."""
        return _writes(self, model, family_coordinates(self.motion, self.name), self.motion.expression)


def _writes(
    joint: SlidingPoint | FamilyJoint,
    model: ReadRecorder,
    names: Sequence[str],
    pose: Callable[[tuple[Symbol, ...]], Expression],
) -> Writes:
    joint.check_free(model)
    q = tuple(position(name) for name in names)
    home = tuple(0.5 * (low + high) for low, high in joint.ranges)
    constraints: dict[str, Constraint] = {}
    for name, coordinate, (low, high) in zip(names, q, joint.ranges, strict=True):
        if joint.limited:
            constraints.update(Limits(low, high).constraints(name, coordinate))
    return Writes(
        frames={joint.child: (joint.parent, (joint.origin, pose(q)))},
        constraints=constraints,
        articulations={joint.name: joint.record(q, home, tuple(c.derivative() for c in q))},
    )


def family_coordinates(motion: FamilyMotion, name: str) -> tuple[str, ...]:
    """Return the coordinates of a joint of a custom family, in the order of its joint values."""
    symbols = list(motion.family.joints)
    return (name,) if len(symbols) == 1 else tuple(f"{name}/{s}" for s in symbols)


def joint_operation(
    motion: FamilyMember,
    ranges: Sequence[tuple[float, float]],
    name: str,
    parent: str,
    child: str,
    limited: bool = True,
) -> Operation:
    """Return the operation that writes a member of a family."""
    names: dict[str, Any] = {"name": name, "parent": parent, "child": child}
    if isinstance(motion, CurveMotion):
        # The only member of a custom family, whose operation documents can hold.
        s = position("s")
        family = Family(motion.name, motion.expression(s), {s: ranges[0]})
        motion = FamilyMotion(family, motion.rows, np.zeros(0))
    if isinstance(motion, FamilyMotion):
        return FamilyJoint(**names, motion=motion, ranges=tuple(ranges), limited=limited)
    if not isinstance(motion, GroupMotion):
        raise TypeError(f"A {type(motion).__name__} is no joint.")
    if motion.rows == 3 and motion.name in ("planar", "free"):
        place = motion.left.copy()
        place[:3, 3] += place[:3, :3] @ motion.right[:3, 3]
        return SlidingPoint(**names, origin=rigid_pose(place), ranges=tuple(ranges), limited=limited)
    limits = [Limits(low, high) if limited else FREE for low, high in ranges]
    bounds: dict[str, Any] = {"lower": limits[0].lower, "upper": limits[0].upper} if limits else {}
    mounted = {**names, "origin": rigid_pose(motion.left), "mount": rigid_pose(motion.right)}
    names["origin"] = rigid_pose(motion.left @ motion.right)
    # The z axis of L in the axes of the child, at joint value 0.
    axis = tuple(float(c) for c in motion.right[2, :3])
    match motion.name:
        case "rigid":
            return Fixed(**names)
        case "prismatic":
            return Prismatic(**names, axis=axis, **bounds)
        case "revolute":
            return MountedRevolute(**mounted, axis=_Z, **bounds)
        case "screw":
            return MountedScrew(**mounted, axis=_Z, **bounds, pitch=2.0 * np.pi * motion.pitch)
        case "cylindrical":
            return MountedCylindrical(**mounted, axis=_Z, slide=limits[0], turn=limits[1])
        case "spherical":
            return MountedBall(**mounted)
        case "planar":
            largest = max(max(-low, high) for low, high in ranges[:2]) if limited else None
            return Planar(**names, axis=axis, lower=None if largest is None else -largest, upper=largest)
    return Floating(**names)


def rigid_pose(matrix: Array) -> Pose:
    """Return a pose with its rotation orthonormalised to double precision."""
    exact = matrix.copy()
    exact[:3, :3] = mean_rotation(matrix[None, :3, :3])
    return Pose.from_matrix(exact)
