"""Layout of documents, as typed structs: msgspec decodes and checks them, in msgpack and in JSON alike.

A node is a list that begins with its type; references are the places of earlier nodes in the table of the
same operation. Bodies have the layout of their classes (:mod:`kineverse.model.body`). ``docs/documents.md``
says what the parts mean.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeAlias, Union

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType, field

from kineverse.model.body import Body, Finite, Pose, Vector3

from .budget import MAX_LENGTH, MAX_NODES, MAX_ORDER, MAX_PATH, MAX_QUESTIONS, MAX_STEPS

FORMAT: Final = "kineverse"
VERSION: Final = 2

Number: TypeAlias = Finite | Literal["inf", "-inf"]
Ref: TypeAlias = Annotated[int, Meta(ge=0, lt=MAX_NODES)]
Refs: TypeAlias = tuple[Ref, ...]
Numbers: TypeAlias = tuple[Finite, ...]
Length: TypeAlias = Annotated[int, Meta(ge=0, le=MAX_LENGTH)]
Count: TypeAlias = Annotated[int, Meta(ge=0, le=MAX_QUESTIONS)]
Order: TypeAlias = Annotated[int, Meta(ge=0, le=MAX_ORDER)]
Steps: TypeAlias = Annotated[int, Meta(ge=0, le=MAX_STEPS)]
GradientSteps: TypeAlias = Annotated[tuple[tuple[Ref, bool], ...], Meta(max_length=MAX_PATH)]
Pairs: TypeAlias = tuple[tuple[Ref, Ref], ...]  # of a symbol and an expression
# The pattern alone allows a line end after it.
Digest: TypeAlias = Annotated[str, Meta(pattern="^[0-9a-f]{64}$", max_length=64)]
Folder: TypeAlias = Annotated[str, Meta(pattern="^[^\\x00]*$")]

_NODE_FIELDS: Mapping[str, Mapping[str, Any]] = {
    "constant": {"value": Number},
    "symbol": {"path": str, "order": Order, "role": Literal["dof", "contact", "location"]},
    "parameter": {"path": str, "value": Number},
    "elementary": {"function": str, "arguments": Refs},
    "element": {"array": Ref, "index": Length},
    "matrix": {"shape": tuple[Length, ...], "elements": tuple[Ref | None, ...]},
    "rotation": {"axis": Vector3, "angle": Ref},
    "translation": {"direction": Vector3, "distance": Ref},
    "augment": {"value": Ref, "replace": bool, "heuristic": bool, "entries": Pairs},
    "less": {"left": Ref, "right": Ref, "contrast": Finite},
    "not": {"argument": Ref},
    "and": {"arguments": Refs},
    "or": {"arguments": Refs},
    "select": {"condition": Ref, "chosen": Ref, "otherwise": Ref},
    "extremum": {"which": Literal["min", "max"], "arguments": Annotated[Refs, Meta(min_length=2)]},
    "norm": {"argument": Ref},
    "piecewise": {"argument": Ref, "periodic": bool, "knots": Numbers, "pieces": tuple[Numbers, ...]},
    "carried": {"coordinate": Ref, "rates": tuple[tuple[Ref, Pairs], ...]},
    "composed": {"coordinate": Ref, "replacements": Pairs},
    "dependent": {"value": Ref, "coordinate": Ref},
    "implicit": {
        **{"name": str, "unknowns": Refs, "inputs": Refs, "residual": Ref, "rows": tuple[Length, ...]},
        **{"seed": Ref, "steps": Steps, "arguments": Refs, "domain": tuple[tuple[Number, Number], ...]},
    },
    "read": {"question": Count, "part": Count, "shape": tuple[Length, ...], "path": GradientSteps},
}

NODES: Mapping[str, type[Struct]] = {
    tag: msgspec.defstruct(
        tag, list(fields.items()), frozen=True, array_like=True, forbid_unknown_fields=True, tag=tag
    )
    for tag, fields in _NODE_FIELDS.items()
}
"""Types of nodes by name: lists of the name and the fields."""

if TYPE_CHECKING:
    AnyNode: TypeAlias = Struct
else:
    AnyNode = Union[tuple(NODES.values())]  # noqa: UP007


class _Part(Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """Part of an operation: an object without members that have their default."""


class ReadsValue(_Part, frozen=True):
    """Paths kind/name that an operation has read, and kinds whose names it has listed."""

    existence: tuple[str, ...] = ()
    value: tuple[str, ...] = ()
    listing: tuple[str, ...] = ()


class FrameValue(_Part, frozen=True):
    """A frame: each factor of its transform is a pose or the place of an expression."""

    parent: str
    factors: tuple[Pose | Ref, ...]


class ArticulationValue(_Part, frozen=True):
    """Record of an articulation."""

    kind: str
    parent: str
    child: str
    coordinates: Refs = ()
    home: tuple[Finite, ...] = ()
    speeds: Refs = ()
    dynamics: tuple[tuple[str, Any], ...] = ()
    follows: Ref | None = None


class WritesValue(_Part, frozen=True):
    """Writes of an operation, by kind and name."""

    frames: dict[str, FrameValue] = field(default_factory=dict)
    bodies: dict[str, Body] = field(default_factory=dict)
    articulations: dict[str, ArticulationValue] = field(default_factory=dict)
    constraints: dict[str, tuple[Ref, Ref, Ref]] = field(default_factory=dict)
    rates: dict[str, tuple[Ref, Ref | Pairs]] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=dict)


class TraceValue(_Part, frozen=True):
    """Questions of an operation to the model, and its writes as expressions of the answers."""

    questions: Annotated[tuple[tuple[Any, ...], ...], Meta(max_length=MAX_QUESTIONS)]
    writes: WritesValue


class OperationValue(_Part, frozen=True, kw_only=True):
    """An operation: the content of a blob."""

    tag: Annotated[str, Meta(min_length=1)]
    kind: str
    nodes: tuple[AnyNode, ...] = ()
    parameters: dict[str, Any] = field(default_factory=dict)
    reads: ReadsValue | None = None
    writes: WritesValue
    trace: TraceValue | None = None
    frozen: str = ""
    below: str = ""


class Resource(_Part, frozen=True):
    """File that bodies refer to, by its address in them and their folder: digest (SHA-256) and size."""

    uri: str
    sha256: Digest
    size: Annotated[int, Meta(ge=0, lt=1 << 62)]
    folder: str = ""


class Envelope(_Part, frozen=True, kw_only=True):
    """A document, with operations that are not decoded yet."""

    format: Literal["kineverse"]
    version: Literal[2]
    operations: Annotated[list[msgspec.Raw], Meta(max_length=MAX_NODES)]
    folders: dict[Folder, dict[str, tuple[Length, ...]]] = field(default_factory=dict)
    resources: tuple[Resource, ...] = ()
    sha256: Digest | UnsetType = UNSET


class Document(Envelope, frozen=True, kw_only=True):
    """A document with its operations, for the schema."""

    operations: tuple[OperationValue, ...]  # type: ignore[assignment]


class Header(Struct, frozen=True):
    """Beginning of any document, for errors about documents of other versions."""

    format: Any = None
    version: Any = None


def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of documents.

    It defines the parts of a document. Only the reader checks that references are to earlier nodes, shapes,
    limits on size and work, and the hash.

    Examples
    --------
    >>> schema = kv.formats.document.schema()
    >>> schema["$schema"]
    'https://json-schema.org/draft/2020-12/schema'
    """
    content = msgspec.json.schema(Document)
    for name in ("folder", "root", "content"):  # parts of a mesh in memory
        del content["$defs"]["Mesh"]["properties"][name]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"Kineverse document, version {VERSION}",
        **content,
    }
