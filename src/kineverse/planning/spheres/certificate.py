"""Proof that spheres cover a polytope: subdivision until each tetrahedron lies in one sphere.

A sphere is convex, so it contains a tetrahedron if it contains the four corners. The polytope is the union of
the tetrahedra between an inner point and its triangles. Those that no sphere contains are cut at the middle of
their longest edge, until the sphere that lacks least of them would have to grow by a small length only, or by as
much as for one of their corners alone. By that much it does grow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kineverse.geometry.mesh_files import Floats, Integers

from .polytope import CoverPolytope

_EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
_MOST_CELLS = 200_000
_CHUNK = 400_000
"""Distances that are computed at once."""


@dataclass(frozen=True, slots=True, eq=False)
class Uncovered:
    """Cells that lie in none of the spheres after subdivision.

    Attributes
    ----------
    growth
        (N,) by how much the radii have to grow, so that the spheres cover everything [m].
    points
        (n, 3) points outside of all spheres, one of a cell that has one [m].
    """

    growth: Floats
    points: Floats


def find_uncovered(polytope: CoverPolytope, centres: Floats, radii: Floats, tolerance: float) -> Uncovered:
    """Return the part of a polytope that spheres do not cover.

    Parameters
    ----------
    polytope
        What is to be covered.
    centres, radii
        (N, 3) and (N,) spheres [m].
    tolerance
        Growth that is accepted without a point that needs it [m].
    """
    growth = np.zeros(len(radii))
    points: list[Floats] = []
    middle = polytope.corners.mean(axis=0)
    corners = polytope.corners[polytope.faces]
    cells = np.concatenate([np.broadcast_to(middle, (len(corners), 1, 3)), corners], axis=1)
    while len(cells):
        gaps, nearest, needs, outside = _measure_gaps(cells, centres, radii)
        final = (gaps > 0.0) & (gaps <= np.maximum(needs, 0.0) + tolerance)
        if len(cells) > _MOST_CELLS:
            final = gaps > 0.0
        np.maximum.at(growth, nearest[final], gaps[final])
        points.append(outside[final & (needs > 0.0)])
        cells = cells[(gaps > 0.0) & ~final]
        a, b = cells[:, _EDGES[:, 0]], cells[:, _EDGES[:, 1]]
        longest = ((a - b) ** 2).sum(axis=2).argmax(axis=1)
        rows = np.arange(len(cells))
        first, second = _EDGES[longest].T
        middles = (cells[rows, first] + cells[rows, second]) / 2
        left, right = cells.copy(), cells
        left[rows, second] = middles
        right[rows, first] = middles
        cells = np.concatenate([left, right])
    return Uncovered(growth, np.concatenate(points))


def _measure_gaps(cells: Floats, centres: Floats, radii: Floats) -> tuple[Floats, Integers, Floats, Floats]:
    """Return how far each cell is from lying in one sphere, and in which one.

    Further, how far its worst corner is from all spheres, negative inside; and that corner.
    """
    count = len(cells)
    gaps, needs, worst = np.empty(count), np.empty(count), np.empty((count, 3))
    nearest = np.empty(count, dtype=np.int64)
    step = max(_CHUNK // (4 * len(radii)), 1)
    for start in range(0, count, step):
        part = slice(start, start + step)
        beyond = (distances(cells[part].reshape(-1, 3), centres) - radii).reshape(-1, 4, len(radii))
        of_cells = beyond.max(axis=1)
        nearest[part] = of_cells.argmin(axis=1)
        gaps[part] = of_cells.min(axis=1)
        of_corners = beyond.min(axis=2)
        which = of_corners.argmax(axis=1)
        rows = np.arange(len(which))
        needs[part], worst[part] = of_corners[rows, which], cells[part][rows, which]
    return gaps, nearest, needs, worst


def distances(points: Floats, centres: Floats) -> Floats:
    """Return the distances (n, N) of points (n, 3) from centres (N, 3) [m]."""
    square: Floats = np.square(points).sum(axis=1)[:, None] + np.square(centres).sum(axis=1)
    square -= 2.0 * points @ centres.T
    return np.sqrt(np.maximum(square, 0.0, out=square), out=square)
