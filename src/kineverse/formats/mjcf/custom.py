"""What the writer says of a model beside MJCF, as custom elements, which MuJoCo ignores.

=======================================  ================================================================
``<numeric>`` ``kineverse:speed:JOINT``  the range of the speed of a joint
``<tuple>`` ``kineverse:massless``       bodies that have mass only because MuJoCo moves none without
``<tuple>`` ``kineverse:ends``           sites that are there only to tie bodies
``<tuple>`` ``kineverse:loop:NAME``      equalities and joints of a loop, those that follow with ``prm=1``
=======================================  ================================================================

A ``<tuple>`` in which there are names with spaces is a ``<text>`` of that name, whose data are its elements
in JSON: ``[[objtype, objname, prm], ...]``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from kineverse.formats.markup import quote

from .description import Closure, Link
from .naming import plain
from .tree import Node

Note = Callable[[Node | None, str], None]

SPEED, LOOP = "kineverse:speed:", "kineverse:loop:"
MASSLESS, ENDS = "kineverse:massless", "kineverse:ends"
ELEMENT = ("objtype", "objname", "prm")
"""The attributes of an element of a tuple."""


@dataclass(frozen=True, slots=True)
class Loop:
    """A loop: the names of its equalities and of its joints, and the element that says so."""

    equalities: tuple[str, ...]
    free: tuple[str, ...]
    dependent: tuple[str, ...]
    node: Node


@dataclass(frozen=True, slots=True)
class Custom:
    """What custom elements say.

    ``speeds`` are ranges of joints [rad/s] or [m/s], ``massless`` bodies and ``ends`` sites, all by name.
    """

    speeds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    massless: frozenset[str] = frozenset()
    ends: frozenset[str] = frozenset()
    loops: Mapping[str, Loop] = field(default_factory=dict)


def custom_of(root: Node, note: Note) -> Custom:
    """Return what the custom elements of a document say, as far as they are those of the writer.

    Parameters
    ----------
    root
        Of the document.
    note
        Called with what is left out.
    """
    speeds: dict[str, tuple[float, float]] = {}
    loops: dict[str, Loop] = {}
    named: dict[str, set[str]] = {MASSLESS: set(), ENDS: set()}
    for node in (child for section in root.children if section.tag == "custom" for child in section.children):
        name = node.attributes.get("name", "")
        if node.tag == "text" and (name in named or name.startswith(LOOP)):
            node = _as_tuple(node)
        if node.tag == "numeric" and name.startswith(SPEED):
            found = _range(node.attributes.get("data", ""))
            if found is None:
                note(node, "is left out: a range of speeds is two numbers, the first of them no larger.")
            else:
                speeds[plain(name.removeprefix(SPEED))] = found
        elif node.tag == "tuple" and name in named:
            named[name].update(_names(node, "body" if name == MASSLESS else "site"))
        elif node.tag == "tuple" and name.startswith(LOOP):
            loops[plain(name.removeprefix(LOOP))] = Loop(
                tuple(_names(node, "equality")),
                tuple(_names(node, "joint", follows=False)),
                tuple(_names(node, "joint", follows=True)),
                node,
            )
    return Custom(speeds, frozenset(named[MASSLESS]), frozenset(named[ENDS]), loops)


def _as_tuple(node: Node) -> Node:
    """Return the tuple that a text stands for, or the text if it stands for none."""
    try:
        given = json.loads(node.attributes.get("data", ""))
        elements = [dict(zip(ELEMENT, map(str, item), strict=True)) for item in given]
    except (ValueError, TypeError, RecursionError):
        return node
    children = [Node("element", attributes, [], node.source, node.line) for attributes in elements]
    return Node("tuple", node.attributes, children, node.source, node.line)


def closed_as_said(
    closures: tuple[Closure, ...], links: tuple[Link, ...], loops: Mapping[str, Loop], note: Note
) -> tuple[Closure, ...]:
    """Return closures with those that are one loop as one, which says who follows in it.

    A loop that names what is not there, since somebody edited the file, is read as those of other files are.
    """
    by_name = {closure.name: closure for closure in closures}
    joints = {joint.name for link in links for joint in link.joints}
    for name, loop in loops.items():
        parts = [by_name.get(equality) for equality in loop.equalities]
        known = [part for part in parts if part is not None]
        strange = [joint for joint in (*loop.free, *loop.dependent) if joint not in joints]
        if not known or len(known) < len(parts) or strange or len({part.kind for part in known}) > 1:
            note(loop.node, f"is left out: loop {quote(name)} is not in the file as it says.")
            continue
        first, *others = known
        said = replace(_turned(first), name=name, more=tuple(map(_turned, others)))
        by_name[first.name] = replace(said, free=loop.free, dependent=loop.dependent)
        for part in others:
            del by_name[part.name]
    return tuple(by_name.values())


def _turned(closure: Closure) -> Closure:
    """Return the same the other way round: the writer names the second end first."""
    return replace(
        closure,
        first=closure.second,
        second=closure.first,
        in_first=closure.in_second,
        in_second=closure.in_first,
    )


def _range(text: str) -> tuple[float, float] | None:
    try:
        lower, upper = map(float, text.split())
    except ValueError:
        return None
    return (lower, upper) if lower <= upper and lower < math.inf and upper > -math.inf else None


def _names(node: Node, kind: str, follows: bool | None = None) -> Iterator[str]:
    for element in node.children:
        said = element.attributes
        leads = said.get("prm", "0") in ("0", "")
        if said.get("objtype") == kind and (follows is None or follows is not leads):
            yield plain(said.get("objname", ""))
