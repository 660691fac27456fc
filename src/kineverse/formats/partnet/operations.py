"""PartNet-Mobility descriptions as model operations.

Each part becomes a frame on the axis of its joint, in the axes of the object with z up, and its joint a
degree of freedom of the same name, both with the part's id behind the name: ``rotation_door_3``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from kineverse.articulations import (
    Continuous,
    Cylindrical,
    Fixed,
    Floating,
    Limits,
    Prismatic,
    Revolute,
    Screw,
)
from kineverse.formats.names import drop_empty_parts
from kineverse.formats.reader_warnings import warn
from kineverse.formats.xml_reader import quote
from kineverse.lie import transform
from kineverse.model.basic_operations import AddFrame, SetBody, SetData
from kineverse.model.body import Body, Mesh, Pose, Shape, Vector3
from kineverse.model.frame import WORLD, Frame
from kineverse.model.operation import Operation
from kineverse.model.registry import FileContent

from .description import NORMALIZED, ROOT, PartNetPart, read_partnet

Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # of points with y up: (x, -z, y)


def partnet_file_operations(file: FileContent) -> Iterator[tuple[str, Operation]]:
    """Yield the operations of a ``mobility_v2.json``, each with its tag."""
    parts = read_partnet(file.content, file.path)
    before = f"{file.prefix}/" if file.prefix else ""
    names = {part.number: before + part_name(part) for part in parts}
    origins: dict[int, Vector3] = {ROOT: (0.0, 0.0, 0.0)}
    roots = [part for part in parts if part.parent == ROOT]
    folder = str(file.path.absolute().parent)
    for part in parts:
        origins[part.number] = part.origin
        parent = WORLD if part.parent == ROOT else names[part.parent]
        place = Pose.from_matrix(
            transform(np.eye(3), np.subtract(part.origin, origins[part.parent]).astype(float))
        )
        is_object = len(roots) == 1 and part.parent == ROOT
        for operation in _joint(part, names[part.number], parent, place, is_object, file.path.name):
            yield operation.default_tag(), operation
        if part.meshes:
            shapes = tuple(_shape(uri, part.origin, folder, file.root) for uri in part.meshes)
            body = SetBody(names[part.number], Body(visuals=shapes, collisions=shapes))
            yield body.default_tag(), body
    data = SetData(before + NORMALIZED, True)
    yield data.default_tag(), data


def part_name(part: PartNetPart) -> str:
    """Return the name of a part with its id."""
    printable = "".join(c if c.isprintable() else "_" for c in drop_empty_parts(part.name))
    return f"{printable or 'part'}_{part.number}"


def _shape(uri: str, origin: Vector3, folder: str, root: str | None) -> Shape:
    """Return a mesh, whose corners are in the axes of the object with y up, in the frame of its part."""
    pose = Pose.from_matrix(transform(Z_UP, -np.array(origin)))
    return Shape(Mesh(uri, folder=folder, root=root), pose)


def _joint(
    part: PartNetPart, name: str, parent: str, origin: Pose, is_object: bool, source: str
) -> Iterator[Operation]:
    common: dict[str, Any] = {"name": name, "parent": parent, "child": name, "origin": origin}
    if part.kind == "free" and not is_object:
        yield Floating(**common)
    elif part.kind in ("free", "fixed"):
        yield AddFrame(name, Frame(parent, (origin,))) if parent == WORLD else Fixed(**common)
    elif part.kind == "hinge":
        yield _hinge(part, common)
    else:
        yield _slider(part, common, source)


def _hinge(part: PartNetPart, common: dict[str, Any]) -> Operation:
    limit = part.limit
    if math.isinf(limit.upper):
        return Continuous(**common, axis=part.direction)
    return Revolute(**common, axis=part.direction, lower=limit.lower, upper=limit.upper)


def _slider(part: PartNetPart, common: dict[str, Any], source: str) -> Operation:
    """Return a slider; a screw where the file says by how much it turns on its way, and how long that is.

    A slider that turns without such a number turns freely.
    """
    limit, axis = part.limit, part.direction
    ends = (None, None) if math.isinf(limit.upper) else (limit.lower, limit.upper)
    if not limit.rotates:
        return Prismatic(**common, axis=axis, lower=ends[0], upper=ends[1])
    way = limit.upper - limit.lower
    if limit.rotation and math.isfinite(way) and way > 0.0:
        pitch = way / (limit.rotation / math.tau)
        turns = sorted(end * math.tau / pitch for end in (limit.lower, limit.upper))
        return Screw(**common, axis=axis, lower=turns[0], upper=turns[1], pitch=pitch)
    warn(
        [
            f"{source}: part {part.number}, {quote(part.name)}, slides and turns, and the file does not "
            "say by how much it turns on its way: it is a cylindrical joint, which does both independently."
        ]
    )
    return Cylindrical(**common, axis=axis, slide=Limits(*ends))
