"""Inertia, visuals and collision shapes of SDF links.

Shapes and colours do not affect kinematics: a shape that is missing or not supported is left out with a
remark.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from kineverse.formats.poses import IDENTITY, compose_poses
from kineverse.formats.resource_paths import find_root_violation
from kineverse.formats.xml_reader import Element, ElementError, find_child, label
from kineverse.formats.xml_values import (
    parse_numbers,
    read_child_number,
    read_child_numbers,
    read_child_text,
    read_child_vector,
    read_element_pose,
    read_or_default,
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

from .custom_attributes import INERTIA, NAME, read_values
from .pose_graph import PoseNode, find_pose_reference, pose_between

_ROUND: dict[str, Callable[[float, float], Geometry]] = {
    "cylinder": Cylinder,
    "capsule": Capsule,
    "cone": Cone,
}
_UNSCALED = (1.0, 1.0, 1.0)


def read_sdf_body(link: PoseNode) -> Body:
    """Return the body of a link."""
    visuals: list[Shape] = []
    collisions: list[Shape] = []
    inertia = None
    document = link.document
    for part in link.element[2]:
        with document.locate_errors(link.element):
            try:
                if part[0] in ("visual", "collision"):
                    shape = _shape(part, link)
                    if shape is not None:
                        (visuals if part[0] == "visual" else collisions).append(shape)
                elif part[0] == "inertial" and inertia is None:
                    inertia = _inertia(part, link)
            except ElementError as mistake:
                document.remarks.repair(mistake, f"the {label(part)} is left out", link.element)
    return Body(tuple(visuals), tuple(collisions), inertia)


def _shape(element: Element, link: PoseNode) -> Shape | None:
    geometry = find_child(element, "geometry")
    form = None if geometry is None else _geometry(geometry, element, link)
    if form is None:
        return None
    link_T_shape = IDENTITY
    pose = find_child(element, "pose")
    if pose is not None:
        link_T_shape = read_element_pose(pose, link.document.remarks)
        reference = find_pose_reference(pose, link.scope, element)
        if reference is not None:
            link_T_shape = compose_poses(pose_between(link, reference), link_T_shape)
    color = _color(element, link) if element[0] == "visual" else None
    name = element[1].get(NAME, element[1].get("name", ""))
    return Shape(form, link_T_shape, name, color)


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
    uri = read_child_text(form, "uri")
    if not uri and link.document.version < (1, 3):
        uri = read_child_text(form, "filename")
    if not uri:
        raise ElementError(form, "has no <uri>; the specification requires it.")
    if find_child(form, "submesh") is not None:
        remarks.add(form, "names a submesh; all of the mesh is taken.", link.element)
    folder, root = link.document.folder, link.document.root
    violation = find_root_violation(uri, folder, root)
    if violation is not None:
        remarks.add(form, f"names {violation}", link.element)
    read = partial(read_child_vector, form, "scale", _UNSCALED)
    scale = read_or_default(read, _UNSCALED, "it is not scaled", remarks, link.element)
    return Mesh(uri, scale, folder, root)


def _length(form: Element, tag: str) -> float:
    """Return a length [m] that is not negative."""
    value = read_child_number(form, tag)
    if value < 0.0:
        raise ElementError(form, f"has a negative {tag}.")
    return value


def _lengths(form: Element, tag: str) -> tuple[float, float, float]:
    """Return three lengths [m] that are not negative."""
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
    count = 3 if len(words) == 3 else 4
    try:
        red, green, blue, alpha = (*parse_numbers(read_text(part), count), 1.0)[:4]
        opaque = 1.0 - read_child_number(visual, "transparency", 0.0)
    except (ValueError, ElementError) as error:
        mistake = error if isinstance(error, ElementError) else ElementError(part, f"{error}.")
        link.document.remarks.repair(mistake, "it is no colour", link.element)
        return None
    return red, green, blue, alpha * min(max(opaque, 0.0), 1.0)


def _inertia(inertial: Element, link: PoseNode) -> Inertia | None:
    """Return an inertia; None, with a remark, if it is to be computed from shapes."""
    if inertial[1].get("auto", "").lower() in ("true", "1"):
        link.document.remarks.add(inertial, "is to be computed from shapes; it is left out.", link.element)
        return None
    if not inertial[1].get(INERTIA, "given").strip():
        return None
    mass = read_child_number(inertial, "mass", 1.0)
    pose, tensor = find_child(inertial, "pose"), find_child(inertial, "inertia")
    origin = IDENTITY if pose is None else read_element_pose(pose, link.document.remarks)
    frame = "" if pose is None else pose[1].get("relative_to", "")
    if pose is not None and frame not in ("", link.element[1].get("name", "")):
        link.document.remarks.add(
            pose, "has relative_to, but an inertia is always given in its link; it is ignored.", link.element
        )
    given = read_values(inertial, INERTIA, 7, link.document.remarks)
    if given:
        mass, ixx, ixy, ixz, iyy, iyz, izz = given
        return Inertia(mass, (ixx, ixy, ixz, iyy, iyz, izz), origin)
    if tensor is None:
        return Inertia(mass, (1.0, 0.0, 0.0, 1.0, 0.0, 1.0), origin)
    ixx, ixy, ixz, iyy, iyz, izz = (
        read_child_numbers(tensor, key, 1, (1.0 if key[1] == key[2] else 0.0,))[0]
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    return Inertia(mass, (ixx, ixy, ixz, iyy, iyz, izz), origin)
