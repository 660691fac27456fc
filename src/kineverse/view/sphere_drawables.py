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


def draw_cover(frame: str, cover: SphereCover, frame_T_solid: Floats) -> Drawable:
    """Return the spheres of a cover as one drawable.

    Parameters
    ----------
    frame
        Frame of the body.
    cover
        The cover.
    frame_T_solid
        (4, 4) pose of the covered solid in the frame [m].
    """
    unit = mesh_geometry(Sphere(1.0))
    count, size = len(cover), len(unit.vertices)
    vertices = cover.centres[:, None] + cover.radii[:, None, None] * unit.vertices
    surface = TriangleMesh(
        vertices.reshape(-1, 3),
        (unit.faces + size * np.arange(count)[:, None, None]).reshape(-1, 3),
        np.tile(unit.normals, (count, 1)),
        closed=True,
    )
    return Drawable(frame, surface.transform(frame_T_solid), SPHERES, "collision")
