"""SDF joint elements as checked joints.

Only the elements that apply to the type of a joint are read: the axis of a fixed joint is ignored.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from kineverse.errors import suggest
from kineverse.formats.mimic import MimicRelation, is_valid_factor
from kineverse.formats.poses import rotate_direction
from kineverse.formats.xml_reader import Element, ElementError, find_child, quote
from kineverse.formats.xml_values import (
    read_axis_direction,
    read_child_bool,
    read_child_limit,
    read_child_number,
    read_text,
)
from kineverse.model.body import Vector3

from .description import AXIS_COUNT, SdfAxis, SdfJoint, SdfJointType
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
    joint = SdfJoint(
        node.path,
        kind,
        parent.path or "world",
        child.path,
        pose_between(parent, node),
        pose_between(child, node),
        axes,
        pitch,
        line=element[3],
        source=document.source,
    )
    return ResolvedJoint(joint, node, parent, child)


def _kind(element: Element) -> SdfJointType:
    """Return the type of a joint, whatever its case."""
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
    """Return an axis of a joint; z, with a remark, if it is missing."""
    element, remarks = node.element, node.document.remarks
    axis = find_child(element, tag)
    if axis is None:
        if kind in ("universal", "revolute2"):
            mistake = ElementError(
                element, f"is {kind} but has no <{tag}>; by default both axes are z, which is no such joint."
            )
            remarks.mend(mistake, "it is z")
            return SdfAxis(suffix=suffix)
        remarks.add(element, f"has no <{tag}>; it is z, the specification's default.")
        return SdfAxis(suffix=suffix)
    limit, dynamics = find_child(axis, "limit"), find_child(axis, "dynamics")
    lower = upper = velocity = effort = None
    if limit is not None:
        lower, upper = read_child_limit(limit, "lower"), read_child_limit(limit, "upper")
        velocity, effort = (_magnitude(limit, key, node) for key in ("velocity", "effort"))
    if kind == "continuous":
        lower = upper = None
    if lower is not None and upper is not None and lower > upper:
        assert limit is not None
        mistake = ElementError(
            limit, f"has lower {lower!r} above upper {upper!r}: no position would be valid."
        )
        remarks.mend(mistake, "the joint is not limited", element)
        lower = upper = None
    values = [] if effort is None or effort < 0.0 else [("effort", effort)]
    if dynamics is not None:
        found = [(key, _dynamics_value(dynamics, key, node)) for key in _DYNAMICS]
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


def _magnitude(limit: Element, key: str, node: PoseNode) -> float | None:
    """Return the limit of a velocity or an effort; None, with a remark, if it is malformed."""
    try:
        return read_child_limit(limit, key)
    except ElementError as mistake:
        node.document.remarks.mend(mistake, "it bounds nothing", node.element)
        return None


def _dynamics_value(dynamics: Element, key: str, node: PoseNode) -> float:
    """Return a number of the dynamics; 0, with a remark, if it is malformed."""
    try:
        return read_child_number(dynamics, key, 0.0)
    except ElementError as mistake:
        node.document.remarks.mend(mistake, "0 is taken", node.element)
        return 0.0


def _direction(node: PoseNode, axis: Element) -> Vector3:
    """Return the direction of an axis in the joint's frame."""
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
    """Return the relation of an axis to the coordinate that it follows; None if it follows none."""
    mimic = find_child(axis, "mimic")
    if mimic is None:
        return None
    name, which = mimic[1].get("joint", ""), mimic[1].get("axis", "axis")
    if not name:
        raise ElementError(mimic, "does not say which joint.")
    if which not in ("axis", "axis2"):
        raise ElementError(mimic, f"says axis={quote(which)}; axis and axis2 are the ones there are.")
    leader = node.scope.find(name, mimic, node.element)
    if leader.kind != "joint":
        raise ElementError(mimic, f"names {quote(name)}, which is a {leader.kind} and no joint.")
    kind = _kind(leader.element)
    count = AXIS_COUNT[kind]
    if count == 0 or kind == "gearbox" or (which == "axis2" and count < 2):
        available = "no position" if count == 0 or kind == "gearbox" else "one axis only"
        raise ElementError(mimic, f"names {quote(name)}, which is {kind} and has {available} to follow.")
    multiplier, offset = read_child_number(mimic, "multiplier", 1.0), read_child_number(mimic, "offset", 0.0)
    shift = offset - multiplier * read_child_number(mimic, "reference", 0.0)
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


def find_reference_body(node: PoseNode, attachments: dict[PoseNode, PoseNode]) -> PoseNode:
    """Return the reference link of a gearbox's angles."""
    part = find_child(node.element, "gearbox_reference_body")
    assert part is not None
    return attachments[node.scope.find(read_text(part), part, node.element)]
