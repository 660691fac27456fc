"""Custom MJCF elements for data that MJCF has no place for, read and written.

=======================================  ================================================================
``<numeric>`` ``kineverse:speed:JOINT``  velocity limits of a joint
``<tuple>`` ``kineverse:massless``       bodies without mass, to which MuJoCo gives one
``<tuple>`` ``kineverse:ends``           sites that mark the ends of loop closures
``<tuple>`` ``kineverse:loop:NAME``      equalities and joints of a loop, dependent joints with ``prm=1``
=======================================  ================================================================

A ``<tuple>`` with names that contain spaces is written as a ``<text>`` of the same name, whose data are its
elements in JSON: ``[[objtype, objname, prm], ...]``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from kineverse.formats.description import JointDescription, LoopJoint
from kineverse.formats.names import drop_empty_parts
from kineverse.formats.xml_reader import quote
from kineverse.formats.xml_writer import Tag
from kineverse.symbols import parse_symbol_name

from .description import MjcfClosure, MjcfLink
from .elements import ElementRemark, MjcfElement

SPEED_PREFIX, LOOP_PREFIX = "kineverse:speed:", "kineverse:loop:"
MASSLESS, ENDS = "kineverse:massless", "kineverse:ends"
TUPLE_ATTRIBUTES = ("objtype", "objname", "prm")  # attributes of an element of a tuple


@dataclass(frozen=True, slots=True)
class CustomLoop:
    """Loop of custom elements: names of its equalities, of its independent and dependent joints."""

    equalities: tuple[str, ...]
    free: tuple[str, ...]
    dependent: tuple[str, ...]
    node: MjcfElement


@dataclass(frozen=True, slots=True)
class CustomElements:
    """Data of all custom elements, by name.

    ``speeds`` are velocity limits of joints [rad/s] or [m/s], ``massless`` bodies without mass, and ``ends``
    the sites that mark ends of loop closures.
    """

    speeds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    massless: frozenset[str] = frozenset()
    ends: frozenset[str] = frozenset()
    loops: Mapping[str, CustomLoop] = field(default_factory=dict)


def read_custom_elements(root: MjcfElement, remark: ElementRemark) -> CustomElements:
    """Read the custom elements of a document that Kineverse has written; others are ignored."""
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
                remark(node, "is left out: a range of speeds is two numbers, the first of them no larger.")
            else:
                speeds[drop_empty_parts(name.removeprefix(SPEED_PREFIX))] = found
        elif node.tag == "tuple" and name in named:
            named[name].update(_object_names(node, "body" if name == MASSLESS else "site"))
        elif node.tag == "tuple" and name.startswith(LOOP_PREFIX):
            loops[drop_empty_parts(name.removeprefix(LOOP_PREFIX))] = CustomLoop(
                tuple(_object_names(node, "equality")),
                tuple(_object_names(node, "joint", dependent=False)),
                tuple(_object_names(node, "joint", dependent=True)),
                node,
            )
    return CustomElements(speeds, frozenset(named[MASSLESS]), frozenset(named[ENDS]), loops)


def _as_tuple(node: MjcfElement) -> MjcfElement:
    """Return the tuple that a text represents, or the text if it represents none."""
    try:
        items = json.loads(node.attributes.get("data", ""))
        elements = [dict(zip(TUPLE_ATTRIBUTES, map(str, item), strict=True)) for item in items]
    except (ValueError, TypeError, RecursionError):
        return node
    children = [MjcfElement("element", attributes, [], node.source, node.line) for attributes in elements]
    return MjcfElement("tuple", node.attributes, children, node.source, node.line)


def merge_loop_closures(
    closures: tuple[MjcfClosure, ...],
    links: tuple[MjcfLink, ...],
    loops: Mapping[str, CustomLoop],
    remark: ElementRemark,
) -> tuple[MjcfClosure, ...]:
    """Merge the closures of each custom loop into one, with its independent and dependent joints.

    A loop with names that do not exist in an edited file is ignored, with a remark.
    """
    by_name = {closure.name: closure for closure in closures}
    joints = {joint.name for link in links for joint in link.joints}
    for name, loop in loops.items():
        parts = [by_name.get(equality) for equality in loop.equalities]
        known = [part for part in parts if part is not None]
        unknown = [joint for joint in (*loop.free, *loop.dependent) if joint not in joints]
        if not known or len(known) < len(parts) or unknown or len({part.kind for part in known}) > 1:
            remark(loop.node, f"is left out: loop {quote(name)} is not in the file as it says.")
            continue
        first, *others = known
        merged = replace(_swap_ends(first), name=name, more=tuple(map(_swap_ends, others)))
        by_name[first.name] = replace(merged, free=loop.free, dependent=loop.dependent)
        for part in others:
            del by_name[part.name]
    return tuple(by_name.values())


def _swap_ends(closure: MjcfClosure) -> MjcfClosure:
    """Return a closure with its ends exchanged; the writer names the second end first."""
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


def _object_names(node: MjcfElement, kind: str, dependent: bool | None = None) -> Iterator[str]:
    for element in node.children:
        attributes = element.attributes
        is_dependent = attributes.get("prm", "0") not in ("0", "")
        if attributes.get("objtype") == kind and (dependent is None or dependent is is_dependent):
            yield drop_empty_parts(attributes.get("objname", ""))


def add_speeds(custom: Tag, joints: Iterable[JointDescription]) -> bool:
    """Add the velocity limits of joints; return True if there are any."""
    result = False
    for joint in joints:
        min_velocity, max_velocity = joint.bounds.min_velocity, joint.bounds.max_velocity
        if (min_velocity, max_velocity) != (-math.inf, math.inf):
            numeric = custom.add("numeric", name=f"{SPEED_PREFIX}{joint.name}")
            numeric.attributes["data"] = f"{min_velocity!r} {max_velocity!r}"
            result = True
    return result


def add_names(custom: Tag, key: str, kind: str, names: Iterable[str]) -> None:
    """Add a tuple of names of one type of objects, unless there are none."""
    tuple_tag = Tag("tuple", {"name": key})
    for name in names:
        tuple_tag.add("element", objtype=kind, objname=name)
    if tuple_tag.inside:
        custom.inside.append(_as_tuple_or_text(tuple_tag))


def add_loop(custom: Tag, loop: LoopJoint, equalities: Iterable[str], joints: Collection[str]) -> None:
    """Add the equalities and joints of a loop; several of its coordinates may belong to one joint."""
    tuple_tag = Tag("tuple", {"name": f"{LOOP_PREFIX}{loop.name}"})
    for name in equalities:
        tuple_tag.add("element", objtype="equality", objname=name)
    for names, is_dependent in ((loop.free, 0), (loop.dependent, 1)):
        paths = [parse_symbol_name(name)[0] for name in names]
        owners = [path if path in joints else path.rpartition("/")[0] for path in paths]
        for joint in dict.fromkeys(owners):
            tuple_tag.add("element", objtype="joint", objname=joint, prm=is_dependent)
    custom.inside.append(_as_tuple_or_text(tuple_tag))


def _as_tuple_or_text(tuple_tag: Tag) -> Tag:
    """Return a tuple, as a text if names contain spaces, which MuJoCo takes for several names."""
    if all(len(tag.attributes["objname"].split()) == 1 for tag in tuple_tag.inside):
        return tuple_tag
    elements = [[tag.attributes.get(key, "0") for key in TUPLE_ATTRIBUTES] for tag in tuple_tag.inside]
    data = json.dumps(elements, ensure_ascii=False)
    return Tag("text", {"name": tuple_tag.attributes["name"], "data": data})
