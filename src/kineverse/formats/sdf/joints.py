"""SDF joints: axes, gearboxes, and the spanning tree of the joints.

Only the elements that apply to the type of a joint are read: the axis of a fixed joint is ignored.

A gearbox is θ2 = -ratio θ1, with the angle θ1 from the reference body to the parent about ``<axis>`` and the
angle θ2 from the reference body to the child about ``<axis2>``. The hinge of the parent is another joint of
the file. If there is no hinge of the child, the gearbox becomes that hinge.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

from kineverse.errors import suggest
from kineverse.formats.description import DisjointSets
from kineverse.formats.mimic import MimicRelation, is_valid_factor
from kineverse.formats.poses import compose_poses, invert_pose, rotate_direction
from kineverse.formats.reader_warnings import CrossedLimits
from kineverse.formats.xml_reader import Element, ElementError, find_child, quote
from kineverse.formats.xml_values import (
    read_axis_direction,
    read_child_bool,
    read_child_limit,
    read_child_number,
    read_child_text,
    read_or_default,
    read_text,
)
from kineverse.model.body import Vector3

from .custom_attributes import HOME, ZERO, joint_motion, read_loop, read_values
from .description import AXIS_COUNT, WORLD, SdfAxis, SdfJoint, SdfJointType, SdfLink, SdfRoot
from .pose_graph import PoseNode, find_early, find_joint_end, pose_between

_SUFFIXES = {1: ("",), 2: ("/first", "/second")}
_DYNAMICS = ("damping", "friction", "spring_reference", "spring_stiffness")


@dataclass(frozen=True, slots=True)
class ResolvedJoint:
    """Joint of the description, with the nodes of the pose graph that it connects."""

    joint: SdfJoint
    node: PoseNode
    parent: PoseNode
    child: PoseNode


def read_sdf_joint(node: PoseNode, attachments: dict[PoseNode, PoseNode]) -> ResolvedJoint:
    """Return the joint of a node; mimic chains are not resolved yet."""
    element, document = node.element, node.document
    parent, child = attachments[find_joint_end(node, "parent")], attachments[node]
    if child.kind == "world":
        document.refuse(element, "its child moves with the world. Exchange parent and child.")
    if parent is child:
        document.refuse(
            element, f"its parent and its child are both {quote(child.path)}: it connects a link to itself."
        )
    with document.locate_errors(element):
        kind = _kind(element)
        axes = tuple(
            _axis(node, tag, suffix, kind)
            for tag, suffix in zip(("axis", "axis2"), _SUFFIXES.get(AXIS_COUNT[kind], ()), strict=False)
        )
        pitch = _pitch(element) if kind == "screw" else 0.0
        if kind == "ball" and find_child(element, "axis") is not None:
            axes = (_axis(node, "axis", "", kind),)
        zero = _zero(node, kind)
        home: tuple[float, ...] = ()
        if kind in COORDINATE_COUNT:
            home = read_values(element, HOME, COORDINATE_COUNT[kind], document.remarks)
        loop = read_loop(element, document.remarks, node.scope.path_of_model_name)
    parent_T_joint = pose_between(parent, node)
    if zero:
        xyz, turns = (axes[0].xyz if axes else (0.0, 0.0, 1.0)), kind != "prismatic"
        motion = joint_motion(xyz, turns, zero, pitch)
        parent_T_joint = compose_poses(parent_T_joint, invert_pose(motion))
    joint = SdfJoint(
        node.path,
        kind,
        parent.path or "world",
        child.path,
        parent_T_joint,
        pose_between(child, node),
        axes,
        pitch,
        frame=node.scope.path_of(element[1]["name"]) if node.is_renamed else node.path,
        home=home,
        zero=zero,
        loop=loop,
        line=element[3],
        source=document.source,
    )
    return ResolvedJoint(joint, node, parent, child)


COORDINATE_COUNT: Mapping[SdfJointType, int] = {
    **dict.fromkeys(("revolute", "continuous", "prismatic", "screw"), 1),
    "universal": 2,
    "ball": 4,
}
"""Number of coordinates of a joint of each type that has a home."""


def _zero(node: PoseNode, kind: SdfJointType) -> tuple[float, ...]:
    """Return the values of a joint's coordinates at the poses of the file; empty for 0."""
    if COORDINATE_COUNT.get(kind) not in (1, 4):
        return ()
    values = read_values(node.element, ZERO, COORDINATE_COUNT[kind], node.document.remarks)
    return values if any(values) else ()


def _first_zero(node: PoseNode, kind: SdfJointType) -> float:
    """Return the value of the coordinate of a joint with one axis at the poses of the file."""
    values = _zero(node, kind)
    return values[0] if len(values) == 1 else 0.0


def _kind(element: Element) -> SdfJointType:
    name = element[1].get("type")
    if not name:
        raise ElementError(
            element, f"has no type; the specification requires one of {', '.join(AXIS_COUNT)}."
        )
    for kind in AXIS_COUNT:
        if kind == name.lower():
            return kind
    raise ElementError(
        element, f"type={quote(name)} is no joint type of SDF. {suggest(name, AXIS_COUNT, 'type')}"
    )


def _axis(node: PoseNode, tag: str, suffix: str, kind: SdfJointType) -> SdfAxis:
    element, remarks = node.element, node.document.remarks
    axis = find_child(element, tag)
    if axis is None:
        if kind in ("universal", "revolute2"):
            mistake = ElementError(
                element, f"is {kind} but has no <{tag}>; by default both axes are z, which is no such joint."
            )
            remarks.repair(mistake, "it is z")
            return SdfAxis(suffix=suffix)
        remarks.add(element, f"has no <{tag}>; it is z, the specification's default.")
        return SdfAxis(suffix=suffix)
    limit, dynamics = find_child(axis, "limit"), find_child(axis, "dynamics")
    read = partial(read_or_default, remarks=remarks, owner=element)
    lower = upper = velocity = effort = None
    if limit is not None:
        lower, upper = read_child_limit(limit, "lower"), read_child_limit(limit, "upper")
        velocity, effort = (
            read(partial(read_child_limit, limit, key), None, "it bounds nothing")
            for key in ("velocity", "effort")
        )
    if kind == "continuous":
        lower = upper = None
    if lower is not None and upper is not None and lower > upper:
        assert limit is not None
        mistake = ElementError(
            limit, f"has lower {lower!r} above upper {upper!r}: no position would be valid."
        )
        crossed = partial(CrossedLimits.of, f"{node.path}{suffix}")
        remarks.repair(mistake, "the joint is not limited", element, crossed)
        lower = upper = None
    zero = _first_zero(node, kind)
    lower, upper = (None if bound is None else bound + zero for bound in (lower, upper))
    values = [] if effort is None or effort < 0.0 else [("effort", effort)]
    if dynamics is not None:
        reads = ((key, partial(read_child_number, dynamics, key, 0.0)) for key in _DYNAMICS)
        found = [(key, read(number, 0.0, "0 is taken")) for key, number in reads]
        has_spring = any(value for key, value in found if key == "spring_stiffness")
        values += [(k, v) for k, v in found if v or (has_spring and k == "spring_reference")]
    if find_child(axis, "initial_position") is not None and read_child_number(axis, "initial_position"):
        remarks.add(axis, "has an initial_position, which is ignored: a description has no state.", element)
    return SdfAxis(
        _direction(node, axis),
        lower,
        upper,
        velocity if velocity is not None and velocity > 0.0 else None,
        tuple(values),
        suffix,
        None if kind == "ball" else _mimic(node, axis),
    )


def _direction(node: PoseNode, axis: Element) -> Vector3:
    xyz, document = read_axis_direction(axis), node.document
    part = find_child(axis, "xyz")
    reference = None
    if part is not None:
        name = document.early_attribute(part, "expressed_in")
        reference = find_early(name, part, node.scope, node.element)
    if document.version < (1, 7):
        # In files without one, libsdformat adds the frame of the model up to 1.4; it replaces expressed_in.
        if read_child_bool(axis, "use_parent_model_frame", default=document.version < (1, 5)):
            reference = node.scope.model if node.scope.model.kind != "world" else None
    elif find_child(axis, "use_parent_model_frame") is not None:
        document.remarks.add(
            axis,
            "has use_parent_model_frame, which is expressed_in since SDF 1.7; it is ignored.",
            node.element,
        )
    return xyz if reference is None else rotate_direction(pose_between(node, reference), xyz)


def _mimic(node: PoseNode, axis: Element) -> MimicRelation[str] | None:
    mimic = find_child(axis, "mimic")
    if mimic is None:
        return None
    name, which = mimic[1].get("joint", ""), mimic[1].get("axis", "axis")
    if not name:
        raise ElementError(mimic, "does not name a joint.")
    if which not in ("axis", "axis2"):
        raise ElementError(mimic, f"says axis={quote(which)}; it has to be axis or axis2.")
    leader = node.scope.find(name, mimic, node.element)
    if leader.kind != "joint":
        raise ElementError(mimic, f"names {quote(name)}, which is a {leader.kind} and no joint.")
    kind = _kind(leader.element)
    count = AXIS_COUNT[kind]
    if count == 0 or kind == "gearbox" or (which == "axis2" and count < 2):
        available = "no position" if count == 0 or kind == "gearbox" else "one axis only"
        raise ElementError(mimic, f"names {quote(name)}, which is {kind} and has {available} to follow.")
    multiplier, offset = read_child_number(mimic, "multiplier", 1.0), read_child_number(mimic, "offset", 0.0)
    reference = read_child_number(mimic, "reference", 0.0) + _first_zero(leader, kind)
    shift = offset - multiplier * reference + _first_zero(node, _kind(node.element))
    return MimicRelation(leader.path + _SUFFIXES[count][which == "axis2"], multiplier, shift)


def _pitch(element: Element) -> float:
    """Return the pitch of a screw [m per revolution], positive for a right-handed thread."""
    if find_child(element, "screw_thread_pitch") is not None or find_child(element, "thread_pitch") is None:
        pitch = read_child_number(element, "screw_thread_pitch", 1.0)
    else:
        radians = read_child_number(element, "thread_pitch")  # per metre, left-handed
        pitch = -math.tau / radians if radians else math.inf
    if not pitch or not is_valid_factor(pitch):
        raise ElementError(
            element, "has a thread without pitch, or with too much: it would only turn, or only slide."
        )
    return pitch


_PARALLEL = 1e-4
_HINGE_TYPES = ("revolute", "continuous")


def resolve_gearboxes(
    hinges: Sequence[ResolvedJoint], attachments: dict[PoseNode, PoseNode]
) -> list[ResolvedJoint]:
    """Replace gearboxes by hinges that follow others.

    A gearbox that couples two other hinges is removed, and the hinge of its child follows that of its parent.
    """
    between: dict[frozenset[PoseNode], int] = {}
    result: list[ResolvedJoint | None] = list(hinges)
    for index, hinge in enumerate(hinges):
        if hinge.joint.kind in _HINGE_TYPES:
            between.setdefault(frozenset((hinge.parent, hinge.child)), index)
    for index, hinge in enumerate(hinges):
        if hinge.joint.kind != "gearbox":
            continue
        node = hinge.node
        if not read_child_text(node.element, "gearbox_reference_body"):
            with node.document.locate_errors(node.element):
                mistake = ElementError(
                    node.element, "has no <gearbox_reference_body>: it is undefined what it turns against."
                )
                node.document.remarks.repair(mistake, "it is left out")
            result[index] = None
            continue
        part = find_child(node.element, "gearbox_reference_body")
        assert part is not None
        body = attachments[node.scope.find(read_text(part), part, node.element)]
        with node.document.locate_errors(node.element):
            ratio = read_child_number(node.element, "gearbox_ratio", 1.0)
        if not ratio:
            node.refuse("has the ratio 0, so nothing would turn.")
        driving = between.get(frozenset((body, hinge.parent)))
        if driving is None:
            node.refuse(
                f"there is no hinge between its reference body {quote(body.path)} and its parent "
                f"{quote(hinge.parent.path)}, whose angle it would pass on."
            )
        first, second = hinge.joint.axes
        driver = hinges[driving]
        factor = -ratio * _sense(driver, hinge, body, first)
        driven = between.get(frozenset((body, hinge.child)))
        if driven is None:
            joint = replace(
                hinge.joint,
                parent=body.path or "world",
                pose_in_parent=pose_between(body, node),
                axes=(replace(second, suffix=""),),
                gear=MimicRelation(driver.joint.name, factor),
            )
            result[index] = replace(hinge, joint=joint, parent=body)
            continue
        found = result[driven]
        assert found is not None
        axis = found.joint.axes[0]
        if axis.mimic is not None:
            node.refuse(f"its child's hinge {quote(found.joint.name)} follows another joint already.")
        factor *= _sense(found, hinge, body, second)
        axis = replace(axis, mimic=MimicRelation(driver.joint.name, factor))
        result[driven] = replace(found, joint=replace(found.joint, axes=(axis,)))
        result[index] = None
    return [hinge for hinge in result if hinge is not None]


def _sense(hinge: ResolvedJoint, gearbox: ResolvedJoint, body: PoseNode, axis: SdfAxis) -> float:
    """Return the sign of a hinge's angle from the reference body about an axis of the gearbox, 1 or -1."""
    hinge_axis = rotate_direction(pose_between(gearbox.node, hinge.node), hinge.joint.axes[0].xyz)
    cosine = sum(x * y for x, y in zip(hinge_axis, axis.xyz, strict=True))
    if abs(cosine) < 1.0 - _PARALLEL:
        angle = math.degrees(math.acos(min(abs(cosine), 1.0)))
        gearbox.node.refuse(
            f"its axis is {angle:.3g}° away from that of the hinge {quote(hinge.joint.name)}, "
            "where they have to be parallel."
        )
    return math.copysign(1.0, cosine) * (1.0 if hinge.parent is body else -1.0)


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
            roots.append(SdfRoot(link.name, free=bool(link.free) or group not in fixed))
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
    axes = []
    for axis in reversed(joint.axes):
        x, y, z = axis.xyz
        axes.append(replace(axis, xyz=(0.0 - x, 0.0 - y, 0.0 - z)))
    return replace(
        joint,
        parent=joint.child,
        child=joint.parent,
        pose_in_parent=joint.pose_in_child,
        pose_in_child=joint.pose_in_parent,
        axes=tuple(axes),
        is_reversed=not joint.is_reversed,
    )
