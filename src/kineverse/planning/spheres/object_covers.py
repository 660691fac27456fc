"""Covers of collision objects, kept by the content of their shapes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePath

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.geometry.mesh_files import Floats
from kineverse.geometry.objects import CollisionObject
from kineverse.geometry.shapes import Solid
from kineverse.model.body import Mesh

from .sphere_cache import cover_key, find_cover, keep_cover
from .sphere_cover import MOST, SphereCover, check_cover_settings, cover_solids

_DIGITS = 12
"""Digits to which poses in a body are told apart."""


def cover_objects(
    items: Sequence[CollisionObject],
    protrusion: float | None = None,
    most: int = MOST,
    *,
    force: bool = False,
) -> SphereCover:
    """Return the cover of the collision objects of a body in the frame of the first one.

    See :func:`.cover_solids`. It is computed once for equal shapes and settings, and then kept in memory and
    in the user's cache; with ``force`` it is computed again.

    Raises
    ------
    KineverseError
        If a shape cannot be used, or is a triangle mesh; the message names the body.
    """
    solids, key = _request(items, protrusion, most)
    found = None if force else find_cover(key)
    if found is None:
        try:
            found = cover_solids(solids, protrusion, most)
        except InvalidValueError as error:
            raise InvalidValueError(
                f"No spheres cover the shapes of body '{items[0].body}' ({_name(items)}): {error} Make them "
                "thicker, or leave the body out: Planner(model, leave_out=[...])."
            ) from None
        keep_cover(key, _name(items), found)
    return found


def are_covered(items: Sequence[CollisionObject], protrusion: float | None = None, most: int = MOST) -> bool:
    """Return True if the cover of collision objects is kept; for errors see :func:`cover_objects`."""
    return find_cover(_request(items, protrusion, most)[1]) is not None


def _request(
    items: Sequence[CollisionObject], protrusion: float | None, most: int
) -> tuple[list[tuple[Solid, Floats]], str]:
    """Return the solids of objects with their poses, and the key of their cover."""
    check_cover_settings(protrusion, most)
    if not items:
        raise InvalidValueError("There is no shape to cover.")
    base = np.linalg.inv(items[0].shape.origin.matrix)
    solids: list[tuple[Solid, Floats]] = []
    for item in items:
        solid = item.make_solid()
        if not solid.is_convex:
            raise InvalidValueError(
                f"Shape {item.number} of body '{item.body}' is a triangle mesh, which has no inside for "
                "spheres to cover: leave the body out of triangles=, so that its hulls are covered."
            )
        # Zeros have one sign.
        solids.append((solid, np.round(base @ item.shape.origin.matrix, _DIGITS) + 0.0))
    return solids, cover_key(solids, protrusion, most)


def _name(items: Sequence[CollisionObject]) -> str:
    geometry = items[0].shape.geometry
    kind = PurePath(geometry.uri).name if isinstance(geometry, Mesh) else geometry.kind
    return f"{items[0].body}: {kind}" + (f" and {len(items) - 1} more" if len(items) > 1 else "")
