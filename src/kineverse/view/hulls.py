"""Meshes as they are touched: by their convex hulls, or those of their parts."""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache

from kineverse.errors import KineverseError
from kineverse.geometry import decomposition
from kineverse.geometry.left_out import is_installed
from kineverse.geometry.mesh_files import Faces
from kineverse.geometry.solids import Solid, solid_of, solid_of_hull
from kineverse.geometry.surface import surface_of
from kineverse.model.body import Mesh
from kineverse.view.meshes import Loaded, load
from kineverse.view.triangles import Triangles, creased


def load_hull(mesh: Mesh) -> Loaded:
    """Return the hull of a mesh that distances are computed to, and what is wrong if there is none [m].

    Without the extra ``geometry``, or where a mesh has no hull, that is the mesh itself, or its placeholder.
    """
    return _load_hull(mesh, mesh.root)


@lru_cache(maxsize=4096)
def _load_hull(mesh: Mesh, root: str | None) -> Loaded:
    """Return the hull of a mesh; what may be opened is no part of what makes two meshes equal."""
    as_seen = load(mesh)
    if as_seen.problem or not is_installed():
        return as_seen
    try:
        return Loaded(_seen(solid_of(mesh)))
    except (KineverseError, OSError) as error:
        return Loaded(as_seen.surface, f"no distances: {error}")


def load_hulls(mesh: Mesh) -> list[Loaded]:
    """Return the hulls that ``kineverse decompose`` made of a mesh, or :func:`load_hull` if it did not."""
    if is_installed():
        with suppress(KineverseError, OSError):
            hulls = decomposition.pieces(mesh)
            if hulls is not None:
                return [Loaded(_seen(solid_of_hull(points))) for points in hulls]
    return [load_hull(mesh)]


def _seen(solid: Solid) -> Triangles:
    surface = surface_of(solid)
    assert isinstance(surface, Faces)  # no primitive is made of a mesh
    return creased(surface.vertices, surface.faces)[0]
