"""Where everything is, and what it moves with, by the references between nodes.

Everything here is iterative and linear in the number of nodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from kineverse.formats.markup import quote
from kineverse.formats.poses import IDENTITY, inverse, product
from kineverse.model.body import Pose

from .nodes import Node

_NEAR = 64


def check_circles(nodes: Iterable[Node]) -> None:
    """Look whether all poses lead to the world, and all that moves with something else to a link.

    Raises
    ------
    FormatError
        If a chain of references leads in a circle.
    """
    nodes = list(nodes)
    for word, key in (("attached_to", "attached"), ("relative_to", "relative")):
        done: set[Node] = set()
        for node in nodes:
            chain: dict[Node, None] = {}
            at: Node | None = node
            while at is not None and at not in done:
                if at in chain:
                    circle = " -> ".join(quote(n.path) for n in list(chain)[list(chain).index(at) :][:8])
                    at.refuse(
                        f"its pose depends on itself: {word} leads in a circle, {circle}."
                        if word == "relative_to"
                        else f"it moves with itself: attached_to leads in a circle, {circle}."
                    )
                chain[at] = None
                at = getattr(at, key)
            done.update(chain)


def place(nodes: Iterable[Node]) -> None:
    """Find where all nodes are in the world."""
    for node in nodes:
        chain = []
        at = node
        while at.place is None and at.relative is not None:
            chain.append(at)
            at = at.relative
        if at.place is None:
            at.place = IDENTITY
        for inner in reversed(chain):
            outer = inner.relative
            assert outer is not None
            assert outer.place is not None
            inner.place = product(outer.place, inner.pose)
            inner.depth = outer.depth + 1


def within(model: Node, frame: Node) -> Pose:
    """Return model_T_frame for a frame whose pose is known by way of the model."""
    chain: list[Pose] = []
    at = frame
    while at is not model:
        if at.relative is None:
            model.refuse(f"its placement_frame {quote(frame.path)} is no frame inside of it.")
        chain.append(at.pose)
        at = at.relative
    pose = IDENTITY
    for step in reversed(chain):
        pose = product(pose, step)
    return pose


def relation(a: Node, b: Node) -> Pose:
    """Return a_T_b: by the shortest way if it is short, so that no rounding comes from elsewhere."""
    assert a.place is not None
    assert b.place is not None
    a_up, b_up = IDENTITY, IDENTITY
    at_a, at_b = a, b
    for _ in range(_NEAR):
        if at_a is at_b:
            return product(inverse(a_up), b_up)
        if at_a.depth > at_b.depth:
            a_up = product(at_a.pose, a_up)
            assert at_a.relative is not None
            at_a = at_a.relative
        else:
            b_up = product(at_b.pose, b_up)
            if at_b.relative is None:
                break
            at_b = at_b.relative
    return product(inverse(a.place), b.place)


def carriers(nodes: Sequence[Node], world: Node) -> dict[Node, Node]:
    """Return for each node the link that it moves with, or the world."""
    known = {world: world}
    for node in nodes:
        chain = []
        at = node
        while at not in known and at.attached is not None:
            chain.append(at)
            at = at.attached
        end = known.get(at, at)
        known.update(dict.fromkeys(chain, end))
        known[node] = end
    return known
