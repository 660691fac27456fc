"""Values of documents: writes of operations, and data.

A frame has its parent and factors, each a pose or the place of an expression; a constraint is the places of
``[lower, expression, upper]``; a rate is ``[coordinate, [[speed, ref], ...]]``. Data are texts, numbers,
true, false, null and lists of these; an expression is ``{"expression": ref}``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, TypeAlias

from kineverse.errors import FormatError, KineverseError
from kineverse.expressions.expression import Expression
from kineverse.formats.resources import meshes_of, without_places
from kineverse.model.articulation import Articulation, check_home
from kineverse.model.body import Body, Mesh, Pose
from kineverse.model.constraint import Constraint, as_constraint
from kineverse.model.frame import WORLD, Frame
from kineverse.model.operation import ARTICULATIONS, BODIES, CONSTRAINTS, DATA, FRAMES, KINDS, RATES, Cell
from kineverse.model.rates import RateEntry, as_entry
from kineverse.symbols import Symbol, symbol_name

from . import structs
from .budget import MAX_DEPTH, InvalidDocumentError, check_depth
from .node_graph import NodeGraph
from .node_table import encode_number
from .node_types import check_name, decode_number

Ref: TypeAlias = Callable[[Expression], int]

MAX_BITS = 10_000  # length of the longest integer: Python reads no more than 4300 digits
PLAIN_BITS = 63
"""Length of the longest integer that is written as a number; other languages and msgpack end there."""
DATUM_TAGS = ("expression", "float", "integer")
_QUATERNION = 4  # coordinates that an orientation has at least
_INTEGER = re.compile("-?[1-9][0-9]{18,3010}")


# -- writing -------------------------------------------------------------------------------------------------


def encode_writes(tag: str, writes: Mapping[Cell, Any], ref: Ref) -> dict[str, dict[str, Any]]:
    """Encode the writes of an operation."""
    kinds: dict[str, dict[str, Any]] = {kind: {} for kind in KINDS}
    for (kind, name), value in writes.items():
        try:
            kinds[kind][name] = _encode_value(kind, value, ref)
        except FormatError as error:
            noun = "The datum" if kind in (DATA, ARTICULATIONS) else "What is"
            raise FormatError(
                f"{noun} under '{kind}/{name}', written by {tag!r}, has no place in a document: {error}"
            ) from None
    return {kind: values for kind, values in kinds.items() if values}


def _encode_value(kind: str, value: Any, ref: Ref) -> Any:
    if kind == FRAMES:
        return {
            "parent": value.parent,
            "factors": [f if isinstance(f, Pose) else ref(f) for f in value.factors],
        }
    if kind == CONSTRAINTS:
        return ref(value.lower), ref(value.expression), ref(value.upper)
    if kind == RATES:
        coordinate, row = value
        if isinstance(row, Expression):
            return ref(coordinate), ref(row)
        return ref(coordinate), [(ref(speed), ref(entry)) for speed, entry in row]
    if kind == BODIES:
        return without_places(value)
    if kind == ARTICULATIONS:
        return {
            "kind": value.kind,
            "parent": value.parent,
            "child": value.child,
            "coordinates": [ref(s) for s in value.coordinates],
            "home": value.home,
            "speeds": [ref(s) for s in value.speeds],
            "dynamics": [(item, encode_datum(datum, ref)) for item, datum in value.dynamics],
            "follows": None if value.follows is None else ref(value.follows),
        }
    return encode_datum(value, ref)


def encode_datum(value: Any, ref: Ref, depth: int = 0) -> Any:
    """Encode a datum, nested in ``depth`` tuples."""
    if type(value) is int and value.bit_length() > MAX_BITS:
        raise FormatError(f"an integer of {value.bit_length()} bits is too long, of more than {MAX_BITS}")
    if type(value) is int and value.bit_length() > PLAIN_BITS:
        return {"integer": str(value)}
    if value is None or type(value) in (bool, int, str):
        return value
    if isinstance(value, float):  # numpy's float64 is a subclass
        number = float(value)
        return number if math.isfinite(number) else {"float": encode_number(number)}
    if type(value) is tuple:
        if depth > MAX_DEPTH:
            raise FormatError(f"it is nested too deeply, in more than {MAX_DEPTH} others")
        return [encode_datum(item, ref, depth + 1) for item in value]
    if isinstance(value, Expression):
        return {"expression": ref(value)}
    raise FormatError(
        f"a {type(value).__name__} cannot be saved; write texts, numbers, true or false, None, expressions "
        "and tuples of these"
    )


# -- reading -------------------------------------------------------------------------------------------------


class Names:
    """Names of a document below a prefix."""

    def __init__(self, before: str) -> None:
        self.before = before

    def frame(self, name: str) -> str:
        """Return the name of a frame in the model; the world stays the world."""
        check_name(name)
        return name if name == WORLD else self.before + name

    def cell(self, kind: Any, name: Any) -> Cell:
        """Return kind and name in the model; any text is a name, because operations may look up anything."""
        if type(name) is not str:
            raise InvalidDocumentError(f"a text is expected, not {describe_value(name)}")
        if type(kind) is not str or kind not in KINDS:
            raise InvalidDocumentError(
                f"{str(kind)[:40]!r} is not a kind of data; kinds are {', '.join(KINDS)}"
            )
        if kind == RATES and self.before:
            return kind, f"{symbol_name(self.before[:-1], 0)}/{name}"
        return kind, name if kind == FRAMES and name == WORLD else self.before + name

    def path_cell(self, path: str) -> Cell:
        """Return kind and name in the model of a path kind/name."""
        return self.cell(*path.partition("/")[::2])


def decode_writes(
    given: structs.WritesValue, graph: NodeGraph, names: Names, is_trace: bool = False
) -> Iterator[tuple[Cell, Any]]:
    """Yield the writes of an operation or of its trace, in the order of kinds."""
    for kind, decode in _DECODERS.items():
        for name, value in getattr(given, kind).items():
            try:
                cell = names.cell(kind, check_name(name))
                decoded = decode(cell[1], value, graph, names)
                if kind == CONSTRAINTS and not is_trace:
                    if not (decoded.lower.sx.is_constant() and decoded.upper.sx.is_constant()):
                        as_constraint(decoded)  # of a trace, once the values are known
            except (InvalidDocumentError, KineverseError) as error:
                raise InvalidDocumentError(f"writes {kind}/{name[:60]}: {error}") from None
            yield cell, decoded


def _decode_frame(name: str, given: structs.FrameValue, graph: NodeGraph, names: Names) -> Frame:
    factors: list[Pose | Expression] = []
    for factor in given.factors:
        if isinstance(factor, Pose):
            factors.append(factor)
            continue
        transform = graph.expression(factor)
        if transform.shape != (4, 4):
            raise InvalidDocumentError(f"a factor should be 4×4, not of shape {transform.shape}")
        factors.append(transform)
    return Frame(names.frame(given.parent), tuple(factors))


def _decode_body(name: str, given: Body, graph: NodeGraph, names: Names) -> Body:
    for mesh in meshes_of(given):
        if mesh != Mesh(mesh.uri, mesh.scale) or mesh.root is not None or mesh.content is not None:
            raise InvalidDocumentError(f"the mesh {mesh.uri[:60]!r} has more than a uri and a scale")
    return given


def _decode_articulation(
    name: str, given: structs.ArticulationValue, graph: NodeGraph, names: Names
) -> Articulation:
    result = Articulation(
        given.kind,
        names.frame(given.parent),
        names.frame(given.child),
        tuple(map(graph.symbol, given.coordinates)),
        given.home,
        tuple(graph.symbol(ref, 1) for ref in given.speeds),
        tuple((item, decode_datum(datum, graph)) for item, datum in given.dynamics),
        None if given.follows is None else graph.scalar(given.follows),
    )
    if len(given.home) >= _QUATERNION:  # all numbers are finite
        check_home(name, result)
    return result


def _decode_rate(name: str, given: Any, graph: NodeGraph, names: Names) -> tuple[Symbol, RateEntry]:
    coordinate, entry = given
    symbol = graph.symbol(coordinate)
    if str(symbol) != name:
        raise InvalidDocumentError(f"this is the rate of '{symbol}'")
    row = graph.scalar(entry) if isinstance(entry, int) else dict(graph.pairs(entry, 1))
    return symbol, as_entry(symbol, row)


_DECODERS: Mapping[str, Callable[[str, Any, NodeGraph, Names], Any]] = MappingProxyType(
    {
        FRAMES: _decode_frame,
        BODIES: _decode_body,
        ARTICULATIONS: _decode_articulation,
        CONSTRAINTS: lambda name, given, graph, names: Constraint(*map(graph.scalar, given)),
        RATES: _decode_rate,
        DATA: lambda name, given, graph, names: decode_datum(given, graph),
    }
)


def decode_datum(value: Any, graph: NodeGraph, depth: int = 0) -> Any:
    """Decode a datum, nested in ``depth`` lists."""
    if type(value) is list:
        check_depth(depth)
        graph.budget.spend(len(value))
        return tuple([decode_datum(item, graph, depth + 1) for item in value])
    if type(value) is float:
        if not math.isfinite(value):
            raise InvalidDocumentError('a number is infinite; such a datum is {"float": "inf"}')
        return value
    if value is None or type(value) in (bool, str):
        return value
    if type(value) is int:
        if value.bit_length() > PLAIN_BITS:
            raise InvalidDocumentError(
                f'an integer of more than {PLAIN_BITS + 1} bits is {{"integer": "digits"}}'
            )
        return value
    tag, inner = tagged(value, DATUM_TAGS)
    if tag == "expression":
        return graph.expression(inner)
    if tag == "float" and inner in ("inf", "-inf"):
        return decode_number(inner)
    if tag == "integer" and isinstance(inner, str) and _INTEGER.fullmatch(inner):
        if PLAIN_BITS < int(inner).bit_length() <= MAX_BITS:
            return int(inner)
    raise InvalidDocumentError(f"{describe_value(inner)} is no {tag} of a datum")


def tagged(value: Any, tags: tuple[str, ...]) -> tuple[str, Any]:
    """Return tag and content of an object with one key."""
    if type(value) is dict and len(value) == 1:
        ((tag, inner),) = value.items()
        if tag in tags:
            return tag, inner
    raise InvalidDocumentError(
        f"{describe_value(value)}: an object of a datum or parameter has one key, of {', '.join(tags)}"
    )


def describe_value(value: Any) -> str:
    """Return a value as text of limited length for an error."""
    text = repr(value) if isinstance(value, (str, int, float, bool, type(None))) else "such a value"
    return text if len(text) <= 60 else f"{text[:57]}..."
