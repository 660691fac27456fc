"""Parts of a URDF that a model does not say, kept for writing it as URDF again.

Kept are the names of robot and materials, and elements that are no part of the kinematics, such as
``<transmission>``, ``<gazebo>``, ``<ros2_control>``, and ``<calibration>`` in a joint. An element is kept as
its text. It may name links and joints: as the value or text of what is called a joint, link, frame, body,
parent, child, reference or mimic. These names follow the prefix of the model, and an element that names what
the model no longer has is not written.
"""

from __future__ import annotations

import html
import re
from collections.abc import Container, Iterable, Iterator, Mapping
from typing import Any

import msgspec
from msgspec import Struct

from kineverse.formats.names import drop_empty_parts
from kineverse.formats.xml_reader import Element
from kineverse.formats.xml_writer import Tag, escape_attribute
from kineverse.model.body import Rgba

DATUM = "urdf"  # last part of the name of the datum, behind the name of a link

KNOWN_PARTS: Mapping[str, frozenset[str]] = {
    "robot": frozenset(("link", "joint", "material")),
    "link": frozenset(("visual", "collision", "inertial")),
    "joint": frozenset(
        ("origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "safety_controller")
    ),
}
"""Elements of a URDF that a model says, by the element that they are in."""


class _Record(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Record that is a list in a document."""


class KeptMaterial(_Record, frozen=True):
    """Material that the robot defines; ``color`` and ``texture`` are None and empty if it only names it."""

    name: str
    color: Rgba | None = None
    texture: str = ""


class KeptElement(_Record, frozen=True):
    """Element of a robot, a link or a joint as text."""

    place: str  # robot, link or joint
    owner: str  # name of the link or joint in the file
    text: str


class KeptParts(_Record, frozen=True, tag=DATUM):
    """Parts of one URDF that its model does not say.

    ``robot`` is the name of the robot, and ``anchor`` the link that the datum is named for. ``visuals`` has
    for each link the name of the material of each visual, and whether it is defined there. ``names`` are the
    links and joints of the file that occur in elements, and ``renamed`` those that have another name in the
    model.
    """

    robot: str
    anchor: str = ""
    namespaces: tuple[tuple[str, str], ...] = ()
    materials: tuple[KeptMaterial, ...] = ()
    visuals: tuple[tuple[str, tuple[tuple[str, bool], ...]], ...] = ()
    elements: tuple[KeptElement, ...] = ()
    names: tuple[str, ...] = ()
    renamed: tuple[tuple[str, str], ...] = ()

    def as_datum(self) -> Any:
        """Return the parts as texts, numbers and lists of these, which a document can hold."""
        return _as_tuples(msgspec.to_builtins(self))


def _as_tuples(value: Any) -> Any:
    return tuple(map(_as_tuples, value)) if isinstance(value, (list, tuple)) else value


def read_kept_parts(data: Mapping[str, Any]) -> Iterator[tuple[str, str, KeptParts]]:
    """Yield the kept parts among the data of a model, with their names and the prefix of their links."""
    for name, value in data.items():
        if not isinstance(value, tuple) or value[:1] != (DATUM,):
            continue
        try:
            parts = msgspec.convert(value, KeptParts)
        except msgspec.ValidationError:
            continue
        own = f"{parts.anchor}/{DATUM}"
        if name == own or name.endswith(f"/{own}"):
            yield name, name.removesuffix(own), parts


# -- reading -------------------------------------------------------------------------------------------------

_TOKEN = re.compile(
    r"<(?:!--.*?-->|!\[CDATA\[.*?\]\]>|\?.*?\?>"
    r"|(?P<end>/)?(?P<tag>[^\s/>!?]+)(?P<attributes>[^>\"']*(?:\"[^\"]*\"[^>\"']*|'[^']*'[^>\"']*)*)>)",
    re.DOTALL,
)
_ATTRIBUTE = re.compile(r"([^\s=/]+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")
_REFERRING = re.compile("joint|link|frame|body|parent|child|reference|mimic", re.IGNORECASE)
_TEXT = re.compile(r"[^<]*")
_WORDS = re.compile(r"(?<=[\"'>])[^\"'<>]+")


def find_elements(text: str, owners: Container[tuple[str, str]], skipped: str) -> Iterator[KeptElement]:
    """Yield the elements of a well-formed URDF that no model says, in their order.

    ``owners`` are the tags and names of the links and joints that have such elements, and ``skipped`` is the
    prefix of elements that are not kept.
    """
    depth, place, owner = 0, "robot", ""
    token = _TOKEN.search(text)
    while token is not None:
        tag, end = token["tag"], token.end()
        if tag is not None:
            is_open = token["end"] is None and not token["attributes"].endswith("/")
            if token["end"] is not None:
                depth -= 1
            elif depth == 1 and tag in KNOWN_PARTS["robot"]:
                place, owner = tag, _name(token["attributes"])
                if is_open and (tag, owner) not in owners:
                    end, is_open = _end_of(text, token), False
            elif depth in (1, 2) and tag not in KNOWN_PARTS.get(place if depth == 2 else "robot", ()):
                end, is_open = _end_of(text, token) if is_open else end, False
                if not tag.startswith(skipped):
                    inside = ("robot", "") if depth == 1 else (place, owner)
                    yield KeptElement(*inside, text[token.start() : end])
            depth += is_open
        token = _TOKEN.search(text, end)


def _end_of(text: str, token: re.Match[str]) -> int:
    """Return the end of the element that a tag opens."""
    tag = token["tag"]
    end = text.find(f"</{tag}", token.end())
    inside = text[token.end() : end]
    if end >= 0 and "<!" not in inside and f"<{tag}" not in inside:
        return text.index(">", end) + 1
    depth = 1
    for later in _TOKEN.finditer(text, token.end()):
        if later["tag"] is not None:
            depth += -1 if later["end"] else not later["attributes"].endswith("/")
            if not depth:
                return later.end()
    return len(text)


def find_occurring(elements: Iterable[KeptElement], names: Iterable[str]) -> tuple[str, ...]:
    """Return the names that are values of attributes or texts in some element."""
    words: set[str] = set()
    for element in elements:
        words.update(map(html.unescape, _WORDS.findall(element.text)))
    return tuple(name for name in names if name in words)


def find_references(text: str) -> Iterator[tuple[int, int, str]]:
    """Yield the places and values of attributes and texts of an element that may name links and joints."""
    is_reference = False  # True if the text of the open element is one
    for token in _TOKEN.finditer(text):
        tag, named = token["tag"], ""
        if token["end"] is not None:
            is_reference = False
            continue
        for found in _ATTRIBUTE.finditer(token["attributes"] or ""):
            group = 2 if found[2] is not None else 3
            named = found[group] if found[1] == "name" else named
            if _REFERRING.search(tag if found[1] in ("name", "value") else found[1]):
                at = token.start("attributes")
                yield at + found.start(group), at + found.end(group), html.unescape(found[group])
        if tag is not None:  # else a comment, behind which the text goes on
            is_open = not token["attributes"].endswith("/")
            is_reference = is_open and _REFERRING.search(f"{tag} {named}") is not None
        inside = _TEXT.match(text, token.end())
        if is_reference and inside and inside[0].strip():
            word = inside[0].strip()
            begin = inside.start() + inside[0].index(word)
            yield begin, begin + len(word), html.unescape(word)


def _name(attributes: str) -> str:
    return next(
        (html.unescape(m[2] or m[3] or "") for m in _ATTRIBUTE.finditer(attributes) if m[1] == "name"), ""
    )


def has_unknown_parts(element: Element) -> bool:
    """Return whether a link or a joint has a part that no model says."""
    known = KNOWN_PARTS[element[0]]
    return any(part[0] not in known for part in element[2])


# -- writing -------------------------------------------------------------------------------------------------


class KeptPartsWriter:
    """Writer of the kept parts of the URDFs of a model."""

    def __init__(self, data: Mapping[str, Any]) -> None:
        self._parts = [(prefix, parts) for _, prefix, parts in read_kept_parts(data)]
        self._materials: dict[str, tuple[str, bool]] = {}
        self._visuals: dict[str, tuple[tuple[str, bool], ...]] = {}
        for prefix, parts in self._parts:
            for link, materials in parts.visuals:
                self._visuals[self._name(prefix, parts, link)] = materials

    @property
    def robot(self) -> str:
        """Name of the robot; empty if the model is that of no URDF, or of several."""
        return self._parts[0][1].robot if len(self._parts) == 1 else ""

    @property
    def namespaces(self) -> dict[str, str]:
        """Declarations of the prefixes of elements."""
        return {key: value for _, parts in self._parts for key, value in parts.namespaces}

    @property
    def materials(self) -> Iterator[KeptMaterial]:
        """Materials that the robots define, the first of each name."""
        seen: set[str] = set()
        for _, parts in self._parts:
            for material in parts.materials:
                if material.name not in seen:
                    seen.add(material.name)
                    yield material

    def visual_material(self, link: str, index: int) -> tuple[str, bool]:
        """Return the name of the material of a visual, and whether it was defined there; empty for none."""
        materials = self._visuals.get(link, ())
        return materials[index] if index < len(materials) else ("", False)

    def add_elements(self, root: Tag) -> Iterator[str]:
        """Add the kept elements to a robot whose links and joints are there; yield remarks."""
        owners = {(tag.name, tag.attributes["name"]): tag for tag in root.inside if "name" in tag.attributes}
        names = {name for kind, name in owners if kind in ("link", "joint")}
        for prefix, parts in self._parts:
            lost: dict[str, list[str]] = {}
            known = set(parts.names)
            for element in parts.elements:
                named = (value for _, _, value in find_references(element.text) if value in known)
                mapping = {name: self._name(prefix, parts, name) for name in named}
                place = root
                if element.place != "robot":
                    owner = self._name(prefix, parts, element.owner)
                    mapping.setdefault(element.owner, owner)
                    place = owners.get((element.place, owner), root)
                missing = next((new for new in mapping.values() if new not in names), None)
                if missing is None:
                    text = _renamed(element.text, mapping, prefix if place is root else "")
                    place.inside.append(Tag("", verbatim=text))
                else:
                    lost.setdefault(missing, []).append(_tag(element.text))
            for name, tags in lost.items():
                shown = ", ".join(f"<{tag}>" for tag in dict.fromkeys(tags))
                yield f"'{name}' is gone, and so is what the URDF that was read says of it: {shown}"

    @staticmethod
    def _name(prefix: str, parts: KeptParts, name: str) -> str:
        return prefix + dict(parts.renamed).get(name, drop_empty_parts(name))


def describe_elements(data: Mapping[str, Any]) -> str:
    """Return the kinds and numbers of kept elements, for a remark; empty if there are none."""
    counts: dict[str, int] = {}
    for _, _, parts in read_kept_parts(data):
        for element in parts.elements:
            counts[_tag(element.text)] = counts.get(_tag(element.text), 0) + 1
    return ", ".join(f"{count} <{tag}>" for tag, count in counts.items())


def _tag(text: str) -> str:
    token = _TOKEN.match(text)
    return token["tag"] if token and token["tag"] else "element"


def _renamed(text: str, mapping: Mapping[str, str], prefix: str) -> str:
    """Return an element with the names of links and joints replaced, and its own name below a prefix."""
    changes: Iterable[tuple[int, int, str]] = [
        (start, end, mapping[value])
        for start, end, value in find_references(text)
        if mapping.get(value, value) != value
    ]
    if prefix:
        token = _TOKEN.match(text)
        assert token is not None
        for found in _ATTRIBUTE.finditer(token["attributes"]):
            group = 2 if found[2] is not None else 3
            start = token.start("attributes") + found.start(group)
            if found[1] == "name" and all(start != begin for begin, _, _ in changes):
                end = token.start("attributes") + found.end(group)
                changes = [*changes, (start, end, prefix + html.unescape(found[group]))]
    for start, end, new in sorted(changes, reverse=True):
        text = text[:start] + escape_attribute(new) + text[end:]
    return text
