"""Semantic description of a robot, with the names of a model.

Units are [m] and [rad]. All names of links and joints include the prefix of the robot in the model; names of
groups, states and end effectors are those of the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

from msgspec import Struct, field

CollisionRule: TypeAlias = "tuple[str, str, bool, str]"
"""Rule of the collision filter as data: two bodies, whether the pair is checked, and the reason."""


class SrdfGroup(Struct, frozen=True):
    """Planning group: joints and links that belong together, such as an arm.

    Attributes
    ----------
    joints
        Articulations of the group that move, in the order of the file: joints, joints above links, chains
        from base to tip, subgroups. Mimic joints and passive joints are among them, fixed joints are not.
    coordinates
        Names of the free coordinates of these joints: what a planner moves. Passive joints have none here,
        and mimic joints have none of their own.
    links
        Frames of the group: listed links, both ends of chains and all between, children of the joints.
    states
        Named states of the group: values [m], [rad] by the name of the coordinate.

    See Also
    --------
    kineverse.formats.srdf.parse_srdf
    """

    name: str
    joints: tuple[str, ...] = ()
    coordinates: tuple[str, ...] = ()
    links: tuple[str, ...] = ()
    states: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


class EndEffector(Struct, frozen=True):
    """End effector: a group that is attached to a link.

    Attributes
    ----------
    group
        Name of the group of the end effector itself.
    parent_link
        Frame that carries it.
    parent_group
        Name of the group that moves it; empty if the file names none.

    See Also
    --------
    kineverse.formats.srdf.parse_srdf
    """

    name: str
    group: str
    parent_link: str
    parent_group: str = ""


class VirtualJoint(Struct, frozen=True):
    """Joint between the robot and the frame in which it stands, which the URDF does not have.

    The model decides how a robot stands or drives, with its bases; this is what the file says.

    Attributes
    ----------
    kind
        ``fixed``, ``planar`` or ``floating``.
    parent_frame
        Frame in which the robot stands, as in the file: it belongs to no robot and has no prefix.
    child_link
        Frame of the robot.

    See Also
    --------
    kineverse.formats.srdf.parse_srdf
    """

    name: str
    kind: str
    parent_frame: str
    child_link: str


class Srdf(Struct, frozen=True):
    """Semantic description of a robot: collision rules, groups, end effectors and named states.

    Attributes
    ----------
    rules
        Rules of the collision filter, ``(a, b, check, why)`` as :class:`kineverse.geometry.Rule`: for
        ``kv.geometry.Scene(model, rules=srdf.rules)``, or as data of the model.
    groups
        Planning groups by name.
    states
        Named states by name: the values of all groups that have a state of that name, by coordinate. Where
        groups differ, the first one counts here, and ``groups[...].states`` has each of them.
    passive_joints
        Articulations that no motor moves.
    warnings
        Faults of the file, each with its line.

    See Also
    --------
    kineverse.formats.srdf.parse_srdf
    """

    name: str
    rules: tuple[CollisionRule, ...] = ()
    groups: Mapping[str, SrdfGroup] = field(default_factory=dict)
    end_effectors: Mapping[str, EndEffector] = field(default_factory=dict)
    states: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    virtual_joints: Mapping[str, VirtualJoint] = field(default_factory=dict)
    passive_joints: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
