"""Triangle meshes of mesh files and of any geometry of a body."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kineverse.errors import KineverseError
from kineverse.geometry.mesh_files import MeshFile, find_mesh_file, load_mesh_parts, unit_length
from kineverse.model.body import Geometry, Mesh
from kineverse.model.model_view import ModelView

from .rendering.triangle_mesh import (
    Floats,
    TriangleMesh,
    build_creased_mesh,
    concatenate_meshes,
    mesh_placeholder,
    mesh_primitive,
)

logger = logging.getLogger(__name__)

_UNPAINTED = (
    0.7,
    0.7,
    0.72,
    1.0,
)  # colour of the pieces of a mesh file that have none, beside others that do
_PLACES = 3  # number of places named in which a file was looked for


@dataclass(frozen=True, slots=True)
class LoadedMesh:
    """A mesh read from its file, or a placeholder and the problem."""

    surface: TriangleMesh
    problem: str = ""


_by_reference: dict[tuple[Mesh, str | None], LoadedMesh] = {}
_by_content: dict[tuple[object, ...], TriangleMesh] = {}
_reported: set[tuple[str, str]] = set()


def load_mesh(mesh: Mesh) -> LoadedMesh:
    """Return the triangles of a mesh file, scaled, in the frame of the mesh [m].

    Files of equal content are parsed once, under any name. A mesh that cannot be loaded becomes a
    placeholder; the reason is logged once a file and kept in ``problem``.
    """
    key = mesh, mesh.root
    if key not in _by_reference:
        try:
            _by_reference[key] = LoadedMesh(_read(mesh))
        except (KineverseError, OSError) as error:
            _by_reference[key] = _substitute_placeholder(mesh, str(error))
        except Exception as error:  # Parsers of mesh files may raise any error.
            _by_reference[key] = _substitute_placeholder(mesh, f"{type(error).__name__}: {error}")
    return _by_reference[key]


def list_visual_meshes(model: ModelView) -> list[Mesh]:
    """Return the meshes of the visual shapes of a model, each once."""
    shapes = (shape.geometry for body in model.bodies.values() for shape in body.visuals)
    return list(dict.fromkeys(geometry for geometry in shapes if isinstance(geometry, Mesh)))


def _substitute_placeholder(mesh: Mesh, problem: str) -> LoadedMesh:
    first, *others = [line.strip() for line in problem.strip().splitlines()] or ["unknown error"]
    more = f" and {len(others) - _PLACES} more places" if len(others) > _PLACES else ""
    reason = f"{first} {', '.join(others[:_PLACES])}{more}" if first.endswith(":") else first
    if (mesh.uri, mesh.folder) not in _reported:
        _reported.add((mesh.uri, mesh.folder))
        logger.warning("mesh %s is shown as a placeholder: %s", mesh.uri, reason)
    return LoadedMesh(mesh_placeholder(), reason)


def _read(mesh: Mesh) -> TriangleMesh:
    file = find_mesh_file(mesh)
    # The folder is part of the key because materials and textures lie beside the file.
    source = (file.digest, file.kind, str(file.path.parent))
    if source not in _by_content:
        _by_content[source] = _parse(file)
    if mesh.scale == (1.0, 1.0, 1.0):
        return _by_content[source]
    scaled = (*source, mesh.scale)
    if scaled not in _by_content:
        _by_content[scaled] = _by_content[source].scale(mesh.scale)
    return _by_content[scaled]


def _parse(file: MeshFile) -> TriangleMesh:
    """Return the triangles of a file in metres, with the colours of the file."""
    pieces = [piece for part in load_mesh_parts(file) if len((piece := _convert_piece(part)).faces)]
    if not pieces:
        raise OSError(f"{file.path} holds no triangles")
    if any(piece.colors is not None for piece in pieces):
        pieces = [
            replace(piece, colors=np.tile(_UNPAINTED, (len(piece.faces), 1)))
            if piece.colors is None
            else piece
            for piece in pieces
        ]
    return concatenate_meshes(pieces).scale(unit_length(file.path))


def _convert_piece(mesh: Any) -> TriangleMesh:
    surface, kept = build_creased_mesh(mesh.vertices, mesh.faces)
    try:
        colors = _face_colors(mesh)
    except Exception:  # The shape is shown even if its texture cannot be decoded.
        logger.debug("no colours from %s", mesh, exc_info=True)
        colors = None
    return surface if colors is None else replace(surface, colors=colors[kept])


def _face_colors(mesh: Any) -> Floats | None:
    """Return (F, 4) colours of the faces of a trimesh, or None if the file has none."""
    visual = mesh.visual
    if visual.kind != "texture":
        return np.asarray(visual.face_colors, dtype=float) / 255.0 if visual.defined else None
    textures = (getattr(visual.material, name, None) for name in ("image", "baseColorTexture"))
    if visual.uv is not None and any(texture is not None for texture in textures):
        corners = np.asarray(visual.to_color().vertex_colors, dtype=float)
        if corners.shape == (len(mesh.vertices), 4):
            return np.asarray(corners[mesh.faces].mean(axis=1) / 255.0)
    main = np.asarray(visual.material.main_color, dtype=float) / 255.0
    return np.tile(main, (len(mesh.faces), 1))


def mesh_geometry(geometry: Geometry) -> TriangleMesh:
    """Return the surface of a shape, in its own frame [m].

    A mesh that cannot be read becomes a placeholder (see :func:`load_mesh`), so that a missing file is no
    error.
    """
    return load_mesh(geometry).surface if isinstance(geometry, Mesh) else mesh_primitive(geometry)
