"""Writes of operations as JSON values.

A frame is ``{"parent": name, "factors": [...]}``, each factor a pose (its 12 numbers) or the place of an
expression; a constraint the places of ``[lower, expression, upper]``; a rate
``[coordinate, [[speed, ref], ...]]``. Data are texts, numbers, true, false, null and lists of these; an
expression is ``{"expression": ref}``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, TypeAlias

from kineverse.errors import FormatError
from kineverse.expressions.expression import Expression
from kineverse.model.articulation import Articulation
from kineverse.model.body import Pose
from kineverse.model.constraint import Constraint
from kineverse.model.frame import WORLD, Frame
from kineverse.model.operation import ARTICULATIONS, BODIES, CONSTRAINTS, DATA, FRAMES, RATES
from kineverse.model.rates import RateEntry, as_entry
from kineverse.symbols import Symbol

from .bodies import (
    decode_body,
    decode_pose,
    encode_body,
    encode_number,
    encode_numbers,
    encode_pose,
    encode_text,
)
from .budget import MAX_DEPTH, check_depth
from .node_graph import NodeGraph
from .schema import (
    InvalidDocumentError,
    check_entity_name,
    check_keys,
    check_length,
    check_list,
    check_number,
    check_numbers,
    check_text,
)

Ref: TypeAlias = Callable[[Expression], int]
Rename: TypeAlias = Callable[[str], str]

MAX_BITS = 10_000
"""Length of the longest integer: Python reads no more than 4300 digits."""
PLAIN_BITS = 63
"""Length of the longest integer that is written as a number; other languages and msgpack end there."""
DATUM_TAGS = ("expression", "float", "integer")
_INTEGER = re.compile("-?[0-9]{1,3011}")


# -- writing -------------------------------------------------------------------------------------------------


def encode_value(kind: str, value: Any, ref: Ref) -> Any:
    """Encode a write of one kind as a JSON value."""
    if kind == FRAMES:
        factors = [encode_pose(f) if isinstance(f, Pose) else ref(f) for f in value.factors]
        return {"parent": value.parent, "factors": factors}
    if kind == CONSTRAINTS:
        return [ref(value.lower), ref(value.expression), ref(value.upper)]
    if kind == RATES:
        coordinate, row = value
        if isinstance(row, Expression):
            return [ref(coordinate), ref(row)]
        return [ref(coordinate), [[ref(speed), ref(entry)] for speed, entry in row]]
    if kind == BODIES:
        return encode_body(value)
    if kind == ARTICULATIONS:
        record = {
            "kind": encode_text(value.kind),
            "parent": encode_text(value.parent),
            "child": encode_text(value.child),
            "coordinates": [ref(s) for s in value.coordinates],
            "home": encode_numbers(value.home),
            "speeds": [ref(s) for s in value.speeds],
            "dynamics": [[encode_text(item), encode_datum(datum, ref)] for item, datum in value.dynamics],
        }
        return record if value.follows is None else {**record, "follows": ref(value.follows)}
    return encode_datum(value, ref)


def encode_datum(value: Any, ref: Ref, depth: int = 0) -> Any:
    """Encode a datum, nested in ``depth`` tuples, as a JSON value."""
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


def decode_value(kind: str, value: Any, graph: NodeGraph, rename: Rename) -> Any:
    """Decode a write of one kind from its JSON value."""
    return _DECODERS[kind](value, graph, rename)


def decode_frame_name(value: Any, rename: Rename) -> str:
    """Decode the name of a frame; the world is not renamed."""
    given = check_entity_name(value)
    return given if given == WORLD else rename(given)


def _decode_frame(value: Any, graph: NodeGraph, rename: Rename) -> Frame:
    given = check_keys(value, ("parent", "factors"))
    factors: list[Pose | Expression] = []
    for factor in check_list(given["factors"], "factors"):
        if type(factor) is list:
            factors.append(decode_pose(factor))
            continue
        transform = graph.expression(factor)
        if transform.shape != (4, 4):
            raise InvalidDocumentError(f"a factor should be 4×4, not of shape {transform.shape}")
        factors.append(transform)
    return Frame(decode_frame_name(given["parent"], rename), tuple(factors))


def _decode_constraint(value: Any, graph: NodeGraph, rename: Rename) -> Constraint:
    return Constraint(*map(graph.scalar, check_length(check_list(value, "lower, expression, upper"), 3)))


def _decode_rate(value: Any, graph: NodeGraph, rename: Rename) -> tuple[Symbol, RateEntry]:
    coordinate, entry = check_length(check_list(value, "a coordinate, and its row or what it depends on"), 2)
    symbol = graph.symbol(coordinate)
    if type(entry) is int:
        return symbol, as_entry(symbol, graph.scalar(entry))
    return symbol, as_entry(symbol, dict(graph.pairs(entry, 1)))


def _decode_articulation(value: Any, graph: NodeGraph, rename: Rename) -> Articulation:
    required = ("kind", "parent", "child", "coordinates", "home", "speeds", "dynamics")
    given = check_keys(value, required, ("follows",))
    dynamics = [
        check_length(check_list(d, "name and value"), 2) for d in check_list(given["dynamics"], "dynamics")
    ]
    coordinates = tuple(map(graph.symbol, check_list(given["coordinates"], "coordinates")))
    home = check_numbers(given["home"])
    names = [symbol.path.rpartition("/")[2] for symbol in coordinates]
    for k in range(len(names) - 3):
        if names[k : k + 4] == ["qx", "qy", "qz", "qw"] and not any(home[k : k + 4]):
            raise InvalidDocumentError(
                "its home has a quaternion of length zero, at which nothing has a pose"
            )
    return Articulation(
        check_text(given["kind"]),
        decode_frame_name(given["parent"], rename),
        decode_frame_name(given["child"], rename),
        coordinates,
        home,
        tuple(graph.symbol(ref, 1) for ref in check_list(given["speeds"], "speeds")),
        tuple((check_text(item), decode_datum(datum, graph, rename)) for item, datum in dynamics),
        graph.scalar(given["follows"]) if "follows" in given else None,
    )


def decode_datum(value: Any, graph: NodeGraph, rename: Rename, depth: int = 0) -> Any:
    """Decode a datum, nested in ``depth`` lists, from its JSON value."""
    if type(value) is list:
        check_depth(depth)
        return tuple([decode_datum(item, graph, rename, depth + 1) for item in value])
    if type(value) is dict:
        return _decode_tagged(value, graph)
    if type(value) is int and value.bit_length() > PLAIN_BITS:
        raise InvalidDocumentError('an integer of more than 64 bits is written {"integer": "its digits"}')
    if type(value) is str:
        return check_text(value)
    if value is not None and type(value) not in (bool, int, float):
        raise InvalidDocumentError(f"a {type(value).__name__} is no datum")
    return check_number(value) if type(value) is float else value


def _decode_tagged(value: dict[str, Any], graph: NodeGraph) -> Any:
    """Decode an expression, an infinity or a long integer."""
    given = check_keys(value, (), DATUM_TAGS)
    if len(given) != 1:
        raise InvalidDocumentError(f"an object among data has one of the keys {', '.join(DATUM_TAGS)}")
    ((tag, inner),) = given.items()
    if tag == "expression":
        return graph.expression(inner)
    if tag == "float" and inner in ("inf", "-inf"):
        return check_number(inner)
    if tag == "integer" and type(inner) is str and _INTEGER.fullmatch(inner):
        return int(inner)
    raise InvalidDocumentError(
        f"{tag!r} is the place of an expression, 'inf' or '-inf', or the digits of an integer"
    )


_DECODERS: dict[str, Callable[[Any, NodeGraph, Rename], Any]] = {
    FRAMES: _decode_frame,
    BODIES: lambda value, graph, rename: decode_body(value),
    ARTICULATIONS: _decode_articulation,
    CONSTRAINTS: _decode_constraint,
    RATES: _decode_rate,
    DATA: decode_datum,
}
