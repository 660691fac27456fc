"""Joint families: subgroups of SE(3) between parent and child, and families of a user's expression.

    parent_T_child = L · g(a) · R,        g(a) = translation(v(a)) · Exp(ω(a))

Each joint value is one of the six components of (v, ω), and these components define the subgroup. For a
screw, v_z also gets the pitch times ω_z. So a revolute joint rotates about the z axis of L. Of the twelve
parameters of L and R, those without a gauge freedom remain: a motion that commutes with the subgroup can move
from L to R, and a motion in the subgroup is a shift of joint values.

Where a joint translates and rotates, the translation of R selects the point of the child that v translates.
The poses do not depend on this sliding point, but the prior of v does, so it is a parameter.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from types import MappingProxyType
from typing import NamedTuple, Self

import casadi as ca
import numpy as np

from kineverse import spatial
from kineverse.errors import InvalidValueError, ShapeError, UnknownNameError
from kineverse.expressions.expression import Expression, array
from kineverse.expressions.functions import maximum, minimum
from kineverse.expressions.layout import SX
from kineverse.lie import Array, log_so3
from kineverse.symbols import Symbol

from .motion_functions import GeneratedMotion, MotionForm, MotionFunctions, ParameterStep, generate
from .observations import Observations

VX, VY, VZ, WX, WY, WZ = range(6)


@dataclass(frozen=True, slots=True)
class Parametrisation:
    """Components of (v, ω) that are joint values or parameters."""

    joints: tuple[int, ...]  # joint values
    left: tuple[int, ...]  # components of the twist that moves L, in the axes of L
    right: tuple[int, ...]  # components of the twist that moves R, applied on its left
    levers: int = 0  # number of components of the child's position in the joint's frame with a prior


@dataclass(frozen=True, eq=False)
class JointFamily:
    """Joint family."""

    name: str
    poses: Parametrisation  # for observed poses of the child
    positions: Parametrisation  # for observed positions only
    pitch: bool = False  # True if the joint translates along z by a pitch [m/rad] as it rotates

    def parametrisation(self, rows: int) -> Parametrisation:
        """Return the parametrisation for poses (6 rows) or positions (3 rows)."""
        return self.poses if rows == 6 else self.positions


_P, _V, _VW, _LINE = Parametrisation, (VX, VY, VZ), (VX, VY, VZ, WX, WY, WZ), (VX, VY, WX, WY)
_FAMILIES = (
    JointFamily("rigid", _P((), (), _VW), _P((), (), _V)),
    JointFamily("prismatic", _P((VZ,), (WX, WY), (VX, VY, WX, WY, WZ)), _P((VZ,), (WX, WY), (VX, VY))),
    JointFamily("revolute", _P((WZ,), _LINE, (*_V, WX, WY), 2), _P((WZ,), _LINE, (VX, VZ), 2)),
    JointFamily("screw", _P((WZ,), _LINE, (*_V, WX, WY), 2), _P((WZ,), _LINE, (VX, VZ), 2), pitch=True),
    JointFamily("cylindrical", _P((VZ, WZ), _LINE, (VX, VY, WX, WY), 2), _P((VZ, WZ), _LINE, (VX,), 2)),
    JointFamily("spherical", _P((WX, WY, WZ), _V, _V, 3), _P((WY, WZ), _V, (VX,), 3)),
    JointFamily("planar", _P((VX, VY, WZ), (WX, WY), (*_V, WX, WY), 2), _P((VX, VY), (WX, WY), (VZ,))),
    JointFamily("free", _P(_VW, (), _V, 3), _P(_V, (), ())),
)
JOINT_FAMILIES: Mapping[str, JointFamily] = MappingProxyType({family.name: family for family in _FAMILIES})
"""Families by name. ``rigid`` has no joint values, and ``free`` has no parameters."""

PITCHES = 0.1  # prior standard deviation of a pitch [m/rad]
REACH = 1.0  # prior standard deviation of each component of a lever [m]


@functools.cache
def group_functions(about_any_axis: bool) -> MotionFunctions:
    """Return the functions of members of groups, whose joint values rotate about z or about any axis."""
    state = [Symbol(f"identification/state {i}") for i in range(33)]
    joints = [Symbol(f"identification/joint {i}") for i in range(6 if about_any_axis else 4)]
    step = [Symbol(f"identification/step {i}") for i in range(13)]

    def frame(at: int) -> Expression:
        matrix = array(state[at : at + 16]).reshape(4, 4)
        return spatial.transform(matrix[:3, :3], matrix[:3, 3])

    def upright(T: Expression) -> Expression:
        # Rotations drift under repeated multiplication. The error of R (3 - RᵀR) / 2 is the square of R's.
        R = T[:3, :3]
        return spatial.transform(R @ (1.5 * np.eye(3) - 0.5 * (R.T @ R)), T[:3, 3])

    def twisted(twist: Sequence[Expression]) -> Expression:
        return spatial.transform(spatial.exp_so3(array(twist[3:])), array(twist[:3]))

    def nearly(twist: Sequence[Expression]) -> Expression:
        return spatial.transform(np.eye(3) + spatial.skew(array(twist[3:])), array(twist[:3]))

    def packed(L: Expression, R: Expression) -> SX:
        return array([*L.ravel(), *R.ravel(), pitch + step[12]]).casadi

    left, right, pitch, angle = frame(0), frame(16), state[32], joints[-1]
    turn = spatial.exp_so3(array(joints[3:])) if about_any_axis else spatial.rotation_z(angle)
    shift = array([joints[0], joints[1], joints[2] + pitch * angle])
    pose = left @ spatial.transform(turn, shift) @ right
    moved = packed(left @ nearly(step[:6]), nearly(step[6:12]) @ right)
    after = packed(upright(left @ twisted(step[:6])), upright(twisted(step[6:12]) @ right))
    prior = array([*(right[:3, 3] / REACH), pitch / PITCHES]).casadi
    return generate(pose.casadi, state, joints, ParameterStep(step, moved, after), prior=prior)


def prepare_functions(wait: bool = False) -> None:
    """Generate and compile the functions of the joint families, in the background unless ``wait``."""
    for about_any_axis in (False, True):
        functions = group_functions(about_any_axis)
        if wait:
            functions.wait()


@functools.cache
def _group_form(group: JointFamily, rows: int) -> MotionForm:
    freedom = group.parametrisation(rows)
    about_any_axis = bool({WX, WY} & {*freedom.joints})
    angles = np.array([j >= WX for j in freedom.joints], dtype=bool)
    free = np.full(len(angles), math.inf)
    ends, others = len(freedom.left), len(freedom.right) + group.pitch
    return MotionForm(
        functions=group_functions(about_any_axis),
        rows=rows,
        parameters=(*freedom.left, *(6 + j for j in freedom.right), *([12] if group.pitch else ())),
        joints=freedom.joints if about_any_axis else tuple(min(j, 3) for j in freedom.joints),
        beliefs=(*range(freedom.levers), *([3] if group.pitch else ())),
        kinds=tuple(angles.astype(int).tolist()),
        # A step turns by at most half a radian, since the poses are linear in the angle only nearby.
        limits=np.array([np.where(angles, 0.5, math.inf), -free, free]),
        # 1 rad⁻² has the width and the density of half a sphere.
        precision=np.array([j in (WX, WY, WZ) for j in freedom.left] + [0] * others + [*angles], dtype=float),
        movers=tuple(ends + i for i, j in enumerate(freedom.right) if j not in freedom.joints),
    )


@dataclass(frozen=True)
class GroupMotion(GeneratedMotion):
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

    @cached_property
    def form(self) -> MotionForm:
        """Form of the family."""
        return _group_form(self.group, self.rows)

    @cached_property
    def state(self) -> Array:
        """Entries of L and R, and the pitch, (33,)."""
        return np.concatenate([self.left.ravel(), self.right.ravel(), (self.pitch,)])

    def with_state(self, state: Array) -> Self:
        """Return the member in another state."""
        left, right = state[:16].reshape(4, 4), state[16:32].reshape(4, 4)
        moved = type(self)(self.group, self.rows, left, right, float(state[32]))
        moved.__dict__.update(form=self.form, state=state)
        return moved

    @property
    def name(self) -> str:
        """Name of the family."""
        return self.group.name

    def log_density(self) -> float:
        """Return the log prior density of the parameters beyond a mean pose.

        A lever is Gaussian. A direction is uniform on half the sphere, because an axis has no sign.
        """
        lever, log = self.right[: self.parametrisation.levers, 3] / REACH, 0.0
        if WX in self.parametrisation.left:
            log -= math.log(math.tau)
        log -= 0.5 * float(lever @ lever) + 0.5 * len(lever) * math.log(math.tau * REACH**2)
        if self.group.pitch:
            log -= 0.5 * (self.pitch / PITCHES) ** 2 + 0.5 * math.log(math.tau * PITCHES**2)
        return log

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

    See Also
    --------
    kineverse.estimation.Family
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

    Examples
    --------
    >>> q, radius = kv.position("q"), kv.position("radius")
    >>> cam = kv.estimation.Family(
    ...     "wheel",
    ...     kv.rotation_z(q) @ kv.translation(radius, 0, 0),
    ...     joints={q: (-np.pi, np.pi)},
    ...     parameters={radius: (0.3, 0.1)},
    ... )
    >>> angles = np.linspace(0, 1, 20)
    >>> poses = np.stack([(kv.rotation_z(a) @ kv.translation(0.4, 0, 0))() for a in angles])
    >>> result = kv.estimation.identify(None, poses, noise=(0.001, 0.01), families=[cam, "prismatic"])
    >>> result.best.family, round(result.best.parameters["radius"], 2)
    ('wheel', 0.4)
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
    def functions(self) -> MotionFunctions:
        """Functions of the parameters and a unit of length, and of the joint values."""
        joints, unknowns, unit = list(self.joints), self.unknowns, Symbol("identification/unit")
        step = [Symbol(f"identification/step {i}") for i in range(len(unknowns) + 1)]
        pose = self.transform * array([[1.0, 1.0, 1.0, 1.0 / unit]] * 3 + [[1.0] * 4])

        def derivatives(symbols: Sequence[Symbol]) -> SX:
            partial = pose.partial(symbols)
            columns = [ca.vec(partial[:, :, j].casadi) for j in range(len(symbols))]
            return ca.horzcat(ca.SX.zeros(16, 0), *columns)

        sums = [s + d for s, d in zip((*unknowns, unit), step, strict=True)]
        bounds = [(u.lower, u.upper) for u in unknowns.values()]
        after = [minimum(maximum(s, low), high) for s, (low, high) in zip(sums, bounds, strict=False)]
        off = [(s - u.start) / u.deviation for s, u in unknowns.items()]
        return generate(
            pose.casadi,
            [*unknowns, unit],
            joints,
            ParameterStep(
                step,
                array(sums).casadi,
                array([*after, unit]).casadi,
                ca.horzcat(derivatives([*unknowns]), ca.SX.zeros(16, 1)),
            ),
            derivatives(joints),
            array(off).casadi if off else None,
        )

    @cached_property
    def _forms(self) -> Mapping[int, MotionForm]:
        ranges = np.array([*self.joints.values()]).reshape(-1, 2)
        count, joints = len(self.unknowns), len(ranges)
        # A step is at most a quarter of the search range.
        limits = np.array([0.25 * (ranges[:, 1] - ranges[:, 0]), *ranges.T])
        form = MotionForm(
            self.functions, 6, tuple(range(count)), tuple(range(joints)), tuple(range(count)),
            tuple(range(joints)), limits, np.repeat([0.0, _MEAN_SPREAD**-2], [count, joints]),
        )  # fmt: skip
        return {6: form, 3: replace(form, rows=3)}


@dataclass(frozen=True, eq=False)
class FamilyMotion(GeneratedMotion):
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
    def form(self) -> MotionForm:
        """Form of the family."""
        return self.family._forms[self.rows]

    @property
    def state(self) -> Array:
        """Parameters, and the unit."""
        return np.append(self.parameters, self.unit)

    def with_state(self, state: Array) -> Self:
        """Return the member in another state."""
        return replace(self, parameters=state[:-1], unit=float(state[-1]))

    def log_density(self) -> float:
        """Return the log prior density of the parameters and of the mean joint values.

        Members of a group also have a mean pose with the density 1. Here the parameters determine the mean
        pose, so the density of a pose within reach is divided out.
        """
        start, deviation = self._prior_moments()
        off = (self.parameters - start) / deviation
        log = -0.5 * float(off @ off) - float(np.sum(np.log(math.sqrt(math.tau) * deviation)))
        log += 1.5 * math.log(math.tau * REACH**2) + (math.log(8.0 * math.pi**2) if self.rows == 6 else 0.0)
        return log - self.joints * math.log(math.sqrt(math.tau) * _MEAN_SPREAD)

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
