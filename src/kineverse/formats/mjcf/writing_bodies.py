"""Bodies as what is inside of ``<body>``: inertia, geoms, and the meshes and materials of these."""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from kineverse.formats.export.markup import Tag
from kineverse.formats.export.poses import quaternion
from kineverse.formats.mjcf.writing_meshes import MeshFiles
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
_LIGHTEST = 1e-13
"""What is less is none for MuJoCo, a mass [kg] or a moment of inertia [kg m²]: it wants 1e-15 and 1e-14."""
_ROUNDING = 1e-12


class BodyWriter:
    """Writes the bodies of one file.

    Parameters
    ----------
    path
        Where the file will lie.
    remarks
        What is left out is said here.
    without
        Files of meshes that are left out, by what they would be called.

    Attributes
    ----------
    assets
        Meshes, textures and materials.
    files
        Where meshes are, and what becomes of those that MuJoCo cannot read.
    """

    def __init__(self, path: Path, remarks: list[str], without: Collection[str] = ()) -> None:
        self.assets = Tag("asset")
        self.files = MeshFiles(path, self._remark, without)
        self._unbalanced = self._weightless = False
        self._without_inertia: list[str] = []
        self._least_mass = self._least_inertia = math.inf
        self._remarks = remarks
        self._meshes: dict[tuple[str, tuple[float, ...]], str] = {}
        self._materials: dict[Any, str | None] = {}
        self._names: set[str] = set()

    def write(self, element: Tag, body: Body, name: str, *, moves: bool) -> None:
        """Put a body into the element of its frame."""
        least = None if body.inertia is None else self._inertia(element, body.inertia, name)
        if name != "world" and least is None:
            self._without_inertia.append(name)
        mass, inertia = least or (0.0, 0.0)
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

    def _inertia(self, element: Tag, inertia: Inertia, name: str) -> tuple[float, float] | None:
        """Write an inertia; return mass and least moment as written, None if there is none like it."""
        xx, xy, xz, yy, yz, zz = inertia.tensor
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        moments, axes = np.linalg.eigh(tensor)
        least, middle, most = moments.tolist()
        mass = inertia.mass
        # What is off by rounding is none that is negative: (0, 0, 1) in other axes has -1e-17 in it.
        if mass < 0 or least < -_ROUNDING * max(most, 0.0):
            self._remark(f"the inertia of '{name}' is left out: no body has one that is negative")
            return None
        if 0 < mass < _LIGHTEST:
            self._remark(f"the mass of '{name}', {mass:g} kg, is as good as none for MuJoCo, so it has none")
            mass = 0.0
        pose, diagonal = inertia.origin.matrix, not (xy or xz or yz)
        floor = max(_LIGHTEST, _ROUNDING * most)
        if most < _LIGHTEST and tensor.any():
            self._remark(f"the inertia of '{name}' is as good as none for MuJoCo, so it has none")
            tensor, diagonal = np.zeros((3, 3)), True
            xx = yy = zz = least = middle = most = 0.0
        elif least < floor < most:
            # As a full tensor it would be refused; so it is given along its axes, each with a moment.
            is_one = least + middle >= most - floor
            least, middle = max(least, floor), max(middle, floor)
            middle = max(middle, most - least) if is_one else middle
            self._remark(
                f"the inertia of '{name}' has a moment of as good as nothing, which MuJoCo refuses: it is "
                f"written as {floor:g} kg m²"
            )
            turn = np.eye(4)
            turn[:3, :3] = axes if np.linalg.det(axes) > 0 else -axes
            pose, diagonal = pose @ turn, True
            xx, yy, zz = least, middle, most
        if least + middle < most * (1 - _ROUNDING):
            self._unbalanced = True
            self._remark(
                f"the inertia of '{name}' is that of no body, so MuJoCo takes a sphere's in its place"
            )
        made = element.add("inertial", pos=inertia.origin.matrix[:3, 3].tolist())
        if not diagonal:
            turn = inertia.origin.matrix[:3, :3]
            xx, xy, xz, _, yy, yz, _, _, zz = (turn @ tensor @ turn.T).ravel().tolist()
            made.give("mass", mass)
            made.give("fullinertia", (xx, yy, zz, xy, xz, yz))
            return mass, least
        turned(made, pose)
        made.give("mass", mass)
        made.give("diaginertia", (xx, yy, zz))
        return mass, min(xx, yy, zz)

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
        material = self._material(shape) if shape.texture else None
        if material is not None:
            geom.give("material", material)
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
            mesh = self._mesh(form)
            return None if mesh is None else {"type": "mesh", "mesh": mesh}
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

    def _mesh(self, mesh: Mesh) -> str | None:
        file = self.files.file(mesh)
        if file is None:
            return None
        key = file, mesh.scale
        if key not in self._meshes:
            self._meshes[key] = f"mesh_{len(self._meshes) + 1}"
            scale = None if mesh.scale == (1.0, 1.0, 1.0) else mesh.scale
            # How much of it there is does not matter, since geoms have no mass; and some are flat.
            self.assets.add("mesh", name=self._meshes[key], file=file, scale=scale, inertia="shell")
        return self._meshes[key]

    def _material(self, shape: Shape) -> str | None:
        beside = shape.geometry if isinstance(shape.geometry, Mesh) else Mesh("")
        key = shape.color, shape.texture, beside.folder, beside.root
        if key not in self._materials:
            file = self.files.texture(Mesh(shape.texture, folder=beside.folder, root=beside.root))
            self._materials[key] = None
            if file is not None:
                name = self._materials[key] = f"material_{len(self._materials)}"
                self.assets.add("texture", name=name, type="2d", file=file)
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
