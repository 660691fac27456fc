"""Spanning tree of the joints of an SDF, and joints that close loops.

All functions are iterative and run in linear time, up to the inverse Ackermann function.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

from kineverse.formats.tree import DisjointSets
from kineverse.formats.xml_reader import quote

from .description import WORLD, SdfAxis, SdfJoint, SdfLink, SdfRoot


def build_spanning_tree(
    links: Sequence[SdfLink],
    joints: Iterable[SdfJoint],
    static: Iterable[str],
    remark: Callable[[SdfJoint, str], None],
) -> tuple[tuple[SdfRoot, ...], tuple[SdfJoint, ...], tuple[SdfJoint, ...]]:
    """Return the roots, the joints from the roots outwards, and the joints that close loops."""
    connected, rigid = DisjointSets(), DisjointSets()
    for link in links:
        if link.static:
            connected.union(WORLD, link.name)
            rigid.union(WORLD, link.name)
    joints = list(joints)
    for joint in joints:
        if joint.kind == "fixed":
            rigid.union(joint.parent, joint.child)
    joints_at: dict[str, list[SdfJoint]] = {}
    children: set[str] = {link.name for link in links if link.static}
    loops: list[SdfJoint] = []
    for joint in joints:
        if connected.union(joint.parent, joint.child):
            joints_at.setdefault(joint.parent, []).append(joint)
            joints_at.setdefault(joint.child, []).append(joint)
            children.add(joint.child)
        elif rigid.find(joint.parent) != rigid.find(joint.child):
            loops.append(joint)
        else:
            remark(joint, "is left out: its links are rigidly connected anyway.")
    roots = [SdfRoot(link.name) for link in links if link.static]
    starts = [WORLD, *(root.link for root in roots)]
    ordered = _outwards(starts, joints_at, remark)
    reached = {connected.find(WORLD)}
    fixed = {connected.find(name) for name in static}
    for link in links:
        group = connected.find(link.name)
        if group not in reached and link.name not in children:
            reached.add(group)
            roots.append(SdfRoot(link.name, free=group not in fixed))
            ordered += _outwards([link.name], joints_at, remark)
    return tuple(roots), tuple(ordered), tuple(loops)


def _outwards(
    starts: Sequence[str], joints_at: dict[str, list[SdfJoint]], remark: Callable[[SdfJoint, str], None]
) -> list[SdfJoint]:
    """Return the joints from some links outwards, depth first, each reversed if it leads inwards."""
    ordered: list[SdfJoint] = []
    visited: set[str] = set(starts)
    stack = [(start, joint) for start in reversed(starts) for joint in reversed(joints_at.get(start, ()))]
    while stack:
        near, joint = stack.pop()
        far = joint.child if joint.parent == near else joint.parent
        if far in visited:
            continue
        visited.add(far)
        if joint.parent != near:
            remark(
                joint, f"leads from {quote(near)} to {quote(far)} here, since that is the way from the root."
            )
            joint = reverse_joint(joint)
        ordered.append(joint)
        stack.extend((far, other) for other in reversed(joints_at.get(far, ())))
    return ordered


def reverse_joint(joint: SdfJoint) -> SdfJoint:
    """Return a joint with parent and child exchanged: the same coordinates about opposite axes."""
    return replace(
        joint,
        parent=joint.child,
        child=joint.parent,
        pose_in_parent=joint.pose_in_child,
        pose_in_child=joint.pose_in_parent,
        axes=tuple(_negate_axis(axis) for axis in reversed(joint.axes)),
        is_reversed=not joint.is_reversed,
    )


def _negate_axis(axis: SdfAxis) -> SdfAxis:
    """Return an axis of the opposite direction."""
    x, y, z = axis.xyz
    return replace(axis, xyz=(0.0 - x, 0.0 - y, 0.0 - z))
