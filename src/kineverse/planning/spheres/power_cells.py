"""Power diagram of spheres within a polytope, by its corners.

The power of a point x for a sphere is |x - c|² - r². Spheres cover a polytope if and only if each sphere
contains its own power cell, the part of the polytope in which its power is least: there, a point that any sphere
covers is covered by this one. A cell is convex, so that its corners decide.

Source: F. Aurenhammer, Power diagrams: properties, algorithms and applications, SIAM J. Comput. 16 (1987).
The corners of a cell are the faces of the convex hull of its dual points (Preparata and Muller, 1979).
"""

from __future__ import annotations

import numpy as np

from kineverse.geometry.mesh_files import Floats, Integers
from kineverse.geometry.shapes import import_coal

_BOX = np.concatenate([np.eye(3), -np.eye(3)])

_ASCENT = 12
_REACH = 1.4
_LEAST_WIDTH = 1e-5
"""Inner radius of cells, as a fraction of the radius of their sphere, below which they are left out."""


def find_power_cells(
    normals: Floats, offsets: Floats, centres: Floats, radii: Floats
) -> tuple[Floats, Integers]:
    """Return the corners of all power cells within a polytope.

    Parameters
    ----------
    normals, offsets
        The polytope: the points x with ``normals @ x <= offsets``; (F, 3) unit vectors and (F,) [m].
    centres, radii
        (N, 3) and (N,) spheres [m].

    Returns
    -------
    corners, owners
        (n, 3) corners [m], and (n,) the sphere whose cell has them. Spheres without a cell own none.
    """
    planes, bounds = _halfspaces(normals, offsets, centres, radii)
    inner, widths = _inner_points(planes, bounds, centres, radii)
    corners: list[Floats] = []
    owners: list[int] = []
    for k in np.flatnonzero(widths > _LEAST_WIDTH * radii).tolist():
        found = _cell_corners(planes[k], bounds[k] - planes[k] @ inner[k], _REACH * float(radii[k]))
        corners.append(found + inner[k])
        owners += len(found) * [k]
    return np.concatenate([np.zeros((0, 3)), *corners]), np.array(owners, dtype=np.int64)


def find_deepest_point(normals: Floats, offsets: Floats, inside: Floats) -> Floats:
    """Return a point (3,) far from all planes of a polytope, starting from a point inside of it [m]."""
    start = inside[None]
    reach = np.array([float(np.abs(offsets - normals @ inside).max())])
    deepest: Floats = _inner_points(normals[None], offsets[None], start, reach, rounds=60)[0][0]
    return deepest


def _halfspaces(
    normals: Floats, offsets: Floats, centres: Floats, radii: Floats
) -> tuple[Floats, Floats]:
    """Return the half-spaces of every cell: (N, F + N, 3) unit normals and (N, F + N) offsets.

    A sphere has none with itself; its place holds one that contains everything.
    """
    count, faces = len(centres), len(normals)
    planes, bounds = np.empty((count, faces + count, 3)), np.empty((count, faces + count))
    planes[:, :faces], bounds[:, :faces] = normals, offsets
    apart = centres[None] - centres[:, None]
    lengths = np.linalg.norm(apart, axis=2)
    same = lengths <= 1e-9 * radii.max()
    lengths[same] = 1.0
    powers = (centres**2).sum(axis=1) - radii**2
    planes[:, faces:] = apart / lengths[:, :, None]
    limits = (powers[None] - powers[:, None]) / (2 * lengths)
    limits[same] = np.inf
    bounds[:, faces:] = limits
    return planes, bounds


def _inner_points(
    planes: Floats, bounds: Floats, centres: Floats, radii: Floats, rounds: int = _ASCENT
) -> tuple[Floats, Floats]:
    """Return a point well inside of each cell, and its distance from the nearest plane, negative outside."""
    rows = np.arange(len(centres))
    points, best, widths = centres.copy(), centres.copy(), np.full(len(centres), -np.inf)
    step = 0.5 * radii
    for _ in range(rounds):
        slack = bounds - np.einsum("nfk,nk->nf", planes, points)
        nearest = slack.argmin(axis=1)
        width = slack[rows, nearest]
        better = width > widths
        best[better], widths[better] = points[better], width[better]
        # Away from the nearest plane; outside of the cell at least to its other side.
        points = points - planes[rows, nearest] * np.maximum(step, -1.1 * width)[:, None]
        step = step * 10.0 ** (-2.0 / rounds)
    return best, widths


def _cell_corners(planes: Floats, slack: Floats, reach: float) -> Floats:
    """Return the corners of a bounded cell about the origin, from planes at positive distances [m].

    Planes beyond all corners cut nothing, so those within a reach are tried first. A box around them closes the
    cell; coal would crash for planes whose dual points are flat.
    """
    coal = import_coal()
    while True:
        near = slack <= reach
        vector = coal.StdVec_Vec3s()
        for dual in np.concatenate([planes[near] / slack[near, None], _BOX / (2 * reach)]):
            vector.append(dual)
        try:
            hull = coal.Convex.convexHull(vector, True, "Qt")
        except Exception:  # qhull's, for planes that are too close together
            return np.zeros((0, 3))
        distances = -np.array(hull.offsets()).reshape(-1)
        if distances.min() <= 0.0:
            return np.zeros((0, 3))
        corners: Floats = np.array(hull.normals()) / distances[:, None]
        if float(np.square(corners).sum(axis=1).max()) <= reach**2:
            return corners
        reach *= 2.0
