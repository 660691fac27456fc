"""Drawable spheres of covers, translucent over the bodies that they cover."""

from __future__ import annotations

import numpy as np

from kineverse.model.body import Sphere
from kineverse.planning.spheres import SphereCover
from kineverse.view.drawables import Drawable, Rgba
from kineverse.view.meshes import mesh_geometry
from kineverse.view.triangle_mesh import Floats, TriangleMesh

SPHERES: Rgba = (0.16, 0.47, 0.86, 0.3)
"""Colour of the spheres of a cover."""


def draw_cover(frame: str, cover: SphereCover) -> Drawable:
    """Return the spheres of a cover in a frame as one drawable."""
    return Drawable(frame, build_spheres(cover.centres, cover.radii), SPHERES, "collision")


def build_spheres(centres: Floats, radii: Floats) -> TriangleMesh:
    """Return the surfaces of spheres with centres (N, 3) and radii (N,) [m]."""
    unit = mesh_geometry(Sphere(1.0))
    count, size = len(centres), len(unit.vertices)
    vertices = centres[:, None] + radii[:, None, None] * unit.vertices
    return TriangleMesh(
        vertices.reshape(-1, 3),
        (unit.faces + size * np.arange(count)[:, None, None]).reshape(-1, 3),
        np.tile(unit.normals, (count, 1)),
        closed=True,
    )
