"""PartNet-Mobility files as checked descriptions.

A ``mobility_v2.json`` is a list of moving parts. Positions are in the axes of the object, y up; angles are in
degrees. ``result.json`` beside it is a tree of the parts of the drawing, whose meshes are in
``textured_objs``. Lengths are not metres: objects are scaled into a ball of radius 1.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeAlias

from kineverse._checks import real_number
from kineverse.errors import FormatError, suggest
from kineverse.formats.files import read_file
from kineverse.formats.reader_warnings import warn
from kineverse.formats.xml_reader import quote
from kineverse.model.body import Vector3

FILE_NAME, RESULT_NAME, MESH_FOLDER = "mobility_v2.json", "result.json", "textured_objs"

NORMALIZED = "geometry/normalized"
"""Name of the data entry of a model, below its prefix, whose lengths are not metres."""

PartNetJointKind: TypeAlias = Literal["hinge", "slider", "slider+", "free", "fixed", "junk"]
KINDS: tuple[PartNetJointKind, ...] = ("hinge", "slider", "slider+", "free", "fixed", "junk")
ROOT = -1  # parent of a root


@dataclass(frozen=True)
class PartNetLimit:
    """Limits of a joint: of the angle [rad] or of the shift, and of the rotation of a slider."""

    lower: float = -math.inf
    upper: float = math.inf
    rotates: bool = False  # True for a slider that also turns
    rotation: float | None = None  # by how much it turns from one end to the other [rad]; None if it is free


@dataclass(frozen=True)
class PartNetPart:
    """Moving part: its joint in its parent, in the axes of the object with z up, and its meshes."""

    number: int
    parent: int  # number of its parent; -1 for a root
    name: str
    kind: PartNetJointKind
    origin: Vector3  # a point of the axis
    direction: Vector3  # of the axis
    limit: PartNetLimit
    meshes: tuple[str, ...]  # files, from the folder of the description


def read_partnet(content: bytes, path: Path) -> list[PartNetPart]:
    """Return the parts of a file, parents first, without junk; the meshes are found beside the file."""
    source = path.name
    entries = _parse(content, source)
    if not isinstance(entries, list) or not entries:
        raise FormatError(f"{source}: it is not the list of the parts of an object.")
    parts: dict[int, PartNetPart] = {}
    objs = _read_objs(path.parent / RESULT_NAME)
    for place, entry in enumerate(entries, start=1):
        part = _Reader(source, place, entry).read(path.parent, objs)
        if part.number in parts:
            raise FormatError(f"{source}: there are two parts with the id {part.number}.")
        parts[part.number] = part
    return _ordered(_without_junk(parts, source), source)


def _parse(content: bytes, source: str) -> Any:
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        reason = "it is nested too deep" if isinstance(error, RecursionError) else error
        raise FormatError(f"{source}: it is not JSON: {reason}.") from None


def _without_junk(parts: Mapping[int, PartNetPart], source: str) -> dict[int, PartNetPart]:
    """Leave out junk; what hangs on it hangs on the parent of the junk."""
    kept: dict[int, PartNetPart] = {}
    for part in parts.values():
        if part.kind == "junk":
            warn([f"{source}: part {part.number}, {quote(part.name)}, is left out: it is junk."])
            continue
        parent, seen = part.parent, set[int]()
        while parent in parts and parts[parent].kind == "junk" and parent not in seen:
            seen.add(parent)
            parent = parts[parent].parent
        kept[part.number] = part if parent == part.parent else replace(part, parent=parent)
    if not kept:
        raise FormatError(f"{source}: all its parts are junk.")
    return kept


def _ordered(parts: Mapping[int, PartNetPart], source: str) -> list[PartNetPart]:
    """Return the parts, parents first."""
    ordered: dict[int, PartNetPart] = {}
    for part in parts.values():
        way = [part]
        while way[-1].parent != ROOT and way[-1].parent not in ordered:
            above = way[-1].parent
            if above not in parts:
                known = ", ".join(map(str, parts))
                raise FormatError(
                    f"{source}: part {way[-1].number} hangs on part {above}, which is not there. "
                    f"Parts: {known}."
                )
            if any(one.number == above for one in way):
                loop = " → ".join(str(one.number) for one in (*way, parts[above]))
                raise FormatError(f"{source}: part {above} hangs on itself: {loop}.")
            way.append(parts[above])
        ordered |= {one.number: one for one in reversed(way)}
    return list(ordered.values())


@dataclass(frozen=True)
class _Reader:
    """Reader of one entry, whose errors name it."""

    source: str
    place: int
    entry: Any

    def read(self, folder: Path, objs: Mapping[int, tuple[str, ...]] | None) -> PartNetPart:
        number, parent = self._integer("id"), self._integer("parent")
        if number < 0:
            self._refuse(f"its id is {number}; ids are from 0 on")
        name = self.entry.get("name", "")
        if not isinstance(name, str):
            self._refuse(f"its name is a text, not {name!r:.60}")
        kind = self.entry.get("joint")
        if kind not in KINDS:
            self._refuse(f"its joint is {kind!r:.60}. {suggest(str(kind), KINDS, 'joint')}")
        joint: PartNetJointKind = kind
        origin: Vector3 = (0.0, 0.0, 0.0)
        direction: Vector3 = (0.0, 0.0, 1.0)
        limit = PartNetLimit()
        if joint in ("hinge", "slider", "slider+"):
            data = self._object(self.entry.get("jointData"), "jointData")
            axis = self._object(data.get("axis"), "axis")
            origin, direction = self._vector(axis, "origin"), self._vector(axis, "direction")
            if not any(direction):
                self._refuse("the direction of its axis is 0")
            limit = self._limit(self._object(data.get("limit", {}), "limit"), joint)
        meshes = tuple(dict.fromkeys(self._meshes(folder, objs))) if objs is not None else ()
        return PartNetPart(number, parent, name, joint, origin, direction, limit, meshes)

    def _limit(self, limit: Mapping[str, Any], kind: PartNetJointKind) -> PartNetLimit:
        unit = math.radians(1.0) if kind == "hinge" else 1.0
        lower, upper = -math.inf, math.inf
        if not self._flag(limit, "noLimit"):
            ends = [self._number(limit.get(end), f"limit {end}") * unit for end in ("a", "b")]
            lower, upper = min(ends), max(ends)
        if kind == "hinge" or not self._flag(limit, "rotates", kind == "slider+"):
            return PartNetLimit(lower, upper)
        if self._flag(limit, "noRotationLimit", "rotationLimit" not in limit):
            return PartNetLimit(lower, upper, rotates=True)
        rotation = math.radians(self._number(limit.get("rotationLimit"), "rotationLimit"))
        return PartNetLimit(lower, upper, rotates=True, rotation=rotation)

    def _meshes(self, folder: Path, objs: Mapping[int, tuple[str, ...]]) -> Iterator[str]:
        parts = self.entry.get("parts", [])
        if not isinstance(parts, list):
            self._refuse("its parts are a list")
        for part in parts:
            number = self._object(part, "parts").get("id")
            if isinstance(number, bool) or not isinstance(number, int):
                self._refuse(f"the id of one of its parts is a whole number, not {number!r:.60}")
            if number not in objs:
                self._say(f"{RESULT_NAME} has no part {number}, so its meshes are missing")
            for name in objs.get(number, ()):
                uri = f"{MESH_FOLDER}/{name}.obj"
                if not (folder / uri).is_file():
                    self._say(f"the mesh {uri} is missing")
                yield uri

    def _integer(self, key: str) -> int:
        entry = self._object(self.entry, "entry")
        value = entry.get(key)
        if isinstance(value, bool) or not isinstance(value, int):
            self._refuse(f"its {key} is a whole number, not {value!r:.60}")
        return int(value)

    def _number(self, value: Any, what: str) -> float:
        try:
            number = real_number(value)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if isinstance(value, bool) or not math.isfinite(number):
            self._refuse(f"its {what} is a finite number, not {value!r:.60}")
        return number

    def _vector(self, axis: Mapping[str, Any], key: str) -> Vector3:
        """Return three numbers in axes with z up: (x, y, z) with y up is (x, -z, y)."""
        given = axis.get(key)
        if not isinstance(given, list) or len(given) != 3:
            self._refuse(f"the {key} of its axis is three numbers, not {given!r:.60}")
        x, y, z = (self._number(value, f"axis {key}") for value in given)
        return x, 0.0 - z, y

    def _flag(self, limit: Mapping[str, Any], key: str, default: bool = False) -> bool:
        value = limit.get(key, default)
        if not isinstance(value, bool):
            self._refuse(f"its {key} is true or false, not {value!r:.60}")
        return bool(value)

    def _object(self, value: Any, what: str) -> Mapping[str, Any]:
        if not isinstance(value, dict):
            self._refuse(f"its {what} is an object with names, not {value!r:.60}")
        result: Mapping[str, Any] = value
        return result

    def _say(self, text: str) -> None:
        warn([f"{self._where}: {text}."])

    def _refuse(self, reason: str) -> NoReturn:
        raise FormatError(f"{self._where}: {reason.rstrip('.')}.")

    @property
    def _where(self) -> str:
        known = self.entry.get("id") if isinstance(self.entry, dict) else None
        return (
            f"{self.source}, part {known}" if isinstance(known, int) else f"{self.source}, entry {self.place}"
        )


def _read_objs(path: Path) -> dict[int, tuple[str, ...]] | None:
    """Return the names of the meshes of each part of the drawing, with those of the parts below it."""
    if not path.is_file():
        warn([f"{path.name} is missing beside {FILE_NAME}, so that no part has a shape."])
        return None
    tree = _parse(read_file(path), path.name)
    found: dict[int, tuple[str, ...]] = {}
    waiting: list[tuple[Any, tuple[int, ...]]] = (
        [(node, ()) for node in tree] if isinstance(tree, list) else []
    )
    if not waiting:
        raise FormatError(f"{path.name}: it is not the list of the parts of a drawing.")
    while waiting:
        node, above = waiting.pop(0)
        number = node.get("id") if isinstance(node, dict) else None
        if isinstance(number, bool) or not isinstance(number, int):
            raise FormatError(f"{path.name}: a part has no whole number as its id: {node!r:.80}.")
        names, children = node.get("objs", []), node.get("children", [])
        if not isinstance(children, list) or not isinstance(names, list):
            raise FormatError(f"{path.name}: part {number}: objs and children are lists.")
        if not all(isinstance(name, str) for name in names):
            raise FormatError(f"{path.name}: part {number}: objs are names of meshes.")
        for one in (*above, number):
            found[one] = tuple(dict.fromkeys((*found.get(one, ()), *names)))
        waiting += [(child, (*above, number)) for child in children]
    return found
