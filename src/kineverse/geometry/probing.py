"""Rays and points in a scene."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kineverse.errors import ShapeError, ValueRejectedError

from .mesh_files import Floats
from .mirror import Mirror
from .narrow import ACCURACY, distance_to_point
from .rays import enter
from .results import Hit, Nearby
from .sweep import FURTHEST


def cast(mirror: Mirror, origin: npt.ArrayLike, direction: npt.ArrayLike, length: float) -> Hit | None:
    """Return what a ray meets first within a length [m], None if nothing."""
    start, way = _place(origin, "origin"), _vector(direction, "direction")
    size = float(np.abs(way).max())
    if size == 0.0:
        raise ValueRejectedError("The direction of a ray is a vector other than 0.")
    if not length > 0.0:
        raise ValueRejectedError(f"The length of a ray is positive [m], not {length!r}.")
    way = way / size  # first, so that squares neither overflow nor vanish
    way /= np.linalg.norm(way)
    mirror.ready()
    table = mirror.table
    # How far along the ray each sphere begins, if the ray goes through it.
    to_centre = table.place - start
    along = to_centre @ way
    aside = ((to_centre - np.outer(along, way)) ** 2).sum(axis=1)
    through = np.flatnonzero((aside <= (table.radius * (1 + 1e-9)) ** 2) & (along >= -table.radius))
    begins = np.maximum(along[through] - table.radius[through], 0.0)
    best: tuple[float, int, Floats] | None = None
    limit = length
    for k in through[np.argsort(begins, kind="stable")].tolist():
        if along[k] - table.radius[k] > limit:
            break
        rotation, position = table.poses[k, :, :3], table.poses[k, :, 3]
        entry = enter(mirror.solid(k), rotation.T @ (start - position), rotation.T @ way)
        if entry is not None and entry[0] <= limit and (best is None or (entry[0], k) < best[:2]):
            best = entry[0], k, rotation @ entry[1]
            limit = entry[0]
    if best is None:
        return None
    distance, k, normal = best
    piece = mirror.pieces[k]
    return Hit(piece.body, piece.number, distance, start + distance * way, normal)


def locate(mirror: Mirror, point: npt.ArrayLike, radius: float) -> Nearby | None:
    """Return what is nearest to a point within a radius [m], deepest if it is inside; None if nothing is."""
    place = _place(point, "point")
    if not radius >= 0.0:
        raise ValueRejectedError(f"A radius is a distance from 0 on [m], not {radius!r}.")
    mirror.ready()
    table = mirror.table
    to_point = place - table.place
    lows = np.linalg.norm(to_point, axis=1) - table.radius
    inside = np.einsum("kji,kj->ki", table.poses[:, :, :3], to_point)
    outside = np.maximum(np.abs(inside) - table.half, 0.0)
    lows = np.maximum(lows, np.where(outside.any(axis=1), np.linalg.norm(outside, axis=1), -math.inf))
    best: Nearby | None = None
    for k in np.argsort(lows, kind="stable").tolist():
        if lows[k] > (radius if best is None else best.distance) + ACCURACY:
            break
        distance, nearest, normal = distance_to_point(mirror.solid(k), table.poses[k], place)
        if distance <= radius and (best is None or distance < best.distance):
            piece = mirror.pieces[k]
            best = Nearby(piece.body, piece.number, distance, nearest, normal)
    return best


def _place(values: npt.ArrayLike, what: str) -> Floats:
    place = _vector(values, what)
    if np.abs(place).max() > FURTHEST:
        raise ValueRejectedError(f"The {what} {place} is further than {FURTHEST:g} m away.")
    return place


def _vector(values: npt.ArrayLike, what: str) -> Floats:
    try:
        vector = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,):
        raise ShapeError(f"The {what} is a vector of three numbers in the world, not {values!r}.")
    if not np.isfinite(vector).all():
        raise ValueRejectedError(f"The {what} {vector} is not finite.")
    return vector
