"""Layout of documents, as typed structs: msgspec decodes and checks them, in msgpack and in JSON alike.

A node is a list that begins with its type; references are the places of earlier nodes in the table of the
same operation. Bodies have the layout of their classes (:mod:`kineverse.model.body`). ``docs/documents.md``
says what the parts mean.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, TypeAlias

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType, field

from kineverse.model.body import Body, Finite, Pose, Vector3

from .budget import MAX_LENGTH, MAX_NODES, MAX_ORDER, MAX_PATH, MAX_QUESTIONS, MAX_STEPS

FORMAT: Final = "kineverse"
VERSION: Final = 2

Number: TypeAlias = Finite | Literal["inf", "-inf"]
Ref: TypeAlias = Annotated[int, Meta(ge=0, lt=MAX_NODES)]
Refs: TypeAlias = tuple[Ref, ...]
Length: TypeAlias = Annotated[int, Meta(ge=0, le=MAX_LENGTH)]
Count: TypeAlias = Annotated[int, Meta(ge=0, le=MAX_QUESTIONS)]
Order: TypeAlias = Annotated[int, Meta(ge=0, le=MAX_ORDER)]
Steps: TypeAlias = Annotated[int, Meta(ge=0, le=MAX_STEPS)]
GradientSteps: TypeAlias = Annotated[tuple[tuple[Ref, bool], ...], Meta(max_length=MAX_PATH)]
Pairs: TypeAlias = tuple[tuple[Ref, Ref], ...]  # of a symbol and an expression
Digest: TypeAlias = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]


class NodeValue(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Node of a table of expressions."""


class ConstantNode(NodeValue, frozen=True, tag="constant"):
    """A number."""

    value: Number


class SymbolNode(NodeValue, frozen=True, tag="symbol"):
    """A symbol that is no parameter."""

    path: str
    order: Order
    role: Literal["dof", "contact", "location"]


class ParameterNode(NodeValue, frozen=True, tag="parameter"):
    """A parameter with its default value."""

    path: str
    value: Number


class ElementaryNode(NodeValue, frozen=True, tag="elementary"):
    """An elementary function of scalars."""

    function: str
    arguments: Refs


class ElementNode(NodeValue, frozen=True, tag="element"):
    """An element of an array, in C order."""

    array: Ref
    index: Length


class MatrixNode(NodeValue, frozen=True, tag="matrix"):
    """An array in C order; null is a zero that is not stored."""

    shape: tuple[Length, ...]
    elements: tuple[Ref | None, ...]


class RotationNode(NodeValue, frozen=True, tag="rotation"):
    """A 4×4 rotation about a coordinate axis by an angle [rad]."""

    axis: Vector3
    angle: Ref


class TranslationNode(NodeValue, frozen=True, tag="translation"):
    """A 4×4 translation along a unit vector by a distance [m]."""

    direction: Vector3
    distance: Ref


class AugmentNode(NodeValue, frozen=True, tag="augment"):
    """A value with given entries of its gradient."""

    value: Ref
    replace: bool
    heuristic: bool
    entries: Pairs


class LessNode(NodeValue, frozen=True, tag="less"):
    """A continuous comparison."""

    left: Ref
    right: Ref
    contrast: Finite


class NotNode(NodeValue, frozen=True, tag="not"):
    """A negation."""

    argument: Ref


class AndNode(NodeValue, frozen=True, tag="and"):
    """A conjunction."""

    arguments: Refs


class OrNode(NodeValue, frozen=True, tag="or"):
    """A disjunction."""

    arguments: Refs


class SelectNode(NodeValue, frozen=True, tag="select"):
    """A choice, element by element."""

    condition: Ref
    chosen: Ref
    otherwise: Ref


class ExtremumNode(NodeValue, frozen=True, tag="extremum"):
    """The smallest or largest of several values, element by element."""

    which: Literal["min", "max"]
    arguments: Annotated[Refs, Meta(min_length=2)]


class NormNode(NodeValue, frozen=True, tag="norm"):
    """The Euclidean norm of a vector."""

    argument: Ref


class PiecewiseNode(NodeValue, frozen=True, tag="piecewise"):
    """A polynomial for each piece between knots."""

    argument: Ref
    periodic: bool
    knots: tuple[Finite, ...]
    pieces: tuple[tuple[Finite, ...], ...]


class CarriedNode(NodeValue, frozen=True, tag="carried"):
    """A coordinate with the table of rates that moves it."""

    coordinate: Ref
    rates: tuple[tuple[Ref, Pairs], ...]


class ComposedNode(NodeValue, frozen=True, tag="composed"):
    """A carried coordinate after a substitution."""

    coordinate: Ref
    replacements: Pairs


class DependentNode(NodeValue, frozen=True, tag="dependent"):
    """A coordinate that is an expression of others."""

    value: Ref
    coordinate: Ref


class ImplicitNode(NodeValue, frozen=True, tag="implicit"):
    """An implicit function, solved by Newton steps, at arguments."""

    name: str
    unknowns: Refs
    inputs: Refs
    residual: Ref
    rows: tuple[Length, ...]
    seed: Ref
    steps: Steps
    arguments: Refs
    domain: tuple[tuple[Number, Number], ...]


class ReadNodeValue(NodeValue, frozen=True, tag="read"):
    """A part of the answer to a question, or an entry of its gradient."""

    question: Count
    part: Count
    shape: tuple[Length, ...]
    path: GradientSteps


AnyNode: TypeAlias = (
    ConstantNode
    | SymbolNode
    | ParameterNode
    | ElementaryNode
    | ElementNode
    | MatrixNode
    | RotationNode
    | TranslationNode
    | AugmentNode
    | LessNode
    | NotNode
    | AndNode
    | OrNode
    | SelectNode
    | ExtremumNode
    | NormNode
    | PiecewiseNode
    | CarriedNode
    | ComposedNode
    | DependentNode
    | ImplicitNode
    | ReadNodeValue
)


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
    folders: dict[str, dict[str, tuple[Length, ...]]] = field(default_factory=dict)
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
    """
    content = msgspec.json.schema(Document)
    for name in ("folder", "root", "content"):  # parts of a mesh in memory
        del content["$defs"]["Mesh"]["properties"][name]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"Kineverse document, version {VERSION}",
        **content,
    }
