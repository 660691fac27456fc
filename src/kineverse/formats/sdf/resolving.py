"""The references between nodes, and with them where everything is."""

from __future__ import annotations

from kineverse.formats.markup import TEXT, Element, child, quote
from kineverse.formats.poses import inverse, product

from .nodes import Node, Scope
from .placing import check_circles, place, within
from .reading import Parts
from .values import pose_of, text_of


def resolve(parts: Parts) -> None:
    """Follow the references of all nodes, and find where they are in the world.

    Raises
    ------
    FormatError
        For references to what does not exist or in a circle, and poses that are none.
    """
    for node in parts.nodes:
        _attach(node)
    for node, scope, canonical, element in reversed(parts.canonical):
        _carry(node, scope, canonical, element)
    for node in parts.nodes:
        _relate(node)
    check_circles(parts.nodes)
    # Models inside of models come later in the list, and have to be placed first.
    for model, scope, frame, element in reversed(parts.placements):
        model.pose = product(model.pose, inverse(within(model, scope.find(frame, element, element))))
    place(parts.nodes)


def end_of(joint: Node, role: str) -> Node:
    """Return the parent or the child of a joint, whatever it is."""
    element, document, scope = joint.element, joint.document, joint.scope
    part = child(element, role)
    if part is None or not text_of(part):
        document.refuse(element, f"has no <{role}>; the specification requires it.")
    name = _reference(part)
    if name == "world":
        if role == "child":
            document.refuse(element, "has the world as its child. Exchange parent and child.")
        while scope.outer is not None:
            scope = scope.outer
        return scope.model
    found = scope.find(name, part, element)
    if found is joint:
        document.refuse(element, f"is its own {role}.")
    return found


def _reference(part: Element) -> str:
    return part[1].get(TEXT, "").strip()


def _attach(node: Node) -> None:
    """Find what a joint or a frame moves with."""
    if node.sort == "joint":
        node.attached = end_of(node, "child")
    elif node.sort == "frame" and node.shown:
        name = node.element[1].get("attached_to", "")
        target = node.scope.find(name, node.element, node.element) if name else node.scope.model
        node.attached = target
        node.relative = target


def _carry(node: Node, scope: Scope, canonical: str, element: Element) -> None:
    """Find what a model moves with: the world, its canonical link, or the first model in it."""
    if scope.static:
        while scope.outer is not None:
            scope = scope.outer
        node.attached = scope.model
    elif canonical:
        node.attached = scope.find(canonical, element, element)
        if node.attached.sort != "link":
            scope.document.refuse(element, f"its canonical_link {quote(canonical)} is no link.")
    elif scope.links or scope.models:
        node.attached = (scope.links or scope.models)[0]
    else:
        scope.document.refuse(element, "has no link; a model has at least one, unless it is static.")


def _relate(node: Node) -> None:
    """Read the pose of a node and find what it is relative to."""
    scope = node.said_in or node.scope
    said = node.said
    default = node.relative
    if default is None:
        default = node.attached if node.sort == "joint" else scope.model
    node.relative = default
    if said is None:
        return
    with scope.document.about(node.element):
        node.pose = pose_of(said, scope.document.remarks)
    key = "frame" if scope.document.version < (1, 7) else "relative_to"
    name = said[1].get(key, "")
    if name:
        node.relative = scope.find(name, said, node.element)
