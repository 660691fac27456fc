"""Support functions of convex solids and separating directions, without coal.

The gap of two convex solids along any direction is a lower bound of their distance, and the largest gap is
the distance, see :mod:`.narrowphase`.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from .mesh_files import Floats
from .shapes import Solid

PlacedSolid: TypeAlias = tuple[Solid, Floats, Floats]
"""Convex solid with its (3, 3) rotation and (3,) position in the world."""

_ROUNDS, _SETS, _STARTS = 80, 8, 2


def directional_gaps(a: PlacedSolid, b: PlacedSolid, directions: Floats) -> Floats:
    """Return the gaps (n,) between two solids along unit directions (n, 3) from the first to the second [m].

    If a gap is negative, a translation of the second solid by that length along the direction separates them.
    """
    (solid_a, rotation_a, position_a), (solid_b, rotation_b, position_b) = a, b
    apart: Floats = (
        directions @ (position_b - position_a)
        - _support_values(solid_a, directions @ rotation_a)
        - _support_values(solid_b, -directions @ rotation_b)
    )
    return apart


def find_widest_gap(a: PlacedSolid, b: PlacedSolid, directions: Floats) -> tuple[float, Floats]:
    """Search for the direction with the largest gap; return the gap [m] and the unit direction (3,).

    Candidates are the axes of both solids, fixed directions all around, and the given ones, (n, 3). A pattern
    search with a shrinking step refines the best of them.
    """
    tried = np.concatenate(
        [directions, _DIRECTIONS, *(sign * rotation.T for _, rotation, _ in (a, b) for sign in (1.0, -1.0))]
    )
    values = directional_gaps(a, b, tried)
    found = [_ascend(a, b, tried[k], float(values[k])) for k in np.argsort(-values, kind="stable")[:_STARTS]]
    return max(found, key=lambda one: one[0])


def smoothed_support(placed: PlacedSolid, direction: Floats) -> Floats:
    """Return the support point (3,) of a solid in the world along a unit direction.

    If an edge or a face is furthest, it is approximately the middle of that.
    """
    solid, rotation, position = placed
    step = 1e-6
    # The gradient of the support function is the support point; at an edge or a face, a mean of several.
    ends = direction + step * np.concatenate([np.eye(3), -np.eye(3)])
    values = _support_values(solid, ends @ rotation)
    point = (values[:3] - values[3:]) / (2 * step)
    missing = float(_support_values(solid, (direction @ rotation)[None])[0] - direction @ point)
    return np.asarray(position + point + missing * direction)


def support(placed: PlacedSolid, direction: Floats) -> Floats:
    """Return a support point (3,) of a solid in the world along a unit direction."""
    solid, rotation, position = placed
    core, own = solid.core, direction @ rotation
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


def _support_values(solid: Solid, directions: Floats) -> Floats:
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
    """Return a low-discrepancy sequence of unit directions, (count, 3): every prefix covers the sphere."""
    k = np.arange(1, count + 1)
    height, angle = 2.0 * (k * 0.7548776662466927 % 1.0) - 1.0, 2.0 * np.pi * (k * 0.5698402909980532 % 1.0)
    side = np.sqrt(1.0 - height**2)
    return np.stack([side * np.cos(angle), side * np.sin(angle), height], axis=1)


_DIRECTIONS = _spread_directions(240)
