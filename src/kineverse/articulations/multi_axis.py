"""Joints with several axes: planar, universal, ball, floating."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, array
from kineverse.expressions.functions import norm
from kineverse.lie import round_exact, smallest_rotation_from_z, transform
from kineverse.model.body import AxisLike, Pose
from kineverse.model.constraint import Constraint
from kineverse.model.operation import Writes
from kineverse.model.read_recorder import ReadRecorder
from kineverse.spatial import quaternion, rotation_z, translation
from kineverse.symbols import Symbol, position, velocity

from .joint import Joint, check_axis, check_joint_number
from .limits import FREE, Limits, check_limits, check_speed_limit, limit_constraints
from .single_axis import rotation_factors, unit_axis

_PERPENDICULAR = 1e-6  # largest cosine between axes that count as perpendicular


@dataclass(frozen=True, kw_only=True)
class Planar(Joint, document_kind="Planar"):
    """Planar joint: parent_T_child = origin · A · translation(x, y, 0) · rotation_z(θ) · Aᵀ.

    The columns of A are two directions in the plane and its normal, the axis. Coordinates are ``name/x``,
    ``name/y`` [m] and ``name/angle`` [rad], all free. For the axis z, A is the identity; for another axis n,
    A is the smallest rotation that takes z to n (about z × n), and a half turn about x for -z.

    Attributes
    ----------
    axis
        Normal of the plane in the joint's frame.
    lower, upper
        Limits of both x and y [m]; None leaves that side open.
    velocity
        Limit of both ``|ẋ|`` and ``|ẏ|`` [m/s]; None for no limit.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.Planar(name="box", parent="world", child="box", lower=-1, upper=1))
    'joint box'
    >>> model.degrees_of_freedom
    (box/angle, box/x, box/y)
    >>> model.violations({"box/x": 0.5, "box/y": 1.25, "box/angle": 0})
    1 violated
      box/y/position: -1 <= 1.25 <= 1 is off by 0.25
    """

    axis: AxisLike = (0.0, 0.0, 1.0)
    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "axis", check_axis(self.axis, self.name))

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame and the limits."""
        x, y, angle = (position(f"{self.name}/{c}") for c in ("x", "y", "angle"))
        turn = rotation_from_z(self.axis)
        motion = (Pose.from_matrix(turn), translation(x, y, 0), rotation_z(angle), Pose.from_matrix(turn.T))
        constraints: dict[str, Constraint] = {}
        for q in (x, y):
            constraints.update(limit_constraints(str(q), q, self.lower, self.upper, self.velocity))
        return Writes(
            frames={self.child: (self.parent, (self.origin, *motion))},
            constraints=constraints,
            articulations={self.name: self.record((x, y, angle))},
        )


@dataclass(frozen=True, kw_only=True)
class Universal(Joint, document_kind="Universal"):
    """Universal (Cardan) joint: parent_T_child = origin · rotation(first, α) · rotation(second, β).

    Coordinates ``name/first``, α, and ``name/second``, β [rad]. The first axis is fixed in the parent, the
    second in the child.

    Attributes
    ----------
    first, second
        The axes in the joint's frame at rest, perpendicular to each other.
    first_limits, second_limits
        Limits of α and of β.

    Raises
    ------
    InvalidValueError
        For axes that are not perpendicular, with the angle between them.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(
    ...         kv.articulations.Universal(
    ...             name="cross", parent="world", child="shaft", first=(1, 0, 0), second=(0, 1, 0)
    ...         )
    ...     )
    'joint cross'
    >>> model.degrees_of_freedom
    (cross/first, cross/second)
    """

    first: AxisLike = (1.0, 0.0, 0.0)
    second: AxisLike = (0.0, 1.0, 0.0)
    first_limits: Limits = FREE
    second_limits: Limits = FREE

    def __post_init__(self) -> None:
        super().__post_init__()
        for what in ("first", "second"):
            object.__setattr__(self, what, check_axis(getattr(self, what), self.name))
            field = f"{what}_limits"
            check_limits(getattr(self, field), f"'{field}' of the universal joint '{self.name}'")
        cosine = float(np.dot(unit_axis(self.first), unit_axis(self.second)))
        if abs(cosine) > _PERPENDICULAR:
            angle = math.acos(max(-1.0, min(cosine, 1.0)))
            raise InvalidValueError(
                f"The axes of the universal joint '{self.name}' are perpendicular, and not {angle:.6g} rad "
                "apart."
            )

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame and the limits."""
        self.check_free(model)
        a, b = position(f"{self.name}/first"), position(f"{self.name}/second")
        motion = (*rotation_factors(self.first, a), *rotation_factors(self.second, b))
        return Writes(
            frames={self.child: (self.parent, (self.origin, *motion))},
            constraints={
                **dict(self.first_limits.constraints(f"{self.name}/first", a)),
                **dict(self.second_limits.constraints(f"{self.name}/second", b)),
            },
            articulations={self.name: self.record((a, b))},
        )


@dataclass(frozen=True, kw_only=True)
class Ball(Joint, document_kind="Ball"):
    """Ball (spherical) joint: parent_T_child = origin · rotation(quaternion).

    Four coordinates ``name/qx|qy|qz|qw`` and three speeds, the angular velocity ω of the child in its own
    axes, ``name/wx|wy|wz`` [rad/s], with q̇ = ½ q ⊗ (ω, 0) as for :class:`Floating`.

    The limits are smooth at rest (swing-twist decomposition). With the quaternion q = (v, w), its component
    p = v·a along the axis a and its component v - pa perpendicular to it:

    - the swing angle γ between the axis and its direction at rest has ``1 - cos γ = 2|v - pa|²/|q|²``, which
      the cone bounds by 1 - cos(cone);
    - the twist angle τ about the axis has tan(τ/2) = p/w, so ``|τ| <= twist`` is
      ``(p² cos²(twist/2) - w² sin²(twist/2))/|q|² <= 0``.

    Both grow with the square of the angle near rest. A velocity row enforces them to first order, so a step
    of Δt violates them by ``(|ω|Δt)²/2`` at most.

    Attributes
    ----------
    axis
        The child's axis that cone and twist refer to, in the joint's frame at rest.
    cone
        The largest angle between the axis and its direction at rest, in (0, π] [rad]; None for no limit.
    twist
        Limit of ``|τ|`` in (0, π] [rad]; None for no limit.
    velocity
        Limit of ``|ω|`` [rad/s]; None for no limit.

    Raises
    ------
    InvalidValueError
        For a cone or a twist outside (0, π], or a negative limit of the speed.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(
    ...         kv.articulations.Ball(name="hip", parent="world", child="leg", axis=(0, 0, 1), cone=0.8)
    ...     )
    'joint hip'
    >>> tilted = model.integrate(model.default_state(), {"hip/wx:velocity": 1.0}, dt=1.0)
    >>> [name for name, *_ in model.violations(tilted)]
    ['hip/cone']
    """

    axis: AxisLike = (0.0, 0.0, 1.0)
    cone: float | None = None
    twist: float | None = None
    velocity: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "axis", check_axis(self.axis, self.name))
        for what in ("cone", "twist"):
            angle = getattr(self, what)
            text = f"The {what} of the ball joint '{self.name}'"
            if angle is not None and not 0 < check_joint_number(angle, text) <= math.pi:
                raise InvalidValueError(f"{text} lies in (0, π] rad, and is not {angle!r}.")
        check_speed_limit(self.velocity, f"The velocity limit of the ball joint '{self.name}'")

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame, the rates of the quaternion and the limits."""
        self.check_free(model)
        q, omega, rows = orientation(self.name)
        whole = array(q)
        along = np.array(unit_axis(self.axis))
        p, w = whole[:3] @ along, q[3]
        across = np.cross(whole[:3], along)
        size = whole @ whole
        constraints = {}
        if self.cone is not None:
            bound, versine = 2 * math.sin(self.cone / 2) ** 2, 2 * (across @ across) / size
            constraints[f"{self.name}/cone"] = Constraint.from_expressions(-math.inf, versine, bound)
        if self.twist is not None:
            c, s = math.cos(self.twist / 2), math.sin(self.twist / 2)
            excess = ((c * p) ** 2 - (s * w) ** 2) / size
            constraints[f"{self.name}/twist"] = Constraint.from_expressions(-math.inf, excess, 0)
        most = check_speed_limit(self.velocity, "")
        if most is not None:
            constraints[f"{self.name}/velocity"] = Constraint.from_expressions(0, norm(array(omega)), most)
        return Writes(
            frames={self.child: (self.parent, (self.origin, quaternion(*q)))},
            constraints=constraints,
            rates=rows,
            articulations={self.name: self.record(q, (0.0, 0.0, 0.0, 1.0), omega)},
        )


@dataclass(frozen=True, kw_only=True)
class Floating(Joint, document_kind="Floating"):
    """Floating joint (free motion): parent_T_child = origin · translation(x, y, z) · rotation(quaternion).

    Seven coordinates ``name/x|y|z`` [m] and ``name/qx|qy|qz|qw``, six speeds: the velocities of x, y, z
    [m/s], and the angular velocity ω of the child in its own axes, ``name/wx|wy|wz`` [rad/s]. The quaternion
    has the rate q̇ = ½ q ⊗ (ω, 0), which preserves its length. The pose normalises the quaternion.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.Floating(name="cup", parent="world", child="cup"))
    'joint cup'
    >>> model.speeds_of("cup")
    (cup/wx:velocity, cup/wy:velocity, cup/wz:velocity, cup/x:velocity, cup/y:velocity, cup/z:velocity)
    """

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame and the rates of the quaternion."""
        xyz = tuple(position(f"{self.name}/{c}") for c in "xyz")
        q, omega, rows = orientation(self.name)
        speeds = (*(c.derivative() for c in xyz), *omega)
        return Writes(
            frames={self.child: (self.parent, (self.origin, translation(*xyz), quaternion(*q)))},
            rates=rows,
            articulations={self.name: self.record((*xyz, *q), (0, 0, 0, 0, 0, 0, 1.0), speeds)},
        )


class Orientation(NamedTuple):
    """Quaternion (x, y, z, w), angular velocity ω in the child's axes, and q̇ = ½ q ⊗ (ω, 0) by rows."""

    coordinates: tuple[Symbol, ...]
    speeds: tuple[Symbol, ...]
    rates: Mapping[Symbol, Mapping[Symbol, Expression]]


def orientation(name: str) -> Orientation:
    """Return the coordinates, speeds and rates of a quaternion with names below a name."""
    x, y, z, w = q = tuple(position(f"{name}/q{c}") for c in "xyzw")
    wx, wy, wz = omega = tuple(velocity(f"{name}/w{c}") for c in "xyz")
    rows = {
        x: {wx: w / 2, wy: -z / 2, wz: y / 2},
        y: {wx: z / 2, wy: w / 2, wz: -x / 2},
        z: {wx: -y / 2, wy: x / 2, wz: w / 2},
        w: {wx: -x / 2, wy: -y / 2, wz: -z / 2},
    }
    return Orientation(q, omega, rows)


def rotation_from_z(axis: AxisLike) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return the smallest rotation that takes z to the axis, 4×4."""
    rotation = smallest_rotation_from_z(np.array(unit_axis(axis)))
    return transform(round_exact(rotation), np.zeros(3))
