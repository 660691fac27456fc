"""Parameters of operations in documents, and the frozen names of classes.

Parameters document an operation, are compared in differences, and rebuild it. They are data as under
``data``, poses (``{"pose": [12 numbers]}``), mappings (``{"mapping": [[key, value], ...]}``), dataclasses
(``{"record": name, "fields": {...}}``), references to the writes of the operation
(``{"written": "frames/door"}``), and, for everything else, the name of its type (``{"unwritten": name}``).
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any

import msgspec

from kineverse.errors import FormatError, KineverseError
from kineverse.expressions.expression import Expression
from kineverse.model.body import Mesh, Pose
from kineverse.model.operation import Cell, Operation

from .budget import MAX_DEPTH, InvalidDocumentError, check_depth
from .node_graph import NodeGraph
from .values import DATUM_TAGS, Names, Ref, decode_datum, encode_datum, tagged

TAGS = ("pose", "mapping", "record", "written", "unwritten", *DATUM_TAGS)


@dataclass(frozen=True)
class OpaqueRecord:
    """Fields of a dataclass, without the class."""

    kind: str
    fields: tuple[tuple[str, Any], ...]


@dataclass(frozen=True)
class WrittenReference:
    """Reference of a parameter to one of the operation's writes, ``kind/name``."""

    path: str


@dataclass(frozen=True)
class UnsupportedParameter:
    """Parameter that a document cannot carry, of which only the type is known."""

    kind: str


# Modules by the class in them: most are imported once an operation is made again, and not with a document.
CLASSES: Mapping[str, str] = MappingProxyType(
    {
        "Frame": "model.frame",
        "Constraint": "model.constraint",
        "Articulation": "model.articulation",
        **dict.fromkeys(("Body", "Shape", "Inertia", "Box", "Capsule", "Cone"), "model.body"),
        **dict.fromkeys(("Cylinder", "Ellipsoid", "Mesh", "Sphere"), "model.body"),
        **dict.fromkeys(("AddFrame", "Attach", "Constrain", "SetRate", "Write"), "model.basic_operations"),
        **dict.fromkeys(("SetBody", "SetHome", "SoftLimits", "Override"), "model.basic_operations"),
        **dict.fromkeys(("CloseLoop", "LoopConstraint"), "loops"),
        **dict.fromkeys(("Limits", "Fixed", "Revolute", "Continuous", "Prismatic", "Screw"), "articulations"),
        **dict.fromkeys(("Cylindrical", "Planar", "Universal", "Ball", "Floating"), "articulations"),
        **dict.fromkeys(("Gearbox", "RackAndPinion", "Cam", "OmniBase", "Ackermann"), "articulations"),
        **dict.fromkeys(("DifferentialDrive", "Mecanum", "DeskLamp", "DoorWithHandle"), "articulations"),
        **dict.fromkeys(("Faucet", "FoldingDoor", "GarageDoor", "Latch", "Microwave"), "articulations"),
        **dict.fromkeys(("PedalBin", "PistonAndRod", "Ratchet", "ScissorLift"), "articulations"),
        "ScrewAndNut": "articulations",
    }
)
"""Classes that documents are rebuilt with, by their frozen names: operations, and records in parameters."""

_RENAMED = {"Write": "SetData"}


def find_class(name: str) -> type | None:
    """Return the class of a frozen name; None for the name of a class of others."""
    if name not in CLASSES:
        return None
    module = importlib.import_module(f"kineverse.{CLASSES[name]}")
    found: type = getattr(module, _RENAMED.get(name, name))
    return found


def document_kind(kind: type) -> str:
    """Return the name that documents have for a class: frozen for those that ship, else that of the class."""
    return kind.document_kind if issubclass(kind, Operation) else kind.__name__


@cache
def _fields(kind: Any) -> tuple[str, ...] | None:
    if issubclass(kind, msgspec.Struct):
        # The place of a mesh on this machine is no part of it.
        return kind.__struct_fields__[:2] if kind is Mesh else kind.__struct_fields__
    if not dataclasses.is_dataclass(kind):
        return None
    return tuple(f.name for f in dataclasses.fields(kind) if f.init and f.compare)


def operation_parameters(operation: Operation) -> dict[str, Any]:
    """Return the constructor arguments of an operation by name; none for one that is no dataclass."""
    return {name: getattr(operation, name) for name in _arguments(type(operation))}


@cache
def _arguments(kind: type[Operation]) -> tuple[str, ...]:
    return tuple(f.name for f in dataclasses.fields(kind) if f.init) if dataclasses.is_dataclass(kind) else ()


def encode_parameter(value: Any, written: Mapping[int, str], ref: Ref, depth: int = 0) -> Any:
    """Encode a parameter; ``written`` has the paths of the operation's writes by the id of the value."""
    if value is None or type(value) in (str, bool):
        return value
    if isinstance(value, (int, float, str, Expression)):
        try:
            return encode_datum(value, ref)
        except FormatError:
            return {"unwritten": document_kind(type(value))}
    if isinstance(value, WrittenReference):
        return {"written": value.path}
    if isinstance(value, UnsupportedParameter):
        return {"unwritten": value.kind}
    if depth >= MAX_DEPTH:  # what is deeper is not read
        return {"unwritten": document_kind(type(value))}

    def inner(item: Any) -> Any:
        return encode_parameter(item, written, ref, depth + 1)

    if isinstance(value, (tuple, list)):
        return [inner(item) for item in value]
    if isinstance(value, Pose):
        return {"pose": list(value.rows)}
    if isinstance(value, Mapping):
        pairs = [[inner(key), inner(item)] for key, item in value.items()]
        # What tells keys apart may not be written.
        if len({repr(key) for key, _ in pairs}) < len(pairs):
            return {"unwritten": document_kind(type(value))}
        return {"mapping": pairs}
    # Not so tuples: equal ones are one object in some programs, and several in others.
    if id(value) in written:
        return {"written": written[id(value)]}
    if isinstance(value, OpaqueRecord):
        return {"record": [value.kind, {key: inner(item) for key, item in value.fields}]}
    kind: Any = type(value)
    names = _fields(kind)
    if names is None:
        return {"unwritten": document_kind(kind)}
    return {"record": [document_kind(kind), {name: inner(getattr(value, name)) for name in names}]}


def rebuild_parameter(value: Any, writes: Mapping[str, Any]) -> Any:
    """Rebuild a constructor argument from a decoded parameter."""
    if isinstance(value, tuple):
        return tuple(rebuild_parameter(item, writes) for item in value)
    if isinstance(value, dict):
        return {
            rebuild_parameter(key, writes): rebuild_parameter(item, writes) for key, item in value.items()
        }
    if isinstance(value, WrittenReference):
        return writes.get(value.path, value)
    if isinstance(value, OpaqueRecord) and (kind := find_class(value.kind)) is not None:
        try:
            return kind(**{name: rebuild_parameter(item, writes) for name, item in value.fields})
        except (TypeError, KineverseError):  # a user's class of the same name
            return value
    return value


def decode_parameter(
    value: Any, graph: NodeGraph, names: Names, written: Mapping[Cell, Any], depth: int = 0
) -> Any:
    """Decode a parameter."""
    if type(value) is not list and type(value) is not dict:
        return decode_datum(value, graph)

    def inner(item: Any) -> Any:
        return decode_parameter(item, graph, names, written, depth + 1)

    check_depth(depth)
    graph.budget.spend(len(value))
    if type(value) is list:
        return tuple([inner(item) for item in value])
    tag, content = tagged(value, TAGS)
    if tag in DATUM_TAGS:
        return decode_datum(value, graph)
    try:
        if tag == "pose":
            return msgspec.convert([content], Pose)
        if tag == "mapping":
            pairs = msgspec.convert(content, tuple[tuple[Any, Any], ...])
            mapping = {inner(key): inner(item) for key, item in pairs}
            if len(mapping) < len(pairs):
                raise InvalidDocumentError("a mapping has two keys that are equal")
            return mapping
        if tag == "record":
            kind, given = msgspec.convert(content, tuple[str, dict[str, Any]])
            return OpaqueRecord(kind, tuple((key, inner(item)) for key, item in given.items()))
        text = msgspec.convert(content, str)
    except msgspec.ValidationError as error:
        raise InvalidDocumentError(str(error) if tag == "pose" else f"it is no {tag}: {error}") from None
    except TypeError:
        raise InvalidDocumentError("a mapping has keys that cannot be compared") from None
    if tag == "unwritten":
        return UnsupportedParameter(text)
    cell = names.path_cell(text)
    if cell not in written:
        raise InvalidDocumentError(f"{text[:60]!r} is not among the values that it writes")
    return WrittenReference("/".join(cell))
