"""URDF inertias, visuals, collision shapes and materials.

Specification: http://wiki.ros.org/urdf/XML/link, and urdf.xsd of ros/urdfdom for defaults. Shapes and colours
do not affect kinematics: a shape that is missing or not supported is left out with a remark. A colour inside
of a visual applies to that visual. A material that is only named is looked up among those of the robot, then
among those that other visuals define.
"""

from __future__ import annotations

from functools import partial
from typing import TypeAlias

from msgspec import structs

from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.resource_paths import RealPaths, find_root_violation
from kineverse.formats.xml_reader import Element, ElementError, find_child, label, quote, read_name
from kineverse.formats.xml_values import (
    parse_numbers,
    read_attribute_number,
    read_attribute_vector,
    read_or_default,
    read_origin,
)
from kineverse.model.body import (
    NO_BODY,
    Body,
    Box,
    Capsule,
    Cylinder,
    Geometry,
    Inertia,
    Mesh,
    Rgba,
    Shape,
    Sphere,
    Vector3,
)

from .description import UrdfLink
from .kept_elements import KeptMaterial

Appearance: TypeAlias = tuple[Rgba | None, str]  # colour or None, and the file of the texture or ""

_NO_APPEARANCE: Appearance = (None, "")


class UrdfMaterials:
    """Materials of one document, as far as it has been read."""

    def __init__(self, remarks: ReaderWarnings):
        self._remarks = remarks
        self._shared: dict[str, Appearance] = {}
        self.defined: list[KeptMaterial] = []
        self._local: dict[str, Appearance] = {}

    def define(self, material: Element) -> None:
        """Define a material of the robot."""
        appearance = self._read(material, material)
        self.defined.append(KeptMaterial(material[1].get("name", ""), *appearance))
        if appearance == _NO_APPEARANCE:
            return
        earlier = self._shared.setdefault(material[1].get("name", ""), appearance)
        if earlier != appearance:
            mistake = ElementError(
                material,
                f"is {_format_appearance(appearance)} here and {_format_appearance(earlier)} before; "
                "give the two different names.",
            )
            self._remarks.repair(mistake, "the first is taken")

    def appearance(self, material: Element, link: Element) -> Appearance | None:
        """Return the appearance of a visual's ``<material>``; None if it is not defined yet."""
        name = material[1].get("name", "")
        if material[2]:
            own = self._read(material, link)
            if own != _NO_APPEARANCE:
                self._local.setdefault(name, own)
                return own
        return self._shared.get(name) if name else _NO_APPEARANCE

    def final_appearance(self, material: Element, link: Element) -> Appearance:
        """Return the appearance of a material that is only named, after the end of the document."""
        name = material[1].get("name", "")
        found = self._shared.get(name) or self._local.get(name)
        if found is None:
            self._remarks.add(material, "is defined nowhere; the shape has no colour.", link)
        return found or _NO_APPEARANCE

    def _read(self, material: Element, owner: Element) -> Appearance:
        """Return the colour and texture of a material; three numbers are read as an opaque colour."""
        color, texture = find_child(material, "color"), find_child(material, "texture")
        file = "" if texture is None else texture[1].get("filename", "")
        text = None if color is None else color[1].get("rgba")
        if color is None or text is None:
            return (None, file)
        try:
            if len(text.split()) == 3:
                red, green, blue = parse_numbers(text, 3)
                self._remarks.add(color, "has three numbers instead of four; it is taken as opaque.", owner)
                return ((red, green, blue, 1.0), file)
            red, green, blue, alpha = parse_numbers(text, 4)
        except ValueError as error:
            mistake = ElementError(color, f"rgba={quote(text)} {error}.")
            try:
                red, green, blue, alpha = parse_numbers(" ".join(text.split()[:4]), 4)
            except ValueError:
                self._remarks.repair(mistake, "it is no colour", owner)
                return (None, file)
            self._remarks.repair(mistake, "the first four are taken", owner)
        return ((red, green, blue, alpha), file)


def _format_appearance(appearance: Appearance) -> str:
    color, texture = appearance
    words = [] if color is None else ["rgba " + " ".join(f"{part:g}" for part in color)]
    return " with ".join([*words, f"texture {quote(texture)}"] if texture else words)


_UNSCALED = (1.0, 1.0, 1.0)


class UrdfLinkReader:
    """Reader of the links of one document."""

    def __init__(
        self, folder: str, version: tuple[int, int], remarks: ReaderWarnings, root: str | None = None
    ):
        self.materials = UrdfMaterials(remarks)
        self._folder, self._root, self._real_path = folder, root, RealPaths()
        self._version = version
        self._remarks = remarks
        self.visual_materials: dict[str, dict[int, tuple[str, bool]]] = {}
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
            return UrdfLink(name, NO_BODY, element[3])
        return UrdfLink(name, Body(tuple(visuals), tuple(collisions), inertia), element[3])

    def assign_materials(self, links: dict[str, UrdfLink]) -> None:
        """Give visuals the materials that were referenced before their definition."""
        for name, index, material, element in self._undefined_materials:
            color, texture = self.materials.final_appearance(material, element)
            link = links[name]
            visuals = list(link.body.visuals)
            visuals[index] = structs.replace(visuals[index], color=color, texture=texture)
            links[name] = structs.replace(link, body=structs.replace(link.body, visuals=tuple(visuals)))

    def _shape(self, element: Element, link: Element, name: str = "", index: int = -1) -> Shape | None:
        read = partial(self._read_shape, element, link, name, index)
        return read_or_default(read, None, f"the {label(element)} is left out", self._remarks, link)

    def _read_shape(self, element: Element, link: Element, name: str, index: int) -> Shape | None:
        origin, geometry, material = (find_child(element, tag) for tag in ("origin", "geometry", "material"))
        form = self._geometry(geometry, element, link)
        if form is None:
            return None
        pose, own_name = read_origin(origin, link, self._version, self._remarks), element[1].get("name", "")
        if material is None or index < 0:
            return Shape(form, pose, own_name)
        named = material[1].get("name", "")
        if named:
            self.visual_materials.setdefault(name, {})[index] = named, bool(material[2])
        appearance = self.materials.appearance(material, link)
        if appearance is None:
            self._undefined_materials.append((name, index, material, link))
            return Shape(form, pose, own_name)
        return Shape(form, pose, own_name, *appearance)

    def _geometry(self, geometry: Element | None, shape: Element, link: Element) -> Geometry | None:
        if geometry is None or not geometry[2]:
            self._remarks.add(geometry or shape, "has no shape and is left out.", link)
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
        uri = mesh[1].get("filename")
        if not uri:
            raise ElementError(mesh, "has no filename; the specification requires it.")
        violation = find_root_violation(uri, self._folder, self._root, self._real_path)
        if violation is not None:
            self._remarks.add(mesh, f"names {violation}", link)
        return Mesh(uri, self._scale(mesh, link), self._folder, self._root)

    def _scale(self, mesh: Element, link: Element) -> Vector3:
        """Return the scale of a mesh; one factor or four factors are read as other parsers read them."""
        words, default = mesh[1].get("scale", "").split(), _UNSCALED
        read = partial(read_or_default, remarks=self._remarks, owner=link)
        if len(words) in (1, 4):
            scale = " ".join(words * 3 if len(words) == 1 else words[:3])
            corrected = (mesh[0], {"scale": scale}, mesh[2], mesh[3])
            default = read(partial(read_attribute_vector, corrected, "scale"), _UNSCALED, "it is not scaled")
        shown = " ".join(f"{factor:g}" for factor in default)
        return read(partial(read_attribute_vector, mesh, "scale", _UNSCALED), default, f"{shown} is taken")

    def _inertia(self, inertial: Element, link: Element) -> Inertia:
        mass_element, tensor = find_child(inertial, "mass"), find_child(inertial, "inertia")
        mass = 0.0 if mass_element is None else read_attribute_number(mass_element, "value", 0.0)
        if mass < 0.0:
            self._remarks.add(inertial, f"has the negative mass {mass!r}, which is kept as it is.", link)
        origin = read_origin(find_child(inertial, "origin"), link, self._version, self._remarks)
        if tensor is None:
            return Inertia(mass, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), origin)
        keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        ixx, ixy, ixz, iyy, iyz, izz = (read_attribute_number(tensor, key, 0.0) for key in keys)
        return Inertia(mass, (ixx, ixy, ixz, iyy, iyz, izz), origin)


def _length(form: Element, key: str) -> float:
    """Return a length [m] that is not negative."""
    value = read_attribute_number(form, key)
    if value < 0.0:
        raise ElementError(form, f"has a negative {key}.")
    return value
