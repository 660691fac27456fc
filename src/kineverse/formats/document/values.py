"""What operations write, as JSON values and back.

A frame is ``{"parent": name, "factors": [...]}``, each factor a pose (its 12 numbers) or the place of an
expression; a constraint the places of ``[lower, expression, upper]``; a rate
``[coordinate, [[speed, ref], ...]]``. Data are texts, numbers, true, false, null and lists of these; an
expression is ``{"expression": ref}``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from kineverse.errors import FormatError
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
from kineverse.model.rates import Entry, as_entry
from kineverse.symbols import Symbol

from .checks import RefusedError, exactly, fields, listed, name, number, numbers, string
from .graph import Graph

Ref: TypeAlias = Callable[[Expression], int]
Rename: TypeAlias = Callable[[str], str]

_ROUND: dict[str, Callable[[float, float], Geometry]] = {
    "cylinder": Cylinder,
    "capsule": Capsule,
    "cone": Cone,
}
_GEOMETRIES = ("box", *_ROUND, "sphere", "ellipsoid", "mesh")
INERTIA_NUMBERS = 6
POSE_NUMBERS = 12
MAX_BITS = 10_000
"""The longest integer: Python reads no more than 4300 digits."""


# -- writing -------------------------------------------------------------------------------------------------


def written(kind: str, value: Any, ref: Ref) -> Any:
    """Return a value as JSON has it.

    Raises
    ------
    FormatError
        For what a document has no place for.
    """
    if kind == FRAMES:
        factors = [written_pose(f) if isinstance(f, Pose) else ref(f) for f in value.factors]
        return {"parent": value.parent, "factors": factors}
    if kind == CONSTRAINTS:
        return [ref(value.lower), ref(value.expression), ref(value.upper)]
    if kind == RATES:
        coordinate, row = value
        if isinstance(row, Expression):
            return [ref(coordinate), ref(row)]
        return [ref(coordinate), [[ref(speed), ref(entry)] for speed, entry in row]]
    if kind == BODIES:
        return _body(value)
    if kind == ARTICULATIONS:
        record = {
            "kind": _text(value.kind),
            "parent": _text(value.parent),
            "child": _text(value.child),
            "coordinates": [ref(s) for s in value.coordinates],
            "home": _numbers(value.home),
            "speeds": [ref(s) for s in value.speeds],
            "dynamics": [[_text(item), written_datum(datum, ref)] for item, datum in value.dynamics],
        }
        return record if value.follows is None else {**record, "follows": ref(value.follows)}
    return written_datum(value, ref)


def written_datum(value: Any, ref: Ref) -> Any:
    """Return a datum as JSON has it.

    Raises
    ------
    FormatError
        For what is none.
    """
    if type(value) is int and value.bit_length() > MAX_BITS:
        raise FormatError(f"an integer of {value.bit_length()} bits is too long, of more than {MAX_BITS}")
    if value is None or type(value) in (bool, int, str):
        return value
    if isinstance(value, float):  # numpy's is one, too
        number = float(value)
        return number if math.isfinite(number) else {"float": _number(number)}
    if type(value) is tuple:
        return [written_datum(item, ref) for item in value]
    if isinstance(value, Expression):
        return {"expression": ref(value)}
    raise FormatError(
        f"a {type(value).__name__} cannot be saved; write texts, numbers, true or false, None, expressions "
        "and tuples of these"
    )


def _body(body: Body) -> dict[str, Any]:
    result: dict[str, Any] = {
        "visuals": [_shape(s) for s in body.visuals],
        "collisions": [_shape(s) for s in body.collisions],
    }
    if body.inertia is not None:
        inertia = body.inertia
        result["inertia"] = {
            "mass": _number(inertia.mass),
            "tensor": _numbers(inertia.tensor),
            "origin": written_pose(inertia.origin),
        }
    return result


def _shape(shape: Shape) -> dict[str, Any]:
    result = {"geometry": _geometry(shape.geometry), "origin": written_pose(shape.origin)}
    if shape.name:
        result["name"] = _text(shape.name)
    if shape.color is not None:
        result["color"] = _numbers(shape.color)
    if shape.texture:
        result["texture"] = _text(shape.texture)
    return result


def _geometry(geometry: Geometry) -> dict[str, Any]:
    if type(geometry) is Box:
        return {"box": {"size": _numbers(geometry.size)}}
    if type(geometry) is Cylinder or type(geometry) is Capsule or type(geometry) is Cone:
        kind = type(geometry).__name__.lower()
        return {kind: {"radius": _number(geometry.radius), "length": _number(geometry.length)}}
    if type(geometry) is Sphere:
        return {"sphere": {"radius": _number(geometry.radius)}}
    if type(geometry) is Ellipsoid:
        return {"ellipsoid": {"radii": _numbers(geometry.radii)}}
    if type(geometry) is Mesh:
        scale = _numbers(geometry.scale)
        return {"mesh": {"uri": _text(geometry.uri), "scale": scale, "folder": _text(geometry.folder)}}
    raise FormatError(f"a {type(geometry).__name__} is no geometry that a document knows")


def written_pose(pose: Pose) -> list[float | str]:
    """Return a pose as JSON has it: the first three rows of its matrix."""
    return _numbers(pose.rows)


def _numbers(values: Any) -> list[float | str]:
    return [v if type(v) is float and -math.inf < v < math.inf else _number(v) for v in values]


def _number(value: Any) -> float | str:
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


def _text(value: Any) -> str:
    if type(value) is not str:
        raise FormatError(f"a text is wanted, not {value!r}")
    return value


# -- reading -------------------------------------------------------------------------------------------------


def as_read(kind: str, value: Any, graph: Graph, rename: Rename) -> Any:
    """Return what JSON has as the value of an operation.

    Raises
    ------
    RefusedError
        Where it is not what it should be.
    """
    return _READERS[kind](value, graph, rename)


def frame_name(value: Any, rename: Rename) -> str:
    """Return the name of a frame that may be the world."""
    given = name(value)
    return given if given == WORLD else rename(given)


def _read_frame(value: Any, graph: Graph, rename: Rename) -> Frame:
    given = fields(value, ("parent", "factors"))
    factors: list[Pose | Expression] = []
    for factor in listed(given["factors"], "factors"):
        if type(factor) is list:
            factors.append(read_pose(factor))
            continue
        transform = graph.expression(factor)
        if transform.shape != (4, 4):
            raise RefusedError(f"a factor should be 4×4, not of shape {transform.shape}")
        factors.append(transform)
    return Frame(frame_name(given["parent"], rename), tuple(factors))


def _read_constraint(value: Any, graph: Graph, rename: Rename) -> Constraint:
    return Constraint(*map(graph.scalar, exactly(listed(value, "lower, expression, upper"), 3)))


def _read_rate(value: Any, graph: Graph, rename: Rename) -> tuple[Symbol, Entry]:
    coordinate, entry = exactly(listed(value, "a coordinate, and its row or what it depends on"), 2)
    symbol = graph.symbol(coordinate)
    if type(entry) is int:
        return symbol, as_entry(symbol, graph.scalar(entry))
    return symbol, as_entry(symbol, dict(graph.pairs(entry, 1)))


def _read_body(value: Any, graph: Graph, rename: Rename) -> Body:
    given = fields(value, ("visuals", "collisions"), ("inertia",))
    return Body(
        tuple(map(_read_shape, listed(given["visuals"], "visuals"))),
        tuple(map(_read_shape, listed(given["collisions"], "collisions"))),
        _read_inertia(given["inertia"]) if "inertia" in given else None,
    )


def _read_inertia(value: Any) -> Inertia:
    given = fields(value, ("mass", "tensor", "origin"))
    ixx, ixy, ixz, iyy, iyz, izz = numbers(given["tensor"], INERTIA_NUMBERS)
    return Inertia(number(given["mass"]), (ixx, ixy, ixz, iyy, iyz, izz), read_pose(given["origin"]))


def _read_shape(value: Any) -> Shape:
    given = fields(value, ("geometry", "origin"), ("name", "color", "texture"))
    color = None
    if "color" in given:
        red, green, blue, alpha = numbers(given["color"], 4)
        color = red, green, blue, alpha
    return Shape(
        _read_geometry(given["geometry"]),
        read_pose(given["origin"]),
        string(given.get("name", "")),
        color,
        string(given.get("texture", "")),
    )


def _read_geometry(value: Any) -> Geometry:
    given = fields(value, (), _GEOMETRIES)
    if len(given) != 1:
        raise RefusedError(f"a geometry is one of {', '.join(_GEOMETRIES)}")
    ((kind, inner),) = given.items()
    if kind == "box":
        return Box(_read_vector(fields(inner, ("size",))["size"]))
    if kind == "sphere":
        return Sphere(number(fields(inner, ("radius",))["radius"]))
    if kind == "ellipsoid":
        return Ellipsoid(_read_vector(fields(inner, ("radii",))["radii"]))
    if kind == "mesh":
        fields(inner, ("uri", "scale", "folder"))
        return Mesh(string(inner["uri"]), _read_vector(inner["scale"]), string(inner["folder"]))
    fields(inner, ("radius", "length"))
    return _ROUND[kind](number(inner["radius"]), number(inner["length"]))


def _read_vector(value: Any) -> tuple[float, float, float]:
    x, y, z = numbers(value, 3)
    return x, y, z


def read_pose(value: Any) -> Pose:
    """Return a pose that was written."""
    return Pose(numbers(value, POSE_NUMBERS))


def _read_articulation(value: Any, graph: Graph, rename: Rename) -> Articulation:
    required = ("kind", "parent", "child", "coordinates", "home", "speeds", "dynamics")
    given = fields(value, required, ("follows",))
    dynamics = [exactly(listed(d, "name and value"), 2) for d in listed(given["dynamics"], "dynamics")]
    return Articulation(
        string(given["kind"]),
        frame_name(given["parent"], rename),
        frame_name(given["child"], rename),
        tuple(map(graph.symbol, listed(given["coordinates"], "coordinates"))),
        numbers(given["home"]),
        tuple(graph.symbol(ref, 1) for ref in listed(given["speeds"], "speeds")),
        tuple((string(item), read_datum(datum, graph, rename)) for item, datum in dynamics),
        graph.scalar(given["follows"]) if "follows" in given else None,
    )


def read_datum(value: Any, graph: Graph, rename: Rename) -> Any:
    """Return a datum that was written."""
    if type(value) is list:
        return tuple(read_datum(item, graph, rename) for item in value)
    if type(value) is dict:
        given = fields(value, (), ("expression", "float"))
        if len(given) != 1 or given.get("float", "inf") not in ("inf", "-inf"):
            raise RefusedError('an object among data is {"expression": ref} or {"float": "inf" or "-inf"}')
        return number(given["float"]) if "float" in given else graph.expression(given["expression"])
    if type(value) is str:
        return string(value)
    return number(value) if type(value) is float else value


_READERS: dict[str, Callable[[Any, Graph, Rename], Any]] = {
    FRAMES: _read_frame,
    BODIES: _read_body,
    ARTICULATIONS: _read_articulation,
    CONSTRAINTS: _read_constraint,
    RATES: _read_rate,
    DATA: read_datum,
}
