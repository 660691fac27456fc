"""Bodies as JSON values: shapes, inertias, poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from struct import Struct
from typing import Any

import numpy as np

from kineverse.errors import FormatError, InvalidValueError
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

from .schema import InvalidDocumentError, check_keys, check_list, check_number, check_numbers, check_text

_ROUND: dict[str, Callable[[float, float], Geometry]] = {
    kind.kind: kind for kind in (Cylinder, Capsule, Cone)
}
GEOMETRIES = ("box", *_ROUND, "sphere", "ellipsoid", "mesh")
INERTIA_NUMBERS = 6
POSE_NUMBERS = 12
_POSE = Struct(f"{POSE_NUMBERS}d")


# -- writing -------------------------------------------------------------------------------------------------


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
            "mesh": {
                "uri": encode_text(geometry.uri),
                "scale": scale,
                "folder": encode_text(geometry.folder),
            }
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


# -- reading -------------------------------------------------------------------------------------------------


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
