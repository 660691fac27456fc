"""Mesh cleanup before decomposition: merged vertices, no degenerate triangles, outward orientation."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

import numpy as np

from kineverse.errors import FormatError, InvalidValueError
from kineverse.geometry.mesh_files import Faces, Floats, Integers, find_mesh_file, read_faces
from kineverse.geometry.shapes import check_extent
from kineverse.model.body import Mesh

from .accuracy import enclosed_volume, is_closed

MOST_FACES = 300_000  # largest number of triangles that is decomposed; more take CoACD hours and all memory
_MOST_PARTS = 64  # connected parts of a mesh are decomposed one by one, up to this number
_FLAT = 1e-6  # a mesh thinner than this part of its size has no volume


@dataclass(frozen=True, slots=True, eq=False)
class CleanMesh:
    """Cleaned mesh, ready for decomposition."""

    faces: Faces  # vertices and triangles [m]
    parts: Integers  # connected part of each triangle, (F,); parts are decomposed one by one
    name: str  # path of the mesh file
    remarks: tuple[str, ...]  # defects of the mesh

    @property
    def size(self) -> float:
        """Longest edge of the bounding box [m]."""
        return float(np.ptp(self.faces.vertices, axis=0).max())

    @property
    def digest(self) -> str:
        """SHA-256 of the vertices and triangles."""
        arrays = self.faces.vertices.astype("<f8"), self.faces.faces.astype("<i8")
        return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()


def clean_mesh(mesh: Mesh) -> CleanMesh:
    """Read, scale and clean a mesh; a scale with an odd number of negative factors mirrors it."""
    scale = np.array(mesh.scale, dtype=float)
    if not all(math.isfinite(factor) and factor for factor in mesh.scale):
        raise InvalidValueError(f"{mesh.uri}: its scale is {mesh.scale}: factors are finite and not 0.")
    try:
        file = find_mesh_file(mesh)
        read = read_faces(file)
    except OSError as error:
        raise FormatError(f"{mesh.uri}: {error}") from error
    try:
        return _prepare(read, scale, str(file.path))
    except InvalidValueError as error:
        raise InvalidValueError(f"{file.path}: {error}") from error


def _prepare(read: Faces, scale: Floats, name: str) -> CleanMesh:
    if len(read.faces) > MOST_FACES:
        raise InvalidValueError(
            f"it has {len(read.faces)} triangles, and {MOST_FACES} are taken at most. Simplify it first."
        )
    used, faces = np.unique(read.faces, return_inverse=True)
    # Adding 0 turns -0 into 0, which is the same coordinate.
    vertices, same = np.unique(read.vertices[used] * scale + 0.0, axis=0, return_inverse=True)
    faces = same.reshape(-1)[faces.reshape(-1, 3)]
    check_extent(vertices)
    if _thickness(vertices) < _FLAT:
        raise InvalidValueError(
            "it is flat and encloses nothing, so there is nothing to decompose. Its hull will do."
        )
    faces = _drop_degenerate(vertices, faces)
    if np.prod(scale) < 0:
        faces = faces[:, ::-1]
    faces = np.ascontiguousarray(faces)
    if not is_closed(faces):
        remark = "its surface is not closed, or several of its triangles share an edge: it is wrapped first"
        return CleanMesh(Faces(vertices, faces), np.zeros(len(faces), dtype=np.int64), name, (remark,))
    parts = _connected_parts(faces, len(vertices))
    volumes = (
        [enclosed_volume(vertices, faces[parts == k]) for k in range(parts.max() + 1)]
        if parts.max() < _MOST_PARTS
        else []
    )
    if volumes and max(volumes) < 0.0:
        faces, volumes = np.ascontiguousarray(faces[:, ::-1]), [-v for v in volumes]
    if not volumes or min(volumes) <= 0.0:
        # A part that faces inwards is a hole in another part.
        parts = np.zeros(len(faces), dtype=np.int64)
    return CleanMesh(Faces(vertices, faces), parts, name, ())


def _thickness(vertices: Floats) -> float:
    """Return the ratio of the smallest to the largest extent along the principal axes."""
    centred = vertices - vertices.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1]
    extents = np.ptp(centred @ axes, axis=0)
    return float(extents.min() / extents.max())


def _drop_degenerate(vertices: Floats, faces: Integers) -> Integers:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return np.asarray(faces[distinct & (np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0.0)])


def _connected_parts(faces: Integers, count: int) -> Integers:
    label = np.arange(count)
    while True:
        least = label[faces].min(axis=1)
        before = label.copy()
        for k in range(3):
            np.minimum.at(label, faces[:, k], least)
            np.minimum.at(label, before[faces[:, k]], least)
        label = label[label]
        if np.array_equal(label, before):
            return np.asarray(np.unique(label[faces[:, 0]], return_inverse=True)[1].reshape(-1))
