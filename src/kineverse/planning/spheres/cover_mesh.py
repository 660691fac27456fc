"""Points of a region that are hardest to cover by given spheres.

The power of a point x for a sphere is |x - c|² - r². Spheres cover a solid if and only if each one covers the
part where its own power is least. These parts are convex, so that their corners are hardest to cover: on the
surface, points of equal power for three spheres; on an edge, for two. A triangle whose corners belong to
different spheres is likely to have one.

Source: F. Aurenhammer, Power diagrams: properties, algorithms and applications, SIAM J. Comput. 16 (1987).
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.geometry.mesh_files import Floats, Integers

from .polytope import CoverRegion, scalar_products

Flags: TypeAlias = npt.NDArray[np.bool_]

_LAYERS, _INNER_TRIANGLES = (0.75, 0.5, 0.25), 60
"""Sizes of the inner surfaces beside the outer one, and the number of their triangles."""


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
        layers = [middles + size * (inner - middles) for size in _LAYERS]
        triangles = np.concatenate([surface, *layers])
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
        after = powers[b, owners[a]] - powers[b, owners[b]]
        part = before / np.maximum(before + after, 1e-30)
        on_edges = self.points[a] + part[:, None] * (self.points[b] - self.points[a])
        own = owners[self._triangles]
        mixed = (own[:, 0] != own[:, 1]) & (own[:, 1] != own[:, 2]) & (own[:, 2] != own[:, 0])
        corners, own = self._triangles[mixed], own[mixed]
        u, v = (powers[corners, own[:, :1]] - powers[corners, own[:, k : k + 1]] for k in (1, 2))
        weights = np.cross(u, v)
        weights = np.maximum(weights * np.sign(weights.sum(axis=1, keepdims=True)), 0.0) + 1e-30
        weights /= weights.sum(axis=1, keepdims=True)
        inside = np.einsum("nk,nkj->nj", weights, self.points[corners])
        points = np.concatenate([self.points, on_edges, inside])
        # Points between two triangles may belong to yet another sphere.
        added = points[len(self.points) :]
        others = squares - scalar_products(added.astype(np.float32), twice)
        return points, np.concatenate([owners, others.argmin(axis=1)])


def is_deep_in_others(region: CoverRegion, triangles: Floats, owners: Integers, least: float) -> Flags:
    """Return flags (n,) of triangles (n, 3, 3) of solids (n,) deeper in another one than a length."""
    if len(region.parts) == 1:
        return np.zeros(len(triangles), dtype=bool)
    depths = region.part_depths(triangles.reshape(-1, 3)).reshape(len(triangles), 3, -1).min(axis=1)
    depths[np.arange(len(triangles)), owners] = -np.inf
    return np.asarray(depths.max(axis=1) > least)


def split_triangles(triangles: Floats, owners: Integers, longest: float) -> tuple[Floats, Integers]:
    """Return triangles (n, 3, 3) cut at the middle of their longest edges, until none is too long.

    Further, of each the owner (n,) of the triangle that it is a part of.
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
