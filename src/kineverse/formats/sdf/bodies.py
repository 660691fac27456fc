"""Inertia, visuals and collision shapes of SDF links.

Shapes and their colours decide nothing about where links are: a shape that cannot be said here, or is not
said, is left out with a remark.
"""

from __future__ import annotations

from collections.abc import Callable

from kineverse.formats.poses import IDENTITY, compose_poses
from kineverse.formats.resource_paths import find_root_violation
from kineverse.formats.xml_reader import Element, ElementError, find_child, label
from kineverse.formats.xml_values import parse_numbers as spelt
from kineverse.formats.xml_values import (
    read_child_number,
    read_child_numbers,
    read_child_text,
    read_child_vector,
    read_element_pose,
    read_text,
)
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

from .pose_graph import PoseNode, pose_between

_ROUND: dict[str, Callable[[float, float], Geometry]] = {
    "cylinder": Cylinder,
    "capsule": Capsule,
    "cone": Cone,
}
_UNSCALED = (1.0, 1.0, 1.0)


def read_sdf_body(link: PoseNode) -> Body:
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


def _shape(element: Element, link: PoseNode) -> Shape | None:
    geometry = find_child(element, "geometry")
    form = None if geometry is None else _geometry(geometry, element, link)
    if form is None:
        return None
    place = IDENTITY
    pose = find_child(element, "pose")
    if pose is not None:
        place = read_element_pose(pose, link.document.remarks)
        old = "frame" if link.document.version < (1, 7) else "relative_to"
        reference = pose[1].get(old, "")
        if reference:
            place = compose_poses(pose_between(link, link.scope.find(reference, pose, element)), place)
    color = _color(element, link) if element[0] == "visual" else None
    return Shape(form, place, element[1].get("name", ""), color)


def _geometry(geometry: Element, shape: Element, link: PoseNode) -> Geometry | None:
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
    uri = read_child_text(form, "uri") or (
        read_child_text(form, "filename") if link.document.version < (1, 3) else ""
    )
    if not uri:
        raise ElementError(form, "has no <uri>; the specification requires it.")
    if find_child(form, "submesh") is not None:
        remarks.add(form, "names a submesh; all of the mesh is taken.", link.element)
    folder, root = link.document.folder, link.document.root
    wrong = find_root_violation(uri, folder, root)
    if wrong is not None:
        remarks.add(form, f"names {wrong}", link.element)
    try:
        scale = read_child_vector(form, "scale", _UNSCALED)
    except ElementError as mistake:
        remarks.mend(mistake, "it is not scaled", link.element)
        scale = _UNSCALED
    return Mesh(uri, scale, folder, root)


def _length(form: Element, tag: str) -> float:
    value = read_child_number(form, tag)
    if value < 0.0:
        raise ElementError(form, f"has a negative {tag}.")
    return value


def _lengths(form: Element, tag: str) -> tuple[float, float, float]:
    x, y, z = read_child_vector(form, tag)
    if min(x, y, z) < 0.0:
        raise ElementError(form, f"has a negative {tag}.")
    return x, y, z


def _color(visual: Element, link: PoseNode) -> Rgba | None:
    material = find_child(visual, "material")
    if material is None:
        return None
    part = find_child(material, "diffuse") or find_child(material, "ambient")
    if part is None or not read_text(part):
        return None
    words = read_text(part).split()
    try:
        red, green, blue, alpha = (*spelt(read_text(part), min(len(words), 4) if len(words) > 2 else 4), 1.0)[
            :4
        ]
        opaque = 1.0 - read_child_number(visual, "transparency", 0.0)
    except (ValueError, ElementError) as error:
        mistake = error if isinstance(error, ElementError) else ElementError(part, f"{error}.")
        link.document.remarks.mend(mistake, "it is no colour", link.element)
        return None
    return red, green, blue, alpha * min(max(opaque, 0.0), 1.0)


def _inertia(inertial: Element, link: PoseNode) -> Inertia | None:
    if inertial[1].get("auto", "").lower() in ("true", "1"):
        link.document.remarks.add(inertial, "is to be computed from shapes; it is left out.", link.element)
        return None
    mass = read_child_number(inertial, "mass", 1.0)
    pose, tensor = find_child(inertial, "pose"), find_child(inertial, "inertia")
    origin = IDENTITY if pose is None else read_element_pose(pose, link.document.remarks)
    if tensor is None:
        return Inertia(mass, (1.0, 0.0, 0.0, 1.0, 0.0, 1.0), origin)
    ixx, ixy, ixz, iyy, iyz, izz = (
        read_child_numbers(tensor, key, 1, (1.0 if key[1] == key[2] else 0.0,))[0]
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    return Inertia(mass, (ixx, ixy, ixz, iyy, iyz, izz), origin)
