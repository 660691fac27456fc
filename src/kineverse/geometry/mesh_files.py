"""Mesh files: search, checks, and reading with a cache by content.

COLLADA, 3MF and glTF name parts of a drawing more than once. A COLLADA of 2 KB whose nodes instance each
other twice, thirty deep, draws a billion parts, so the size of a mesh file with everything written out is
computed before it is read.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import json
import logging
import os
import re
import struct
import threading
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from kineverse._extras import install_command
from kineverse.errors import FormatError, MissingDependencyError, summarize_error
from kineverse.formats.resource_paths import locate_mesh
from kineverse.formats.resources import fetch_mesh
from kineverse.formats.root_folder import is_below
from kineverse.model.body import Mesh

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


_NODE_BYTES = 2048  # size of a node beyond its triangles [bytes]: trimesh takes about as long for it

_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


@dataclass(slots=True)
class _Part:
    """Part of a drawing: its own size [bytes], the keys of what it draws, and whether the file holds it."""

    size: float = _NODE_BYTES
    draws: list[object] = field(default_factory=list)
    is_written: bool = True


def expanded_size(path: Path) -> float:
    """Return the size that a mesh file gains if everything it draws is written out [bytes]."""
    kind = path.suffix.lower()
    if kind == ".dae":
        return _collada_size(path.read_bytes())
    if kind == ".zae":
        return max(map(_collada_size, _packed(path, ".dae")), default=0.0)
    if kind == ".3mf":
        models = map(ElementTree.fromstring, _packed(path, ".model"))
        return _total({key: part for model in models for key, part in _threemf_parts(model)})
    if kind in (".gltf", ".glb"):
        return _total(dict(_gltf_parts(_gltf_header(path))))
    return 0.0


def _total(parts: Mapping[object, _Part]) -> float:
    """Return the size of the parts that the part None draws, less that of the parts that are written."""
    sizes: dict[object, float] = {}
    stack: list[object] = [None]
    inside: set[object] = set()
    while stack:
        key = stack[-1]
        part = parts.get(key)
        waiting = [k for k in part.draws if k in parts and k not in sizes] if part is not None else []
        if waiting and key not in inside:
            inside.add(key)
            if not inside.isdisjoint(waiting):
                raise ValueError("a part of it draws itself")
            stack += waiting
            continue
        stack.pop()
        inside.discard(key)
        if part is not None and key not in sizes:
            if waiting:
                raise ValueError("a part of it draws itself")
            sizes[key] = part.size + sum(sizes[k] for k in part.draws if k in parts)
    return sizes.get(None, 0.0) - sum(part.size for part in parts.values() if part.is_written)


def _packed(path: Path, ending: str) -> list[bytes]:
    if not zipfile.is_zipfile(path):
        return []
    with zipfile.ZipFile(path) as packed:
        return [packed.read(name) for name in packed.namelist() if name.lower().endswith(ending)]


def _tag(element: ElementTree.Element) -> str:
    tag = element.tag
    return tag.rpartition("}")[2] if isinstance(tag, str) else ""  # that of a comment is no text for lxml


def _collada_size(content: bytes) -> float:
    """Return :func:`expanded_size` of a COLLADA, parsed as pycollada does it, in any encoding."""
    try:
        parse = importlib.import_module("collada.xmlutil").createElementTree
    except (ImportError, AttributeError):  # older versions use this one
        parse = ElementTree.parse
    return _total(dict(_collada_parts(parse(io.BytesIO(content)).getroot())))


def _collada_parts(root: ElementTree.Element) -> Iterator[tuple[object, _Part]]:
    """Yield the nodes and geometries of a COLLADA, and as None all of its scenes."""
    whole = _Part(0.0)
    elements = list(root.iter())  # kept, since lxml makes new ones otherwise, with other ids
    for element in elements:
        tag = _tag(element)
        if tag in ("geometry", "controller"):
            text = float(sum(len(e.text or "") for e in element.iter()))
            drawn = [f"#{source.lstrip('#')}" for e in element for source in [e.get("source")] if source]
            yield f"#{element.get('id')}", _Part(text, list(drawn))
        elif tag in ("node", "visual_scene"):
            part = _Part()
            for child in element:
                if _tag(child) == "node":
                    part.draws.append(id(child))
                elif _tag(child).startswith("instance_"):
                    part.draws.append(child.get("url"))
            yield id(element), part
            if tag == "visual_scene":
                whole.draws.append(id(element))
            elif element.get("id"):
                yield f"#{element.get('id')}", _Part(0.0, [id(element)])
    yield None, whole


def _threemf_parts(root: ElementTree.Element) -> Iterator[tuple[object, _Part]]:
    """Yield the objects of a 3MF, and as None what is to be built."""
    whole = _Part(0.0)
    for element in root.iter():
        if _tag(element) == "object":
            inner = list(element.iter())
            triangles = sum(_tag(e) in ("triangle", "vertex") for e in inner) * 32.0
            drawn = [e.get("objectid") for e in inner if _tag(e) == "component"]
            yield element.get("id"), _Part(_NODE_BYTES + triangles, list(drawn))
        elif _tag(element) == "item":
            whole.draws.append(element.get("objectid"))
    yield None, whole


def _gltf_header(path: Path) -> Mapping[str, Any]:
    """Return the JSON of a glTF, which is the first chunk of a GLB."""
    content = path.read_bytes()
    if content[:4] == b"glTF":
        (length,) = struct.unpack_from("<I", content, 12)
        content = content[20 : 20 + length]
    header = json.loads(content)
    return header if isinstance(header, dict) else {}


def _gltf_parts(header: Mapping[str, Any]) -> Iterator[tuple[object, _Part]]:
    """Yield the meshes and accessors of a glTF, and as None what its nodes draw."""
    whole = _Part(0.0)
    for k, accessor in enumerate(header.get("accessors", ())):
        each = _COMPONENT_BYTES.get(accessor.get("componentType"), 4)
        each *= _COMPONENTS.get(accessor.get("type"), 16)
        is_written = "bufferView" in accessor  # an accessor without one is all zeros
        yield ("accessor", k), _Part(float(accessor.get("count", 0)) * each, is_written=is_written)
        whole.draws += [("accessor", k)] * (not is_written)
    for k, mesh in enumerate(header.get("meshes", ())):
        used = _Part()
        for primitive in mesh.get("primitives", ()):
            numbers = [*primitive.get("attributes", {}).values(), primitive.get("indices")]
            used.draws += [("accessor", number) for number in numbers]
        yield ("mesh", k), used
    # A node has one parent in trimesh, so it is drawn once.
    whole.draws += [("mesh", node["mesh"]) for node in header.get("nodes", ()) if "mesh" in node]
    whole.size = float(_NODE_BYTES * len(header.get("nodes", ())))
    yield None, whole
