"""Covers of collision objects, kept by the content of their shapes."""

from __future__ import annotations

from pathlib import PurePath

from kineverse.errors import InvalidValueError
from kineverse.geometry.objects import CollisionObject
from kineverse.geometry.shapes import Solid
from kineverse.model.body import Mesh

from .sphere_cache import cover_key, find_cover, keep_cover
from .sphere_cover import MOST, SphereCover, check_cover_settings, cover_solid, default_protrusion


def cover_object(
    item: CollisionObject, protrusion: float | None = None, most: int = MOST, *, force: bool = False
) -> SphereCover:
    """Return the cover of a collision object in the frame of the object, see :func:`.cover_solid`.

    It is computed once for equal shapes and settings, and then kept in memory and in the user's cache; with
    ``force`` it is computed again.

    Raises
    ------
    KineverseError
        If the shape cannot be used, or is a triangle mesh; the message names the body.
    """
    solid, wanted, key = _request(item, protrusion, most)
    found = None if force else find_cover(key)
    if found is None:
        found = cover_solid(solid, wanted, most)
        keep_cover(key, _shape_name(item), found)
    return found


def is_covered(item: CollisionObject, protrusion: float | None = None, most: int = MOST) -> bool:
    """Return True if the cover of a collision object is kept; for errors see :func:`cover_object`."""
    return find_cover(_request(item, protrusion, most)[2]) is not None


def _request(item: CollisionObject, protrusion: float | None, most: int) -> tuple[Solid, float, str]:
    """Return the solid of an object, the protrusion of its cover [m], and the key in the cache."""
    check_cover_settings(protrusion, most)
    solid = item.make_solid()
    if not solid.is_convex:
        raise InvalidValueError(
            f"Shape {item.number} of body '{item.body}' is a triangle mesh, which has no inside for spheres "
            "to cover: leave the body out of triangles=, so that its hulls are covered."
        )
    wanted = default_protrusion(solid) if protrusion is None else protrusion
    return solid, wanted, cover_key(solid, wanted, most)


def _shape_name(item: CollisionObject) -> str:
    geometry = item.shape.geometry
    kind = PurePath(geometry.uri).name if isinstance(geometry, Mesh) else geometry.kind
    return f"{item.body}: {kind}"
