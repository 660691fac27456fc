"""Polytopes around and inside of convex solids, for sphere covers.

A cover of the outer polytope covers the solid. The depth of a point in the inner polytope is a lower bound of
its depth in the solid. Boxes and hulls are both polytopes themselves; round primitives lie between the hull
of points on their surface and that of points around them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.geometry.mesh_files import Faces, Floats, Integers
from kineverse.geometry.shapes import Hull, Solid, solid_from_points, solid_surface
from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Sphere

_ROUNDNESS = 0.03
"""Gap between a round solid and either polytope, as a fraction of the protrusion of a cover."""

_FEWEST_SIDES, _MOST_SIDES = 12, 192

_ASCENT = 120

_MANY_CORNERS, _DIRECTIONS = 200, 400


@dataclass(frozen=True, slots=True, eq=False)
class CoverPolytope:
    """Polytopes that bound a convex solid from outside and from inside.

    Attributes
    ----------
    corners, faces
        Outer polytope: (V, 3) corners [m] and (T, 3) triangles, counter-clockwise seen from outside.
    normals, offsets
        Inner polytope: the points x with ``normals @ x <= offsets``; (F, 3) unit vectors and (F,) [m].
    volume
        Volume of the solid itself [m³].
    is_round
        True if the solid lies between the two; False if both are the solid.
    """

    corners: Floats
    faces: Integers
    normals: Floats
    offsets: Floats
    volume: float
    is_round: bool = False

    def depths(self, points: Floats) -> Floats:
        """Return lower bounds (n,) of the depths of points (n, 3) in the solid [m]; negative outside."""
        depths: Floats = (self.offsets - points @ self.normals.T).min(axis=1)
        return depths

    def simplify(self) -> CoverPolytope:
        """Return the hull of the corners that are extreme along some directions, if there are many corners.

        It lies inside of the solid, and is returned for hulls only.
        """
        if self.is_round or len(self.corners) <= _MANY_CORNERS:
            return self
        extreme = np.unique((self.corners @ _sphere_lattice(_DIRECTIONS).T).argmax(axis=0))
        try:
            return _bound_hull(solid_from_points(self.corners[extreme]))
        except InvalidValueError:  # those of a very thin hull may be flat
            return self

    def find_deepest_point(self) -> Floats:
        """Return a point (3,) of the solid that is far from all planes [m]."""
        point = best = self.corners.mean(axis=0)
        width = -math.inf
        step = 0.5 * float(np.ptp(self.corners, axis=0).max())
        for _ in range(_ASCENT):
            slack = self.offsets - self.normals @ point
            nearest = int(slack.argmin())
            if slack[nearest] > width:
                best, width = point, float(slack[nearest])
            # Away from the nearest plane; from outside, at least to its inner side.
            point = point - self.normals[nearest] * max(step, -1.1 * float(slack[nearest]))
            step *= 0.93
        return np.asarray(best)

    def normalize(self, centre: Floats, radius: float) -> CoverPolytope:
        """Return the polytopes about a point (3,) as the origin, with a radius [m] as the unit of length."""
        return CoverPolytope(
            (self.corners - centre) / radius,
            self.faces,
            self.normals,
            (self.offsets - self.normals @ centre) / radius,
            self.volume / radius**3,
            self.is_round,
        )


def bound_solid(solid: Solid, protrusion: float) -> CoverPolytope:
    """Return the polytopes of a convex solid, close enough for covers with a protrusion [m].

    Raises
    ------
    InvalidValueError
        For a triangle mesh, which has no inside.
    """
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
    if isinstance(surface, Sphere | Ellipsoid):
        radii = np.ones(3) * (surface.radius if isinstance(surface, Sphere) else surface.radii)
        inner, widening = _sphere_points(_count_sides(float(radii.max()), protrusion))
        return _between(inner * radii, inner * radii * widening, solid_volume(solid))
    radius, half = float(surface.radius), float(surface.length) / 2
    up = np.array([0.0, 0.0, half])
    count = _count_sides(radius, protrusion)
    if isinstance(surface, Capsule):
        inner, widening = _sphere_points(count)
        inner = radius * inner
        ends = [np.concatenate([points + up, points - up]) for points in (inner, widening * inner)]
        return _between(ends[0], ends[1], solid_volume(solid))
    angles = 2 * math.pi * np.arange(count) / count
    inner = radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])
    outer = inner / math.cos(math.pi / count)
    if isinstance(surface, Cylinder):
        ends = [np.concatenate([points + up, points - up]) for points in (inner, outer)]
        return _between(ends[0], ends[1], solid_volume(solid))
    assert isinstance(surface, Cone)
    ends = [np.concatenate([points - up, up[None]]) for points in (inner, outer)]
    return _between(ends[0], ends[1], solid_volume(solid))


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
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - mesh.vertices.mean(axis=0), 1, 0)
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)
    # Triangles of one flat face share a plane.
    planes = np.column_stack([surface.normals, surface.offsets / solid.radius])
    kept = np.unique(np.round(planes, 9), axis=0, return_index=True)[1]
    return CoverPolytope(mesh.vertices, mesh.faces, surface.normals[kept], surface.offsets[kept], volume)


def _between(inner: Floats, outer: Floats, volume: float) -> CoverPolytope:
    """Return the bounds of a solid between the hulls of two sets of points."""
    inside, outside = _bound_hull(solid_from_points(inner)), _bound_hull(solid_from_points(outer))
    return CoverPolytope(outside.corners, outside.faces, inside.normals, inside.offsets, volume, True)


def _count_sides(radius: float, protrusion: float) -> int:
    """Return the sides of a regular polygon whose sagitta is small beside a protrusion [m]."""
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
