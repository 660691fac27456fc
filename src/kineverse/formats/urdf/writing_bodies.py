"""Bodies as what is inside of ``<link>``: inertia, shapes to see, shapes to touch."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from kineverse.formats.export.markup import Tag
from kineverse.formats.export.meshes import reference
from kineverse.formats.export.poses import angles
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

_IDENTITY = Pose()
_TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


class BodyWriter:
    """Writes the bodies of one file.

    Parameters
    ----------
    folder
        Where the file will lie.
    remarks
        What is left out is said here.
    """

    def __init__(self, folder: Path, remarks: list[str]) -> None:
        self._folder = folder
        self._remarks = remarks
        self._materials: dict[object, str] = {}

    def write(self, link: Tag, body: Body) -> None:
        """Put a body into the element of its link."""
        name = link.attributes["name"]
        if body.inertia is not None:
            _inertia(link, body.inertia)
        for shape in body.visuals:
            visual = self._shape(link, "visual", shape, name)
            if visual is not None:
                self._material(visual, shape)
        for shape in body.collisions:
            self._shape(link, "collision", shape, name)
            if shape.color is not None or shape.texture:
                self._remark(f"the colours of what is to be touched of '{name}' are left out")

    def _shape(self, link: Tag, tag: str, shape: Shape, name: str) -> Tag | None:
        if isinstance(shape.geometry, (Ellipsoid, Cone)):
            kind = type(shape.geometry).__name__.lower()
            self._remark(f"URDF has no {kind}: one of '{name}' is left out ({tag})")
            return None
        element = link.add(tag, name=shape.name or None)
        origin(element, shape.origin)
        self._geometry(element.add("geometry"), shape.geometry)
        return element

    def _geometry(self, element: Tag, form: Geometry) -> None:
        if isinstance(form, Box):
            element.add("box", size=form.size)
        elif isinstance(form, Cylinder):
            element.add("cylinder", radius=form.radius, length=form.length)
        elif isinstance(form, Capsule):
            element.add("capsule", radius=form.radius, length=form.length)
        elif isinstance(form, Sphere):
            element.add("sphere", radius=form.radius)
        elif isinstance(form, Mesh):
            scale = None if form.scale == (1.0, 1.0, 1.0) else form.scale
            element.add("mesh", filename=reference(form, self._folder, self._remark), scale=scale)

    def _material(self, visual: Tag, shape: Shape) -> None:
        if shape.color is None and not shape.texture:
            return
        folder = shape.geometry.folder if shape.texture and isinstance(shape.geometry, Mesh) else ""
        key = shape.color, shape.texture, folder
        # Equal ones share a name, because a name that means two things is an error for some readers.
        name = self._materials.setdefault(key, f"material_{len(self._materials) + 1}")
        material = visual.add("material", name=name)
        if shape.color is not None:
            material.add("color", rgba=shape.color)
        if shape.texture:
            material.add("texture", filename=self._texture(shape))

    def _texture(self, shape: Shape) -> str:
        """Return what the file calls a texture; where a relative one is, only a mesh beside it knows."""
        if isinstance(shape.geometry, Mesh) and shape.geometry.folder:
            texture = replace(shape.geometry, uri=shape.texture)
            return reference(texture, self._folder, self._remark)
        if "://" not in shape.texture and not os.path.isabs(shape.texture):
            self._remark(f"the texture {shape.texture} is written as it is, relative to some other folder")
        return shape.texture

    def _remark(self, text: str) -> None:
        if text not in self._remarks:
            self._remarks.append(text)


def origin(element: Tag, pose: Pose) -> None:
    """Say where something is, unless it is where it is by default."""
    if pose == _IDENTITY:
        return
    matrix = pose.matrix
    turned = angles(matrix)
    element.add("origin", xyz=matrix[:3, 3].tolist(), rpy=None if turned == (0.0, 0.0, 0.0) else turned)


def _inertia(link: Tag, inertia: Inertia) -> None:
    element = link.add("inertial")
    origin(element, inertia.origin)
    element.add("mass", value=inertia.mass)
    element.add("inertia", **dict(zip(_TENSOR, inertia.tensor, strict=True)))
