"""Checked MJCF description: links, sites, couplings, closures and tendons.

Units are [m], [rad], [kg], [s]. All elements have names, and names of frames are unique. ``where`` is the
place of an element in the file, for messages. A description is plain immutable data.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from kineverse.formats.poses import IDENTITY
from kineverse.model.body import NO_BODY, Body, Pose, Vector3

MjcfJointType: TypeAlias = Literal["hinge", "slide", "ball", "free"]
MjcfDynamics: TypeAlias = tuple[tuple[str, float], ...]
Quartic: TypeAlias = tuple[float, float, float, float, float]

WORLD = "world"  # name of the root body

COORDINATE_SUFFIXES: dict[MjcfJointType, tuple[str, ...]] = {
    "hinge": (),
    "slide": (),
    "ball": ("qx", "qy", "qz", "qw"),
    "free": ("x", "y", "z", "qx", "qy", "qz", "qw"),
}
"""Last parts of the names of coordinates, after the name of a joint, in the order of its home position."""


@dataclass(frozen=True, slots=True)
class MjcfJoint:
    """Joint of a body; several joints move a body one after the other.

    ``anchor`` is the centre of rotation [m] and ``axis`` a unit vector, both in the frame of the body. At the
    coordinate ``reference`` [rad] or [m], the body is at its pose in the file. ``lower`` and ``upper`` bound
    the coordinate, ``upper`` the angle of a ball [rad]; None for no limit. ``speed`` is the range of its
    velocity, None if unknown. ``frame`` is the name of the frame that it moves, if that is not the body.
    ``home`` is the home position of its coordinates. ``dynamics`` are those of effort [N] or [N m], damping,
    friction, spring_stiffness, spring_reference and armature that are not zero.

    See Also
    --------
    kineverse.formats.mjcf.parse_mjcf
    """

    name: str
    kind: MjcfJointType
    frame: str
    axis: Vector3 = (0.0, 0.0, 1.0)
    anchor: Vector3 = (0.0, 0.0, 0.0)
    reference: float = 0.0
    lower: float | None = None
    upper: float | None = None
    speed: tuple[float, float] | None = None
    home: tuple[float, ...] = ()
    dynamics: MjcfDynamics = ()
    where: str = ""


@dataclass(frozen=True, slots=True)
class MjcfLink:
    """Body: its pose in its parent while its joints are at their references, and the joints that move it.

    See Also
    --------
    kineverse.formats.mjcf.parse_mjcf
    """

    name: str
    parent: str
    pose: Pose = IDENTITY
    joints: tuple[MjcfJoint, ...] = ()
    body: Body = NO_BODY
    where: str = ""


@dataclass(frozen=True, slots=True)
class MjcfSite:
    """Frame fixed to a body.

    See Also
    --------
    kineverse.formats.mjcf.parse_mjcf
    """

    name: str
    parent: str
    pose: Pose = IDENTITY
    where: str = ""


@dataclass(frozen=True, slots=True)
class MjcfCoupling:
    """Equality between two joints or two tendons: y - y0 = Σ aₖ (x - x0)ᵏ, or y - y0 = a0 without leader.

    ``rest`` is y0 and ``leader_rest`` x0.
    """

    name: str
    follower: str
    leader: str | None
    coefficients: Quartic
    rest: float = 0.0
    leader_rest: float = 0.0
    where: str = ""


@dataclass(frozen=True, slots=True)
class MjcfClosure:
    """Loop closure: two points (``connect``) or two poses (``weld``) that coincide.

    ``in_first`` and ``in_second`` are their poses in the frames ``first`` and ``second``, links or sites.
    ``more`` are further closures of the same loop. ``free`` and ``dependent`` are the independent and the
    dependent joints of the loop, if the file states them.
    """

    name: str
    kind: Literal["connect", "weld"]
    first: str
    second: str
    in_first: Pose = IDENTITY
    in_second: Pose = IDENTITY
    where: str = ""
    more: tuple[MjcfClosure, ...] = ()
    free: tuple[str, ...] = ()
    dependent: tuple[str, ...] | None = None


@dataclass(frozen=True, slots=True)
class MjcfTendon:
    """Tendon whose length [m] is a linear combination of joint positions, or that of a path through sites.

    ``terms`` are pairs of joint and factor, ``paths`` pairs of a pulley's divisor and the sites of its
    branch.
    """

    name: str
    terms: tuple[tuple[str, float], ...] = ()
    paths: tuple[tuple[float, tuple[str, ...]], ...] = ()
    lower: float | None = None
    upper: float | None = None
    dynamics: MjcfDynamics = ()
    where: str = ""


@dataclass(frozen=True, slots=True)
class MjcfScene:
    """Description of a file.

    ``links`` begin with the world, each after its parent. ``remarks`` are warnings about ignored or ambiguous
    elements, each with its line. ``has_home`` is True if the file has a home position.

    See Also
    --------
    kineverse.formats.mjcf.parse_mjcf
    """

    links: tuple[MjcfLink, ...] = ()
    sites: tuple[MjcfSite, ...] = ()
    couplings: tuple[MjcfCoupling, ...] = ()
    closures: tuple[MjcfClosure, ...] = ()
    tendons: tuple[MjcfTendon, ...] = ()
    tendon_couplings: tuple[MjcfCoupling, ...] = ()
    source: str = ""
    remarks: tuple[str, ...] = ()
    has_home: bool = False
