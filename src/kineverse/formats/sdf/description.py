"""Checked SDF description: links, frames, roots, joints and loops.

Units are [m], [rad], [kg], [s]. Names are paths: ``a::b`` of the file is ``a/b`` here. A description is plain
immutable data: nothing in it refers to the file any more but line numbers, and no mesh has been opened.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from kineverse.formats.mimic import MimicRelation
from kineverse.model.body import Body, Pose, Vector3

SdfJointType: TypeAlias = Literal[
    "fixed",
    "revolute",
    "continuous",
    "prismatic",
    "screw",
    "universal",
    "revolute2",
    "ball",
    "gearbox",
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
"""How many axes a joint of each kind moves along or about."""

WORLD = "world"
"""What stands for the world where the name of a link is expected: no link may be called so."""

_IDENTITY = Pose()
_NOTHING = Body()


@dataclass(frozen=True, slots=True)
class SdfAxis:
    """One axis of a joint.

    ``xyz`` is a unit vector in the joint's frame. ``lower`` and ``upper`` bound the position [rad] or [m],
    ``velocity`` the magnitude of the speed [rad/s] or [m/s]; None is no bound. ``dynamics`` are effort [N m]
    or [N], damping, friction, spring_reference and spring_stiffness, as far as they are given. ``suffix`` is
    what the name of its coordinate has behind that of the joint. ``following`` names the coordinate that it
    follows, at the end of a chain.
    """

    xyz: Vector3 = (0.0, 0.0, 1.0)
    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None
    dynamics: tuple[tuple[str, float], ...] = ()
    suffix: str = ""
    following: MimicRelation[str] | None = None


@dataclass(frozen=True, slots=True)
class SdfJoint:
    """A joint between two links, or between a link and the world.

    ``in_parent`` and ``in_child`` are where its frame is in both while all positions are zero.
    ``pitch`` [m per revolution] is that of a screw. ``turned`` says that child and parent were exchanged to
    make a tree, with what follows from that: axes are negated and in reverse order. ``pose`` is where its
    frame is in the world, ``gear`` what drives a gearbox and with which ratio.
    """

    name: str
    kind: SdfJointType
    parent: str
    child: str
    in_parent: Pose = _IDENTITY
    in_child: Pose = _IDENTITY
    axes: tuple[SdfAxis, ...] = ()
    pitch: float = 0.0
    gear: MimicRelation[str] | None = None
    turned: bool = False
    line: int = 0
    source: str = ""


@dataclass(frozen=True, slots=True)
class SdfLink:
    """A link, and where it is in the world while all positions are zero."""

    name: str
    body: Body = _NOTHING
    pose: Pose = _IDENTITY
    static: bool = False
    line: int = 0
    source: str = ""


@dataclass(frozen=True, slots=True)
class SdfFrame:
    """A frame that moves with a link or stands in the world: one of a ``<frame>`` or of a model."""

    name: str
    parent: str
    pose: Pose = _IDENTITY
    line: int = 0
    source: str = ""


@dataclass(frozen=True, slots=True)
class SdfRoot:
    """A link that no joint holds: it stands where it is, or moves freely."""

    link: str
    free: bool = False


@dataclass(frozen=True, slots=True)
class SdfScene:
    """The models of a file.

    ``joints`` lead from the ``roots`` outwards, so that a joint comes after what places its parent. ``loops``
    are the joints between links that others place already. ``remarks`` say what was left out or read in a way
    its author may not have meant; each names its line.
    """

    links: tuple[SdfLink, ...] = ()
    frames: tuple[SdfFrame, ...] = ()
    roots: tuple[SdfRoot, ...] = ()
    joints: tuple[SdfJoint, ...] = ()
    loops: tuple[SdfJoint, ...] = ()
    source: str = ""
    remarks: tuple[str, ...] = field(default=())
