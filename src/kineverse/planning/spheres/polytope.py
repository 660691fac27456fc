"""Solids that spheres shall cover: polytopes around them, and depths of points in them.

A cover of the outer polytopes covers the solids. Depths are exact but for an ellipsoid, which lies between
the hull of points on its surface and that of points around it; those in the inner hull are lower bounds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError
from kineverse.geometry.mesh_files import Faces, Floats, Integers
from kineverse.geometry.shapes import (
    Hull,
    Solid,
    enclosed_volume,
    sample_inside,
    solid_from_points,
    solid_surface,
)
from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Sphere

_ROUNDNESS = 0.03  # gap between a round solid and its polytope, as a fraction of the protrusion of a cover

_FEWEST_SIDES, _MOST_SIDES = 12, 192

_ASCENT = 120

_MANY_CORNERS, _DIRECTIONS = 200, 400

_BLOCK = 80_000
_SAMPLES = 1000
_FAR = 1e9  # offset of a plane that bounds nothing


@dataclass(frozen=True, slots=True, eq=False)
class RoundSide:
    """Round side of a solid, in which a point x has the depth ``offset - slope z - width |x - a|``.

    z is the place of x along the axis, and a the point of the axis next to x, no further than ``reach`` from
    the origin. A sphere has the reach 0; cylinders and cones have an infinite one, and a cone has a slope.
    """

    origin: Floats  # (3,), of the axis [m]
    axis: Floats  # (3,), its direction
    reach: float  # [m]
    offset: float  # [m]
    slope: float = 0.0
    width: float = 1.0


_Z = np.array([0.0, 0.0, 1.0])
_NO_SIDE = RoundSide(np.zeros(3), _Z, 0.0, _FAR, width=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class CoverPolytope:
    """Convex solid, with a polytope that contains it."""

    corners: Floats  # (V, 3), of the polytope [m]
    faces: Integers  # (T, 3), its triangles
    normals: Floats  # (F, 3) and (F,), flat sides of the solid: normals @ x <= offsets [m]
    offsets: Floats
    volume: float  # of the solid [m³]
    side: RoundSide = _NO_SIDE
    is_hull: bool = False  # True if the polytope is the solid

    def simplify(self) -> CoverPolytope:
        """Return the hull of the corners of a hull that are extreme along some directions, if there are many.

        It lies inside of the solid.
        """
        if not self.is_hull or len(self.corners) <= _MANY_CORNERS:
            return self
        extreme = np.unique((self.corners @ _sphere_lattice(_DIRECTIONS).T).argmax(axis=0))
        try:
            return _bound_hull(solid_from_points(self.corners[extreme]))
        except InvalidValueError:  # those of a very thin hull may be flat
            return self

    def move(self, pose: Floats, factor: float = 1.0) -> CoverPolytope:
        """Return the solid at a pose (4, 4), everything scaled by a factor."""
        rotation, place = pose[:3, :3], pose[:3, 3]
        normals, side = self.normals @ rotation.T, self.side
        origin, axis = factor * (rotation @ side.origin + place), rotation @ side.axis
        moved = RoundSide(origin, axis, factor * side.reach, factor * side.offset, side.slope, side.width)
        corners = factor * (self.corners @ rotation.T + place)
        offsets, volume = factor * (self.offsets + normals @ place), factor**3 * self.volume
        return CoverPolytope(corners, self.faces, normals, offsets, volume, moved, self.is_hull)


class CoverRegion:
    """Union of convex solids."""

    def __init__(self, parts: Sequence[CoverPolytope]) -> None:
        self.parts = tuple(parts)
        first = np.cumsum([0, *(len(part.corners) for part in parts)])
        self.corners: Floats = np.concatenate([part.corners for part in parts])
        self.faces = np.concatenate([part.faces + k for part, k in zip(parts, first.tolist(), strict=False)])
        self.owners = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
        # Rows of planes are filled up by some that bound nothing.
        most = max(1, *(len(part.normals) for part in parts))
        self._normals = np.zeros((len(parts), most, 3))
        self._offsets = np.full((len(parts), most), _FAR)
        for k, part in enumerate(parts):
            self._normals[k, : len(part.normals)] = part.normals
            self._offsets[k, : len(part.offsets)] = part.offsets
        sides = [part.side for part in parts]
        self._origins = np.array([side.origin for side in sides])
        self._axes = np.array([side.axis for side in sides])
        self._sides = np.array([[side.reach, side.offset, side.slope, side.width] for side in sides])
        self.middles: Floats = np.array([part.corners.mean(axis=0) for part in parts])
        self._find_middles()

    def simplify(self) -> CoverRegion:
        """Return the region of the simplified solids."""
        simple = [part.simplify() for part in self.parts]
        changed = any(one is not other for one, other in zip(simple, self.parts, strict=True))
        return CoverRegion(simple) if changed else self

    def part_depths(self, points: Floats) -> Floats:
        """Return the depths (n, P) of points (n, 3) in each solid [m]; negative outside."""
        products = scalar_products(points, self._normals.reshape(-1, 3))
        flat = (self._offsets - products.reshape(len(points), *self._offsets.shape)).min(axis=2)
        round_ = self._round_depths(points[:, None], np.arange(len(self.parts)))[0]
        return np.asarray(np.minimum(flat, round_))

    def depths(self, points: Floats) -> Floats:
        """Return lower bounds (n,) of the depths of points (n, 3) in the union [m]; negative outside."""
        return np.asarray(self.part_depths(points).max(axis=1))

    def nearest_sides(self, points: Floats, owners: Integers, count: int) -> tuple[Floats, Floats]:
        """Return how far points (n, 3) are inside of the nearest sides of their solids (n,), and the normals.

        They have the shapes (n, F) and (n, F, 3), F at most the count and 1.
        """
        flat = self._offsets[owners] - np.einsum("nfj,nj->nf", self._normals[owners], points)
        count, rows = min(count, flat.shape[1]), np.arange(len(points))[:, None]
        near = np.argpartition(flat, count - 1, axis=1)[:, :count]
        depths, away = self._round_depths(points, owners)
        normals = np.concatenate([self._normals[owners[:, None], near], away[:, None]], axis=1)
        return np.concatenate([flat[rows, near], depths[:, None]], axis=1), normals

    def measure_volume(self) -> float:
        """Return the volume of the union, to about a percent where solids overlap [m³]."""
        if len(self.parts) == 1:
            return self.parts[0].volume
        volume = 0.0
        for k, part in enumerate(self.parts):
            # Each point counts as often as one solid contains it.
            inside = sample_inside(part.corners, part.faces, self.middles[k], _SAMPLES)
            shared = (self.part_depths(inside) >= 0.0).sum(axis=1)
            volume += part.volume * float((1.0 / np.maximum(shared, 1)).mean())
        return volume

    def _round_depths(self, points: Floats, owners: Integers) -> tuple[Floats, Floats]:
        """Return the depths of points (..., 3) in the round sides of solids (...,), and the normals there."""
        axis, (reach, offset, slope, width) = self._axes[owners], np.moveaxis(self._sides[owners], -1, 0)
        apart = points - self._origins[owners]
        along = np.einsum("...j,...j->...", apart, axis)
        apart = apart - np.clip(along, -reach, reach)[..., None] * axis
        lengths = np.sqrt(np.einsum("...j,...j->...", apart, apart))
        away = (width / np.maximum(lengths, 1e-12))[..., None] * apart + slope[..., None] * axis
        return offset - slope * along - width * lengths, away

    def _find_middles(self) -> None:
        """Move the middles away from the nearest sides, by ever smaller steps."""
        everyone = np.arange(len(self.parts))
        points, widths = self.middles, np.full(len(self.parts), -math.inf)
        steps = np.array([0.5 * float(np.ptp(part.corners, axis=0).max()) for part in self.parts])
        for _ in range(_ASCENT):
            slacks, normals = self.nearest_sides(points, everyone, 1)
            nearest = slacks.argmin(axis=1)
            least = slacks[everyone, nearest]
            better = least > widths
            self.middles = np.where(better[:, None], points, self.middles)
            widths = np.where(better, least, widths)
            # From outside, at least to the inner side.
            points = points - normals[everyone, nearest] * np.maximum(steps, -1.1 * least)[:, None]
            steps *= 0.93


def scalar_products(points: npt.NDArray[Any], others: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the scalar products (n, m) of vectors (n, 3) and (m, 3).

    It is computed in blocks: libraries share a large product among threads, which may have other work.
    """
    result = np.empty((len(points), len(others)), dtype=points.dtype)
    rows = max(_BLOCK // max(len(others), 1), 1)
    for k in range(0, len(points), rows):
        np.matmul(points[k : k + rows], others.T, out=result[k : k + rows])
    return result


def bound_solid(solid: Solid, protrusion: float) -> CoverPolytope:
    """Bound a convex solid by a polytope that is close enough for covers with a protrusion [m]."""
    surface = solid.surface
    if isinstance(surface, Faces):
        raise InvalidValueError(
            "A triangle mesh has no inside to be covered by spheres: use its hull or its decomposition."
        )
    if isinstance(surface, Hull):
        return _bound_hull(solid)
    if isinstance(surface, Box):
        signs = np.array([[i, j, k] for i in (-1.0, 1.0) for j in (-1.0, 1.0) for k in (-1.0, 1.0)])
        return _bound_hull(solid_from_points(signs * solid.half))
    if isinstance(surface, Ellipsoid):
        radii = np.asarray(surface.radii, dtype=float)
        points, widening = _sphere_points(_count_sides(float(radii.max()), protrusion))
        inner, outer = (_bound_hull(solid_from_points(factor * points * radii)) for factor in (1.0, widening))
        return CoverPolytope(outer.corners, outer.faces, inner.normals, inner.offsets, solid_volume(solid))
    radius = float(surface.radius)
    half = 0.0 if isinstance(surface, Sphere) else float(surface.length) / 2
    count, up = _count_sides(radius, protrusion), half * _Z
    if isinstance(surface, Sphere | Capsule):
        points, widening = _sphere_points(count)
        points *= radius * widening
        side = RoundSide(np.zeros(3), _Z, half, radius)
        return _bound_round(np.concatenate([points + up, points - up]), solid_volume(solid), side)
    angles = 2 * math.pi * np.arange(count) / count
    rim = radius / math.cos(math.pi / count) * np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    if isinstance(surface, Cylinder):
        side = RoundSide(np.zeros(3), _Z, math.inf, radius)
        return _bound_round(np.concatenate([rim + up, rim - up]), solid_volume(solid), side, half, half)
    assert isinstance(surface, Cone)
    slant = math.hypot(radius, 2 * half)
    side = RoundSide(np.zeros(3), _Z, math.inf, half * radius / slant, radius / slant, 2 * half / slant)
    return _bound_round(np.concatenate([rim - up, up[None]]), solid_volume(solid), side, half)


@lru_cache(maxsize=4096)
def solid_volume(solid: Solid) -> float:
    """Return the volume of a convex solid [m³]."""
    surface = solid.surface
    assert not isinstance(surface, Faces)
    if isinstance(surface, Hull):
        return _bound_hull(solid).volume
    if isinstance(surface, Box):
        return float(8.0 * solid.half.prod())
    if isinstance(surface, Ellipsoid):
        return 4 / 3 * math.pi * math.prod(surface.radii)
    disc = math.pi * surface.radius**2
    if isinstance(surface, Sphere):
        return 4 / 3 * disc * surface.radius
    if isinstance(surface, Capsule):
        return disc * (surface.length + 4 / 3 * surface.radius)
    return disc * surface.length / (3 if isinstance(surface, Cone) else 1)


def _bound_hull(solid: Solid) -> CoverPolytope:
    mesh, surface = solid_surface(solid), solid.surface
    assert isinstance(mesh, Faces)
    assert isinstance(surface, Hull)
    volume = enclosed_volume(mesh.vertices, mesh.faces)
    # Triangles of one flat face share a plane.
    planes = np.column_stack([surface.normals, surface.offsets / solid.radius])
    kept = np.unique(np.round(planes, 9), axis=0, return_index=True)[1]
    normals, offsets = surface.normals[kept], surface.offsets[kept]
    return CoverPolytope(mesh.vertices, mesh.faces, normals, offsets, volume, is_hull=True)


def _bound_round(
    corners: Floats, volume: float, side: RoundSide, below: float | None = None, above: float | None = None
) -> CoverPolytope:
    """Bound a solid with a round side, which may be cut flat below and above the origin [m]."""
    around = _bound_hull(solid_from_points(corners))
    cuts = [(-_Z, below), (_Z, above)]
    normals = np.array([normal for normal, height in cuts if height is not None]).reshape(-1, 3)
    offsets = np.array([height for _, height in cuts if height is not None])
    return CoverPolytope(around.corners, around.faces, normals, offsets, volume, side)


def _count_sides(radius: float, protrusion: float) -> int:
    """Return the sides of a regular polygon whose sagitta is small compared with a protrusion [m]."""
    cosine = 1.0 - min(_ROUNDNESS * protrusion / radius, 0.5)
    return min(max(4 * math.ceil(math.pi / math.acos(cosine) / 4), _FEWEST_SIDES), _MOST_SIDES)


def _sphere_points(count: int) -> tuple[Floats, float]:
    """Return points on the unit sphere, and the factor by which their hull contains the sphere.

    They are as far from each other as the corners of a regular polygon with that many sides, about.
    """
    points = _sphere_lattice(min(int(count**2 / 3.0), 500))
    return points, 1.0 / float(_bound_hull(solid_from_points(points)).offsets.min())


def _sphere_lattice(number: int) -> Floats:
    """Return a Fibonacci lattice of points (number, 3) on the unit sphere."""
    k = np.arange(number)
    z = 1.0 - (2.0 * k + 1.0) / number
    angle = math.pi * (3.0 - math.sqrt(5.0)) * k
    width = np.sqrt(1.0 - z**2)
    return np.column_stack([width * np.cos(angle), width * np.sin(angle), z])
