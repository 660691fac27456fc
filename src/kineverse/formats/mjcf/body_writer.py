"""Inertia, geoms, mesh files and materials of written MJCF bodies."""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from kineverse.errors import FormatError, MissingDependencyError
from kineverse.formats.poses import unit_quaternion
from kineverse.formats.resource_paths import RemarkCallback, file_reference, find_file, locate_mesh
from kineverse.formats.xml_writer import Tag
from kineverse.lie import transform
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
from kineverse.model.registry import find_service

_HEADER, _TRIANGLE = 84, 50
MAX_STL_FACES = 200_000  # largest number of faces of an STL file in MuJoCo


class MeshFiles:
    """Mesh files of one description; meshes that MuJoCo cannot read are converted."""

    def __init__(self, path: Path, remark: RemarkCallback, excluded_files: Collection[str] = ()) -> None:
        self._folder = path.absolute().parent
        self._mesh_folder = self._folder / f"{path.name.removesuffix(path.suffix)}_meshes"
        self._remark, self._excluded_files = remark, excluded_files
        self._references: dict[tuple[str, str, str | None], str | None] = {}
        self.converted: dict[Path, bytes] = {}

    def mesh_reference(self, mesh: Mesh) -> str | None:
        """Return the reference to the file of a mesh; None, with a remark, if it is left out."""
        key = mesh.uri, mesh.folder, mesh.root
        if key not in self._references:
            self._references[key] = self._find_or_convert(mesh)
        reference = self._references[key]
        return None if reference in self._excluded_files else reference

    def texture_reference(self, texture: Mesh) -> str | None:
        """Return the reference to the file of a texture; None, with a remark, if it is left out."""
        uri = texture.uri
        if not texture.folder and "://" not in uri and not os.path.isabs(uri):
            self._remark(f"the texture {uri} is left out: it is relative to a folder that is not known")
            return None
        file = find_file(texture)
        if file is None or file.suffix.lower() != ".png":
            reason = "it is not there" if file is None else "MuJoCo reads PNG"
            self._remark(f"the texture {uri} is left out: {reason}")
            return None
        return file_reference(file, self._folder, self._remark)

    def _find_or_convert(self, mesh: Mesh) -> str | None:
        try:
            file = Path(os.path.abspath(locate_mesh(mesh)))
        except FormatError as error:
            self._remark(f"the mesh {mesh.uri} is left out. {error}")
            return None
        if file.suffix.lower() in (".obj", ".msh") or _is_binary_stl(file):
            return file_reference(file, self._folder, self._remark)
        return self._convert(mesh, file)

    def _convert(self, mesh: Mesh, file: Path) -> str | None:
        try:
            triangles = find_service("read_mesh")(mesh)
        except (FormatError, MissingDependencyError, OSError) as error:
            self._remark(f"the mesh {mesh.uri} is left out: MuJoCo cannot read it, and {error}")
            return None
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in triangles.vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (triangles.faces + 1).tolist()]
        content = ("\n".join(lines) + "\n").encode()
        name, count = f"{file.stem}.obj", 1
        while self._is_taken(self._mesh_folder / name, content):
            count += 1
            name = f"{file.stem}_{count}.obj"
        self.converted[self._mesh_folder / name] = content
        self._remark(
            f"the mesh {mesh.uri} is converted to {self._mesh_folder.name}/{name}, which MuJoCo can read"
        )
        return f"{self._mesh_folder.name}/{name}"

    def _is_taken(self, path: Path, content: bytes) -> bool:
        if path in self.converted:
            return self.converted[path] != content
        try:
            return os.path.lexists(path) and path.read_bytes() != content
        except OSError:
            return True


def _is_binary_stl(path: Path) -> bool:
    """Return True for an STL file that MuJoCo reads: binary, with at most :data:`MAX_STL_FACES` faces."""
    if path.suffix.lower() != ".stl":
        return False
    try:
        with path.open("rb") as file:
            start = file.read(_HEADER)
            size = os.fstat(file.fileno()).st_size
    except OSError:  # the conversion reports the reason
        return False
    if len(start) < _HEADER:
        return False
    count: int = struct.unpack("<I", start[-4:])[0]
    return 0 < count <= MAX_STL_FACES and size == _HEADER + _TRIANGLE * count


VISUAL_GROUP, COLLISION_GROUP = "1", "3"
"""Geom groups of visuals, which viewers show, and of collision shapes, which they show on request."""

_SMALLEST_MASS, _SMALLEST_INERTIA = 1e-3, 1e-6
_NEGLIGIBLE = 1e-13  # mass [kg] and inertia [kg m²] that are zero; MuJoCo needs 1e-15 and 1e-14
_ROUNDING = 1e-12


class MjcfBodyWriter:
    """Writer of the bodies of one file."""

    def __init__(self, path: Path, remarks: list[str], excluded_files: Collection[str] = ()) -> None:
        self.assets = Tag("asset")
        self.files = MeshFiles(path, self._remark, excluded_files)
        self._unbalanced = self._weightless = False
        self._without_inertia: list[str] = []
        self._least_mass = self._least_inertia = math.inf
        self._remarks = remarks
        self._meshes: dict[tuple[str, tuple[float, ...]], str] = {}
        self._materials: dict[Any, str | None] = {}
        self._names: set[str] = set()

    def write(self, element: Tag, body: Body, name: str, *, moves: bool) -> None:
        """Add the elements of a body to the element of its frame."""
        least = None if body.inertia is None else self._inertia(element, body.inertia, name)
        if name != "world" and least is None:
            self._without_inertia.append(name)
        mass, inertia = least or (0.0, 0.0)
        self._least_mass = min(self._least_mass, mass if mass > 0 else math.inf)
        self._least_inertia = min(self._least_inertia, inertia if inertia > 0 else math.inf)
        self._weightless |= moves and (mass <= 0 or inertia <= 0)
        for shape in body.visuals:
            self._shape(element, shape, name, is_visual=True)
        for shape in body.collisions:
            self._shape(element, shape, name, is_visual=False)

    def settings(self) -> dict[str, str | float]:
        """Return the compiler settings for inertia: MuJoCo moves no body without mass and inertia."""
        result: dict[str, str | float] = {"balanceinertia": "true"} if self._unbalanced else {}
        if self._weightless:
            # The compiler raises smaller values to these, so they must not exceed any given value.
            result["boundmass"] = min(_SMALLEST_MASS, self._least_mass)
            result["boundinertia"] = min(_SMALLEST_INERTIA, self._least_inertia)
        return result

    @property
    def massless(self) -> list[str]:
        """Frames without inertia, if :meth:`settings` give them one."""
        return self._without_inertia if self._weightless else []

    def _inertia(self, element: Tag, inertia: Inertia, name: str) -> tuple[float, float] | None:
        """Add an inertia; return its mass and smallest principal moment, None if it is left out."""
        xx, xy, xz, yy, yz, zz = inertia.tensor
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        moments, axes = np.linalg.eigh(tensor)
        least, middle, most = moments.tolist()
        mass = inertia.mass
        # Rounding errors are not negative moments: (0, 0, 1) in rotated axes has a moment of -1e-17.
        if mass < 0 or least < -_ROUNDING * max(most, 0.0):
            self._remark(f"the inertia of '{name}' is left out: no body has one that is negative")
            return None
        if 0 < mass < _NEGLIGIBLE:
            self._remark(f"the mass of '{name}', {mass:g} kg, is as good as none for MuJoCo, so it has none")
            mass = 0.0
        pose, diagonal = inertia.origin.matrix, not (xy or xz or yz)
        floor = max(_NEGLIGIBLE, _ROUNDING * most)
        if most < _NEGLIGIBLE and tensor.any():
            self._remark(f"the inertia of '{name}' is as good as none for MuJoCo, so it has none")
            tensor, diagonal = np.zeros((3, 3)), True
            xx = yy = zz = least = middle = most = 0.0
        elif least < floor < most:
            # MuJoCo refuses it as a full tensor, so the moments about its principal axes are written.
            is_physical = least + middle >= most - floor
            least, middle = max(least, floor), max(middle, floor)
            middle = max(middle, most - least) if is_physical else middle
            self._remark(
                f"the inertia of '{name}' has a moment of as good as nothing, which MuJoCo refuses: it is "
                f"written as {floor:g} kg m²"
            )
            turn = axes if np.linalg.det(axes) > 0 else -axes
            pose, diagonal = pose @ transform(turn, np.zeros(3)), True
            xx, yy, zz = least, middle, most
        if least + middle < most * (1 - _ROUNDING):
            self._unbalanced = True
            self._remark(
                f"the inertia of '{name}' is that of no body, so MuJoCo takes a sphere's in its place"
            )
        inertial = element.add("inertial", pos=inertia.origin.matrix[:3, 3].tolist())
        if not diagonal:
            turn = inertia.origin.matrix[:3, :3]
            xx, xy, xz, _, yy, yz, _, _, zz = (turn @ tensor @ turn.T).ravel().tolist()
            inertial.give("mass", mass)
            inertial.give("fullinertia", (xx, yy, zz, xy, xz, yz))
            return mass, least
        add_orientation(inertial, pose)
        inertial.give("mass", mass)
        inertial.give("diaginertia", (xx, yy, zz))
        return mass, min(xx, yy, zz)

    def _shape(self, element: Tag, shape: Shape, name: str, *, is_visual: bool) -> None:
        attributes = self._geometry(shape.geometry, name)
        if attributes is None:
            return
        geom = element.add("geom", name=self._name(shape, name), **attributes)
        add_pose(geom, shape.origin.matrix)
        geom.give("group", VISUAL_GROUP if is_visual else COLLISION_GROUP)
        if is_visual:
            geom.give("contype", "0")
            geom.give("conaffinity", "0")
        geom.give("mass", 0.0)  # the inertial element has the mass of the body
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
        size: tuple[float, ...] = ()
        if isinstance(form, Box):
            size = tuple(edge / 2 for edge in form.size)
        elif isinstance(form, Sphere):
            size = (form.radius,)
        elif isinstance(form, (Cylinder, Capsule)):
            size = (form.radius, form.length / 2)
        elif isinstance(form, Ellipsoid):
            size = form.radii
        if not size or not all(s > 0 or math.isnan(s) for s in size):
            self._remark(
                f"MJCF has no {form.kind}{' of size 0' if size else ''}: one of '{name}' is left out"
            )
            return None
        return {"type": form.kind, "size": size}

    def _mesh(self, mesh: Mesh) -> str | None:
        file = self.files.mesh_reference(mesh)
        if file is None:
            return None
        key = file, mesh.scale
        if key not in self._meshes:
            self._meshes[key] = f"mesh_{len(self._meshes) + 1}"
            scale = None if mesh.scale == (1.0, 1.0, 1.0) else mesh.scale
            # Geoms have no mass, so any inertia rule will do; "shell" accepts flat meshes, too.
            self.assets.add("mesh", name=self._meshes[key], file=file, scale=scale, inertia="shell")
        return self._meshes[key]

    def _material(self, shape: Shape) -> str | None:
        mesh = shape.geometry if isinstance(shape.geometry, Mesh) else Mesh("")
        key = shape.color, shape.texture, mesh.folder, mesh.root
        if key not in self._materials:
            file = self.files.texture_reference(Mesh(shape.texture, folder=mesh.folder, root=mesh.root))
            self._materials[key] = None
            if file is not None:
                name = self._materials[key] = f"material_{len(self._materials)}"
                self.assets.add("texture", name=name, type="2d", file=file)
                self.assets.add("material", name=name, texture=name, rgba=shape.color)
        return self._materials[key]

    def _remark(self, text: str) -> None:
        if text not in self._remarks:
            self._remarks.append(text)


def add_pose(element: Tag, pose: Any) -> None:
    """Add the position and orientation of an element, unless they are the identity."""
    if pose[:3, 3].any():
        element.give("pos", pose[:3, 3].tolist())
    add_orientation(element, pose)


def add_orientation(element: Tag, pose: Any) -> None:
    """Say how something is turned, unless it is not."""
    x, y, z, w = unit_quaternion(pose)
    if (x, y, z) != (0.0, 0.0, 0.0):
        element.give("quat", (w, x, y, z))
