"""Support functions, separating directions and distances (GJK) of convex solids, in Python.

The gap of two convex solids along any direction is a lower bound of their distance, and the largest gap is
the distance, see :mod:`.narrowphase`. GJK is the iteration of ``gjk.h``, a thousand times slower,
with the same two bounds: it returns a distance only once they meet.
"""

from __future__ import annotations

from itertools import combinations
from typing import TypeAlias

import numpy as np

from .mesh_files import Faces, Floats
from .shapes import Core, Solid

PlacedSolid: TypeAlias = tuple[Solid, Floats, Floats]  # convex solid, its (3, 3) rotation and (3,) position

_ROUNDS, _SETS, _STARTS = 80, 8, 2


def directional_gaps(a: PlacedSolid, b: PlacedSolid, directions: Floats) -> Floats:
    """Return the gaps (n,) between two solids along unit directions (n, 3) from the first to the second [m].

    If a gap is negative, a translation of the second solid by that length along the direction separates them.
    """
    (solid_a, rotation_a, position_a), (solid_b, rotation_b, position_b) = a, b
    return np.asarray(
        directions @ (position_b - position_a)
        - support_values(solid_a, directions @ rotation_a)
        - support_values(solid_b, -directions @ rotation_b)
    )


def find_widest_gap(a: PlacedSolid, b: PlacedSolid, directions: Floats) -> tuple[float, Floats]:
    """Search for the direction with the largest gap; return the gap [m] and the unit direction (3,).

    Candidates are the axes of both solids, fixed directions all around, and some more (n, 3). A pattern
    search with a shrinking step refines the best of them.
    """
    tried = np.concatenate(
        [directions, _DIRECTIONS, *(sign * rotation.T for _, rotation, _ in (a, b) for sign in (1.0, -1.0))]
    )
    values = directional_gaps(a, b, tried)
    result = [_ascend(a, b, tried[k], float(values[k])) for k in np.argsort(-values, kind="stable")[:_STARTS]]
    return max(result, key=lambda one: one[0])


def smoothed_support(placed: PlacedSolid, direction: Floats) -> Floats:
    """Return the support point (3,) of a solid in the world along a unit direction.

    If an edge or a face is furthest, it is approximately the middle of that.
    """
    solid, rotation, position = placed
    step = 1e-6
    # The gradient of the support function is the support point; at an edge or a face, a mean of several.
    values = support_values(solid, (direction + step * np.concatenate([np.eye(3), -np.eye(3)])) @ rotation)
    point = (values[:3] - values[3:]) / (2 * step)
    missing = float(support_values(solid, (direction @ rotation)[None])[0] - direction @ point)
    return np.asarray(position + point + missing * direction)


def support(placed: PlacedSolid, direction: Floats) -> Floats:
    """Return a support point (3,) of a solid in the world along a unit direction."""
    solid, rotation, position = placed
    core, local = solid.core, direction @ rotation
    assert core is not None
    if core.tip and 2 * core.tip * local[2] >= core.radii[0] * np.hypot(local[0], local[1]):
        return np.asarray(position + rotation @ np.array([0.0, 0.0, core.tip]))
    point = np.where(local > 0.0, core.half, -core.half) + core.radius * local - [0.0, 0.0, core.tip]
    if core.corners.size:
        point += core.corners[:, np.argmax(local @ core.corners)]
    across = np.linalg.norm(core.radii * local)
    if across > 0.0:
        point += core.radii**2 * local / across
    return np.asarray(position + rotation @ point)


def _ascend(a: PlacedSolid, b: PlacedSolid, direction: Floats, gap: float) -> tuple[float, Floats]:
    width = 0.3
    for turn in range(_ROUNDS):
        # A different set each time: along a ridge only few directions lead upwards.
        turned = direction + width * _DIRECTIONS[turn % _SETS :: _SETS]
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        values = directional_gaps(a, b, turned)
        best = int(np.argmax(values))
        if values[best] > gap:
            gap, direction = float(values[best]), turned[best]
            width *= 1.5
        else:
            width *= 0.75
    return gap, direction


def support_values(solid: Solid, directions: Floats) -> Floats:
    """Return the support function of a solid, max ``direction @ x``, for (n, 3) directions in its frame."""
    core = solid.core
    assert core is not None
    if core.tip:
        side = core.radii[0] * np.hypot(directions[:, 0], directions[:, 1])
        return np.asarray(np.maximum(core.tip * directions[:, 2], side - core.tip * directions[:, 2]))
    values: Floats = np.abs(directions) @ core.half
    if core.radius:
        values += core.radius * np.sqrt((directions * directions).sum(axis=1))
    if core.radii[0]:
        values += np.sqrt(((directions * core.radii) ** 2).sum(axis=1))
    if core.corners.size:
        values += (directions @ core.corners).max(axis=1)
    return values


def _spread_directions(count: int) -> Floats:
    """Return a low-discrepancy sequence of unit directions (count, 3)."""
    k = np.arange(1, count + 1)
    height, angle = 2.0 * (k * 0.7548776662466927 % 1.0) - 1.0, 2.0 * np.pi * (k * 0.5698402909980532 % 1.0)
    side = np.sqrt(1.0 - height**2)
    return np.stack([side * np.cos(angle), side * np.sin(angle), height], axis=1)


_DIRECTIONS = _spread_directions(240)

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
        kept, some, result = nearest
        if not (nearer := float(np.linalg.norm(result))) < high:
            break
        points, origins = [[*points, corner][k] for k in kept], [[*origins, point][k] for k in kept]
        direction, high, weights = result, nearer, some
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
    local = (corners - position_a) @ rotation_a - solid.centre
    apart = np.maximum(np.maximum(local.min(axis=1) - solid.half, -solid.half - local.max(axis=1)), 0.0)
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
        result = gjk_distance(a, (triangle, np.eye(3), middle))
        if result is None:
            return None
        if best is None or result[0] < best[0]:
            best = result
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
            result = weights @ corners
            if best is None or result @ result < best[2] @ best[2]:
                best = kept, weights, result
    return best
