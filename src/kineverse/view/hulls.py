"""Meshes as they are touched: by their convex hulls."""

from __future__ import annotations

from functools import lru_cache

from kineverse.errors import KineverseError
from kineverse.geometry.left_out import is_installed
from kineverse.geometry.mesh_files import Faces
from kineverse.geometry.solids import solid_of
from kineverse.geometry.surface import surface_of
from kineverse.model.body import Mesh
from kineverse.view.meshes import Loaded, load
from kineverse.view.triangles import creased


@lru_cache(maxsize=4096)
def load_hull(mesh: Mesh) -> Loaded:
    """Return the hull of a mesh that distances are computed to, and what is wrong if there is none [m].

    Without the extra ``geometry``, or where a mesh has no hull, that is the mesh itself, or its placeholder.
    """
    as_seen = load(mesh)
    if as_seen.problem or not is_installed():
        return as_seen
    try:
        surface = surface_of(solid_of(mesh))
    except (KineverseError, OSError) as error:
        return Loaded(as_seen.surface, f"no distances: {error}")
    if not isinstance(surface, Faces):
        return as_seen
    hull, _ = creased(surface.vertices, surface.faces)
    return Loaded(hull)
