"""Checked URDF description: links, joints, limits and mimic relations.

Units are [m], [rad], [kg], [s]. A description is plain immutable data. It refers to the file by line numbers
only, and meshes have not been opened.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

from msgspec import Struct

from kineverse.formats.mimic import MimicRelation
from kineverse.formats.poses import IDENTITY
from kineverse.model.body import NO_BODY, Body, Pose, Vector3

from .kept_elements import KeptParts

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
"""Degrees of freedom of a joint of each type that does not mimic another.

``spherical`` is not part of URDF; MuJoCo reads it.
"""

SPECIFIED_TYPES = tuple(kind for kind in DOF_BY_TYPE if kind != "spherical")
"""Joint types of the specification."""


class UrdfLimits(Struct, frozen=True):
    """Limits of one joint; None for no limit.

    ``lower`` and ``upper`` bound the position [rad] or [m], ``velocity`` the magnitude of the velocity
    [rad/s] or [m/s], ``effort`` that of the torque [N m] or force [N]. From URDF 1.2 on, ``acceleration`` and
    ``deceleration`` bound the rates at which the speed grows and falls [rad/s²] or [m/s²], and ``jerk`` the
    magnitude of the jerk [rad/s³] or [m/s³].

    See Also
    --------
    kineverse.formats.urdf.parse_urdf
    """

    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None
    effort: float | None = None
    acceleration: float | None = None
    deceleration: float | None = None
    jerk: float | None = None


UNLIMITED = UrdfLimits()


class UrdfSafetyController(Struct, frozen=True):
    """Soft limits and gains of a joint's safety controller (ROS wiki, pr2_controller_manager/safety_limits).

    The controller keeps the velocity between ``-k_position (q - soft_lower)`` and ``-k_position (q -
    soft_upper)``. The joint slows down towards the soft limits and returns from beyond them. ``k_velocity``
    bounds the effort near the velocity limit in the same manner. Soft limits are in [rad] or [m],
    ``k_position`` is in [1/s].

    See Also
    --------
    kineverse.formats.urdf.parse_urdf
    """

    soft_lower: float = 0.0
    soft_upper: float = 0.0
    k_position: float = 0.0
    k_velocity: float = 0.0

    @property
    def has_limits(self) -> bool:
        """True if the soft limits are a range; missing ones are both 0 and do not limit the joint."""
        return self.soft_lower < self.soft_upper


class UrdfDynamics(Struct, frozen=True):
    """Damping [N s/m] or [N m s/rad] and static friction [N] or [N m] of a joint.

    See Also
    --------
    kineverse.formats.urdf.parse_urdf
    """

    damping: float = 0.0
    friction: float = 0.0


FRICTIONLESS = UrdfDynamics()


class UrdfJoint(Struct, frozen=True):
    """Joint between two links.

    ``origin`` is parent_T_joint, the pose of the child link in the parent link at position zero. ``axis`` is
    a unit vector in the joint's frame: the axis of rotation, the direction of translation, or the normal of
    the plane; None for joints without axis. The ``limits`` of a planar joint hold for both directions in the
    plane; those of a floating joint are an effort only. ``mimic`` and soft limits are defined for joints of
    one DoF; ``mimic`` is the relation to the independent joint at the end of its chain.

    See Also
    --------
    kineverse.formats.urdf.parse_urdf
    """

    name: str
    kind: UrdfJointType
    parent: str
    child: str
    origin: Pose = IDENTITY
    axis: Vector3 | None = None
    limits: UrdfLimits = UNLIMITED
    safety: UrdfSafetyController | None = None
    mimic: MimicRelation[str] | None = None
    dynamics: UrdfDynamics = FRICTIONLESS
    line: int = 0


class UrdfLink(Struct, frozen=True):
    """Link: a frame and the body attached to it.

    See Also
    --------
    kineverse.formats.urdf.parse_urdf
    """

    name: str
    body: Body = NO_BODY
    line: int = 0


class UrdfRobot(Struct, frozen=True):
    """Tree of links and joints.

    ``links`` are in the order of the file. ``joints`` are ordered from the ``root`` outwards, each after the
    joint of its parent link. ``more_roots`` are further links without parent, in files that are no tree;
    their pose is that of the root. ``remarks`` are warnings about ignored or ambiguous elements, each with
    its line. ``kept`` are the parts that say nothing of motion.

    See Also
    --------
    kineverse.formats.urdf.parse_urdf
    """

    name: str
    root: str
    links: tuple[UrdfLink, ...]
    joints: tuple[UrdfJoint, ...]
    source: str = ""
    remarks: tuple[str, ...] = ()
    more_roots: tuple[str, ...] = ()
    kept: KeptParts | None = None

    @property
    def dof(self) -> int:
        """Number of degrees of freedom; joints that mimic another have none."""
        return sum(DOF_BY_TYPE[joint.kind] for joint in self.joints if joint.mimic is None)
