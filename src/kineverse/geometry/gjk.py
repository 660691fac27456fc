"""Distance of two convex solids by GJK, in Python.

This is the iteration of :mod:`.narrowphase_c`, a thousand times slower, with the same two bounds: it returns
a distance only once they meet.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from .mesh_files import Faces, Floats
from .shapes import Core, Solid
from .support import PlacedSolid, support

_STEPS = 200
_CONVERGED, _ACCEPTED = 1e-11, 1e-7
"""Tolerances of the two bounds: to converge, and to accept when no step improves any more. They are absolute
[m] up to a size of 1 m, and relative beyond."""


def gjk_distance(a: PlacedSolid, b: PlacedSolid) -> tuple[float, Floats, Floats] | None:
    """Return the distance of two solids [m], the nearest point (3,) of the first, and the normal from there.

    None if they touch, or if the bounds do not meet.
    """
    (_, _, position_a), (_, _, position_b) = a, b
    size = max(1.0, a[0].radius, b[0].radius, float(np.linalg.norm(position_b - position_a)))
    direction = position_b - position_a
    points: list[Floats] = []
    origins: list[Floats] = []
    high, low, weights = np.inf, -np.inf, np.zeros(0)
    for _ in range(_STEPS):
        length = float(np.linalg.norm(direction))
        if not length > 0.0:
            return None
        point = support(a, direction / length)
        corner = support(b, -direction / length) - point
        low = max(low, float(direction @ corner) / length)
        if high - low <= _CONVERGED * size:
            break
        nearest = _nearest_to_origin([*points, corner])
        if nearest is None:
            return None
        kept, some, found = nearest
        if not (nearer := float(np.linalg.norm(found))) < high:
            break
        points, origins = [[*points, corner][k] for k in kept], [[*origins, point][k] for k in kept]
        direction, high, weights = found, nearer, some
    if not (high > 0.0 and high - low <= _ACCEPTED * size):
        return None
    return high, weights @ np.array(origins), direction / high


def gjk_distance_to_faces(
    a: PlacedSolid, faces: Faces, rotation: Floats, position: Floats
) -> tuple[float, Floats, Floats] | None:
    """Return the :func:`gjk_distance` of a convex solid from triangles at a pose; None if they touch."""
    solid, rotation_a, position_a = a
    corners = (faces.vertices @ rotation.T + position)[faces.faces]
    # In the frame of the solid, the distance of both bounding boxes is a lower bound.
    seen = (corners - position_a) @ rotation_a - solid.centre
    apart = np.maximum(np.maximum(seen.min(axis=1) - solid.half, -solid.half - seen.max(axis=1)), 0.0)
    lows = np.linalg.norm(apart, axis=1)
    best: tuple[float, Floats, Floats] | None = None
    for k in np.argsort(lows, kind="stable").tolist():
        if best is not None and lows[k] >= best[0]:
            break
        middle = corners[k].mean(axis=0)
        radius = float(np.linalg.norm(corners[k] - middle, axis=1).max())
        triangle = Solid(
            None, faces, np.zeros(3), np.zeros(3), radius, core=Core.from_corners(corners[k] - middle)
        )
        found = gjk_distance(a, (triangle, np.eye(3), middle))
        if found is None:
            return None
        if best is None or found[0] < best[0]:
            best = found
    return best


def _nearest_to_origin(points: list[Floats]) -> tuple[tuple[int, ...], Floats, Floats] | None:
    """Return the point nearest to 0 in the hull of up to four points: their indices, weights, and the point.

    None if 0 is inside of the hull.
    """
    best: tuple[tuple[int, ...], Floats, Floats] | None = None
    for count in range(1, len(points) + 1):
        for kept in combinations(range(len(points)), count):
            corners = np.array([points[k] for k in kept])
            edges = (corners[1:] - corners[0]).T
            part = np.linalg.lstsq(edges, -corners[0], rcond=None)[0] if count > 1 else np.zeros(0)
            weights = np.array([1.0 - part.sum(), *part])
            if (weights < 0.0).any():
                continue
            if count == 4:
                return None
            found = weights @ corners
            if best is None or found @ found < best[2] @ best[2]:
                best = kept, weights, found
    return best
