"""Support functions of convex solids and separating directions, without coal.

No distance of convex solids is less than any gap, and the largest gap is the distance, see :mod:`.narrow`.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from .mesh_files import Floats
from .shapes import Solid

PlacedSolid: TypeAlias = tuple[Solid, Floats, Floats]
"""A convex solid with its (3, 3) rotation and (3,) position in the world."""

_ROUNDS, _SETS, _STARTS = 80, 8, 2


def directional_gaps(a: PlacedSolid, b: PlacedSolid, ways: Floats) -> Floats:
    """Return how far two solids are apart along unit directions (n, 3) from one to the other, (n,) [m].

    Where that is negative, moving the second by so much along the direction separates them.
    """
    (solid_a, rotation_a, at_a), (solid_b, rotation_b, at_b) = a, b
    apart: Floats = (
        ways @ (at_b - at_a)
        - _support_values(solid_a, ways @ rotation_a)
        - _support_values(solid_b, -ways @ rotation_b)
    )
    return apart


def find_widest_gap(a: PlacedSolid, b: PlacedSolid, ways: Floats) -> tuple[float, Floats]:
    """Search for the direction with the largest gap; return the gap [m] and the unit direction (3,).

    The best of the axes of both, of some fixed directions and of those given, (n, 3), are turned a little, by
    less and less.
    """
    tried = np.concatenate(
        [ways, _DIRECTIONS, *(sign * rotation.T for _, rotation, _ in (a, b) for sign in (1.0, -1.0))]
    )
    values = directional_gaps(a, b, tried)
    found = [_ascend(a, b, tried[k], float(values[k])) for k in np.argsort(-values, kind="stable")[:_STARTS]]
    return max(found, key=lambda one: one[0])


def smoothed_support(placed: PlacedSolid, way: Floats) -> Floats:
    """Return the point (3,) of a solid, in the world, that is furthest in a unit direction.

    Of an edge or a face it is about the middle.
    """
    solid, rotation, position = placed
    step = 1e-6
    # The gradient of the reach is a point; at an edge or a face, the mean of some of them.
    ends = way + step * np.concatenate([np.eye(3), -np.eye(3)])
    reach = _support_values(solid, ends @ rotation)
    point = (reach[:3] - reach[3:]) / (2 * step)
    short = float(_support_values(solid, (way @ rotation)[None])[0] - way @ point)
    return np.asarray(position + point + short * way)


def support(placed: PlacedSolid, way: Floats) -> Floats:
    """Return a point (3,) of a solid, in the world, that is furthest in a unit direction."""
    solid, rotation, position = placed
    core, own = solid.core, way @ rotation
    assert core is not None
    if core.tip and 2 * core.tip * own[2] >= core.radii[0] * np.hypot(own[0], own[1]):
        return np.asarray(position + rotation @ np.array([0.0, 0.0, core.tip]))
    point = np.where(own > 0.0, core.half, -core.half) + core.radius * own - [0.0, 0.0, core.tip]
    if core.corners.size:
        point += core.corners[:, np.argmax(own @ core.corners)]
    across = np.linalg.norm(core.radii * own)
    if across > 0.0:
        point += core.radii**2 * own / across
    return np.asarray(position + rotation @ point)


def _ascend(a: PlacedSolid, b: PlacedSolid, way: Floats, gap: float) -> tuple[float, Floats]:
    width = 0.3
    for turn in range(_ROUNDS):
        # Others each time: along a ridge only few lead upwards.
        turned = way + width * _DIRECTIONS[turn % _SETS :: _SETS]
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        values = directional_gaps(a, b, turned)
        best = int(np.argmax(values))
        if values[best] > gap:
            gap, way = float(values[best]), turned[best]
            width *= 1.5
        else:
            width *= 0.75
    return gap, way


def _support_values(solid: Solid, ways: Floats) -> Floats:
    """Return the largest ``way @ x`` over the points x of a solid in its own frame, for (n, 3) directions."""
    core = solid.core
    assert core is not None
    if core.tip:
        side = core.radii[0] * np.hypot(ways[:, 0], ways[:, 1])
        return np.asarray(np.maximum(core.tip * ways[:, 2], side - core.tip * ways[:, 2]))
    reach: Floats = np.abs(ways) @ core.half
    if core.radius:
        reach += core.radius * np.sqrt((ways * ways).sum(axis=1))
    if core.radii[0]:
        reach += np.sqrt(((ways * core.radii) ** 2).sum(axis=1))
    if core.corners.size:
        reach += (ways @ core.corners).max(axis=1)
    return reach


def _spread_directions(count: int) -> Floats:
    """Return unit directions (count, 3) all around, of which any number of the first ones are so too."""
    k = np.arange(1, count + 1)
    height, angle = 2.0 * (k * 0.7548776662466927 % 1.0) - 1.0, 2.0 * np.pi * (k * 0.5698402909980532 % 1.0)
    side = np.sqrt(1.0 - height**2)
    return np.stack([side * np.cos(angle), side * np.sin(angle), height], axis=1)


_DIRECTIONS = _spread_directions(240)
