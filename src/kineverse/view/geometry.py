"""The surface of any geometry a body can have."""

from __future__ import annotations

from kineverse.model.body import Geometry, Mesh
from kineverse.view.meshes import load
from kineverse.view.primitives import primitive
from kineverse.view.triangles import Triangles


def triangles_of(geometry: Geometry) -> Triangles:
    """Return the surface of a piece of geometry, in its own frame [m].

    A mesh is read here, and only here; one that cannot be read becomes a marked placeholder (see
    :mod:`kineverse.view.meshes`), so this never fails for a missing file.
    """
    return load(geometry).surface if isinstance(geometry, Mesh) else primitive(geometry)
