"""Joint families: subgroups of SE(3) between parent and child, and families of a user's expression.

    parent_T_child = L · g(a) · R,        g(a) = translation(v(a)) · Exp(ω(a))

Each joint value is one of the six components of (v, ω), and these components define the subgroup. For a
screw, v_z also gets the pitch times ω_z. So a revolute joint rotates about the z axis of L. Of the twelve
parameters of L and R, those without a gauge freedom remain: a motion that commutes with the subgroup can move
from L to R, and a motion in the subgroup is a shift of joint values.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from types import MappingProxyType
from typing import NamedTuple, Self

import numpy as np

from kineverse.compilation import CompiledFunction
from kineverse.compilation import compile as compiled
from kineverse.errors import InvalidValueError, ShapeError, UnknownNameError
from kineverse.expressions.expression import Expression
from kineverse.lie import Array, exp_so3, log_so3, orthonormalize, right_jacobian, skew, transform
from kineverse.symbols import Symbol

from .motion_model import LinearisedPoses, ParameterPrior
from .native import evaluate_poses, fits_kernel, library
from .observations import Observations

VX, VY, VZ, WX, WY, WZ = range(6)


@dataclass(frozen=True, slots=True)
class Parametrisation:
    """Components of (v, ω) that are joint values or parameters."""

    joints: tuple[int, ...]  # joint values
    left: tuple[int, ...]  # components of the twist that moves L, in the axes of L
    right: tuple[int, ...]  # components of the twist that moves R, applied on its left


@dataclass(frozen=True, slots=True)
class JointFamily:
    """Joint family."""

    name: str
    poses: Parametrisation  # for observed poses of the child
    positions: Parametrisation  # for observed positions only
    pitch: bool = False  # True if the joint translates along z by a pitch [m/rad] as it rotates
    reach: int = 0  # number of components of the child's position in the joint's frame that are a lever
    slides: int = 0  # number of components of the sliding point

    def parametrisation(self, rows: int) -> Parametrisation:
        """Return the parametrisation for poses (6 rows) or positions (3 rows)."""
        return self.poses if rows == 6 else self.positions


_P, _V, _VW, _LINE = Parametrisation, (VX, VY, VZ), (VX, VY, VZ, WX, WY, WZ), (VX, VY, WX, WY)
_FAMILIES = (
    JointFamily("rigid", _P((), (), _VW), _P((), (), _V)),
    JointFamily("prismatic", _P((VZ,), (WX, WY), (VX, VY, WX, WY, WZ)), _P((VZ,), (WX, WY), (VX, VY))),
    JointFamily("revolute", _P((WZ,), _LINE, (*_V, WX, WY)), _P((WZ,), _LINE, (VX, VZ)), reach=2),
    JointFamily("screw", _P((WZ,), _LINE, (*_V, WX, WY)), _P((WZ,), _LINE, (VX, VZ)), pitch=True, reach=2),
    JointFamily("cylindrical", _P((VZ, WZ), _LINE, (VX, VY, WX, WY)), _P((VZ, WZ), _LINE, (VX,)), reach=2),
    JointFamily("spherical", _P((WX, WY, WZ), _V, _V), _P((WY, WZ), _V, (VX,)), reach=3),
    JointFamily("planar", _P((VX, VY, WZ), (WX, WY), (VZ, WX, WY)), _P((VX, VY), (WX, WY), (VZ,)), slides=2),
    JointFamily("free", _P(_VW, (), ()), _P(_V, (), ()), slides=3),
)
JOINT_FAMILIES: Mapping[str, JointFamily] = MappingProxyType({family.name: family for family in _FAMILIES})
"""Families by name. ``rigid`` has no joint values, and ``free`` has no parameters."""

PITCHES = 0.1  # prior standard deviation of a pitch [m/rad]
REACH = 1.0  # prior standard deviation of each component of a lever [m]


@dataclass(frozen=True, slots=True)
class GroupMotion:
    """Member of a joint family, parent_T_child = L · g(a) · R."""

    group: JointFamily
    rows: int  # 6, or 3 for positions only
    left: Array  # L and R, (4, 4)
    right: Array
    pitch: float = 0.0  # [m/rad]; 0 for families without one

    @property
    def parametrisation(self) -> Parametrisation:
        """Components that are joint values or parameters."""
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
        """Number of unknown components of the sliding point, see :mod:`.joint_values`."""
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
        arm = slide @ l_R.T + lever
        parent_T_child = transform(parent_R_joint @ self.right[:3, :3], self.left[:3, 3] + arm)
        moved = _columns(parent_R_joint, lever)
        by_left = _columns(np.broadcast_to(l_R, turn.shape), arm)[:, :, freedom.left]
        by_pitch = np.zeros((len(values), 6, int(self.group.pitch)))
        by_pitch[:, :3] = (l_R[:, 2] * twist[:, WZ, None])[:, :, None]
        by_parameters = np.concatenate([by_left, moved[:, :, freedom.right], by_pitch], axis=2)
        by_joints = moved.copy()
        # Translations come before the rotation, so they are along the axes of L.
        by_joints[:, :3, :3], by_joints[:, 3:, :3] = l_R, 0.0
        if WX in freedom.joints or WY in freedom.joints:
            by_joints[:, :, 3:] = moved[:, :, 3:] @ right_jacobian(twist[:, 3:])
        if self.group.pitch:
            by_joints[:, :3, WZ] += self.pitch * l_R[:, 2]
        rows = self.rows
        return LinearisedPoses(parent_T_child, by_parameters[:, :rows], by_joints[:, :rows, freedom.joints])

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
        return np.asarray(values + step)

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
        # The lever, and the sliding point.
        for count in (reach if {VX, VY} <= {*freedom.left} else 0, self.slides):
            place = self.right[:count, 3] / REACH
            log -= 0.5 * float(place @ place) + 0.5 * count * math.log(math.tau * REACH**2)
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
        axis, point = self.left[:3, 2].copy(), self.left[:3, 3].copy()
        special: dict[str, dict[str, Array | float]] = {
            "rigid": {},
            "prismatic": {"axis": axis},
            "screw": {"axis": axis, "point": point, "pitch": math.tau * self.pitch},
            "spherical": {"centre": point},
            "planar": {"normal": axis},
            "free": {},
        }
        return special.get(self.name, {"axis": axis, "point": point}) | {"reference": self.left @ self.right}

    def coordinates(self) -> tuple[str, ...]:
        """Return the names of the parameters, in their order."""
        of_left = [f"{part}.{letter}" for part in ("point", "axis") for letter in "xyz"]
        of_right = [f"child.{letter}" for letter in ("x", "y", "z", "rx", "ry", "rz")]
        left, right = self.parametrisation.left, self.parametrisation.right
        pitch = ["pitch"] if self.group.pitch else []
        return (*(of_left[j] for j in left), *(of_right[j] for j in right), *pitch)

    def prior(self) -> ParameterPrior:
        """Return the Gaussian prior of levers and pitch."""
        reach, freedom = self.group.reach, self.parametrisation
        r_p, start = self.right[:3, 3], len(freedom.left)
        moves = np.concatenate([np.eye(3), -skew(r_p)], axis=1)[:reach, freedom.right]
        derivatives = np.zeros((reach + self.group.pitch, self.size))
        derivatives[:reach, start : start + len(freedom.right)] = moves / REACH
        residuals = r_p[:reach] / REACH
        if self.group.pitch:
            derivatives[-1, -1] = 1.0 / PITCHES
            residuals = np.append(residuals, self.pitch / PITCHES)
        return ParameterPrior(residuals, derivatives)


def _columns(parent_R_frame: Array, lever: Array) -> Array:
    """Return twists of the child about its origin, per unit twist of a frame at the end of a lever."""
    result = np.zeros((len(lever), 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = parent_R_frame
    result[:, :3, 3:] = -skew(lever) @ parent_R_frame
    return result


# Candidate values of a single joint for each observation, and number of random initial members.
_TRIED = 41
_MEMBERS = 8
_MEAN_SPREAD = 3.0  # prior standard deviation of the mean of a joint value [m] or [rad]


class FamilyParameter(NamedTuple):
    """Prior and bounds of an unknown parameter of a family.

    Attributes
    ----------
    start
        Mean of the prior.
    deviation
        Standard deviation of the prior.
    lower, upper
        Bounds.
    """

    start: float
    deviation: float
    lower: float = -math.inf
    upper: float = math.inf


@dataclass(frozen=True, eq=False)
class Family:
    """Joint family defined by an expression.

    Attributes
    ----------
    name
        Name of the family, as in ``result["garage"]``.
    transform
        Pose of the child in the parent, (4, 4), as an expression of joints and parameters.
    joints
        Symbols with a value for each observation, and the search range of each.
    parameters
        Symbols with one unknown value, and its prior: a :class:`FamilyParameter` or its first two numbers.
    weight
        Prior weight of the family. That of a revolute joint is 1.

    Raises
    ------
    ShapeError, UnknownNameError, InvalidValueError
        If the transform is not (4, 4), has symbols that are neither joints nor parameters, a deviation is not
        positive, or a range is empty.
    """

    name: str
    transform: Expression
    joints: Mapping[Symbol, tuple[float, float]]
    parameters: Mapping[Symbol, FamilyParameter | tuple[float, float]] = field(default_factory=dict)
    weight: float = 1.0

    def __post_init__(self) -> None:
        if np.shape(self.transform) != (4, 4):
            raise ShapeError(f"The transform of the family '{self.name}' is a 4×4 expression.")
        known = {*self.joints, *self.parameters}
        others = sorted(str(s) for s in self.transform.symbols if s not in known)
        if others:
            raise UnknownNameError(
                f"The family '{self.name}' depends on {', '.join(others)}: neither a joint nor a parameter."
            )
        object.__setattr__(self, "parameters", {s: FamilyParameter(*u) for s, u in self.parameters.items()})
        for symbol, (low, high) in self.joints.items():
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise InvalidValueError(f"The range of the joint '{symbol}' is empty: {low} to {high}.")
        for symbol, unknown in self.unknowns.items():
            if not (unknown.deviation > 0.0 and unknown.lower <= unknown.start <= unknown.upper):
                raise InvalidValueError(
                    f"'{symbol}' has a positive deviation, and a start within its bounds, not {unknown}."
                )

    @property
    def unknowns(self) -> Mapping[Symbol, FamilyParameter]:
        """Priors of the parameters."""
        return self.parameters  # type: ignore[return-value]

    @cached_property
    def function(self) -> CompiledFunction:
        """Compiled function of joints and parameters: the transform and its derivatives by both."""
        joints, parameters = list(self.joints), list(self.parameters)
        outputs = [self.transform]
        outputs += [self.transform.partial(symbols) for symbols in (parameters, joints) if symbols]
        return compiled(outputs, [*joints, *parameters])


@dataclass(frozen=True, eq=False)
class FamilyMotion:
    """Member of a custom family. Lengths of its poses are in a unit [m], see :mod:`.normalisation`."""

    family: Family
    rows: int
    parameters: Array
    unit: float = 1.0

    @property
    def name(self) -> str:
        """Name of the family."""
        return self.family.name

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def joints(self) -> int:
        """Number of joint values."""
        return len(self.family.joints)

    @property
    def kinds(self) -> tuple[int, ...]:
        """Kind of each joint value, all different: each has its range."""
        return tuple(range(self.joints))

    def linearise(self, values: Array) -> LinearisedPoses:
        """Return the poses at joint values (N, k) and their derivatives."""
        count, rows = len(values), self.rows
        inputs = np.concatenate([values, np.tile(self.parameters, (count, 1))], axis=1)
        poses, *derivatives = (np.array(a) for a in self.family.function.batch(inputs))
        for lengths in (poses, *derivatives):
            lengths[:, :3, 3] /= self.unit
        blocks = iter(derivatives)
        by_parameters = _twists(poses, next(blocks))[:, :rows] if self.size else np.zeros((count, rows, 0))
        by_joints = _twists(poses, next(blocks))[:, :rows] if self.joints else np.zeros((count, rows, 0))
        return LinearisedPoses(poses, by_parameters, by_joints)

    def retract(self, step: Array) -> Self:
        """Return the member after a step, clipped to the bounds of the parameters."""
        bounds = np.array([(u.lower, u.upper) for u in self.family.unknowns.values()]).reshape(-1, 2)
        return replace(self, parameters=np.clip(self.parameters + step, bounds[:, 0], bounds[:, 1]))

    def retract_joints(self, values: Array, step: Array) -> Array:
        """Return joint values after a step of at most a quarter of the search range, clipped to the range."""
        ranges = np.array([*self.family.joints.values()]).reshape(-1, 2)
        largest = 0.25 * (ranges[:, 1] - ranges[:, 0])
        return np.asarray(np.clip(values + np.clip(step, -largest, largest), ranges[:, 0], ranges[:, 1]))

    def prior(self) -> ParameterPrior:
        """Return the Gaussian prior of the parameters."""
        start, deviation = self._prior_moments()
        return ParameterPrior((self.parameters - start) / deviation, np.diag(1.0 / deviation))

    def log_prior(self, mean: Array) -> tuple[float, Array]:
        """Return the log prior of the parameters and of the mean joint values, and its precision.

        Members of a group also have a mean pose with the density 1. Here the parameters determine the mean
        pose, so the density of a pose within reach is divided out.
        """
        _, deviation = self._prior_moments()
        off = self.prior().residuals
        log = -0.5 * float(off @ off) - float(np.sum(np.log(math.sqrt(math.tau) * deviation)))
        log += 1.5 * math.log(math.tau * REACH**2) + (math.log(8.0 * math.pi**2) if self.rows == 6 else 0.0)
        log -= self.joints * math.log(math.sqrt(math.tau) * _MEAN_SPREAD)
        return log, np.concatenate([np.zeros(self.size), np.full(self.joints, _MEAN_SPREAD**-2)])

    def named_parameters(self) -> dict[str, Array | float]:
        """Return the parameters by name."""
        return dict(zip(self.coordinates(), self.parameters.tolist(), strict=True))

    def coordinates(self) -> tuple[str, ...]:
        """Return the names of the parameters."""
        return tuple(str(s) for s in self.family.parameters)

    def expression(self, joints: Sequence[Expression]) -> Expression:
        """Return the pose of the child in the parent as an expression of other joint symbols."""
        values = dict(zip(self.family.joints, joints, strict=True))
        values |= zip(self.family.parameters, self.parameters.tolist(), strict=True)
        return self.family.transform.substitute(values)

    def _prior_moments(self) -> tuple[Array, Array]:
        unknowns = self.family.unknowns.values()
        return np.array([u.start for u in unknowns]), np.array([u.deviation for u in unknowns])


def family_starts(
    family: Family, observations: Observations, unit: float
) -> Iterator[tuple[FamilyMotion, Array]]:
    """Yield initial members of a family, at its start and around it, with the nearest joint values."""
    start = np.array([u.start for u in family.unknowns.values()])
    motion = FamilyMotion(family, observations.rows, start, unit)
    # A fixed seed makes the result reproducible.
    random, (_, deviation) = np.random.default_rng(0), motion._prior_moments()
    for k in range(_MEMBERS if motion.size else 1):
        member = motion.retract(random.normal(0.0, deviation)) if k else motion
        yield member, _nearest(member, observations)


def _nearest(motion: FamilyMotion, observations: Observations) -> Array:
    each = max(3, round(_TRIED ** (1.0 / max(1, motion.joints)) * (1 if motion.joints < 2 else 3)))
    ranges = motion.family.joints.values()
    candidates = np.array([*product(*(np.linspace(low, high, each) for low, high in ranges))])
    poses = motion.linearise(candidates.reshape(-1, motion.joints)).pose
    distances = np.sum((observations.relative[:, None, :3, 3] - poses[None, :, :3, 3]) ** 2, axis=-1)
    if observations.rows == 6:
        turns = np.swapaxes(observations.relative[:, None, :3, :3], -1, -2) @ poses[None, :, :3, :3]
        variances = np.einsum("nii->ni", observations.child_covariance)
        ratio = float(np.mean(variances[:, :3])) / float(np.mean(variances[:, 3:]))
        distances = distances + ratio * np.sum(log_so3(turns) ** 2, axis=-1)
    return np.asarray(candidates.reshape(-1, motion.joints)[np.argmin(distances, axis=1)])


def _twists(poses: Array, derivatives: Array) -> Array:
    """Return twists of the child in the parent's axes, (N, 6, n), from derivatives (N, 4, 4, n)."""
    turning = np.einsum("nijk,nlj->nilk", derivatives[:, :3, :3], poses[:, :3, :3])
    omega = np.stack([turning[:, 2, 1], turning[:, 0, 2], turning[:, 1, 0]], axis=1)
    return np.concatenate([derivatives[:, :3, 3], omega], axis=1)
