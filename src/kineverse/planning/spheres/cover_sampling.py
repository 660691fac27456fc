"""Points of a region that are hardest to cover by spheres, and first centres for covers.

The power of a point x for a sphere is |x - c|² - r². Spheres cover a solid if and only if each one covers the
part where its own power is least. These parts are convex, so that their corners are hardest to cover: on the
surface, points of equal power for three spheres; on an edge, for two. A triangle whose corners belong to
different spheres is likely to have one (F. Aurenhammer, Power diagrams: properties, algorithms and
applications, SIAM J. Comput. 16, 1987). First centres come from a greedy set cover, and from lattices.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.geometry.mesh_files import Floats, Integers

from .certificate import distances
from .polytope import CoverRegion, scalar_products

Flags: TypeAlias = npt.NDArray[np.bool_]

_LAYERS, _INNER_TRIANGLES = (0.75, 0.5, 0.25), 60
"""Sizes of the inner surfaces relative to the outer one, and the number of their triangles."""


class CoverMesh:
    """Triangles on the surfaces of the solids of a region, and coarser ones on smaller copies inside.

    Those that lie deep in another solid are left out.
    """

    def __init__(self, region: CoverRegion, spacing: float) -> None:
        surface, of_surface = split_triangles(region.corners[region.faces], region.owners, spacing)
        inner, of_inner = split_triangles(region.corners[region.faces], region.owners, 2 * spacing)
        step = len(inner) // (_INNER_TRIANGLES * len(region.parts)) + 1
        inner, of_inner = inner[::step], of_inner[::step]
        middles = region.middles[of_inner][:, None]
        triangles = np.concatenate([surface, *[middles + size * (inner - middles) for size in _LAYERS]])
        owners = np.concatenate([of_surface, *(of_inner for _ in _LAYERS)])
        triangles = triangles[~is_deep_in_others(region, triangles, owners, spacing)].reshape(-1, 3)
        # Corners are merged, so that each counts once.
        marks = np.round(triangles @ np.array([1.0, math.sqrt(2.0), math.pi]), 9)
        _, first, which = np.unique(marks, return_index=True, return_inverse=True)
        self.points: Floats = np.concatenate([triangles[first], region.middles])
        self._single = self.points.astype(np.float32)
        self._triangles: Integers = which.reshape(-1, 3)
        pairs = np.concatenate([self._triangles[:, [i, j]] for i, j in ((0, 1), (1, 2), (2, 0))])
        pairs.sort(axis=1)
        keys = np.unique(pairs[:, 0] * len(self.points) + pairs[:, 1])
        self._edges = np.column_stack(np.divmod(keys, len(self.points)))

    def find_critical(self, centres: Floats, radii: Floats) -> tuple[Floats, Integers]:
        """Return points (n, 3) of the region that may be the hardest to cover, and the sphere (n,) of each.

        They are all corners of triangles, and points of equal power on edges and in triangles.
        """
        # Powers without the common |x|² are linear. Which sphere a point belongs to need not be exact.
        squares = ((centres**2).sum(axis=1) - radii**2).astype(np.float32)
        twice = (2.0 * centres).astype(np.float32)
        powers = squares - scalar_products(self._single, twice)
        owners = powers.argmin(axis=1)
        a, b = self._edges.T
        cut = owners[a] != owners[b]
        a, b = a[cut], b[cut]
        before = powers[a, owners[b]] - powers[a, owners[a]]
        part = before / np.maximum(before + (powers[b, owners[a]] - powers[b, owners[b]]), 1e-30)
        on_edges = self.points[a] + part[:, None] * (self.points[b] - self.points[a])
        labels = owners[self._triangles]
        mixed = (labels != np.roll(labels, 1, axis=1)).all(axis=1)
        corners, labels = self._triangles[mixed], labels[mixed]
        u, v = (powers[corners, labels[:, :1]] - powers[corners, labels[:, k : k + 1]] for k in (1, 2))
        weights = np.cross(u, v)
        weights = np.maximum(weights * np.sign(weights.sum(axis=1, keepdims=True)), 0.0) + 1e-30
        weights /= weights.sum(axis=1, keepdims=True)
        inside = np.einsum("nk,nkj->nj", weights, self.points[corners])
        points = np.concatenate([self.points, on_edges, inside])
        # Points between two triangles may belong to yet another sphere.
        others = squares - scalar_products(points[len(self.points) :].astype(np.float32), twice)
        return points, np.concatenate([owners, others.argmin(axis=1)])


def is_deep_in_others(region: CoverRegion, triangles: Floats, owners: Integers, least: float) -> Flags:
    """Return flags (n,) of triangles (n, 3, 3) of solids (n,) deeper in another one than a length."""
    if len(region.parts) == 1:
        return np.zeros(len(triangles), dtype=bool)
    depths = region.part_depths(triangles.reshape(-1, 3)).reshape(len(triangles), 3, -1).min(axis=1)
    depths[np.arange(len(triangles)), owners] = -np.inf
    return np.asarray(depths.max(axis=1) > least)


def split_triangles(triangles: Floats, owners: Integers, longest: float) -> tuple[Floats, Integers]:
    """Cut triangles (n, 3, 3) at the middle of their longest edges, until none is too long.

    Also return the owner (n,) of each part.
    """
    done: list[tuple[Floats, Integers]] = []
    while len(triangles):
        edges = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2)
        first = edges.argmax(axis=1)
        long = edges[np.arange(len(triangles)), first] > longest
        done.append((triangles[~long], owners[~long]))
        triangles, owners, first = triangles[long], owners[long], first[long]
        rows = np.arange(len(triangles))
        a, b, c = (triangles[rows, (first + k) % 3] for k in range(3))
        middle = (a + b) / 2
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        owners = np.concatenate([owners, owners])
    return np.concatenate([part for part, _ in done]), np.concatenate([of for _, of in done])


_SAMPLES, _CANDIDATES = 150, 1500


class CoverStarts:
    """Points of a region, and candidates for centres, for a protrusion.

    Candidates lie below the surface at several depths, where balls that touch it on both sides have their
    centres.
    """

    def __init__(self, region: CoverRegion, protrusion: float) -> None:
        self._region = region
        triangles = region.corners[region.faces]
        a, b, c = np.moveaxis(triangles, 1, 0)
        area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
        spacing = max(1.1 * protrusion, math.sqrt(area / _SAMPLES))
        triangles, owners = split_triangles(triangles, region.owners, spacing)
        outside = ~is_deep_in_others(region, triangles, owners, spacing)
        triangles, owners = triangles[outside], owners[outside]
        surface, kept = _thin(triangles.reshape(-1, 3), 0.6 * spacing)
        origins = region.middles[owners[kept // 3]]
        surface = surface - origins
        self._points = np.concatenate([origins + size * surface for size in (1.0, 0.7, 0.35)])
        middles, kept = _thin(triangles.mean(axis=1), spacing)
        a, b, c = np.moveaxis(triangles[kept], 1, 0)
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        deepest = max(float(region.depths(region.middles).max()), protrusion)
        levels = protrusion * np.geomspace(0.7, max(1.2 * deepest / protrusion, 1.5), 5)
        inner = [origins + size * surface for size in (0.3, 0.6, 0.8, 0.9)]
        candidates = np.concatenate([region.middles, *inner, *(middles - t * normals for t in levels)])
        candidates = candidates[region.depths(candidates) > 0.0]
        self._candidates = candidates[:: len(candidates) // _CANDIDATES + 1]
        self._depths = region.depths(self._candidates)
        self._apart = distances(self._points, self._candidates)
        self._protrusion = protrusion

    def least_greedy(self, most: int) -> float:
        """Return nearly the least protrusion for which :meth:`greedy` chooses at most so many centres.

        The search begins at half the protrusion of the starts.
        """
        low = high = 0.5 * self._protrusion
        while len(self.greedy(high)) > most:
            low, high = high, 2.0 * high
        while high > 1.1 * low:
            middle = math.sqrt(low * high)
            low, high = (middle, high) if len(self.greedy(middle)) > most else (low, middle)
        return high

    def greedy(self, protrusion: float) -> Floats:
        """Return centres whose balls cover the points, each chosen because it covers most new ones."""
        covers = self._apart <= self._depths + protrusion
        gains = covers.sum(axis=0)
        left = np.ones(len(self._points), dtype=bool)
        chosen: list[int] = []
        while gains.any():
            best = int(gains.argmax())
            chosen.append(best)
            new = left & covers[:, best]
            left &= ~new
            gains -= covers[new].sum(axis=0)
        # What no candidate reaches, such as a sharp corner, is left to the descent.
        return self._candidates[chosen]

    def lattice(self, protrusion: float, most: int) -> Floats:
        """Return the centres of equal boxes along the principal axes of each solid.

        They are the fewest whose balls protrude no further, or at most so many with the least protrusion.
        """
        region = self._region
        centres = [_box_centres(part.corners, protrusion, most) for part in region.parts]
        owners = np.repeat(np.arange(len(centres)), [len(result) for result in centres])
        points = np.concatenate(centres)
        depths = region.part_depths(points)
        # What lies deeper in another solid is left to that one.
        kept = (depths.max(axis=1) > -protrusion) & (depths.argmax(axis=1) == owners)
        result: Floats = points[kept]
        return result if len(result) else region.middles[:1]


def _box_centres(corners: Floats, protrusion: float, most: int) -> Floats:
    """Return the centres (n, 3) of equal boxes that make up a box around corners."""
    axes = _principal_axes(corners)
    low, high = (corners @ axes.T).min(axis=0), (corners @ axes.T).max(axis=0)
    numbers = range(1, most + 1)
    pairs = ((i, j) for i in numbers for j in numbers[: most // i])
    counts = np.array([(i, j, k) for i, j in pairs for k in numbers[: most // (i * j)]])
    half = (high - low) / 2 / counts
    protrusions = np.linalg.norm(half, axis=1) - half.min(axis=1)
    totals = np.where(protrusions <= protrusion, counts.prod(axis=1), np.inf)
    best = counts[totals.argmin() if np.isfinite(totals).any() else protrusions.argmin()]
    ticks = [low[k] + (high[k] - low[k]) * (np.arange(best[k]) + 0.5) / best[k] for k in range(3)]
    return np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3) @ axes


def _principal_axes(corners: Floats) -> Floats:
    """Return axes (3, 3) as rows: the coordinate axes, or those of the corners if their box is smaller."""
    principal = np.linalg.svd(corners - corners.mean(axis=0), full_matrices=False)[2]
    boxes = [float(np.ptp(corners @ axes.T, axis=0).prod()) for axes in (np.eye(3), principal)]
    return principal if boxes[1] < 0.99 * boxes[0] else np.eye(3)


def _thin(points: Floats, spacing: float) -> tuple[Floats, Integers]:
    """Return one point of each cell of a grid, and the indices of these."""
    cells = np.floor(points / spacing + 0.137).astype(np.int64)
    kept = np.unique(cells @ np.array([1, 100_003, 10_000_019_933]), return_index=True)[1]
    return points[kept], kept
