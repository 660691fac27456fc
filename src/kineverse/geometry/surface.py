"""Solids as triangles, for whoever wants to see what distances are computed to."""

from __future__ import annotations

from typing import Any

import numpy as np

from .mesh_files import Faces
from .solids import Hull, Primitive, Solid


def surface_of(solid: Solid) -> Faces | Primitive:
    """Return the surface of a solid: the primitive that it is, or triangles, seen from outside."""
    return _faces(solid.engine) if isinstance(solid.surface, Hull) else solid.surface


def _faces(convex: Any) -> Faces:
    """Return the triangles of a ``coal.Convex``, counter-clockwise seen from outside."""
    vertices = np.array(convex.points())
    triangles = [convex.polygons(k) for k in range(convex.num_polygons)]
    faces = np.array([[triangle[0], triangle[1], triangle[2]] for triangle in triangles], dtype=np.int64)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), np.array(convex.normals())) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return Faces(vertices, faces)
