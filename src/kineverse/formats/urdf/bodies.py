"""Inertia, visuals and collision shapes of URDF links.

Specification: http://wiki.ros.org/urdf/XML/link, and urdf.xsd of ros/urdfdom for defaults. Shapes and colours
do not affect kinematics: a shape that is missing or not supported is left out with a remark.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.resource_paths import find_root_violation
from kineverse.formats.urdf.description import UrdfLink
from kineverse.formats.urdf.materials import UrdfMaterials
from kineverse.formats.xml_reader import Element, ElementError, find_child, label, read_name
from kineverse.formats.xml_values import (
    read_attribute_number,
    read_attribute_vector,
    read_or_default,
    read_origin,
)
from kineverse.model.body import Body, Box, Capsule, Cylinder, Geometry, Inertia, Mesh, Shape, Sphere, Vector3

_UNSCALED = (1.0, 1.0, 1.0)
_EMPTY_BODY = Body()


class UrdfLinkReader:
    """Reader of the links of one document."""

    def __init__(
        self, folder: str, version: tuple[int, int], remarks: ReaderWarnings, root: str | None = None
    ):
        self.materials = UrdfMaterials(remarks)
        self._folder, self._root = folder, root
        self._version = version
        self._remarks = remarks
        self._undefined_materials: list[tuple[str, int, Element, Element]] = []

    def read(self, element: Element) -> UrdfLink:
        """Return the link of a ``<link>`` element."""
        name = read_or_default(lambda: read_name(element), "", "it gets a name", self._remarks)
        visuals: list[Shape] = []
        collisions: list[Shape] = []
        inertia: Inertia | None = None
        for part in element[2]:
            tag = part[0]
            if tag == "visual":
                shape = self._shape(part, element, name, len(visuals))
                if shape is not None:
                    visuals.append(shape)
            elif tag == "collision":
                shape = self._shape(part, element)
                if shape is not None:
                    collisions.append(shape)
            elif tag == "inertial":
                if inertia is None:
                    inertia = read_or_default(
                        partial(self._inertia, part, element), None, "it is left out", self._remarks, element
                    )
                else:
                    self._remarks.add(part, "is ignored: another one came first.", element)
        if not visuals and not collisions and inertia is None:
            return UrdfLink(name, _EMPTY_BODY, element[3])
        return UrdfLink(name, Body(tuple(visuals), tuple(collisions), inertia), element[3])

    def assign_materials(self, links: dict[str, UrdfLink]) -> None:
        """Give visuals the materials that were referenced before their definition."""
        for name, index, material, element in self._undefined_materials:
            color, texture = self.materials.final_appearance(material, element)
            link = links[name]
            visuals = list(link.body.visuals)
            visuals[index] = replace(visuals[index], color=color, texture=texture)
            links[name] = replace(link, body=replace(link.body, visuals=tuple(visuals)))

    def _shape(self, element: Element, link: Element, name: str = "", index: int = -1) -> Shape | None:
        """Return the shape of a ``<visual>`` or ``<collision>``; None, with a remark, if it has none."""
        read = partial(self._read_shape, element, link, name, index)
        return read_or_default(read, None, f"the {label(element)} is left out", self._remarks, link)

    def _read_shape(self, element: Element, link: Element, name: str, index: int) -> Shape | None:
        """Return a shape; with its appearance if ``index`` is that of a visual of the link."""
        origin = geometry = material = None
        for part in element[2]:
            tag = part[0]
            if tag == "origin":
                origin = origin or part
            elif tag == "geometry":
                geometry = geometry or part
            elif tag == "material":
                material = material or part
        form = self._geometry(geometry, element, link)
        if form is None:
            return None
        pose, own_name = read_origin(origin, link, self._version, self._remarks), element[1].get("name", "")
        if material is None or index < 0:
            return Shape(form, pose, own_name)
        appearance = self.materials.appearance(material, link)
        if appearance is None:
            self._undefined_materials.append((name, index, material, link))
            return Shape(form, pose, own_name)
        return Shape(form, pose, own_name, *appearance)

    def _geometry(self, geometry: Element | None, shape: Element, link: Element) -> Geometry | None:
        """Return the geometry of a shape; None, with a remark, if it is missing or unknown."""
        if geometry is None or not geometry[2]:
            self._remarks.add(geometry or shape, "says no shape and is left out.", link)
            return None
        form = geometry[2][0]
        tag = form[0]
        if tag == "mesh":
            return self._mesh(form, link)
        if tag == "box":
            x, y, z = read_attribute_vector(form, "size")
            if min(x, y, z) < 0.0:
                raise ElementError(form, "has a negative size.")
            return Box((x, y, z))
        if tag == "sphere":
            return Sphere(_length(form, "radius"))
        if tag == "cylinder":
            return Cylinder(_length(form, "radius"), _length(form, "length"))
        if tag == "capsule":
            return Capsule(_length(form, "radius"), _length(form, "length"))
        self._remarks.add(form, f"is not a shape of URDF; the {label(shape)} is left out.", link)
        return None

    def _mesh(self, mesh: Element, link: Element) -> Mesh:
        """Return a mesh, with a remark if its file is outside of the root folder."""
        uri = mesh[1].get("filename")
        if not uri:
            raise ElementError(mesh, "has no filename; the specification requires it.")
        violation = find_root_violation(uri, self._folder, self._root)
        if violation is not None:
            self._remarks.add(mesh, f"names {violation}", link)
        return Mesh(uri, self._scale(mesh, link), self._folder, self._root)

    def _scale(self, mesh: Element, link: Element) -> Vector3:
        """Return the scale of a mesh; one factor or four factors are read as other parsers read them."""
        words = mesh[1].get("scale", "").split()
        if len(words) in (1, 4):
            x, y, z = words * 3 if len(words) == 1 else words[:3]
            corrected = (mesh[0], {"scale": f"{x} {y} {z}"}, mesh[2], mesh[3])
            default = read_or_default(
                lambda: read_attribute_vector(corrected, "scale"),
                _UNSCALED,
                "it is not scaled",
                self._remarks,
                link,
            )
        else:
            default = _UNSCALED
        shown = " ".join(f"{factor:g}" for factor in default)
        return read_or_default(
            lambda: read_attribute_vector(mesh, "scale", _UNSCALED),
            default,
            f"{shown} is taken",
            self._remarks,
            link,
        )

    def _inertia(self, inertial: Element, link: Element) -> Inertia:
        """Return the inertia of a link; a missing tensor is zero."""
        mass_element, tensor = find_child(inertial, "mass"), find_child(inertial, "inertia")
        mass = 0.0 if mass_element is None else read_attribute_number(mass_element, "value", 0.0)
        if mass < 0.0:
            self._remarks.add(inertial, f"has the negative mass {mass!r}, which is kept as it is.", link)
        origin = read_origin(find_child(inertial, "origin"), link, self._version, self._remarks)
        if tensor is None:
            return Inertia(mass, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), origin)
        ixx, ixy, ixz = (
            read_attribute_number(tensor, "ixx", 0.0),
            read_attribute_number(tensor, "ixy", 0.0),
            read_attribute_number(tensor, "ixz", 0.0),
        )
        iyy, iyz, izz = (
            read_attribute_number(tensor, "iyy", 0.0),
            read_attribute_number(tensor, "iyz", 0.0),
            read_attribute_number(tensor, "izz", 0.0),
        )
        return Inertia(mass, (ixx, ixy, ixz, iyy, iyz, izz), origin)


def _length(form: Element, key: str) -> float:
    """Return a length [m] that is not negative."""
    value = read_attribute_number(form, key)
    if value < 0.0:
        raise ElementError(form, f"has a negative {key}.")
    return value
