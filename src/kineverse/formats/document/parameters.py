"""What an operation was made with, as JSON values and back; for people, for differences, and to make it anew.

Parameters are data as under ``data``, and beside these poses (``{"pose": [12 numbers]}``), mappings
(``{"mapping": [[key, value], ...]}``), values of dataclasses (``{"record": name, "fields": {...}}``), what
the operation also wrote (``{"written": "frames/door"}``), and, for all else, its type
(``{"unwritten": name}``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from kineverse.errors import FormatError
from kineverse.expressions.expression import Expression
from kineverse.model.body import Pose
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


def read_parameter(
    value: Any, graph: Graph, rename: Rename, path: Callable[[str], str], depth: int = 0
) -> Any:
    """Return a parameter that was written, and lies in so many others.

    Raises
    ------
    RefusedError
        For what is none.
    """

    def inner(item: Any) -> Any:
        return read_parameter(item, graph, rename, path, depth + 1)

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
        return Written(path(string(fields(value, (tag,))[tag])))
    if tag == "unwritten":
        return Unwritten(string(fields(value, (tag,))[tag]))
    if tag is None:
        raise RefusedError(f"an object among parameters has one of the keys {', '.join(TAGS)}")
    return read_datum(value, graph, rename)
