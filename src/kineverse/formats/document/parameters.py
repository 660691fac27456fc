"""What an operation was made with, as JSON values and back; for people, for differences, and to make it anew.

Parameters are data as under ``data``, and beside these poses (``{"pose": [12 numbers]}``), mappings
(``{"mapping": [[key, value], ...]}``), values of dataclasses (``{"record": name, "fields": {...}}``), what
the operation also wrote (``{"written": "frames/door"}``), and, for all else, its type
(``{"unwritten": name}``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from kineverse import articulations
from kineverse.articulations.limits import Limits
from kineverse.errors import FormatError, KineverseError
from kineverse.expressions.expression import Expression
from kineverse.loops import CloseLoop, LoopConstraint
from kineverse.model.articulation import Articulation
from kineverse.model.body import (
    Body,
    Box,
    Capsule,
    Cone,
    Cylinder,
    Ellipsoid,
    Inertia,
    Mesh,
    Pose,
    Shape,
    Sphere,
)
from kineverse.model.constraint import Constraint
from kineverse.model.edit import AddFrame, Attach, Constrain, SetRate, Write
from kineverse.model.frame import Frame
from kineverse.model.operation import Operation
from kineverse.model.reader import Cell

from .checks import RefusedError, exactly, fields, listed, string
from .graph import Graph
from .limits import MAX_DEPTH, check_depth
from .shapes import read_pose, written_pose
from .values import DATUM_TAGS, Ref, Rename, read_datum, written_datum

TAGS = ("pose", "mapping", "record", "written", "unwritten", *DATUM_TAGS)


@dataclass(frozen=True)
class Record:
    """A value of a dataclass that is not at hand."""

    kind: str
    fields: tuple[tuple[str, Any], ...]


@dataclass(frozen=True)
class Written:
    """A parameter that is among the operation's writes, under ``kind/name``."""

    path: str


@dataclass(frozen=True)
class Unwritten:
    """A parameter that a document has no place for; only its type is known."""

    kind: str


def _is_operation(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, Operation)


RECORDS: Mapping[str, type] = MappingProxyType(
    {
        kind.__name__: kind
        for kind in (
            *(Limits, Frame, Constraint, Articulation),
            *(Body, Shape, Inertia, Box, Capsule, Cone, Cylinder, Ellipsoid, Mesh, Sphere),
            *(AddFrame, Attach, Constrain, SetRate, Write, CloseLoop, LoopConstraint),
            *(kind for kind in vars(articulations).values() if _is_operation(kind)),
        )
    }
)
"""What operations that ship are made with, by the name under which a document has it; a closed set.

Operations are among it, since :class:`kineverse.Override` is made with one.
"""


def parameters_of(operation: Operation) -> dict[str, Any]:
    """Return what an operation was made with, by name; empty for one that is no dataclass."""
    if not dataclasses.is_dataclass(operation):
        return {}
    return {f.name: getattr(operation, f.name) for f in dataclasses.fields(operation) if f.init}


def expressions_among(parameter: Any, writes: Mapping[Cell, Any]) -> list[Expression]:
    """Return the expressions that :func:`written_parameter` needs."""
    found: list[Expression] = []

    def note(expression: Expression) -> int:
        found.append(expression)
        return 0

    written_parameter(parameter, writes, note)
    return found


def written_parameter(value: Any, writes: Mapping[Cell, Any], ref: Ref, depth: int = 0) -> Any:
    """Return a parameter as JSON has it, which lies in so many others."""

    def inner(item: Any) -> Any:
        return written_parameter(item, writes, ref, depth + 1)

    if depth > MAX_DEPTH:
        return {"unwritten": type(value).__name__}
    if value is None or isinstance(value, (bool, int, float, str, Expression)):
        try:
            return written_datum(value, ref)
        except FormatError:
            return {"unwritten": type(value).__name__}
    if isinstance(value, (tuple, list)):
        return [inner(item) for item in value]
    if isinstance(value, Pose):
        return {"pose": written_pose(value)}
    if isinstance(value, Written):
        return {"written": value.path}
    if isinstance(value, Unwritten):
        return {"unwritten": value.kind}
    if isinstance(value, Mapping):
        return {"mapping": [[inner(key), inner(item)] for key, item in value.items()]}
    for (kind, name), written in writes.items():
        if written is value:
            return {"written": f"{kind}/{name}"}
    if isinstance(value, Record):
        return {"record": value.kind, "fields": {key: inner(item) for key, item in value.fields}}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = {
            f.name: inner(getattr(value, f.name)) for f in dataclasses.fields(value) if f.init and f.compare
        }
        return {"record": type(value).__name__, "fields": parts}
    return {"unwritten": type(value).__name__}


def made(value: Any, writes: Mapping[str, Any]) -> Any:
    """Return a parameter that was read as what an operation takes.

    Parameters
    ----------
    value
        As :func:`read_parameter` returns it.
    writes
        What the operation wrote, by ``kind/name``.
    """
    if isinstance(value, tuple):
        return tuple(made(item, writes) for item in value)
    if isinstance(value, dict):
        return {made(key, writes): made(item, writes) for key, item in value.items()}
    if isinstance(value, Written):
        return writes.get(value.path, value)
    if isinstance(value, Record) and value.kind in RECORDS:
        try:
            return RECORDS[value.kind](**{name: made(item, writes) for name, item in value.fields})
        except (TypeError, KineverseError):  # it is somebody else's class of the same name
            return value
    return value


def read_parameter(
    value: Any,
    graph: Graph,
    rename: Rename,
    path: Callable[[str], str],
    written: Collection[str],
    depth: int = 0,
) -> Any:
    """Return a parameter as it was given, and lies in so many others.

    Parameters
    ----------
    value
        What stands in the document.
    graph
        The expressions.
    rename
        Puts the document's prefix in front of a name.
    path
        Does so with that of a cell, ``kind/name``.
    written
        The cells that the operation writes, so named.
    depth
        In how many others it lies.

    Raises
    ------
    RefusedError
        For what is none, or said to be among the writes and is not.
    """

    def inner(item: Any) -> Any:
        return read_parameter(item, graph, rename, path, written, depth + 1)

    check_depth(depth)
    if type(value) is list:
        return tuple(map(inner, value))
    if type(value) is not dict:
        return read_datum(value, graph, rename)
    tag = next((tag for tag in TAGS if tag in value), None)
    if tag == "pose":
        return read_pose(fields(value, ("pose",))["pose"])
    if tag == "mapping":
        pairs = [exactly(listed(p, "key and value"), 2) for p in listed(fields(value, (tag,))[tag], tag)]
        try:
            return {inner(key): inner(item) for key, item in pairs}
        except TypeError:
            raise RefusedError("a mapping has keys that cannot be compared") from None
    if tag == "record":
        given = fields(value, ("record", "fields"))
        if type(given["fields"]) is not dict:
            raise RefusedError("the fields of a record are an object")
        parts = tuple((string(key), inner(item)) for key, item in given["fields"].items())
        return Record(string(given["record"]), parts)
    if tag == "written":
        named = path(string(fields(value, (tag,))[tag]))
        if named not in written:
            raise RefusedError(f"{named[:60]!r} is said to be written, and is not")
        return Written(named)
    if tag == "unwritten":
        return Unwritten(string(fields(value, (tag,))[tag]))
    if tag is None:
        raise RefusedError(f"an object among parameters has one of the keys {', '.join(TAGS)}")
    return read_datum(value, graph, rename)
