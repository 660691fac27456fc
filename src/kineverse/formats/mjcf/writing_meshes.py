"""Meshes and textures as MuJoCo opens them: by paths, in its formats, and only where they are."""

from __future__ import annotations

import os
import struct
from collections.abc import Collection
from pathlib import Path

import numpy as np

from kineverse.errors import FormatError, MissingExtraError
from kineverse.formats.export.meshes import Note, found, path_to
from kineverse.formats.packages import locate_mesh
from kineverse.model.body import Mesh

_HEADER, _TRIANGLE = 84, 50
MOST_FACES = 200_000
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

    def __init__(self, path: Path, note: Note, without: Collection[str] = ()) -> None:
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
        there = found(texture)
        if there is None or there.suffix.lower() != ".png":
            why = "it is not there" if there is None else "MuJoCo reads PNG"
            self._note(f"the texture {uri} is left out: {why}")
            return None
        return path_to(there, self._folder, self._note)

    def _file(self, mesh: Mesh) -> str | None:
        try:
            there = Path(os.path.abspath(locate_mesh(mesh)))
        except FormatError as error:
            self._note(f"the mesh {mesh.uri} is left out. {error}")
            return None
        if there.suffix.lower() in (".obj", ".msh") or _is_binary_stl(there):
            return path_to(there, self._folder, self._note)
        return self._convert(mesh, there)

    def _convert(self, mesh: Mesh, there: Path) -> str | None:
        # Where meshes are read is a layer above, as it needs an extra; only who converts asks for it.
        from kineverse.geometry.mesh_files import find, read_faces

        try:
            triangles = read_faces(find(mesh))
        except (FormatError, MissingExtraError, OSError) as error:
            self._note(f"the mesh {mesh.uri} is left out: MuJoCo cannot read it, and {error}")
            return None
        content = _as_obj(triangles.vertices, triangles.faces)
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
    return 0 < count <= MOST_FACES and size == _HEADER + _TRIANGLE * count


def _as_obj(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """Return triangles as an OBJ, coordinates to the last bit."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    return ("\n".join(lines) + "\n").encode()
