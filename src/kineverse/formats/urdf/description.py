"""Checked URDF description: links, joints, limits and mimic relations.

Units are [m], [rad], [kg], [s]. A description is plain immutable data: nothing in it refers to the file any
more but line numbers, and no mesh has been opened.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from kineverse.model.body import Body, Pose, Vector3

UrdfJointType: TypeAlias = Literal[
    "fixed", "revolute", "continuous", "prismatic", "planar", "floating", "spherical"
]

DOF_BY_TYPE: dict[UrdfJointType, int] = {
    "fixed": 0,
    "revolute": 1,
    "continuous": 1,
    "prismatic": 1,
    "planar": 3,
    "floating": 6,
    "spherical": 3,
}
"""How many independent speeds a joint of each kind has, unless it mimics another.

``spherical`` is no word of URDF; MuJoCo reads it.
"""

SPECIFIED = tuple(kind for kind in DOF_BY_TYPE if kind != "spherical")
"""The kinds that the specification has."""

_IDENTITY = Pose()
_NOTHING = Body()


@dataclass(frozen=True, slots=True)
class UrdfLimits:
    """Bounds of one joint; None is no bound.

    ``lower`` and ``upper`` bound the position [rad] or [m], ``velocity`` the magnitude of the speed [rad/s]
    or [m/s], ``effort`` that of the torque [N m] or force [N]; from URDF 1.2 on, ``acceleration`` and
    ``deceleration`` those of gaining and losing speed [rad/s²] or [m/s²], ``jerk`` that of their change.
    """

    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None
    effort: float | None = None
    acceleration: float | None = None
    deceleration: float | None = None
    jerk: float | None = None


UNLIMITED = UrdfLimits()


@dataclass(frozen=True, slots=True)
class UrdfSafetyController:
    """What the safety controller of a joint does (ROS wiki, pr2_controller_manager/safety_limits).

    It keeps the speed between ``-k_position (q - soft_lower)`` and ``-k_position (q - soft_upper)``, so that
    the joint slows down towards the soft limits and is led back from beyond them; ``k_velocity`` bounds the
    effort around the velocity limit in the same manner. Soft limits are in [rad] or [m], ``k_position`` is in
    [1/s].
    """

    soft_lower: float = 0.0
    soft_upper: float = 0.0
    k_position: float = 0.0
    k_velocity: float = 0.0

    @property
    def bounds(self) -> bool:
        """Whether the soft limits leave a range; those left out are both 0 and bound nothing."""
        return self.soft_lower < self.soft_upper


@dataclass(frozen=True, slots=True)
class UrdfMimic:
    """A position that follows another joint: ``multiplier * joint + offset``.

    A chain is resolved: ``joint`` is the one at its end that moves by itself, and the factors are composed.
    """

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class UrdfDynamics:
    """Damping [N s/m] or [N m s/rad] and static friction [N] or [N m] of a joint."""

    damping: float = 0.0
    friction: float = 0.0


FRICTIONLESS = UrdfDynamics()


@dataclass(frozen=True, slots=True)
class UrdfJoint:
    """A joint between two links.

    ``origin`` is parent_T_joint, the pose of the child link in the parent link at position zero. ``axis`` is
    a unit vector in the joint's frame: of rotation, of translation, or the normal of the plane; None for
    joints that have none. ``limits``, ``safety``, ``mimic`` and ``dynamics`` only have meaning for joints of
    one DoF.
    """

    name: str
    kind: UrdfJointType
    parent: str
    child: str
    origin: Pose = _IDENTITY
    axis: Vector3 | None = None
    limits: UrdfLimits = UNLIMITED
    safety: UrdfSafetyController | None = None
    mimic: UrdfMimic | None = None
    dynamics: UrdfDynamics = FRICTIONLESS
    line: int = 0


@dataclass(frozen=True, slots=True)
class UrdfLink:
    """A link: a frame, and what is attached to it."""

    name: str
    body: Body = _NOTHING
    line: int = 0


@dataclass(frozen=True, slots=True)
class UrdfRobot:
    """A tree of links and joints.

    ``links`` are in the order of the file; ``joints`` lead from the ``root`` outwards, so that a joint comes
    after the one that moves its parent. ``more_roots`` are further links that are nobody's child, of files
    that are no tree: they stand where the root does. ``remarks`` say what was ignored, or read in a way its
    author may not have meant; each names its line.
    """

    name: str
    root: str
    links: tuple[UrdfLink, ...]
    joints: tuple[UrdfJoint, ...]
    source: str = ""
    remarks: tuple[str, ...] = ()
    more_roots: tuple[str, ...] = ()

    @property
    def dof(self) -> int:
        """The number of independent speeds; joints that mimic another have none of their own."""
        return sum(DOF_BY_TYPE[joint.kind] for joint in self.joints if joint.mimic is None)
