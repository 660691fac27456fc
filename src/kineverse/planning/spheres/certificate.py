"""Proof that spheres cover a region: subdivision until each tetrahedron lies in one sphere.

A sphere is convex, so it contains a tetrahedron if it contains the four corners. A polytope is the union
of the tetrahedra between an inner point and its triangles. One that no sphere contains is cut at the middle
of its longest edge. It is final once the sphere that lacks least of it would have to grow by a small length
only, or hardly more than for one corner alone. By that much the sphere does grow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kineverse.geometry.mesh_files import Floats, Integers

from .polytope import CoverRegion, scalar_products

_EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
_MOST_CELLS = 60_000
_NEAR, _SMALL = 10, 0.7  # spheres that a cell is tried with, and a small cell's edge in median radii


@dataclass(frozen=True, slots=True, eq=False)
class Uncovered:
    """Cells that lie in none of the spheres after subdivision."""

    growth: Floats  # (N,) growth of the radii with which the spheres cover everything [m]
    points: Floats  # (n, 3) points outside of all spheres, one for each cell that has one [m]


def find_uncovered(region: CoverRegion, centres: Floats, radii: Floats, tolerance: float) -> Uncovered:
    """Find the part of a region that spheres do not cover."""
    growth = np.zeros(len(radii))
    points: list[Floats] = []
    cells = np.concatenate([region.middles[region.owners][:, None], region.corners[region.faces]], axis=1)
    # A small cell is tried with the spheres around it only. A large one may lie in others, and is cut.
    near = _nearest_spheres(cells, centres, radii)
    least = _SMALL * float(np.median(radii)) if len(radii) > _NEAR else np.inf
    large = np.full(len(cells), len(radii) > _NEAR)
    while len(cells):
        gaps, nearest, needs, outside = _measure_gaps(cells, near, centres, radii + growth)
        final = (gaps > 0.0) & (gaps <= np.maximum(needs, 0.0) + tolerance) & ~large
        if len(cells) > _MOST_CELLS:
            final = gaps > 0.0
        grown = growth.copy()
        np.maximum.at(grown, nearest[final], growth[nearest[final]] + gaps[final])
        growth = grown
        points.append(outside[final & (needs > 0.0)])
        left_over = (gaps > 0.0) & ~final
        cells, near = cells[left_over], near[left_over]
        a, b = cells[:, _EDGES[:, 0]], cells[:, _EDGES[:, 1]]
        lengths = ((a - b) ** 2).sum(axis=2)
        longest = lengths.argmax(axis=1)
        rows = np.arange(len(cells))
        large = lengths[rows, longest] > least**2
        first, second = _EDGES[longest].T
        middles = (cells[rows, first] + cells[rows, second]) / 2
        left, right = cells.copy(), cells
        left[rows, second] = middles
        right[rows, first] = middles
        cells = np.concatenate([left, right])
        near, large = np.concatenate([near, near]), np.concatenate([large, large])
        near[large] = _nearest_spheres(cells[large], centres, radii + growth)
    return Uncovered(growth, np.concatenate(points))


def _nearest_spheres(cells: Floats, centres: Floats, radii: Floats) -> Integers:
    """Return for each cell the indices (n, k) of the spheres that reach furthest beyond its middle."""
    count = len(radii)
    if count <= _NEAR:
        return np.broadcast_to(np.arange(count), (len(cells), count)).copy()
    return np.argpartition(distances(cells.mean(axis=1), centres) - radii, _NEAR, axis=1)[:, :_NEAR]


def _measure_gaps(
    cells: Floats, near: Integers, centres: Floats, radii: Floats
) -> tuple[Floats, Integers, Floats, Floats]:
    """Measure how far each cell is from lying in a sphere, and in which one.

    Further, how far its worst corner is from all spheres, negative inside; and that corner.
    """
    beyond = np.empty((len(cells), 4, near.shape[1]))
    around, sizes = centres[near], radii[near]
    for k in range(4):
        apart = around - cells[:, k, None]
        beyond[:, k] = np.sqrt(np.einsum("nij,nij->ni", apart, apart)) - sizes
    of_cells = beyond.max(axis=1)
    rows = np.arange(len(cells))
    best = of_cells.argmin(axis=1)
    of_corners = beyond.min(axis=2)
    which = of_corners.argmax(axis=1)
    return of_cells[rows, best], near[rows, best], of_corners[rows, which], cells[rows, which]


def distances(points: Floats, centres: Floats) -> Floats:
    """Return the distances (n, N) of points (n, 3) from centres (N, 3) [m]."""
    square: Floats = np.square(points).sum(axis=1)[:, None] + np.square(centres).sum(axis=1)
    square -= scalar_products(2.0 * points, centres)
    return np.sqrt(np.maximum(square, 0.0, out=square), out=square)
