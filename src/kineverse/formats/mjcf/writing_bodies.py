"""Bodies as what is inside of ``<body>``: inertia, geoms, and the meshes and materials of these."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from kineverse.formats.export.markup import Tag
from kineverse.formats.export.meshes import reference
from kineverse.formats.export.poses import quaternion
from kineverse.model.body import (
    Body,
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Geometry,
    Inertia,
    Mesh,
    Shape,
    Sphere,
)

SEEN, TOUCHED = "1", "3"
"""The groups of geoms that are seen, which viewers show, and touched, which they show when asked to."""

_SMALLEST_MASS, _SMALLEST_INERTIA = 1e-3, 1e-6


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
        self.assets = Tag("asset")
        self._unbalanced = self._weightless = False
        self._without_inertia: list[str] = []
        self._least_mass = self._least_inertia = math.inf
        self._folder, self._remarks = folder, remarks
        self._meshes: dict[tuple[str, tuple[float, ...]], str] = {}
        self._materials: dict[Any, str] = {}
        self._names: set[str] = set()

    def write(self, element: Tag, body: Body, name: str, *, moves: bool) -> None:
        """Put a body into the element of its frame."""
        if name != "world" and (body.inertia is None or not self._inertia(element, body.inertia, name)):
            self._without_inertia.append(name)
        mass = 0.0 if body.inertia is None else body.inertia.mass
        inertia = 0.0 if body.inertia is None else min(body.inertia.tensor[k] for k in (0, 3, 5))
        self._least_mass = min(self._least_mass, mass if mass > 0 else math.inf)
        self._least_inertia = min(self._least_inertia, inertia if inertia > 0 else math.inf)
        self._weightless |= moves and (mass <= 0 or inertia <= 0)
        for shape in body.visuals:
            self._shape(element, shape, name, seen=True)
        for shape in body.collisions:
            self._shape(element, shape, name, seen=False)

    def settings(self) -> dict[str, str | float]:
        """Return what the compiler is to do about inertia: MuJoCo moves nothing that has none."""
        found: dict[str, str | float] = {"balanceinertia": "true"} if self._unbalanced else {}
        if self._weightless:
            # What has less is given this much, so it is no more than what anything has.
            found["boundmass"] = min(_SMALLEST_MASS, self._least_mass)
            found["boundinertia"] = min(_SMALLEST_INERTIA, self._least_inertia)
        return found

    @property
    def massless(self) -> list[str]:
        """The frames without inertia, if :meth:`settings` give them one."""
        return self._without_inertia if self._weightless else []

    def _inertia(self, element: Tag, inertia: Inertia, name: str) -> bool:
        """Write an inertia; return whether there can be one like it."""
        xx, xy, xz, yy, yz, zz = inertia.tensor
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        least, middle, most = np.linalg.eigvalsh(tensor).tolist()
        if inertia.mass < 0 or least < 0:
            self._remark(f"the inertia of '{name}' is left out: no body has one that is negative")
            return False
        if least + middle < most:
            self._unbalanced = True
            self._remark(
                f"the inertia of '{name}' is that of no body, so MuJoCo takes a sphere's in its place"
            )
        made = element.add("inertial", pos=inertia.origin.matrix[:3, 3].tolist())
        if xy or xz or yz:
            turn = inertia.origin.matrix[:3, :3]
            xx, xy, xz, _, yy, yz, _, _, zz = (turn @ tensor @ turn.T).ravel().tolist()
            made.give("mass", inertia.mass)
            made.give("fullinertia", (xx, yy, zz, xy, xz, yz))
            return True
        turned(made, inertia.origin.matrix)
        made.give("mass", inertia.mass)
        made.give("diaginertia", (xx, yy, zz))
        return True

    def _shape(self, element: Tag, shape: Shape, name: str, *, seen: bool) -> None:
        given = self._geometry(shape.geometry, name)
        if given is None:
            return
        geom = element.add("geom", name=self._name(shape, name), **given)
        placed(geom, shape.origin.matrix)
        geom.give("group", SEEN if seen else TOUCHED)
        if seen:
            geom.give("contype", "0")
            geom.give("conaffinity", "0")
        geom.give("mass", 0.0)  # that of the body is all there is
        if shape.texture:
            geom.give("material", self._material(shape))
        elif shape.color is not None:
            geom.give("rgba", shape.color)

    def _name(self, shape: Shape, owner: str) -> str | None:
        if not shape.name or shape.name in self._names:
            if shape.name:
                self._remark(f"a shape of '{owner}' has no name, since there is another '{shape.name}'")
            return None
        self._names.add(shape.name)
        return shape.name

    def _geometry(self, form: Geometry, name: str) -> dict[str, Any] | None:
        if isinstance(form, Mesh):
            return {"type": "mesh", "mesh": self._mesh(form)}
        sizes: dict[type, tuple[str, tuple[float, ...]]] = {}
        if isinstance(form, Box):
            x, y, z = form.size
            sizes[Box] = "box", (x / 2, y / 2, z / 2)
        elif isinstance(form, Sphere):
            sizes[Sphere] = "sphere", (form.radius,)
        elif isinstance(form, (Cylinder, Capsule)):
            sizes[type(form)] = type(form).__name__.lower(), (form.radius, form.length / 2)
        elif isinstance(form, Ellipsoid):
            sizes[Ellipsoid] = "ellipsoid", form.radii
        if type(form) not in sizes:
            self._remark(f"MJCF has no {type(form).__name__.lower()}: one of '{name}' is left out")
            return None
        kind, size = sizes[type(form)]
        if not all(s > 0 or math.isnan(s) for s in size):
            self._remark(f"MJCF has no {kind} of size 0: one of '{name}' is left out")
            return None
        return {"type": kind, "size": size}

    def _mesh(self, mesh: Mesh) -> str:
        file = reference(mesh, self._folder)
        key = file, mesh.scale
        if key not in self._meshes:
            self._meshes[key] = f"mesh_{len(self._meshes) + 1}"
            scale = None if mesh.scale == (1.0, 1.0, 1.0) else mesh.scale
            self.assets.add("mesh", name=self._meshes[key], file=file, scale=scale)
            if "://" in file or not file.lower().endswith((".stl", ".obj", ".msh")):
                self._remark(f"MuJoCo itself cannot open {file}: it reads STL, OBJ and MSH, by their paths")
        return self._meshes[key]

    def _material(self, shape: Shape) -> str:
        key = shape.color, shape.texture
        if key not in self._materials:
            name = self._materials[key] = f"material_{len(self._materials) + 1}"
            self.assets.add("texture", name=name, type="2d", file=shape.texture)
            self.assets.add("material", name=name, texture=name, rgba=shape.color)
        return self._materials[key]

    def _remark(self, text: str) -> None:
        if text not in self._remarks:
            self._remarks.append(text)


def placed(element: Tag, pose: Any) -> None:
    """Say where something is, unless it is where it is by default."""
    if pose[:3, 3].any():
        element.give("pos", pose[:3, 3].tolist())
    turned(element, pose)


def turned(element: Tag, pose: Any) -> None:
    """Say how something is turned, unless it is not."""
    x, y, z, w = quaternion(pose)
    if (x, y, z) != (0.0, 0.0, 0.0):
        element.give("quat", (w, x, y, z))
