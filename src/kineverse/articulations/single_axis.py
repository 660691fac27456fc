"""Joints with one axis: revolute, continuous, prismatic, screw, cylindrical."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression
from kineverse.lie import normalize, round_exact, transform
from kineverse.model.body import AxisLike, Pose
from kineverse.model.operation import Writes
from kineverse.model.read_recorder import ReadRecorder
from kineverse.spatial import X, Y, Z, rotation_about, translation_along
from kineverse.symbols import position

from .joint import Joint, OneDofJoint, Size, check_axis, check_size
from .limits import FREE, Limits, check_limits


@dataclass(frozen=True, kw_only=True)
class Revolute(OneDofJoint, document_kind="Revolute"):
    """Revolute joint (hinge): parent_T_child = origin · rotation(axis, q), q in [rad].

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(
    ...         kv.Revolute(name="door", parent="world", child="door", axis=(0, 0, 1), lower=0, upper=1.6)
    ...     )
    ...     edit.add_frame("handle", parent="door", transform=kv.translation(0.4, 0, 0))
    'joint door'
    'frame handle'
    >>> model.fk("handle")({"door": 0.5})[:3, 3].round(3)
    array([0.351, 0.192, 0.   ])
    """

    def motion(self, q: Expression) -> tuple[Pose | Expression, ...]:
        """Return the factors of joint_T_child."""
        return rotation_factors(self.axis, q)


@dataclass(frozen=True, kw_only=True)
class Continuous(Revolute, document_kind="Continuous"):
    """Revolute joint without end stops, q in [rad]; usually without position limits.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.Continuous(name="wheel", parent="world", child="rim", axis=(0, 1, 0)))
    'joint wheel'
    >>> model.limits("wheel")
    (-inf, inf)
    >>> model.fk("rim")({"wheel": np.pi})[:3, 0].round(3) + 0.0
    array([-1.,  0.,  0.])
    """


@dataclass(frozen=True, kw_only=True)
class Prismatic(OneDofJoint, document_kind="Prismatic"):
    """Prismatic joint (slider): parent_T_child = origin · translation(axis · q), q in [m].

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.Prismatic(name="drawer", parent="world", child="drawer", lower=0, upper=0.4))
    'joint drawer'
    >>> model.fk("drawer")({"drawer": 0.25})[:3, 3]
    array([0.25, 0.  , 0.  ])
    >>> model.violations({"drawer": 0.5})
    1 violated
      drawer/position: 0 <= 0.5 <= 0.4 is off by 0.1
    """

    def motion(self, q: Expression) -> tuple[Pose | Expression, ...]:
        """Return the factors of joint_T_child."""
        return (translation_along(unit_axis(self.axis), q),)


@dataclass(frozen=True, kw_only=True)
class Screw(OneDofJoint, document_kind="Screw"):
    """Screw joint: parent_T_child = origin · translation(axis · p q/2π) · rotation(axis, q), q in [rad].

    Attributes
    ----------
    pitch
        Displacement along the axis in one revolution, p [m], a number or an expression: positive for a
        right-handed thread, negative for a left-handed one.

    Raises
    ------
    InvalidValueError
        For a pitch of 0 or NaN.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(
    ...         kv.articulations.Screw(name="lid", parent="world", child="lid", axis=(0, 0, 1), pitch=0.004)
    ...     )
    'joint lid'
    >>> model.fk("lid")({"lid": np.pi})[2, 3]  # half a turn
    np.float64(0.002)
    """

    pitch: Size

    def __post_init__(self) -> None:
        super().__post_init__()
        if check_size(self.pitch, f"The pitch of the screw '{self.name}'") == 0:
            raise InvalidValueError(
                f"The pitch of the screw '{self.name}' is 0, so it does not move along its axis; "
                "that is a kv.Revolute."
            )

    def motion(self, q: Expression) -> tuple[Pose | Expression, ...]:
        """Return the factors of joint_T_child."""
        along = translation_along(unit_axis(self.axis), self.pitch / math.tau * q)
        return along, *rotation_factors(self.axis, q)

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame and the limits."""
        self.check_free(model)
        return super().apply(model)


@dataclass(frozen=True, kw_only=True)
class Cylindrical(Joint, document_kind="Cylindrical"):
    """Cylindrical joint: parent_T_child = origin · translation(axis · s) · rotation(axis, φ).

    Coordinates ``name/slide``, s [m], and ``name/turn``, φ [rad], independent of each other.

    Attributes
    ----------
    axis
        Direction in the joint's frame, of any length but zero.
    slide, turn
        Limits of s and of φ.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(
    ...         kv.articulations.Cylindrical(
    ...             name="bolt", parent="world", child="bolt", axis=(0, 0, 1), slide=kv.Limits(0, 0.05)
    ...         )
    ...     )
    'joint bolt'
    >>> model.fk("bolt")({"bolt/slide": 0.02, "bolt/turn": 0.5})[2, 3]
    np.float64(0.02)
    """

    axis: AxisLike = (1.0, 0.0, 0.0)
    slide: Limits = FREE
    turn: Limits = FREE

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "axis", check_axis(self.axis, self.name))
        for what in ("slide", "turn"):
            check_limits(getattr(self, what), f"'{what}' of the cylindrical joint '{self.name}'")

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame and the limits."""
        self.check_free(model)
        s, angle = position(f"{self.name}/slide"), position(f"{self.name}/turn")
        motion = (translation_along(unit_axis(self.axis), s), *rotation_factors(self.axis, angle))
        return Writes(
            frames={self.child: (self.parent, (self.origin, *motion))},
            constraints={
                **dict(self.slide.constraints(f"{self.name}/slide", s)),
                **dict(self.turn.constraints(f"{self.name}/turn", angle)),
            },
            articulations={self.name: self.record((s, angle))},
        )


def unit_axis(axis: AxisLike) -> tuple[float, float, float]:
    """Return the unit vector along an axis."""
    numbers = normalize(axis)
    assert numbers is not None  # joints check their axis at construction
    x, y, z = numbers
    return x, y, z


def rotation_factors(axis: AxisLike, q: Expression) -> tuple[Pose | Expression, ...]:
    """Return the rotation about an axis as factors: A · rotation_z(q) · Aᵀ, the axis as last column of A.

    Only the middle factor depends on q, so the expressions of a chain stay small. A rotation about x, y or z
    is one factor.
    """
    x, y, z = unit_axis(axis)
    for component, about in ((x, X), (y, Y), (z, Z)):
        if abs(component) == 1.0 and (x, y, z).count(0.0) == 2:
            return (rotation_about(about, q if component > 0 else -q),)
    a = np.array([x, y, z])
    helper = np.eye(3)[np.argmin(np.abs(a))]
    first = np.cross(helper, a)
    first /= np.linalg.norm(first)
    to_axis = transform(round_exact(np.column_stack([first, np.cross(a, first), a])), np.zeros(3))
    return Pose.from_matrix(to_axis), rotation_about(Z, q), Pose.from_matrix(to_axis.T)
