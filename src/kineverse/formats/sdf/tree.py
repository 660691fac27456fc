"""Spanning tree of the joints of an SDF, and those that close loops.

Everything here is iterative and linear but for the inverse of Ackermann's function.
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
    standing: Iterable[str],
    note: Callable[[SdfJoint, str], None],
) -> tuple[tuple[SdfRoot, ...], tuple[SdfJoint, ...], tuple[SdfJoint, ...]]:
    """Return the roots, the joints from there outwards, and those that close loops.

    Parameters
    ----------
    links, joints
        In the order of the file.
    standing
        Links that stand where they are with all that is connected to them, unless the world holds that.
    note
        Called with joints that are left out, and why.
    """
    whole, rigid = DisjointSets(), DisjointSets()
    for link in links:
        if link.static:
            whole.union(WORLD, link.name)
            rigid.union(WORLD, link.name)
    joints = list(joints)
    for joint in joints:
        if joint.kind == "fixed":
            rigid.union(joint.parent, joint.child)
    at: dict[str, list[SdfJoint]] = {}
    held: set[str] = {link.name for link in links if link.static}
    loops: list[SdfJoint] = []
    for joint in joints:
        if whole.union(joint.parent, joint.child):
            at.setdefault(joint.parent, []).append(joint)
            at.setdefault(joint.child, []).append(joint)
            held.add(joint.child)
        elif rigid.find(joint.parent) != rigid.find(joint.child):
            loops.append(joint)
        else:
            note(joint, "is left out: its links are rigidly connected anyway.")
    roots = [SdfRoot(link.name) for link in links if link.static]
    starts = [WORLD, *(root.link for root in roots)]
    ordered = _outwards(starts, at, note)
    reached = {whole.find(WORLD)}
    fixed = {whole.find(name) for name in standing}
    for link in links:
        group = whole.find(link.name)
        if group not in reached and link.name not in held:
            reached.add(group)
            roots.append(SdfRoot(link.name, free=group not in fixed))
            ordered += _outwards([link.name], at, note)
    return tuple(roots), tuple(ordered), tuple(loops)


def _outwards(
    starts: Sequence[str], at: dict[str, list[SdfJoint]], note: Callable[[SdfJoint, str], None]
) -> list[SdfJoint]:
    ordered: list[SdfJoint] = []
    seen: set[str] = set(starts)
    ahead = [(start, joint) for start in reversed(starts) for joint in reversed(at.get(start, ()))]
    while ahead:
        near, joint = ahead.pop()
        far = joint.child if joint.parent == near else joint.parent
        if far in seen:
            continue
        seen.add(far)
        if joint.parent != near:
            note(
                joint, f"leads from {quote(near)} to {quote(far)} here, since that is the way from the root."
            )
            joint = reverse_joint(joint)
        ordered.append(joint)
        ahead.extend((far, other) for other in reversed(at.get(far, ())))
    return ordered


def reverse_joint(joint: SdfJoint) -> SdfJoint:
    """Return a joint seen from the other end: the same coordinates about opposite axes."""
    return replace(
        joint,
        parent=joint.child,
        child=joint.parent,
        in_parent=joint.in_child,
        in_child=joint.in_parent,
        axes=tuple(_opposite(axis) for axis in reversed(joint.axes)),
        turned=not joint.turned,
    )


def _opposite(axis: SdfAxis) -> SdfAxis:
    x, y, z = axis.xyz
    return replace(axis, xyz=(0.0 - x, 0.0 - y, 0.0 - z))
