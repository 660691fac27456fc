"""Mesh files: search, checks, and reading with a cache by content."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import threading
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse._extras import install_command
from kineverse.errors import FormatError, MissingDependencyError, summarize_error
from kineverse.formats.resource_paths import locate_mesh
from kineverse.formats.resources import fetch_mesh
from kineverse.formats.root_folder import is_below
from kineverse.model.body import Mesh

from .mesh_expansion import expanded_size

Floats: TypeAlias = npt.NDArray[np.float64]
Integers: TypeAlias = npt.NDArray[np.int64]

LARGEST_FILE = 256 * 2**20  # largest mesh file that is read [bytes]; descriptions are not trusted with memory

_ARCHIVES = (".zip", ".gz", ".bz2", ".tgz", ".xz")


@dataclass(frozen=True, slots=True)
class MeshFile:
    """Existing mesh file of an acceptable size, with the SHA-256 of its content."""

    path: Path
    digest: str

    @property
    def kind(self) -> str:
        """Suffix of the file name, in lower case, with the dot."""
        return self.path.suffix.lower()


@dataclass(frozen=True, slots=True, eq=False)
class Faces:
    """The triangles of a mesh: (V, 3) vertices [m] and (F, 3) indices; read-only."""

    vertices: Floats
    faces: Integers


_by_content: dict[tuple[str, str], Faces] = {}
_reading = threading.Lock()


def find_mesh_file(mesh: Mesh) -> MeshFile:
    """Return the file of a mesh: where its description has it, else fetched by its content."""
    try:
        path = locate_mesh(mesh)
    except FormatError:
        fetched = fetch_mesh(mesh)
        if fetched is None:
            raise
        path = fetched
    size = path.stat().st_size
    if size > LARGEST_FILE:
        raise OSError(
            f"{path} has {size / 2**20:.0f} MiB, more than the {LARGEST_FILE / 2**20:.0f} MiB read here"
        )
    return MeshFile(path, hashlib.sha256(path.read_bytes()).hexdigest())


def read_mesh(mesh: Mesh) -> Faces:
    """Read the triangles of a mesh, see :func:`find_mesh_file` and :func:`read_faces`."""
    return read_faces(find_mesh_file(mesh))


def read_faces(file: MeshFile) -> Faces:
    """Return all triangles of a file, in its frame [m]; files of equal content are read once."""
    key = (file.digest, file.kind)
    with _reading:
        if key not in _by_content:
            _by_content[key] = _read_file(file)
        return _by_content[key]


def _read_file(file: MeshFile) -> Faces:
    try:
        result = load_mesh_parts(file)
    except MissingDependencyError:
        raise
    except Exception as error:  # Parsers of trimesh raise all kinds of exceptions.
        raise FormatError(f"{file.path} cannot be read as a mesh: {summarize_error(error)}") from error
    firsts = np.cumsum([0, *(len(part.vertices) for part in result[:-1])]).tolist()
    numbered = [np.asarray(part.faces, dtype=np.int64) + k for part, k in zip(result, firsts, strict=True)]
    faces = np.concatenate(numbered)
    vertices = np.concatenate([np.asarray(part.vertices, dtype=float) for part in result])
    vertices *= unit_length(file.path)
    if not np.isfinite(vertices).all():
        raise FormatError(f"{file.path} has vertices that are not finite.")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise FormatError(f"{file.path} has faces with missing vertices.")
    vertices.flags.writeable = faces.flags.writeable = False
    return Faces(vertices, faces)


def load_mesh_parts(file: MeshFile) -> list[Any]:
    """Return the parts of a file as ``trimesh.Trimesh``, at least one, in the file's own unit of length."""
    try:
        import trimesh
    except ImportError as error:
        raise MissingDependencyError(
            f"reading meshes needs trimesh: {install_command('geometry')}"
        ) from error
    _check_packing(file)
    _check_expansion(file)
    with _without_logging("trimesh"):
        scene = trimesh.load_scene(file.path, process=False, resolver=_FolderFiles(file.path.parent))
        result = [g for g in scene.dump() if isinstance(g, trimesh.Trimesh) and len(g.faces)]
    if not result:
        raise OSError(f"{file.path} holds no triangles")
    return result


def _check_packing(file: MeshFile) -> None:
    """Raise OSError for archives, and for packed meshes that unpack to more than :data:`LARGEST_FILE`."""
    if file.kind in _ARCHIVES:
        raise OSError(f"{file.path} is an archive, not a mesh. Unpack it, and name the mesh in it")
    if zipfile.is_zipfile(file.path):
        with zipfile.ZipFile(file.path) as packed:
            size = sum(part.file_size for part in packed.infolist())
        if size > LARGEST_FILE:
            most = f"the {LARGEST_FILE / 2**20:.0f} MiB read here"
            raise OSError(f"{file.path} unpacks to {size / 2**20:.0f} MiB, more than {most}")


def _check_expansion(file: MeshFile) -> None:
    """Raise OSError for meshes that draw so much, so often, that it would be larger than what is read."""
    try:
        size = expanded_size(file.path)
    except ValueError as error:
        raise OSError(f"{file.path} is not read: {error}") from None
    if size > LARGEST_FILE:
        raise OSError(
            f"{file.path} draws its parts so often that all of them would be {size / 2**20:.3g} MiB, more "
            f"than the {LARGEST_FILE / 2**20:.0f} MiB read here"
        )


class _FolderFiles(Mapping[str, bytes]):
    """Files in and below the folder of a mesh, for its materials, pictures and buffers."""

    def __init__(self, folder: Path) -> None:
        self._folder = os.path.realpath(folder)

    def __getitem__(self, name: str) -> bytes:
        name = name.strip()
        for candidate in (name, name.lstrip("/"), os.path.basename(name)):
            path = os.path.realpath(os.path.join(self._folder, candidate))
            if "\0" not in name and is_below(path, self._folder) and os.path.isfile(path):
                if os.path.getsize(path) > LARGEST_FILE:
                    raise OSError(f"{path} is larger than what is read here")
                return Path(path).read_bytes()
        raise FileNotFoundError(name)

    def __iter__(self) -> Iterator[str]:
        return iter(())

    def __len__(self) -> int:
        return 0


def unit_length(path: Path) -> float:
    """Return the length of a file's unit [m].

    Only COLLADA states its unit. As RViz does, this function applies the unit and ignores the up axis,
    because robot descriptions rely on that.
    """
    if path.suffix.lower() != ".dae":
        return 1.0
    with path.open("rb") as file:
        match = re.search(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']\s*([-+.\deE]+)", file.read(2**16))
    try:
        factor = float(match.group(1)) if match else 1.0
    except ValueError:
        return 1.0
    return factor if np.isfinite(factor) and factor > 0.0 else 1.0


@contextmanager
def _without_logging(name: str) -> Iterator[None]:
    """Silence the logger of a library: a missing texture only costs a mesh its colour."""
    log, nowhere = logging.getLogger(name), logging.NullHandler()
    before = log.propagate
    log.addHandler(nowhere)
    log.propagate = False
    try:
        yield
    finally:
        log.propagate = before
        log.removeHandler(nowhere)
