"""Checked SDF description: links, frames, roots, joints and loops.

Units are [m], [rad], [kg], [s]. Names are paths: ``a::b`` of the file is ``a/b`` here. A description is plain
immutable data. It refers to the file by line numbers only, and meshes have not been opened.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from kineverse.formats.mimic import MimicRelation
from kineverse.formats.poses import IDENTITY
from kineverse.model.body import NO_BODY, Body, Pose, Vector3

from .custom_attributes import SdfLoop

SdfJointType: TypeAlias = Literal[
    "fixed", "revolute", "continuous", "prismatic", "screw", "universal", "revolute2", "ball", "gearbox"
]

AXIS_COUNT: dict[SdfJointType, int] = {
    "fixed": 0,
    "revolute": 1,
    "continuous": 1,
    "prismatic": 1,
    "screw": 1,
    "universal": 2,
    "revolute2": 2,
    "ball": 0,
    "gearbox": 2,
}
"""Number of axes of a joint of each type."""

WORLD = "world"  # name of the world in place of a link; reserved in SDF


@dataclass(frozen=True, slots=True)
class SdfAxis:
    """Axis of a joint.

    ``xyz`` is a unit vector in the joint's frame. ``lower`` and ``upper`` bound the position [rad] or [m],
    ``velocity`` the magnitude of the velocity [rad/s] or [m/s]; None for no limit. ``dynamics`` are those of
    effort [N m] or [N], damping, friction, spring_reference and spring_stiffness that are given. ``suffix``
    is the part of the coordinate's name after that of the joint. ``mimic`` is the relation to the coordinate
    that the axis follows, at the end of the chain.

    See Also
    --------
    kineverse.formats.sdf.parse_sdf
    """

    xyz: Vector3 = (0.0, 0.0, 1.0)
    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None
    dynamics: tuple[tuple[str, float], ...] = ()
    suffix: str = ""
    mimic: MimicRelation[str] | None = None


@dataclass(frozen=True, slots=True)
class SdfJoint:
    """Joint between two links, or between the world and a link.

    ``pose_in_parent`` and ``pose_in_child`` are the poses of the joint's frame in both links while all
    positions are zero. ``pitch`` [m per revolution] is that of a screw. ``gear`` is the relation of a gearbox
    to the coordinate that drives it. ``frame`` is the name of the joint's frame, where that of the child is
    another one. ``home`` are default values of its coordinates, and ``zero`` their values at the poses of the
    file; empty for 0. ``loop`` is the loop that it closes, if the file states one. ``is_reversed`` is True if
    parent and child were exchanged to form a tree; the axes are then negated and in reverse order.

    See Also
    --------
    kineverse.formats.sdf.parse_sdf
    """

    name: str
    kind: SdfJointType
    parent: str
    child: str
    pose_in_parent: Pose = IDENTITY
    pose_in_child: Pose = IDENTITY
    axes: tuple[SdfAxis, ...] = ()
    pitch: float = 0.0
    gear: MimicRelation[str] | None = None
    frame: str = ""
    home: tuple[float, ...] = ()
    zero: tuple[float, ...] = ()
    loop: SdfLoop | None = None
    is_reversed: bool = False
    line: int = 0
    source: str = ""


@dataclass(frozen=True, slots=True)
class SdfLink:
    """Link, with its pose in the world while all positions are zero.

    ``free`` is the name of its free motion, if the file states one, and ``home`` are the coordinates of that
    motion at the pose; empty for no motion.

    See Also
    --------
    kineverse.formats.sdf.parse_sdf
    """

    name: str
    body: Body = NO_BODY
    pose: Pose = IDENTITY
    static: bool = False
    free: str = ""
    home: tuple[float, ...] = ()
    line: int = 0
    source: str = ""


@dataclass(frozen=True, slots=True)
class SdfFrame:
    """Frame of a ``<frame>`` or of a model, fixed to a link or to the world.

    See Also
    --------
    kineverse.formats.sdf.parse_sdf
    """

    name: str
    parent: str
    pose: Pose = IDENTITY
    line: int = 0
    source: str = ""


@dataclass(frozen=True, slots=True)
class SdfRoot:
    """Link without parent joint; it is fixed to the world, or moves freely if ``free``.

    See Also
    --------
    kineverse.formats.sdf.parse_sdf
    """

    link: str
    free: bool = False


@dataclass(frozen=True, slots=True)
class SdfScene:
    """All models of a file.

    ``joints`` are ordered from the ``roots`` outwards, each after the joint of its parent link. ``loops`` are
    the joints that close loops. ``remarks`` are warnings about ignored or ambiguous elements, each with its
    line.

    See Also
    --------
    kineverse.formats.sdf.parse_sdf
    """

    links: tuple[SdfLink, ...] = ()
    frames: tuple[SdfFrame, ...] = ()
    roots: tuple[SdfRoot, ...] = ()
    joints: tuple[SdfJoint, ...] = ()
    loops: tuple[SdfJoint, ...] = ()
    source: str = ""
    remarks: tuple[str, ...] = field(default=())
