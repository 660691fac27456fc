"""``<joint>`` elements to joints: their kind, axes, limits and what they follow.

A joint is read for what its kind can have: the axis of a fixed joint means nothing and is not looked at.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from kineverse.errors import suggest
from kineverse.formats.chains import Following, factor_is_sound
from kineverse.formats.markup import Element, ElementError, child, quote
from kineverse.formats.poses import rotated
from kineverse.model.body import Vector3

from .description import AXES, Axis, Joint, Kind
from .nodes import MODEL, Node
from .placing import relation
from .resolving import end_of
from .values import bound, direction, number, text_of, truth

_SUFFIXES = {1: ("",), 2: ("/first", "/second")}
_DYNAMICS = ("damping", "friction", "spring_reference", "spring_stiffness")


@dataclass(frozen=True, slots=True)
class Hinge:
    """A joint as it was read, and the nodes it connects."""

    joint: Joint
    node: Node
    parent: Node
    child: Node


def read_joint(node: Node, carriers: dict[Node, Node]) -> Hinge:
    """Return a joint; what its axes follow is the next coordinate, not yet that at the end of the chain.

    Raises
    ------
    FormatError
        If something is missing, malformed or without meaning.
    """
    element, document = node.element, node.document
    parent, over = carriers[end_of(node, "parent")], carriers[node]
    if over.sort == "world":
        document.refuse(element, "its child moves with the world. Exchange parent and child.")
    if parent is over:
        document.refuse(
            element, f"its parent and its child are both {quote(over.path)}: it connects a link to itself."
        )
    with document.about(element):
        kind = _kind(element)
        axes = tuple(
            _axis(node, tag, suffix, kind)
            for tag, suffix in zip(("axis", "axis2"), _SUFFIXES.get(AXES[kind], ()), strict=False)
        )
        pitch = _pitch(element) if kind == "screw" else 0.0
        if kind == "ball" and child(element, "axis") is not None:
            axes = (_axis(node, "axis", "", kind),)
    joint = Joint(
        node.path,
        kind,
        parent.path or "world",
        over.path,
        relation(parent, node),
        relation(over, node),
        axes,
        pitch,
        line=element[3],
        source=document.source,
    )
    return Hinge(joint, node, parent, over)


def _kind(element: Element) -> Kind:
    said = element[1].get("type")
    if not said:
        raise ElementError(element, f"has no type; the specification requires one of {', '.join(AXES)}.")
    for kind in AXES:
        if kind == said.lower():
            return kind
    raise ElementError(element, f"type={quote(said)} is no joint type of SDF. {suggest(said, AXES, 'type')}")


def _axis(node: Node, tag: str, suffix: str, kind: Kind) -> Axis:
    element, remarks = node.element, node.document.remarks
    axis = child(element, tag)
    if axis is None:
        if kind in ("universal", "revolute2"):
            mistake = ElementError(
                element, f"is {kind} but has no <{tag}>; by default both axes are z, which is no such joint."
            )
            remarks.mend(mistake, "it is z")
            return Axis(suffix=suffix)
        remarks.add(element, f"has no <{tag}>; it is z, the specification's default.")
        return Axis(suffix=suffix)
    limit, dynamics = child(axis, "limit"), child(axis, "dynamics")
    lower = upper = velocity = effort = None
    if limit is not None:
        lower, upper = bound(limit, "lower"), bound(limit, "upper")
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
        found = [(key, _known(dynamics, key, node)) for key in _DYNAMICS]
        springs = any(value for key, value in found if key == "spring_stiffness")
        values += [(k, v) for k, v in found if v or (springs and k == "spring_reference")]
    if child(axis, "initial_position") is not None and number(axis, "initial_position"):
        remarks.add(axis, "has an initial_position, which is ignored: a description has no state.", element)
    return Axis(
        _direction(node, axis),
        lower,
        upper,
        velocity if velocity is not None and velocity > 0.0 else None,
        tuple(values),
        suffix,
        None if kind == "ball" else _following(node, axis),
    )


def _magnitude(limit: Element, key: str, node: Node) -> float | None:
    """Return a bound of a speed or an effort; what is none bounds nothing."""
    try:
        return bound(limit, key)
    except ElementError as mistake:
        node.document.remarks.mend(mistake, "it bounds nothing", node.element)
        return None


def _known(dynamics: Element, key: str, node: Node) -> float:
    """Return a number of the dynamics, 0 where it is none."""
    try:
        return number(dynamics, key, 0.0)
    except ElementError as mistake:
        node.document.remarks.mend(mistake, "0 is taken", node.element)
        return 0.0


def _direction(node: Node, axis: Element) -> Vector3:
    """Return the axis in the joint's frame."""
    xyz, version = direction(axis), node.document.version
    part = child(axis, "xyz")
    frame = ""
    if version >= (1, 7):
        frame = "" if part is None else part[1].get("expressed_in", "")
    elif truth(axis, "use_parent_model_frame", default=version < (1, 5)):
        frame = MODEL if node.scope.model.sort != "world" else ""
    if not frame:
        return xyz
    assert part is not None or frame == MODEL
    reference = node.scope.find(frame, part or axis, node.element)
    return rotated(relation(node, reference), xyz)


def _following(node: Node, axis: Element) -> Following[str] | None:
    mimic = child(axis, "mimic")
    if mimic is None:
        return None
    name, which = mimic[1].get("joint", ""), mimic[1].get("axis", "axis")
    if not name:
        raise ElementError(mimic, "does not say which joint.")
    if which not in ("axis", "axis2"):
        raise ElementError(mimic, f"says axis={quote(which)}; axis and axis2 are the ones there are.")
    leader = node.scope.find(name, mimic, node.element)
    if leader.sort != "joint":
        raise ElementError(mimic, f"names {quote(name)}, which is a {leader.sort} and no joint.")
    kind = _kind(leader.element)
    count = AXES[kind]
    if count == 0 or kind == "gearbox" or (which == "axis2" and count < 2):
        what = "no position" if count == 0 or kind == "gearbox" else "one axis only"
        raise ElementError(mimic, f"names {quote(name)}, which is {kind} and has {what} to follow.")
    multiplier, offset = number(mimic, "multiplier", 1.0), number(mimic, "offset", 0.0)
    shift = offset - multiplier * number(mimic, "reference", 0.0)
    return Following(leader.path + _SUFFIXES[count][which == "axis2"], multiplier, shift)


def _pitch(element: Element) -> float:
    """Return how far a screw goes in a revolution [m], positive for a right-handed thread."""
    if child(element, "screw_thread_pitch") is not None or child(element, "thread_pitch") is None:
        pitch = number(element, "screw_thread_pitch", 1.0)
    else:
        radians = number(element, "thread_pitch")  # per metre, left-handed
        pitch = -math.tau / radians if radians else math.inf
    if not pitch or not factor_is_sound(pitch):
        raise ElementError(
            element, "has a thread without pitch, or with too much: it would only turn, or only slide."
        )
    return pitch


def reference_body(node: Node, carriers: dict[Node, Node]) -> Node:
    """Return the link against which a gearbox measures its angles."""
    part = child(node.element, "gearbox_reference_body")
    assert part is not None
    return carriers[node.scope.find(text_of(part), part, node.element)]
