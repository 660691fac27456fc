"""Bodies as JSON values and back: visual and collision shapes, inertia, poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from struct import Struct
from typing import Any

import numpy as np

from kineverse.errors import FormatError, ValueRejectedError
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

from .checks import RefusedError, fields, listed, number, numbers, string

_ROUND: dict[str, Callable[[float, float], Geometry]] = {
    "cylinder": Cylinder,
    "capsule": Capsule,
    "cone": Cone,
}
GEOMETRIES = ("box", *_ROUND, "sphere", "ellipsoid", "mesh")
INERTIA_NUMBERS = 6
POSE_NUMBERS = 12
_POSE = Struct(f"{POSE_NUMBERS}d")


# -- writing -------------------------------------------------------------------------------------------------


def written_body(body: Body) -> dict[str, Any]:
    """Return a body as JSON has it."""
    result: dict[str, Any] = {
        "visuals": [_shape(s) for s in body.visuals],
        "collisions": [_shape(s) for s in body.collisions],
    }
    if body.inertia is not None:
        inertia = body.inertia
        result["inertia"] = {
            "mass": written_number(inertia.mass),
            "tensor": written_numbers(inertia.tensor),
            "origin": written_pose(inertia.origin),
        }
    return result


def _shape(shape: Shape) -> dict[str, Any]:
    result = {"geometry": _geometry(shape.geometry), "origin": written_pose(shape.origin)}
    if shape.name:
        result["name"] = written_text(shape.name)
    if shape.color is not None:
        result["color"] = written_numbers(shape.color)
    if shape.texture:
        result["texture"] = written_text(shape.texture)
    return result


def _geometry(geometry: Geometry) -> dict[str, Any]:
    if type(geometry) is Box:
        return {"box": {"size": written_numbers(geometry.size)}}
    if type(geometry) is Cylinder or type(geometry) is Capsule or type(geometry) is Cone:
        kind = type(geometry).__name__.lower()
        return {kind: {"radius": written_number(geometry.radius), "length": written_number(geometry.length)}}
    if type(geometry) is Sphere:
        return {"sphere": {"radius": written_number(geometry.radius)}}
    if type(geometry) is Ellipsoid:
        return {"ellipsoid": {"radii": written_numbers(geometry.radii)}}
    if type(geometry) is Mesh:
        scale = written_numbers(geometry.scale)
        return {
            "mesh": {
                "uri": written_text(geometry.uri),
                "scale": scale,
                "folder": written_text(geometry.folder),
            }
        }
    raise FormatError(f"a {type(geometry).__name__} is no geometry that a document knows")


def written_pose(pose: Pose) -> list[float | str]:
    """Return a pose as JSON has it: the first three rows of its matrix."""
    return written_numbers(pose.rows)


def written_numbers(values: Any) -> list[float | str]:
    """Return numbers as JSON has them."""
    return [v if type(v) is float and -math.inf < v < math.inf else written_number(v) for v in values]


def written_number(value: Any) -> float | str:
    """Return a number as JSON has it; infinite ones are texts.

    Raises
    ------
    FormatError
        For NaN, and for what is no number.
    """
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


def written_text(value: Any) -> str:
    """Return a text."""
    if type(value) is not str:
        raise FormatError(f"a text is wanted, not {value!r}")
    return value


# -- reading -------------------------------------------------------------------------------------------------


def read_body(value: Any) -> Body:
    """Return a body that was written.

    Raises
    ------
    RefusedError
        Where it is not what it should be.
    """
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
    given = fields(value, (), GEOMETRIES)
    if len(given) != 1:
        raise RefusedError(f"a geometry is one of {', '.join(GEOMETRIES)}")
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
    """Return a pose that was written.

    Raises
    ------
    RefusedError
        For what is none.
    """
    rows = numbers(value, POSE_NUMBERS)
    try:
        return _pose(_POSE.pack(*rows))
    except ValueRejectedError as error:
        raise RefusedError(str(error)) from None


@lru_cache(1024)
def _pose(rows: bytes) -> Pose:
    # The same ones come again and again, and to check a rotation takes a while. As bytes, -0.0 is not 0.0.
    return Pose(_POSE.unpack(rows))
