"""Kinematic tree of a URDF: one parent each, joints from the root outwards.

All functions are iterative and run in linear time, also for a chain of 10^5 links.
"""

from __future__ import annotations

from collections.abc import Sequence

from kineverse.errors import FormatError, list_some, suggest
from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.xml_reader import quote
from kineverse.model.frame import WORLD

from .description import UrdfJoint, UrdfLink

_SHOWN = 8


def keep_one_parent(joints: Sequence[UrdfJoint], remarks: ReaderWarnings) -> list[UrdfJoint]:
    """Return the joints with one parent joint for each link: the last by name, as in urdfdom."""
    joint_above: dict[str, UrdfJoint] = {}
    for joint in joints:
        other = joint_above.setdefault(joint.child, joint)
        if other is joint:
            continue
        text = (
            f"its child link {quote(joint.child)} has a parent already, by the joint {quote(other.name)} on "
            f"line {other.line}. URDF describes trees only: a link has one parent."
        )
        if remarks.strict:
            raise FormatError(f"{_location(remarks.source, joint)}: {text}")
        kept, dropped = (joint, other) if joint.name.encode() > other.name.encode() else (other, joint)
        joint_above[joint.child] = kept
        remarks.fault(
            joint.line,
            f"<joint name={quote(joint.name)}>: {text.rstrip('.')}; {quote(dropped.name)} is left out.",
        )
    return [joint for joint in joints if joint_above[joint.child] is joint]


def order_from_root(
    links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], remarks: ReaderWarnings, hint: str = ""
) -> tuple[tuple[str, ...], tuple[UrdfJoint, ...], list[UrdfLink]]:
    """Return the roots, the joints from the roots outwards, and the links that they reach.

    Siblings are in the order of the file.
    """
    source = remarks.source
    links = _with_world(links, joints, remarks)
    lines = {link.name: link.line for link in links}
    joints_below: dict[str, list[UrdfJoint]] = {}
    joint_above: dict[str, UrdfJoint] = {}
    for joint in joints:
        for role, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in lines:
                raise FormatError(
                    f"{_location(source, joint)}: its {role} link {quote(name)} does not exist; every link "
                    f"needs a <link> element of its own. {suggest(name, lines, 'link')}"
                )
        joint_above[joint.child] = joint
        joints_below.setdefault(joint.parent, []).append(joint)

    roots = [link for link in links if link.name not in joint_above]
    if len(roots) > 1:
        shown = list_some((f"{quote(link.name)} (line {link.line})" for link in roots), _SHOWN)
        text = (
            f"<link name={quote(roots[1].name)}>: there are {len(roots)} links without a parent, "
            f"where one root is expected: {shown}. Connect them by joints.{hint}"
        )
        if remarks.strict:
            raise FormatError(f"{source}, line {roots[1].line}, {text}")
        remarks.fault(roots[1].line, f"{text.rstrip('.')}; all of them stand where the first does.")
    ordered = [joint for root in roots for joint in _outwards(root.name, joints_below)]
    reached = {root.name for root in roots} | {joint.child for joint in ordered}
    if len(ordered) != len(joints):
        loop = _loop(next(joint for joint in joints if joint.child not in reached), joint_above)
        shown = " -> ".join(f"{quote(joint.name)}" for joint in loop[:_SHOWN])
        more = f" and {len(loop) - _SHOWN} more" if len(loop) > _SHOWN else ""
        cycle = f"the joints {shown}{more} lead in a circle"
        if len(loop) == 1:
            cycle = "its child link is its own parent"
        text = f"{cycle}. URDF describes trees only: remove a joint.{hint}"
        if remarks.strict or not roots:
            raise FormatError(f"{_location(source, loop[0])}: {text}")
        where = _location(source, loop[0]).removeprefix(f"{source}, line {loop[0].line}, ")
        left = len(links) - len(reached)
        remarks.fault(
            loop[0].line, f"{where}: {text.rstrip('.')}; {left} links that no root holds are left out."
        )
    return tuple(root.name for root in roots), tuple(ordered), [k for k in links if k.name in reached]


def _with_world(
    links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], remarks: ReaderWarnings
) -> Sequence[UrdfLink]:
    """Return the links, with the world if it is a parent without a link of its own, as in Drake."""
    joint = next((joint for joint in joints if joint.parent == WORLD), None)
    if joint is None or remarks.strict or any(link.name == WORLD for link in links):
        return links
    remarks.fault(
        joint.line,
        f"<joint name={quote(joint.name)}>: its parent link {quote(WORLD)} has no <link> element of its own; "
        "it is the world.",
    )
    return [UrdfLink(WORLD, line=joint.line), *links]


def _outwards(root: str, joints_below: dict[str, list[UrdfJoint]]) -> list[UrdfJoint]:
    ordered: list[UrdfJoint] = []
    stack = joints_below.get(root, [])[::-1]
    while stack:
        joint = stack.pop()
        ordered.append(joint)
        stack.extend(reversed(joints_below.get(joint.child, ())))
    return ordered


def _loop(start: UrdfJoint, joint_above: dict[str, UrdfJoint]) -> list[UrdfJoint]:
    """Return the joints of the cycle that ``start`` is in or below, beginning with the first in the file."""
    joint, visited = start, {start.name}
    while True:
        joint = joint_above[joint.parent]
        if joint.name in visited:
            break
        visited.add(joint.name)
    loop = [joint]
    while (above := joint_above[loop[-1].parent]) is not joint:
        loop.append(above)
    loop.reverse()
    first = min(range(len(loop)), key=lambda index: loop[index].line)
    return loop[first:] + loop[:first]


def _location(source: str, joint: UrdfJoint) -> str:
    return f"{source}, line {joint.line}, <joint name={quote(joint.name)}>"
