"""Custom MJCF elements for data that MJCF has no place for, read and written.

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
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from kineverse.formats.description import JointDescription, LoopJoint
from kineverse.formats.names import drop_empty_parts
from kineverse.formats.xml_reader import quote
from kineverse.formats.xml_writer import Tag
from kineverse.symbols import parse_symbol_name

from .description import MjcfClosure, MjcfLink
from .elements import MjcfElement

_ElementNote = Callable[[MjcfElement | None, str], None]

SPEED_PREFIX, LOOP_PREFIX = "kineverse:speed:", "kineverse:loop:"
MASSLESS, ENDS = "kineverse:massless", "kineverse:ends"
TUPLE_ATTRIBUTES = ("objtype", "objname", "prm")
"""The attributes of an element of a tuple."""


@dataclass(frozen=True, slots=True)
class CustomLoop:
    """A loop: the names of its equalities and of its joints, and the element that says so."""

    equalities: tuple[str, ...]
    free: tuple[str, ...]
    dependent: tuple[str, ...]
    node: MjcfElement


@dataclass(frozen=True, slots=True)
class CustomElements:
    """What custom elements say.

    ``speeds`` are ranges of joints [rad/s] or [m/s], ``massless`` bodies and ``ends`` sites, all by name.
    """

    speeds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    massless: frozenset[str] = frozenset()
    ends: frozenset[str] = frozenset()
    loops: Mapping[str, CustomLoop] = field(default_factory=dict)


def read_custom_elements(root: MjcfElement, note: _ElementNote) -> CustomElements:
    """Return what the custom elements of a document say, as far as they are those of the writer.

    Parameters
    ----------
    root
        Of the document.
    note
        Called with what is left out.
    """
    speeds: dict[str, tuple[float, float]] = {}
    loops: dict[str, CustomLoop] = {}
    named: dict[str, set[str]] = {MASSLESS: set(), ENDS: set()}
    for node in (child for section in root.children if section.tag == "custom" for child in section.children):
        name = node.attributes.get("name", "")
        if node.tag == "text" and (name in named or name.startswith(LOOP_PREFIX)):
            node = _as_tuple(node)
        if node.tag == "numeric" and name.startswith(SPEED_PREFIX):
            found = _parse_range(node.attributes.get("data", ""))
            if found is None:
                note(node, "is left out: a range of speeds is two numbers, the first of them no larger.")
            else:
                speeds[drop_empty_parts(name.removeprefix(SPEED_PREFIX))] = found
        elif node.tag == "tuple" and name in named:
            named[name].update(_object_names(node, "body" if name == MASSLESS else "site"))
        elif node.tag == "tuple" and name.startswith(LOOP_PREFIX):
            loops[drop_empty_parts(name.removeprefix(LOOP_PREFIX))] = CustomLoop(
                tuple(_object_names(node, "equality")),
                tuple(_object_names(node, "joint", follows=False)),
                tuple(_object_names(node, "joint", follows=True)),
                node,
            )
    return CustomElements(speeds, frozenset(named[MASSLESS]), frozenset(named[ENDS]), loops)


def _as_tuple(node: MjcfElement) -> MjcfElement:
    """Return the tuple that a text stands for, or the text if it stands for none."""
    try:
        given = json.loads(node.attributes.get("data", ""))
        elements = [dict(zip(TUPLE_ATTRIBUTES, map(str, item), strict=True)) for item in given]
    except (ValueError, TypeError, RecursionError):
        return node
    children = [MjcfElement("element", attributes, [], node.source, node.line) for attributes in elements]
    return MjcfElement("tuple", node.attributes, children, node.source, node.line)


def merge_loop_closures(
    closures: tuple[MjcfClosure, ...],
    links: tuple[MjcfLink, ...],
    loops: Mapping[str, CustomLoop],
    note: _ElementNote,
) -> tuple[MjcfClosure, ...]:
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
        said = replace(_swap_ends(first), name=name, more=tuple(map(_swap_ends, others)))
        by_name[first.name] = replace(said, free=loop.free, dependent=loop.dependent)
        for part in others:
            del by_name[part.name]
    return tuple(by_name.values())


def _swap_ends(closure: MjcfClosure) -> MjcfClosure:
    """Return the same the other way round: the writer names the second end first."""
    return replace(
        closure,
        first=closure.second,
        second=closure.first,
        in_first=closure.in_second,
        in_second=closure.in_first,
    )


def _parse_range(text: str) -> tuple[float, float] | None:
    try:
        lower, upper = map(float, text.split())
    except ValueError:
        return None
    return (lower, upper) if lower <= upper and lower < math.inf and upper > -math.inf else None


def _object_names(node: MjcfElement, kind: str, follows: bool | None = None) -> Iterator[str]:
    for element in node.children:
        said = element.attributes
        leads = said.get("prm", "0") in ("0", "")
        if said.get("objtype") == kind and (follows is None or follows is not leads):
            yield drop_empty_parts(said.get("objname", ""))


def add_speeds(custom: Tag, joints: Iterable[JointDescription]) -> bool:
    """Add the ranges of speeds of joints that have some; return whether there are any."""
    found = False
    for joint in joints:
        min_velocity, max_velocity = joint.bounds.min_velocity, joint.bounds.max_velocity
        if (min_velocity, max_velocity) != (-math.inf, math.inf):
            numeric = custom.add("numeric", name=f"{SPEED_PREFIX}{joint.name}")
            numeric.attributes["data"] = format_range(min_velocity, max_velocity)
            found = True
    return found


def add_names(custom: Tag, what: str, kind: str, names: Iterable[str]) -> None:
    """Add that things of some kind are something, unless there are none."""
    listed = Tag("tuple", {"name": what})
    for name in names:
        listed.add("element", objtype=kind, objname=name)
    if listed.inside:
        custom.inside.append(_as_tuple_or_text(listed))


def add_loop(custom: Tag, loop: LoopJoint, equalities: Iterable[str], joints: Collection[str]) -> None:
    """Add which coordinates of a loop follow; several of them may belong to one of the joints."""
    listed = Tag("tuple", {"name": f"{LOOP_PREFIX}{loop.name}"})
    for name in equalities:
        listed.add("element", objtype="equality", objname=name)
    for names, follows in ((loop.free, 0), (loop.dependent, 1)):
        paths = [parse_symbol_name(name)[0] for name in names]
        owners = [path if path in joints else path.rpartition("/")[0] for path in paths]
        for joint in dict.fromkeys(owners):
            listed.add("element", objtype="joint", objname=joint, prm=follows)
    custom.inside.append(_as_tuple_or_text(listed))


def _as_tuple_or_text(listed: Tag) -> Tag:
    """Return a tuple, as a text where there are names with spaces: MuJoCo takes each for several."""
    if all(len(tag.attributes["objname"].split()) == 1 for tag in listed.inside):
        return listed
    elements = [[tag.attributes.get(key, "0") for key in TUPLE_ATTRIBUTES] for tag in listed.inside]
    return Tag("text", {"name": listed.attributes["name"], "data": json.dumps(elements, ensure_ascii=False)})


def format_range(lower: float, upper: float) -> str:
    """Return the ends of an interval as text, which may be infinite."""
    return " ".join(
        "inf" if end == math.inf else "-inf" if end == -math.inf else repr(end) for end in (lower, upper)
    )
