"""Checked MJCF description: links, sites, couplings, closures and tendons.

Units are [m], [rad], [kg], [s]. Everything has a name, and names of frames are unique. ``where`` is the place
in the file, for messages. A description is plain immutable data.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from kineverse.formats.poses import IDENTITY
from kineverse.model.body import Body, Pose, Vector3

MjcfJointType: TypeAlias = Literal["hinge", "slide", "ball", "free"]
MjcfDynamics: TypeAlias = tuple[tuple[str, float], ...]
Quartic: TypeAlias = tuple[float, float, float, float, float]

_NOTHING = Body()

WORLD = "world"
"""What the body at the root is called."""

COORDINATE_SUFFIXES: dict[MjcfJointType, tuple[str, ...]] = {
    "hinge": (),
    "slide": (),
    "ball": ("qx", "qy", "qz", "qw"),
    "free": ("x", "y", "z", "qx", "qy", "qz", "qw"),
}
"""What the names of coordinates have behind the name of a joint, in the order of its home."""


@dataclass(frozen=True, slots=True)
class MjcfJoint:
    """A joint of a body; several of them move a body one after the other.

    ``anchor`` is the point about which it turns and ``axis`` a unit vector, both in the frame of the body.
    While its coordinate is ``reference`` [rad] or [m], it has moved nothing. ``lower`` and ``upper`` bound
    the coordinate, or ``upper`` the angle of a ball [rad]; None is no bound. ``speed`` is the range of its
    speed, if that is known. ``frame`` is what the frame that
    it moves is called if that is not the body's. ``home`` are the values of its coordinates at home.
    ``dynamics`` are effort [N] or [N m], damping, friction, spring_stiffness, spring_reference and armature,
    as far as they are not zero.
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
    """A body: where it is in its parent while its joints are at rest, and what moves it."""

    name: str
    parent: str
    pose: Pose = IDENTITY
    joints: tuple[MjcfJoint, ...] = ()
    body: Body = _NOTHING
    where: str = ""


@dataclass(frozen=True, slots=True)
class MjcfSite:
    """A frame that moves with a body."""

    name: str
    parent: str
    pose: Pose = IDENTITY
    where: str = ""


@dataclass(frozen=True, slots=True)
class MjcfCoupling:
    """One joint or tendon as a polynomial of another: y - y0 = Σ aₖ (x - x0)ᵏ, with y = a0 where none leads.

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
    """Two points (``connect``) or two poses (``weld``) that coincide, each in the frame of a link or site.

    ``more`` are others of the same loop. ``free`` and ``dependent`` are the joints in it, those
    that follow last, if the file says so.
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
    """A length [m]: a sum of joint positions, each with its factor; or that of a line through sites.

    ``terms`` are joints and factors, ``paths`` divisors of pulleys and the sites of the branch behind.
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
    """All of a file.

    ``links`` begin with the world, and each comes after its parent. ``remarks`` say what was left out or read
    in a way its author may not have meant; each names its line. ``has_home`` says that a key of the file has
    where joints are at home.
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
