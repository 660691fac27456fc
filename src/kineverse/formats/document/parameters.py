"""Parameters of operations as JSON values, and the frozen names of classes in documents.

Parameters document an operation, are compared in differences, and rebuild it. They are data as under
``data``, poses (``{"pose": [12 numbers]}``), mappings (``{"mapping": [[key, value], ...]}``), dataclasses
(``{"record": name, "fields": {...}}``), references to the writes of the operation
(``{"written": "frames/door"}``), and, for everything else, the name of its type (``{"unwritten": name}``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from kineverse import articulations as a
from kineverse.errors import FormatError, KineverseError
from kineverse.expressions.expression import Expression
from kineverse.loops import CloseLoop, LoopConstraint
from kineverse.model.articulation import Articulation
from kineverse.model.basic_operations import AddFrame, Attach, Constrain, SetData, SetRate
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
from kineverse.model.frame import Frame
from kineverse.model.operation import Cell, Operation

from .budget import MAX_DEPTH, check_depth
from .json_values import InvalidDocumentError, check_keys, check_length, check_list, check_text
from .node_graph import NodeGraph
from .values import DATUM_TAGS, Ref, Rename, decode_datum, decode_pose, encode_datum, encode_pose

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


_OPERATIONS: tuple[type[Operation], ...] = (
    *(AddFrame, Attach, Constrain, SetRate, SetData, CloseLoop, LoopConstraint),
    *(a.Fixed, a.Revolute, a.Continuous, a.Prismatic, a.Screw, a.Cylindrical),
    *(a.Planar, a.Universal, a.Ball, a.Floating, a.Gearbox, a.RackAndPinion, a.Cam),
    *(a.OmniBase, a.DifferentialDrive, a.Ackermann, a.Mecanum),
    *(a.DeskLamp, a.DoorWithHandle, a.Faucet, a.FoldingDoor, a.GarageDoor, a.Latch, a.Microwave),
    *(a.PedalBin, a.PistonAndRod, a.Ratchet, a.ScissorLift, a.ScrewAndNut),
)

RECORDS: Mapping[str, type] = MappingProxyType(
    {
        "Limits": a.Limits,
        "Frame": Frame,
        "Constraint": Constraint,
        "Articulation": Articulation,
        "Body": Body,
        "Shape": Shape,
        "Inertia": Inertia,
        "Box": Box,
        "Capsule": Capsule,
        "Cone": Cone,
        "Cylinder": Cylinder,
        "Ellipsoid": Ellipsoid,
        "Mesh": Mesh,
        "Sphere": Sphere,
        **{operation.document_kind: operation for operation in _OPERATIONS},
    }
)
"""Classes that a record in a document is rebuilt as, by the frozen name that documents have for them.

Operations are among them, because :class:`kineverse.model.Override` has one as its parameter.
"""

_NAMES = {kind: name for name, kind in RECORDS.items()}


def document_kind(kind: type) -> str:
    """Return the name that documents have for a class: frozen for those that ship, else that of the class."""
    return kind.document_kind if issubclass(kind, Operation) else _NAMES.get(kind, kind.__name__)


def operation_parameters(operation: Operation) -> dict[str, Any]:
    """Return the constructor arguments of an operation by name; none for one that is no dataclass."""
    if not dataclasses.is_dataclass(operation):
        return {}
    return {f.name: getattr(operation, f.name) for f in dataclasses.fields(operation) if f.init}


def expressions_in_parameter(parameter: Any, writes: Mapping[Cell, Any]) -> list[Expression]:
    """Return the expressions in a parameter that :func:`encode_parameter` encodes."""
    result: list[Expression] = []

    def note(expression: Expression) -> int:
        result.append(expression)
        return 0

    encode_parameter(parameter, writes, note)
    return result


def encode_parameter(value: Any, writes: Mapping[Cell, Any], ref: Ref, depth: int = 0) -> Any:
    """Encode a parameter as a JSON value."""

    def inner(item: Any) -> Any:
        return encode_parameter(item, writes, ref, depth + 1)

    if depth > MAX_DEPTH:
        return {"unwritten": document_kind(type(value))}
    if value is None or isinstance(value, (bool, int, float, str, Expression)):
        try:
            return encode_datum(value, ref)
        except FormatError:
            return {"unwritten": document_kind(type(value))}
    if isinstance(value, (tuple, list)):
        return [inner(item) for item in value]
    if isinstance(value, Pose):
        return {"pose": encode_pose(value)}
    if isinstance(value, WrittenReference):
        return {"written": value.path}
    if isinstance(value, UnsupportedParameter):
        return {"unwritten": value.kind}
    if isinstance(value, Mapping):
        return {"mapping": [[inner(key), inner(item)] for key, item in value.items()]}
    for (kind, name), written in writes.items():
        if written is value:
            return {"written": f"{kind}/{name}"}
    if isinstance(value, OpaqueRecord):
        return {"record": value.kind, "fields": {key: inner(item) for key, item in value.fields}}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = {
            f.name: inner(getattr(value, f.name)) for f in dataclasses.fields(value) if f.init and f.compare
        }
        return {"record": document_kind(type(value)), "fields": parts}
    return {"unwritten": document_kind(type(value))}


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
    if isinstance(value, OpaqueRecord) and value.kind in RECORDS:
        try:
            return RECORDS[value.kind](
                **{name: rebuild_parameter(item, writes) for name, item in value.fields}
            )
        except (TypeError, KineverseError):  # a user's class of the same name
            return value
    return value


def decode_parameter(
    value: Any,
    graph: NodeGraph,
    rename: Rename,
    path: Callable[[str], str],
    written: Collection[str],
    depth: int = 0,
) -> Any:
    """Decode a parameter from its JSON value."""

    def inner(item: Any) -> Any:
        return decode_parameter(item, graph, rename, path, written, depth + 1)

    check_depth(depth)
    if type(value) is list:
        return tuple(map(inner, value))
    if type(value) is not dict:
        return decode_datum(value, graph, rename)
    tag = next((tag for tag in TAGS if tag in value), None)
    if tag == "pose":
        return decode_pose(check_keys(value, ("pose",))["pose"])
    if tag == "mapping":
        pairs = [
            check_length(check_list(p, "key and value"), 2)
            for p in check_list(check_keys(value, (tag,))[tag], tag)
        ]
        try:
            return {inner(key): inner(item) for key, item in pairs}
        except TypeError:
            raise InvalidDocumentError("a mapping has keys that cannot be compared") from None
    if tag == "record":
        given = check_keys(value, ("record", "fields"))
        if type(given["fields"]) is not dict:
            raise InvalidDocumentError("the fields of a record are an object")
        parts = tuple((check_text(key), inner(item)) for key, item in given["fields"].items())
        return OpaqueRecord(check_text(given["record"]), parts)
    if tag == "written":
        named = path(check_text(check_keys(value, (tag,))[tag]))
        if named not in written:
            raise InvalidDocumentError(f"{named[:60]!r} is not among the values that it writes")
        return WrittenReference(named)
    if tag == "unwritten":
        return UnsupportedParameter(check_text(check_keys(value, (tag,))[tag]))
    if tag is None:
        raise InvalidDocumentError(f"an object among parameters has one of the keys {', '.join(TAGS)}")
    return decode_datum(value, graph, rename)
