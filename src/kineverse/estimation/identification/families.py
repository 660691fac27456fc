"""Joint families as subgroups of SE(3) between parent and child.

    parent_T_child = L · g(a) · R,        g(a) = translation(v(a)) · Exp(ω(a))

Each joint value is one of the six components of (v, ω). The set of components defines the subgroup. For a
screw, v_z also gets the pitch times ω_z. So a revolute joint rotates about the z axis of L, and a prismatic
joint translates along it. L and R have twelve parameters. Those without a gauge freedom remain: a motion that
commutes with the subgroup can move from L to R, and a motion in the subgroup is a shift of joint values.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Self

import numpy as np

from kineverse.lie import Array, exp_so3, orthonormalize, right_jacobian, skew, transform

from .bindings import evaluate_poses, fits_kernel, library
from .motion_model import LinearisedPoses, ParameterPrior

VX, VY, VZ, WX, WY, WZ = range(6)


@dataclass(frozen=True, slots=True)
class Parametrisation:
    """Components of the joint values and of the parameters."""

    joints: tuple[int, ...]  # components of (v, ω) that are joint values
    left: tuple[int, ...]  # components of the twist that moves L, in the axes of L
    right: tuple[int, ...]  # components of the twist that moves R, applied on its left


@dataclass(frozen=True, slots=True)
class JointFamily:
    """Joint family."""

    name: str  # name of the family, as in result["revolute"]
    poses: Parametrisation  # parametrisation for observed poses of the child
    positions: Parametrisation  # parametrisation for observed positions only
    pitch: bool = False  # True if the joint translates along z by a pitch [m/rad] as it rotates
    reach: int = 0  # number of components of the child's position in the joint's frame that are a lever
    slides: int = 0

    def parametrisation(self, rows: int) -> Parametrisation:
        """Return the parametrisation for poses (6 rows) or positions (3 rows)."""
        return self.poses if rows == 6 else self.positions


_LINE = (VX, VY, WX, WY)
JOINT_FAMILIES: Mapping[str, JointFamily] = MappingProxyType(
    {
        group.name: group
        for group in (
            JointFamily(
                "rigid",
                Parametrisation((), (), (VX, VY, VZ, WX, WY, WZ)),
                Parametrisation((), (), (VX, VY, VZ)),
            ),
            JointFamily(
                "prismatic",
                Parametrisation((VZ,), (WX, WY), (VX, VY, WX, WY, WZ)),
                Parametrisation((VZ,), (WX, WY), (VX, VY)),
            ),
            JointFamily(
                "revolute",
                Parametrisation((WZ,), _LINE, (VX, VY, VZ, WX, WY)),
                Parametrisation((WZ,), _LINE, (VX, VZ)),
                reach=2,
            ),
            JointFamily(
                "screw",
                Parametrisation((WZ,), _LINE, (VX, VY, VZ, WX, WY)),
                Parametrisation((WZ,), _LINE, (VX, VZ)),
                pitch=True,
                reach=2,
            ),
            JointFamily(
                "cylindrical",
                Parametrisation((VZ, WZ), _LINE, (VX, VY, WX, WY)),
                Parametrisation((VZ, WZ), _LINE, (VX,)),
                reach=2,
            ),
            JointFamily(
                "spherical",
                Parametrisation((WX, WY, WZ), (VX, VY, VZ), (VX, VY, VZ)),
                Parametrisation((WY, WZ), (VX, VY, VZ), (VX,)),
                reach=3,
            ),
            JointFamily(
                "planar",
                Parametrisation((VX, VY, WZ), (WX, WY), (VZ, WX, WY)),
                Parametrisation((VX, VY), (WX, WY), (VZ,)),
                slides=2,
            ),
            JointFamily(
                "free",
                Parametrisation((VX, VY, VZ, WX, WY, WZ), (), ()),
                Parametrisation((VX, VY, VZ), (), ()),
                slides=3,
            ),
        )
    }
)
"""Families by name. ``rigid`` has no joint values, and ``free`` has no parameters."""

PITCHES = 0.1
"""Prior standard deviation of a pitch [m/rad]."""

REACH = 1.0
"""Prior standard deviation of each component of a lever [m]."""


@dataclass(frozen=True, slots=True)
class GroupMotion:
    """Member of a joint family, parent_T_child = L · g(a) · R."""

    group: JointFamily  # family
    rows: int  # 6, or 3 for positions only
    left: Array  # L and R, (4, 4)
    right: Array
    pitch: float = 0.0  # pitch [m/rad]; 0 for families without one

    @property
    def parametrisation(self) -> Parametrisation:
        """Components of the joint values and of the parameters."""
        return self.group.parametrisation(self.rows)

    @property
    def size(self) -> int:
        """Number of parameters."""
        freedom = self.parametrisation
        return len(freedom.left) + len(freedom.right) + self.group.pitch

    @property
    def joints(self) -> int:
        """Number of joint values."""
        return len(self.parametrisation.joints)

    @property
    def slides(self) -> int:
        """Number of unknown components of the sliding point, see :mod:`.ambiguities`."""
        return self.group.slides if self.rows == 6 else 0

    @property
    def is_plain(self) -> bool:
        """True if the motion is no subclass and its family fits the C kernels."""
        return type(self) is GroupMotion and fits_kernel(self.group, self.rows)

    def linearise(self, values: Array, native: bool = True) -> LinearisedPoses:
        """Return the poses at joint values (N, k) and their derivatives, in C if possible and ``native``."""
        if native and library.is_native and self.is_plain:
            return evaluate_poses(self, values)
        freedom = self.parametrisation
        twist = np.zeros((len(values), 6))
        twist[:, freedom.joints] = values
        if self.group.pitch:
            twist[:, VZ] += self.pitch * twist[:, WZ]
        turn, slide = exp_so3(twist[:, 3:]), twist[:, :3]
        l_R, r_p = self.left[:3, :3], self.right[:3, 3]
        parent_R_joint = l_R @ turn
        lever = parent_R_joint @ r_p
        way = slide @ l_R.T
        parent_T_child = transform(parent_R_joint @ self.right[:3, :3], self.left[:3, 3] + way + lever)
        moved = _columns(parent_R_joint, lever)
        blocks = [_columns(np.broadcast_to(l_R, turn.shape), way + lever)[:, :, freedom.left]]
        blocks.append(moved[:, :, freedom.right])
        if self.group.pitch:
            along = np.zeros((len(values), 6, 1))
            along[:, :3, 0] = l_R[:, 2] * twist[:, WZ, None]
            blocks.append(along)
        by_joints = self._by_joints(moved, twist)[:, :, freedom.joints]
        rows = self.rows
        return LinearisedPoses(parent_T_child, np.concatenate(blocks, axis=2)[:, :rows], by_joints[:, :rows])

    def _by_joints(self, moved: Array, twist: Array) -> Array:
        result = np.empty_like(moved)
        # Translations come before the rotation, so they are along the axes of L.
        result[:, :3, :3] = self.left[:3, :3]
        result[:, 3:, :3] = 0.0
        joints = self.parametrisation.joints
        if WX in joints or WY in joints:
            result[:, :, 3:] = moved[:, :, 3:] @ right_jacobian(twist[:, 3:])
        else:
            result[:, :, 3:] = moved[:, :, 3:]
        if self.group.pitch:
            result[:, :3, WZ] += self.pitch * self.left[:3, 2]
        return result

    def retract(self, step: Array) -> Self:
        """Return the motion after a step in the parameters."""
        freedom = self.parametrisation
        left, right = np.zeros(6), np.zeros(6)
        ends = len(freedom.left), len(freedom.left) + len(freedom.right)
        left[list(freedom.left)] = step[: ends[0]]
        right[list(freedom.right)] = step[ends[0] : ends[1]]
        l_T_l = transform(exp_so3(left[3:]), left[:3])
        r_T_r = transform(exp_so3(right[3:]), right[:3])
        pitch = self.pitch + (float(step[-1]) if self.group.pitch else 0.0)
        # Rotations drift under repeated multiplication.
        left_moved, right_moved = orthonormalize(self.left @ l_T_l), orthonormalize(r_T_r @ self.right)
        return replace(self, left=left_moved, right=right_moved, pitch=pitch)

    def retract_joints(self, values: Array, step: Array) -> Array:
        """Return joint values after a step of at most half a radian in each angle."""
        turning = [j >= WX for j in self.parametrisation.joints]
        step = step.copy()
        step[:, turning] = np.clip(step[:, turning], -0.5, 0.5)
        result: Array = values + step
        return result

    @property
    def name(self) -> str:
        """Name of the family."""
        return self.group.name

    @property
    def kinds(self) -> tuple[int, ...]:
        """Kind of each joint value: 0 for translations, 1 for rotations."""
        return tuple(int(j >= WX) for j in self.parametrisation.joints)

    def log_prior(self, mean: Array) -> tuple[float, Array]:
        """Return the log prior of the parameters beyond a mean pose, and its precision.

        A lever is Gaussian. A direction is uniform on half the sphere, because an axis has no sign. The mean
        pose has the improper density 1 / (m³ rad³), which is the same for all families.
        """
        freedom, reach = self.parametrisation, self.group.reach
        log = 0.0
        if WX in freedom.left:
            log -= math.log(math.tau)
        if VX in freedom.left and VY in freedom.left and reach:
            lever = self.right[:reach, 3] / REACH
            log -= 0.5 * float(lever @ lever) + 0.5 * reach * math.log(math.tau * REACH**2)
        if self.slides:
            place = self.right[: self.slides, 3] / REACH
            log -= 0.5 * float(place @ place) + 0.5 * self.slides * math.log(math.tau * REACH**2)
        if self.group.pitch:
            log -= 0.5 * (self.pitch / PITCHES) ** 2 + 0.5 * math.log(math.tau * PITCHES**2)
        # Volume of mean poses per unit of the parameters and joint values that move them.
        linear = self.linearise(mean[None, :])
        right = slice(len(freedom.left), len(freedom.left) + len(freedom.right))
        matrix = np.concatenate([linear.by_parameters[0, :, right], linear.by_joints[0]], axis=1)
        # A lever of length zero has no volume. The bound has the size of an atom [m].
        log += float(np.sum(np.log(np.maximum(np.linalg.svd(matrix, compute_uv=False), 1e-10))))
        # A precision of 1 rad⁻² has the width and the density of half a sphere. It keeps unobservable
        # directions finite, and the mean angle of a rotation without a lever.
        precision = np.zeros(self.size + self.joints + self.slides)
        precision[: len(freedom.left)] = [j >= WX for j in freedom.left]
        precision[self.size : self.size + self.joints] = [j >= WX for j in freedom.joints]
        precision[self.size + self.joints :] = REACH**-2
        return log, precision

    def named_parameters(self) -> dict[str, Array | float]:
        """Return the parameters by name."""
        name = self.name
        result: dict[str, Array | float] = {}
        axis, point = self.left[:3, 2].copy(), self.left[:3, 3].copy()
        if name == "planar":
            result["normal"] = axis
        elif name == "spherical":
            result["centre"] = point
        elif name not in ("rigid", "free"):
            result["axis"] = axis
            if name != "prismatic":
                result["point"] = point
        if self.group.pitch:
            result["pitch"] = math.tau * self.pitch
        result["reference"] = self.left @ self.right
        return result

    def coordinates(self) -> tuple[str, ...]:
        """Return the names of the parameters, in their order."""
        letters = "xyz"
        left = [
            f"point.{letters[j]}" if j < WX else f"axis.{letters[j - WX]}" for j in self.parametrisation.left
        ]
        right = [
            f"child.{letters[j]}" if j < WX else f"child.r{letters[j - WX]}"
            for j in self.parametrisation.right
        ]
        return (*left, *right, *(["pitch"] if self.group.pitch else []))

    def prior(self) -> ParameterPrior:
        """Return the Gaussian prior of levers and pitch."""
        reach, freedom = self.group.reach, self.parametrisation
        r_p = self.right[:3, 3]
        moves = np.concatenate([np.eye(3), -skew(r_p)], axis=1)[:reach, freedom.right]
        derivatives = np.zeros((reach, self.size))
        start = len(freedom.left)
        derivatives[:, start : start + len(freedom.right)] = moves
        if not self.group.pitch:
            return ParameterPrior(r_p[:reach] / REACH, derivatives / REACH)
        steep = np.zeros((1, self.size))
        steep[0, -1] = 1.0 / PITCHES
        residuals = np.append(r_p[:reach] / REACH, self.pitch / PITCHES)
        return ParameterPrior(residuals, np.concatenate([derivatives / REACH, steep]))


def _columns(parent_R_frame: Array, lever: Array) -> Array:
    """Return twists of the child about its origin, per unit twist of a frame at the end of a lever."""
    result = np.zeros((len(lever), 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = parent_R_frame
    result[:, :3, 3:] = -skew(lever) @ parent_R_frame
    return result
