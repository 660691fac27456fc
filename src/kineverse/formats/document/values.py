"""Values of documents as JSON: writes of operations, bodies, numbers and texts.

A frame is ``{"parent": name, "factors": [...]}``, each factor a pose (its 12 numbers) or the place of an
expression; a constraint the places of ``[lower, expression, upper]``; a rate
``[coordinate, [[speed, ref], ...]]``. Data are texts, numbers, true, false, null and lists of these; an
expression is ``{"expression": ref}``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import lru_cache
from struct import Struct
from typing import Any, TypeAlias

import numpy as np

from kineverse.errors import FormatError, InvalidValueError
from kineverse.expressions.expression import Expression
from kineverse.model.articulation import Articulation
from kineverse.model.body import (
    Body,
    Box,
    Capsule,
    Cone,
    Cylinder,
    Ellipsoid,
    Geometry,
    Inertia,
    Mesh,
    Pose,
    Shape,
    Sphere,
)
from kineverse.model.constraint import Constraint
from kineverse.model.frame import WORLD, Frame
from kineverse.model.operation import ARTICULATIONS, BODIES, CONSTRAINTS, DATA, FRAMES, RATES
from kineverse.model.rates import RateEntry, as_entry
from kineverse.symbols import Symbol

from .budget import MAX_DEPTH, check_depth
from .json_values import (
    InvalidDocumentError,
    check_entity_name,
    check_keys,
    check_length,
    check_list,
    check_number,
    check_numbers,
    check_text,
)
from .node_graph import NodeGraph

Ref: TypeAlias = Callable[[Expression], int]
Rename: TypeAlias = Callable[[str], str]

MAX_BITS = 10_000  # length of the longest integer: Python reads no more than 4300 digits
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

_ROUND: dict[str, Callable[[float, float], Geometry]] = {
    kind.kind: kind for kind in (Cylinder, Capsule, Cone)
}
GEOMETRIES = ("box", *_ROUND, "sphere", "ellipsoid", "mesh")
INERTIA_NUMBERS = 6
POSE_NUMBERS = 12
_POSE = Struct(f"{POSE_NUMBERS}d")


# -- writing of bodies, numbers and texts --------------------------------------------------------------------


def encode_body(body: Body) -> dict[str, Any]:
    """Encode a body as a JSON value."""
    result: dict[str, Any] = {
        "visuals": [_encode_shape(s) for s in body.visuals],
        "collisions": [_encode_shape(s) for s in body.collisions],
    }
    if body.inertia is not None:
        inertia = body.inertia
        result["inertia"] = {
            "mass": encode_number(inertia.mass),
            "tensor": encode_numbers(inertia.tensor),
            "origin": encode_pose(inertia.origin),
        }
    return result


def _encode_shape(shape: Shape) -> dict[str, Any]:
    """Encode a shape; members with their default values are left out."""
    result = {"geometry": _encode_geometry(shape.geometry), "origin": encode_pose(shape.origin)}
    if shape.name:
        result["name"] = encode_text(shape.name)
    if shape.color is not None:
        result["color"] = encode_numbers(shape.color)
    if shape.texture:
        result["texture"] = encode_text(shape.texture)
    return result


def _encode_geometry(geometry: Geometry) -> dict[str, Any]:
    if type(geometry) is Box:
        return {"box": {"size": encode_numbers(geometry.size)}}
    if type(geometry) is Cylinder or type(geometry) is Capsule or type(geometry) is Cone:
        sizes = {"radius": encode_number(geometry.radius), "length": encode_number(geometry.length)}
        return {geometry.kind: sizes}
    if type(geometry) is Sphere:
        return {"sphere": {"radius": encode_number(geometry.radius)}}
    if type(geometry) is Ellipsoid:
        return {"ellipsoid": {"radii": encode_numbers(geometry.radii)}}
    if type(geometry) is Mesh:
        scale = encode_numbers(geometry.scale)
        return {
            "mesh": {"uri": encode_text(geometry.uri), "scale": scale, "folder": encode_text(geometry.folder)}
        }
    raise FormatError(f"a {type(geometry).__name__} is no geometry that a document knows")


def encode_pose(pose: Pose) -> list[float | str]:
    """Encode a pose as the 12 numbers of the first three rows of its matrix."""
    return encode_numbers(pose.rows)


def encode_numbers(values: Any) -> list[float | str]:
    """Encode numbers as a JSON list."""
    return [v if type(v) is float and -math.inf < v < math.inf else encode_number(v) for v in values]


def encode_number(value: Any) -> float | str:
    """Encode a number as a JSON value; infinities are texts."""
    if isinstance(value, np.generic):
        value = value.item()
    if type(value) not in (float, int):
        raise FormatError(f"a number is wanted, not {value!r}")
    if value != value:
        raise FormatError("NaN has no place in a document")
    try:
        result = float(value)
    except OverflowError:
        raise FormatError("an integer is too large for a 64-bit float") from None
    return result if abs(result) < math.inf else ("inf" if result > 0 else "-inf")


def encode_text(value: Any) -> str:
    """Return a text after checking that it is one."""
    if type(value) is not str:
        raise FormatError(f"a text is wanted, not {value!r}")
    return value


# -- reading of bodies ---------------------------------------------------------------------------------------


def decode_body(value: Any) -> Body:
    """Decode a body from its JSON value."""
    given = check_keys(value, ("visuals", "collisions"), ("inertia",))
    return Body(
        tuple(map(_decode_shape, check_list(given["visuals"], "visuals"))),
        tuple(map(_decode_shape, check_list(given["collisions"], "collisions"))),
        _decode_inertia(given["inertia"]) if "inertia" in given else None,
    )


def _decode_inertia(value: Any) -> Inertia:
    given = check_keys(value, ("mass", "tensor", "origin"))
    ixx, ixy, ixz, iyy, iyz, izz = check_numbers(given["tensor"], INERTIA_NUMBERS)
    return Inertia(check_number(given["mass"]), (ixx, ixy, ixz, iyy, iyz, izz), decode_pose(given["origin"]))


def _decode_shape(value: Any) -> Shape:
    given = check_keys(value, ("geometry", "origin"), ("name", "color", "texture"))
    color = None
    if "color" in given:
        red, green, blue, alpha = check_numbers(given["color"], 4)
        color = red, green, blue, alpha
    return Shape(
        _decode_geometry(given["geometry"]),
        decode_pose(given["origin"]),
        check_text(given.get("name", "")),
        color,
        check_text(given.get("texture", "")),
    )


def _decode_geometry(value: Any) -> Geometry:
    given = check_keys(value, (), GEOMETRIES)
    if len(given) != 1:
        raise InvalidDocumentError(f"a geometry is one of {', '.join(GEOMETRIES)}")
    ((kind, inner),) = given.items()
    if kind == "box":
        return Box(_decode_vector(check_keys(inner, ("size",))["size"]))
    if kind == "sphere":
        return Sphere(check_number(check_keys(inner, ("radius",))["radius"]))
    if kind == "ellipsoid":
        return Ellipsoid(_decode_vector(check_keys(inner, ("radii",))["radii"]))
    if kind == "mesh":
        check_keys(inner, ("uri", "scale", "folder"))
        return Mesh(check_text(inner["uri"]), _decode_vector(inner["scale"]), check_text(inner["folder"]))
    check_keys(inner, ("radius", "length"))
    return _ROUND[kind](check_number(inner["radius"]), check_number(inner["length"]))


def _decode_vector(value: Any) -> tuple[float, float, float]:
    x, y, z = check_numbers(value, 3)
    return x, y, z


def decode_pose(value: Any) -> Pose:
    """Decode a pose from its 12 numbers."""
    rows = check_numbers(value, POSE_NUMBERS)
    try:
        return _pose(_POSE.pack(*rows))
    except InvalidValueError as error:
        raise InvalidDocumentError(str(error)) from None


@lru_cache(1024)
def _pose(rows: bytes) -> Pose:
    # Poses repeat, and checking a rotation is slow. As bytes, -0.0 is not 0.0.
    return Pose(_POSE.unpack(rows))
