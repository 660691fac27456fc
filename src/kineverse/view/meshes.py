"""Mesh files as triangles with colours, read when somebody wants to see them."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np

from kineverse.errors import KineverseError
from kineverse.geometry.mesh_files import MeshFile, find, metres, parts
from kineverse.model.body import Mesh
from kineverse.model.view import ModelView
from kineverse.view.primitives import placeholder
from kineverse.view.triangles import Floats, Triangles, creased, join

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Loaded:
    """A mesh that was asked for: its surface, or a placeholder and what was wrong."""

    surface: Triangles
    problem: str = ""


_by_reference: dict[tuple[Mesh, str | None], Loaded] = {}
_by_content: dict[tuple[object, ...], Triangles] = {}
_reported: set[tuple[str, str]] = set()


def load(mesh: Mesh) -> Loaded:
    """Return the triangles of a mesh file, scaled, in the frame of the mesh [m].

    Files of equal content are parsed once, whatever name led to them. What cannot be loaded becomes a
    placeholder; the reason is logged once a file and kept in ``problem``.

    Parameters
    ----------
    mesh
        The reference: uri, scale along x, y, z, and the folder from which a relative uri is resolved.
    """
    key = mesh, mesh.root
    if key not in _by_reference:
        try:
            _by_reference[key] = Loaded(_read(mesh))
        except (KineverseError, OSError) as error:
            _by_reference[key] = _missing(mesh, str(error))
        except Exception as error:  # Parsers of other people's formats raise anything at all.
            _by_reference[key] = _missing(mesh, f"{type(error).__name__}: {error}")
    return _by_reference[key]


def seen_in(model: ModelView) -> list[Mesh]:
    """Return the meshes by which a model is seen, each once."""
    shapes = (shape.geometry for body in model.bodies.values() for shape in body.visuals)
    return list(dict.fromkeys(geometry for geometry in shapes if isinstance(geometry, Mesh)))


def _missing(mesh: Mesh, problem: str) -> Loaded:
    first_line = (problem.strip().splitlines() or ["unknown error"])[0]
    if (mesh.uri, mesh.folder) not in _reported:
        _reported.add((mesh.uri, mesh.folder))
        logger.warning("mesh %s is shown as a placeholder: %s", mesh.uri, first_line)
    return Loaded(placeholder(), first_line)


def _read(mesh: Mesh) -> Triangles:
    file = find(mesh)
    # The folder is part of the key because materials and textures lie beside the file.
    source = (file.digest, file.kind, str(file.path.parent))
    if source not in _by_content:
        _by_content[source] = _parse(file)
    if mesh.scale == (1.0, 1.0, 1.0):
        return _by_content[source]
    scaled = (*source, mesh.scale)
    if scaled not in _by_content:
        _by_content[scaled] = _by_content[source].scaled(mesh.scale)
    return _by_content[scaled]


def _parse(file: MeshFile) -> Triangles:
    """Return the triangles of a file in metres, with the colours it brings."""
    pieces = [piece for part in parts(file) if len((piece := _piece(part)).faces)]
    if not pieces:
        raise OSError(f"{file.path} holds no triangles")
    if any(piece.colors is not None for piece in pieces):
        pieces = [_colored(piece) for piece in pieces]
    return join(pieces).scaled(metres(file.path))


def _piece(mesh: Any) -> Triangles:
    surface, kept = creased(mesh.vertices, mesh.faces)
    try:
        colors = _face_colors(mesh)
    except Exception:  # A picture that cannot be decoded is no reason not to show the shape.
        logger.debug("no colours from %s", mesh, exc_info=True)
        colors = None
    return surface if colors is None else surface.painted(colors[kept])


def _face_colors(mesh: Any) -> Floats | None:
    """Return (F, 4) colours of the faces of a trimesh, or None where the file says nothing."""
    visual = mesh.visual
    if visual.kind != "texture":
        return np.asarray(visual.face_colors, dtype=float) / 255.0 if visual.defined else None
    if visual.uv is not None and _has_picture(visual.material):
        corners = np.asarray(visual.to_color().vertex_colors, dtype=float)
        if corners.shape == (len(mesh.vertices), 4):
            return np.asarray(corners[mesh.faces].mean(axis=1) / 255.0)
    main = np.asarray(visual.material.main_color, dtype=float) / 255.0
    return np.tile(main, (len(mesh.faces), 1))


def _has_picture(material: Any) -> bool:
    names = ("image", "baseColorTexture")
    return any(getattr(material, name, None) is not None for name in names)


def _colored(
    piece: Triangles, fallback: tuple[float, float, float, float] = (0.7, 0.7, 0.72, 1.0)
) -> Triangles:
    """Return the piece with colours, so that pieces with and without can be joined."""
    if piece.colors is not None:
        return piece
    return piece.painted(np.tile(fallback, (len(piece.faces), 1)))
