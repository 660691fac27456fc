"""What MJCF has no place for as custom elements, which MuJoCo ignores and the reader knows."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable

from kineverse.formats.export.markup import Tag
from kineverse.formats.export.plan import Joint, Loop
from kineverse.symbols import parse_symbol_name

from .custom import ELEMENT, LOOP, SPEED


def add_speeds(custom: Tag, joints: Iterable[Joint]) -> bool:
    """Add the ranges of speeds of joints that have some; return whether there are any."""
    found = False
    for joint in joints:
        slowest, fastest = joint.bounds.slowest, joint.bounds.fastest
        if (slowest, fastest) != (-math.inf, math.inf):
            numeric = custom.add("numeric", name=f"{SPEED}{joint.name}")
            numeric.attributes["data"] = interval(slowest, fastest)
            found = True
    return found


def add_names(custom: Tag, what: str, kind: str, names: Iterable[str]) -> None:
    """Add that things of some kind are something, unless there are none."""
    listed = Tag("tuple", {"name": what})
    for name in names:
        listed.add("element", objtype=kind, objname=name)
    if listed.inside:
        custom.inside.append(_as_it_can_be(listed))


def add_loop(custom: Tag, loop: Loop, equalities: Iterable[str], joints: Collection[str]) -> None:
    """Add which coordinates of a loop follow; several of them may belong to one of the joints."""
    listed = Tag("tuple", {"name": f"{LOOP}{loop.name}"})
    for name in equalities:
        listed.add("element", objtype="equality", objname=name)
    for names, follows in ((loop.free, 0), (loop.dependent, 1)):
        paths = [parse_symbol_name(name)[0] for name in names]
        owners = [path if path in joints else path.rpartition("/")[0] for path in paths]
        for joint in dict.fromkeys(owners):
            listed.add("element", objtype="joint", objname=joint, prm=follows)
    custom.inside.append(_as_it_can_be(listed))


def _as_it_can_be(listed: Tag) -> Tag:
    """Return a tuple, as a text where there are names with spaces: MuJoCo takes each for several."""
    if all(len(tag.attributes["objname"].split()) == 1 for tag in listed.inside):
        return listed
    elements = [[tag.attributes.get(key, "0") for key in ELEMENT] for tag in listed.inside]
    return Tag("text", {"name": listed.attributes["name"], "data": json.dumps(elements, ensure_ascii=False)})


def interval(lower: float, upper: float) -> str:
    """Return the ends of an interval as text, which may be infinite."""
    return " ".join(
        "inf" if end == math.inf else "-inf" if end == -math.inf else repr(end) for end in (lower, upper)
    )
