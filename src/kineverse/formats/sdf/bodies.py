"""``<link>`` elements to what they carry: inertia, shapes to see, shapes to touch.

Shapes and their colours decide nothing about where links are: a shape that cannot be said here, or is not
said, is left out with a remark.
"""

from __future__ import annotations

from collections.abc import Callable

from kineverse.formats.markup import Element, ElementError, child, label
from kineverse.formats.numerals import numbers as spelt
from kineverse.formats.packages import outside
from kineverse.formats.poses import IDENTITY, product
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
    Rgba,
    Shape,
    Sphere,
)

from .nodes import Node
from .placing import relation
from .values import number, numbers, pose_of, text, text_of, vector

_ROUND: dict[str, Callable[[float, float], Geometry]] = {
    "cylinder": Cylinder,
    "capsule": Capsule,
    "cone": Cone,
}
_UNSCALED = (1.0, 1.0, 1.0)


def body_of(link: Node) -> Body:
    """Return what a link carries.

    Raises
    ------
    FormatError
        If something is missing, malformed or without meaning.
    """
    visuals: list[Shape] = []
    collisions: list[Shape] = []
    inertia = None
    document = link.document
    for part in link.element[2]:
        with document.about(link.element):
            try:
                if part[0] in ("visual", "collision"):
                    shape = _shape(part, link)
                    if shape is not None:
                        (visuals if part[0] == "visual" else collisions).append(shape)
                elif part[0] == "inertial" and inertia is None:
                    inertia = _inertia(part, link)
            except ElementError as mistake:
                document.remarks.mend(mistake, f"the {label(part)} is left out", link.element)
    return Body(tuple(visuals), tuple(collisions), inertia)


def _shape(element: Element, link: Node) -> Shape | None:
    geometry = child(element, "geometry")
    form = None if geometry is None else _geometry(geometry, element, link)
    if form is None:
        return None
    place = IDENTITY
    pose = child(element, "pose")
    if pose is not None:
        place = pose_of(pose, link.document.remarks)
        old = "frame" if link.document.version < (1, 7) else "relative_to"
        reference = pose[1].get(old, "")
        if reference:
            place = product(relation(link, link.scope.find(reference, pose, element)), place)
    color = _color(element, link) if element[0] == "visual" else None
    return Shape(form, place, element[1].get("name", ""), color)


def _geometry(geometry: Element, shape: Element, link: Node) -> Geometry | None:
    form = geometry[2][0] if geometry[2] else None
    tag = "empty" if form is None else form[0]
    if form is None or tag == "empty":
        return None
    if tag == "box":
        return Box(_lengths(form, "size"))
    if tag == "sphere":
        return Sphere(_length(form, "radius"))
    if tag == "ellipsoid":
        return Ellipsoid(_lengths(form, "radii"))
    if tag in _ROUND:
        return _ROUND[tag](_length(form, "radius"), _length(form, "length"))
    remarks = link.document.remarks
    if tag != "mesh":
        remarks.add(form, f"cannot be said here; the {label(shape)} is left out.", link.element)
        return None
    uri = text(form, "uri") or (text(form, "filename") if link.document.version < (1, 3) else "")
    if not uri:
        raise ElementError(form, "has no <uri>; the specification requires it.")
    if child(form, "submesh") is not None:
        remarks.add(form, "names a submesh; all of the mesh is taken.", link.element)
    folder, root = link.document.folder, link.document.root
    wrong = outside(uri, folder, root)
    if wrong is not None:
        remarks.add(form, f"names {wrong}", link.element)
    try:
        scale = vector(form, "scale", _UNSCALED)
    except ElementError as mistake:
        remarks.mend(mistake, "it is not scaled", link.element)
        scale = _UNSCALED
    return Mesh(uri, scale, folder, root)


def _length(form: Element, tag: str) -> float:
    value = number(form, tag)
    if value < 0.0:
        raise ElementError(form, f"has a negative {tag}.")
    return value


def _lengths(form: Element, tag: str) -> tuple[float, float, float]:
    x, y, z = vector(form, tag)
    if min(x, y, z) < 0.0:
        raise ElementError(form, f"has a negative {tag}.")
    return x, y, z


def _color(visual: Element, link: Node) -> Rgba | None:
    material = child(visual, "material")
    if material is None:
        return None
    part = child(material, "diffuse") or child(material, "ambient")
    if part is None or not text_of(part):
        return None
    words = text_of(part).split()
    try:
        red, green, blue, alpha = (*spelt(text_of(part), min(len(words), 4) if len(words) > 2 else 4), 1.0)[
            :4
        ]
        opaque = 1.0 - number(visual, "transparency", 0.0)
    except (ValueError, ElementError) as error:
        mistake = error if isinstance(error, ElementError) else ElementError(part, f"{error}.")
        link.document.remarks.mend(mistake, "it is no colour", link.element)
        return None
    return red, green, blue, alpha * min(max(opaque, 0.0), 1.0)


def _inertia(inertial: Element, link: Node) -> Inertia | None:
    if inertial[1].get("auto", "").lower() in ("true", "1"):
        link.document.remarks.add(inertial, "is to be computed from shapes; it is left out.", link.element)
        return None
    mass = number(inertial, "mass", 1.0)
    pose, tensor = child(inertial, "pose"), child(inertial, "inertia")
    origin = IDENTITY if pose is None else pose_of(pose, link.document.remarks)
    if tensor is None:
        return Inertia(mass, (1.0, 0.0, 0.0, 1.0, 0.0, 1.0), origin)
    ixx, ixy, ixz, iyy, iyz, izz = (
        numbers(tensor, key, 1, (1.0 if key[1] == key[2] else 0.0,))[0]
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    return Inertia(mass, (ixx, ixy, ixz, iyy, iyz, izz), origin)
