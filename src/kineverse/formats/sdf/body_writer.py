"""Inertia, visuals and collision shapes of written SDF links."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kineverse.errors import list_some
from kineverse.formats.description import Matrix
from kineverse.formats.names import TakenNames
from kineverse.formats.poses import rpy_angles
from kineverse.formats.resource_paths import mesh_reference
from kineverse.formats.xml_writer import Tag, format_numbers
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
    Shape,
    Sphere,
)

from .custom_attributes import INERTIA, NAME, allowed_name

_TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_ROUNDING = 1e-9  # part of the largest moment by which a sum of two may fall short: files have ten digits
_MASS, _MOMENT = 1e-3, 1e-6
"""Mass [kg] and moments [kg m²] of links without, since SDF takes 1 kg where none is stated."""


class SdfBodyWriter:
    """Writer of the bodies of one file."""

    def __init__(self, folder: Path, remarks: list[str]) -> None:
        self._folder = folder
        self._remarks = remarks
        self.has_cones = False
        self._massless: list[str] = []

    def write(self, link: Tag, body: Body, name: str) -> None:
        """Add the elements of a body to its link."""
        self._inertia(link, body.inertia, name)
        names = TakenNames()
        for tag, shapes in (("visual", body.visuals), ("collision", body.collisions)):
            for shape in shapes:
                own = names.take(*([allowed_name(shape.name)] if shape.name else []), tag)
                element = link.add(tag, name=own)
                if own != shape.name:
                    element.attributes[NAME] = shape.name
                add_sdf_pose(element, shape.origin.matrix)
                self._geometry(element.add("geometry"), shape.geometry)
                self._material(element, shape, name)

    def finish(self) -> None:
        """Add the remark on links that have no mass in the model."""
        if self._massless:
            links = list_some(self._massless, 4)
            self._remark(f"SDF has no links without mass; {_MASS:g} kg is written for {links}")

    def _inertia(self, link: Tag, inertia: Inertia | None, name: str) -> None:
        element = link.add("inertial")
        if inertia is None or inertia.mass <= 0:
            self._massless.append(name)
        mass, tensor = _MASS, (_MOMENT, 0.0, 0.0, _MOMENT, 0.0, _MOMENT)
        if inertia is None:
            element.attributes[INERTIA] = ""
        else:
            add_sdf_pose(element, inertia.origin.matrix)
            mass = inertia.mass if inertia.mass > 0 else _MASS
            tensor = inertia.tensor if _is_physical(inertia) else _of_sphere(inertia)
            if (mass, tensor) != (inertia.mass, inertia.tensor):
                element.attributes[INERTIA] = format_numbers((inertia.mass, *inertia.tensor))
            if tensor != inertia.tensor and inertia.mass > 0:
                self._remark(
                    f"the inertia of '{name}' is that of no body, which SDF refuses: a sphere's is written"
                )
        element.add_text("mass", mass)
        moments = element.add("inertia")
        for key, value in zip(_TENSOR, tensor, strict=True):
            moments.add_text(key, value)

    def _geometry(self, element: Tag, form: Geometry) -> None:
        if isinstance(form, Box):
            element.add("box").add_text("size", form.size)
        elif isinstance(form, Sphere):
            element.add("sphere").add_text("radius", form.radius)
        elif isinstance(form, Ellipsoid):
            element.add("ellipsoid").add_text("radii", form.radii)
        elif isinstance(form, (Cylinder, Capsule, Cone)):
            self.has_cones |= isinstance(form, Cone)
            inside = element.add(form.kind)
            inside.add_text("radius", form.radius)
            inside.add_text("length", form.length)
        elif isinstance(form, Mesh):
            inside = element.add("mesh")
            inside.add_text("uri", mesh_reference(form, self._folder, self._remark))
            if form.scale != (1.0, 1.0, 1.0):
                inside.add_text("scale", form.scale)

    def _material(self, element: Tag, shape: Shape, name: str) -> None:
        if element.name == "collision":
            if shape.color is not None or shape.texture:
                self._remark(f"the colours of the collision shapes of '{name}' are left out")
            return
        if shape.texture:
            self._remark(f"the texture {shape.texture} is left out: SDF has textures for materials of meshes")
        if shape.color is not None:
            material = element.add("material")
            for kind in ("ambient", "diffuse"):
                material.add_text(kind, shape.color)

    def _remark(self, text: str) -> None:
        if text not in self._remarks:
            self._remarks.append(text)


def add_sdf_pose(element: Tag, pose: Matrix, relative_to: str | None = None) -> None:
    """Add the ``<pose>`` of an element, unless it is the identity where poses are by default."""
    numbers = (*pose[:3, 3].tolist(), *rpy_angles(pose))
    if any(numbers) or relative_to:
        element.add_text("pose", numbers, relative_to=relative_to)


def _is_physical(inertia: Inertia) -> bool:
    """Return whether some body has these moments: none is negative or above the sum of the others."""
    least, middle, most = _moments(inertia)
    return least >= 0 and least + middle >= most * (1 - _ROUNDING)


def _of_sphere(inertia: Inertia) -> tuple[float, float, float, float, float, float]:
    mean = float(np.abs(_moments(inertia)).mean()) or _MOMENT
    return (mean, 0.0, 0.0, mean, 0.0, mean)


def _moments(inertia: Inertia) -> list[float]:
    xx, xy, xz, yy, yz, zz = inertia.tensor
    moments: list[float] = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).tolist()
    return moments
