"""Joints with several coordinates: planar and floating."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kineverse.model.body import Pose, Vector3
from kineverse.model.constraint import Constraint
from kineverse.model.operation import Effects
from kineverse.model.reader import Reader
from kineverse.spatial import quaternion, rotation_z, snapped, translation
from kineverse.symbols import position, velocity

from .axis_joints import unit_axis
from .joint import Joint, checked_axis, limits


@dataclass(frozen=True, kw_only=True)
class Planar(Joint):
    """Motion in a plane: parent_T_child = origin · A · translation(x, y, 0) · rotation_z(θ) · Aᵀ.

    The columns of A are two directions in the plane and its normal, the axis. Coordinates are ``name/x``,
    ``name/y`` [m] and ``name/angle`` [rad], all free. For the axis z, A is the identity; for another axis n,
    A is the smallest rotation that turns z into n (about z × n), and a half turn about x for -z.

    Attributes
    ----------
    axis
        The normal of the plane in the joint's frame.
    lower, upper
        Limits of x and y alike [m]; None leaves that side open.
    velocity
        Limit of the speeds of x and y alike [m/s]; None for no limit.
    """

    axis: Vector3 = (0.0, 0.0, 1.0)
    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "axis", checked_axis(self.axis, self.name))

    def apply(self, model: Reader) -> Effects:
        """Write the child frame and the limits."""
        x, y, angle = (position(f"{self.name}/{c}") for c in ("x", "y", "angle"))
        turn = _from_z(self.axis)
        motion = (Pose.of(turn), translation(x, y, 0), rotation_z(angle), Pose.of(turn.T))
        constraints: dict[str, Constraint] = {}
        for q in (x, y):
            constraints.update(limits(str(q), q, self.lower, self.upper, self.velocity))
        coordinates = (x, y, angle)
        return Effects(
            frames={self.child: (self.parent, (self.origin, *motion))},
            constraints=constraints,
            articulations={
                self.name: self.record(
                    coordinates, (0.0, 0.0, 0.0), tuple(c.derivative() for c in coordinates)
                )
            },
        )


@dataclass(frozen=True, kw_only=True)
class Floating(Joint):
    """Free motion: parent_T_child = origin · translation(x, y, z) · rotation(quaternion).

    Seven coordinates ``name/x|y|z`` [m] and ``name/qx|qy|qz|qw``, six speeds: the velocities of x, y, z
    [m/s], and the angular velocity ω of the child in its own axes, ``name/wx|wy|wz`` [rad/s]. The quaternion
    moves by q̇ = ½ q ⊗ (ω, 0), which keeps its length; a quaternion of another length is normalised where it
    is used.
    """

    def apply(self, model: Reader) -> Effects:
        """Write the child frame and the rates of the quaternion."""
        xyz = tuple(position(f"{self.name}/{c}") for c in "xyz")
        q = tuple(position(f"{self.name}/q{c}") for c in "xyzw")
        wx, wy, wz = (velocity(f"{self.name}/w{c}") for c in "xyz")
        x, y, z, w = q
        rows = {
            x: {wx: w / 2, wy: -z / 2, wz: y / 2},
            y: {wx: z / 2, wy: w / 2, wz: -x / 2},
            z: {wx: -y / 2, wy: x / 2, wz: w / 2},
            w: {wx: -x / 2, wy: -y / 2, wz: -z / 2},
        }
        speeds = (*(c.derivative() for c in xyz), wx, wy, wz)
        return Effects(
            frames={self.child: (self.parent, (self.origin, translation(*xyz), quaternion(*q)))},
            rates=rows,
            articulations={self.name: self.record((*xyz, *q), (0, 0, 0, 0, 0, 0, 1.0), speeds)},
        )


def _from_z(axis: Vector3) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return the smallest rotation that turns z into the axis, 4×4."""
    n = np.array(unit_axis(axis))
    turn = np.eye(4)
    if n[2] < 0 and not n[:2].any():
        turn[1, 1] = turn[2, 2] = -1.0
        return turn
    v = np.array([-n[1], n[0], 0.0])  # z × n
    k = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    # 1 / (1 + cos) of the angle; near a half turn by its sine, because nothing is left of the sum.
    factor = 1 / (1 + n[2]) if n[2] > 0 else (1 - n[2]) / (v @ v)
    turn[:3, :3] = snapped(np.eye(3) + k + k @ k * factor)
    return turn
