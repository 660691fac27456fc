"""Joints with one coordinate: revolute, continuous, prismatic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kineverse.expressions.expression import Expression
from kineverse.model.body import Pose, Vector3
from kineverse.motions import X, Y, Z, slide, turn
from kineverse.spatial import normalised, snapped

from .joint import AxisJoint


@dataclass(frozen=True, kw_only=True)
class Revolute(AxisJoint):
    """A hinge: parent_T_child = origin · rotation(axis, q), q in [rad]."""

    def motion(self, q: Expression) -> tuple[Pose | Expression, ...]:
        """Return joint_T_child as factors."""
        return rotation_factors(self.axis, q)


@dataclass(frozen=True, kw_only=True)
class Continuous(Revolute):
    """A hinge without end stops, q in [rad]; usually without position limits."""


@dataclass(frozen=True, kw_only=True)
class Prismatic(AxisJoint):
    """A slider: parent_T_child = origin · translation(axis · q), q in [m]."""

    def motion(self, q: Expression) -> tuple[Pose | Expression, ...]:
        """Return joint_T_child as factors."""
        return (slide(unit_axis(self.axis), q),)


def unit_axis(axis: Vector3) -> tuple[float, float, float]:
    """Return the axis at length one."""
    numbers = normalised(axis)
    assert numbers is not None  # joints check their axis when they are made
    x, y, z = numbers
    return x, y, z


def rotation_factors(axis: Vector3, q: Expression) -> tuple[Pose | Expression, ...]:
    """Return the rotation about any axis as constants around one about x, y or z.

    Such factors keep the Jacobian constant in q and the chain short: A · rotation_z(q) · Aᵀ with A's last
    column the axis.
    """
    x, y, z = unit_axis(axis)
    for component, about in ((x, X), (y, Y), (z, Z)):
        if abs(component) == 1.0 and (x, y, z).count(0.0) == 2:
            return (turn(about, q if component > 0 else -q),)
    to_axis = np.eye(4)
    a = np.array([x, y, z])
    helper = np.eye(3)[np.argmin(np.abs(a))]
    first = np.cross(helper, a)
    first /= np.linalg.norm(first)
    to_axis[:3, :3] = snapped(np.column_stack([first, np.cross(a, first), a]))
    return Pose.of(to_axis), turn(Z, q), Pose.of(to_axis.T)
