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
from kineverse.formats.export.mesh_paths import RemarkCallback, file_reference, find_file
from kineverse.formats.export.poses import unit_quaternion
from kineverse.formats.resource_paths import locate_mesh
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
MAX_STL_FACES = 200_000
"""Faces of an STL that MuJoCo reads."""


class MeshFiles:
    """Finds the meshes of one file, and converts those that MuJoCo cannot read.

    Parameters
    ----------
    path
        Where the file will lie; converted meshes lie beside it, in a folder ``NAME_meshes``.
    note
        Called with remarks.
    without
        Files, as the description names them, that are left out, since MuJoCo refuses them.

    Attributes
    ----------
    converted
        The content of files that are to be written beside the description.
    """

    def __init__(self, path: Path, note: RemarkCallback, without: Collection[str] = ()) -> None:
        self._folder = path.absolute().parent
        self._beside = self._folder / f"{path.name.removesuffix(path.suffix)}_meshes"
        self._note, self._without = note, without
        self._known: dict[tuple[str, str, str | None], str | None] = {}
        self.converted: dict[Path, bytes] = {}

    def file(self, mesh: Mesh) -> str | None:
        """Return what the description calls the file of a mesh; None if it is left out, with a remark."""
        key = mesh.uri, mesh.folder, mesh.root
        if key not in self._known:
            self._known[key] = self._file(mesh)
        named = self._known[key]
        return None if named in self._without else named

    def texture(self, texture: Mesh) -> str | None:
        """Return what the description calls the file of a texture; None if it is left out, with a remark.

        Parameters
        ----------
        texture
            What it is called, its folder and its root, as those of a mesh.
        """
        uri = texture.uri
        if not texture.folder and "://" not in uri and not os.path.isabs(uri):
            self._note(f"the texture {uri} is left out: it is relative to a folder that is not known")
            return None
        there = find_file(texture)
        if there is None or there.suffix.lower() != ".png":
            why = "it is not there" if there is None else "MuJoCo reads PNG"
            self._note(f"the texture {uri} is left out: {why}")
            return None
        return file_reference(there, self._folder, self._note)

    def _file(self, mesh: Mesh) -> str | None:
        try:
            there = Path(os.path.abspath(locate_mesh(mesh)))
        except FormatError as error:
            self._note(f"the mesh {mesh.uri} is left out. {error}")
            return None
        if there.suffix.lower() in (".obj", ".msh") or _is_binary_stl(there):
            return file_reference(there, self._folder, self._note)
        return self._convert(mesh, there)

    def _convert(self, mesh: Mesh, there: Path) -> str | None:
        try:
            triangles = find_service("read_mesh")(mesh)
        except (FormatError, MissingDependencyError, OSError) as error:
            self._note(f"the mesh {mesh.uri} is left out: MuJoCo cannot read it, and {error}")
            return None
        content = _to_obj(triangles.vertices, triangles.faces)
        name, count = f"{there.stem}.obj", 1
        while self._is_another(self._beside / name, content):
            count += 1
            name = f"{there.stem}_{count}.obj"
        self.converted[self._beside / name] = content
        self._note(f"the mesh {mesh.uri} is converted to {self._beside.name}/{name}, which MuJoCo can read")
        return f"{self._beside.name}/{name}"

    def _is_another(self, path: Path, content: bytes) -> bool:
        """Whether a path is that of another mesh, or of a file that is there and that nobody gave up."""
        if path in self.converted:
            return self.converted[path] != content
        try:
            return os.path.lexists(path) and path.read_bytes() != content
        except OSError:
            return True


def _is_binary_stl(path: Path) -> bool:
    """Whether a file is an STL as MuJoCo reads them: binary, with as many faces as there is room for."""
    if path.suffix.lower() != ".stl":
        return False
    try:
        with path.open("rb") as file:
            start = file.read(_HEADER)
            size = os.fstat(file.fileno()).st_size
    except OSError:  # whoever reads it says why
        return False
    if len(start) < _HEADER:
        return False
    count: int = struct.unpack("<I", start[-4:])[0]
    return 0 < count <= MAX_STL_FACES and size == _HEADER + _TRIANGLE * count


def _to_obj(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """Return triangles as an OBJ, coordinates to the last bit."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    return ("\n".join(lines) + "\n").encode()


VISUAL_GROUP, COLLISION_GROUP = "1", "3"
"""The groups of geoms that are seen, which viewers show, and touched, which they show when asked to."""

_SMALLEST_MASS, _SMALLEST_INERTIA = 1e-3, 1e-6
_LIGHTEST = 1e-13
"""What is less is none for MuJoCo, a mass [kg] or a moment of inertia [kg m²]: it wants 1e-15 and 1e-14."""
_ROUNDING = 1e-12


class MjcfBodyWriter:
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
            turn = axes if np.linalg.det(axes) > 0 else -axes
            pose, diagonal = pose @ transform(turn, np.zeros(3)), True
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
        add_orientation(made, pose)
        made.give("mass", mass)
        made.give("diaginertia", (xx, yy, zz))
        return mass, min(xx, yy, zz)

    def _shape(self, element: Tag, shape: Shape, name: str, *, seen: bool) -> None:
        given = self._geometry(shape.geometry, name)
        if given is None:
            return
        geom = element.add("geom", name=self._name(shape, name), **given)
        add_pose(geom, shape.origin.matrix)
        geom.give("group", VISUAL_GROUP if seen else COLLISION_GROUP)
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


def add_pose(element: Tag, pose: Any) -> None:
    """Say where something is, unless it is where it is by default."""
    if pose[:3, 3].any():
        element.give("pos", pose[:3, 3].tolist())
    add_orientation(element, pose)


def add_orientation(element: Tag, pose: Any) -> None:
    """Say how something is turned, unless it is not."""
    x, y, z, w = unit_quaternion(pose)
    if (x, y, z) != (0.0, 0.0, 0.0):
        element.give("quat", (w, x, y, z))
