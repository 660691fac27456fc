"""Accuracy of a convex decomposition, measured by sampling."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from kineverse.geometry.mesh_files import Faces, Floats, Integers
from kineverse.geometry.shapes import build_bvh, convex_hull, enclosed_volume, hull_faces, sample_inside

SAMPLES = 4000  # number of sample points on each surface and in each hull, in addition to all corners
_MOST_CORNERS = 20_000  # largest number of corners of the mesh that are sampled
_NEGLIGIBLE = 1e-7  # lengths below this part of the size are rounding errors
_PAIRS = 2_000_000  # largest number of pairs of a point and a triangle in one batch, which bounds the memory


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Volumes and deviations of a convex decomposition, estimated from samples.

    Lengths are maxima over samples, so the true values may be a little larger.

    Attributes
    ----------
    mesh_volume
        Volume that the surface of the mesh encloses [m³]; None if the surface is not closed.
    volume
        Volume of the union of the hulls [m³]: exact if no two of them overlap, else estimated.
    hull_volume
        Volume of the convex hull of the whole mesh [m³].
    excess
        Largest distance of the hulls outside of the mesh [m], from the surface of the mesh.
    uncovered
        Largest distance of the surface of the mesh from the union of the hulls [m].

    See Also
    --------
    kineverse.geometry.decomposition.decompose
    """

    mesh_volume: float | None
    volume: float
    hull_volume: float
    excess: float
    uncovered: float


@dataclass(frozen=True, slots=True, eq=False)
class Polytope:
    """Convex hull: corners (n, 3), triangles (F, 3), and the points x with ``normals @ x <= offsets`` [m]."""

    engine: Any
    points: Floats
    triangles: Integers
    normals: Floats
    offsets: Floats

    @staticmethod
    def from_points(points: Floats) -> Polytope:
        """Return the hull of (n, 3) points [m]; flat hulls are thickened."""
        convex = convex_hull(points)
        mesh = hull_faces(convex)
        offsets = -np.array(convex.offsets()).reshape(-1)
        return Polytope(convex, mesh.vertices, mesh.faces, np.array(convex.normals()), offsets)

    def face_distances(self, points: Floats) -> Floats:
        """Return the largest signed distances of (N, 3) points from the planes of the faces, (N,) [m].

        They are negative inside, and lower bounds of the distance outside.
        """
        return np.asarray((points @ self.normals.T - self.offsets).max(axis=1))

    @property
    def volume(self) -> float:
        """Enclosed volume [m³]."""
        return enclosed_volume(self.points, self.triangles)


def measure_accuracy(mesh: Faces, hulls: list[Polytope]) -> Accuracy:
    """Measure the accuracy of hulls as an approximation of a mesh."""
    random = np.random.default_rng(0)
    return Accuracy(
        mesh_volume=abs(enclosed_volume(mesh.vertices, mesh.faces)) if is_closed(mesh.faces) else None,
        volume=_union_volume(hulls),
        hull_volume=Polytope.from_points(mesh.vertices).volume,
        excess=_excess(mesh, hulls, random),
        uncovered=_uncovered(mesh, hulls, random),
    )


def is_closed(faces: Integers) -> bool:
    """Return True if every edge is used once in each direction, so that the surface has an inside."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    return bool((counts == 1).all()) and np.array_equal(unique, np.unique(edges[:, ::-1], axis=0))


def _union_volume(hulls: list[Polytope]) -> float:
    """Return ``Σ V_i · mean of 1/m(x) over x in hull i``, where m(x) hulls contain x."""
    total = 0.0
    for k, polytope in enumerate(hulls):
        inside = sample_inside(polytope.points, polytope.triangles, polytope.points.mean(axis=0), SAMPLES)
        count = np.ones(len(inside))
        for other in (*hulls[:k], *hulls[k + 1 :]):
            count += other.face_distances(inside) < 0.0
        total += polytope.volume * float((1.0 / count).mean())
    return total


def _sample_surface(vertices: Floats, faces: Integers, count: int, random: np.random.Generator) -> Floats:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = random.choice(len(areas), count, p=areas / areas.sum())
    return np.asarray(np.einsum("nk,nkd->nd", random.dirichlet(np.ones(3), count), vertices[faces[chosen]]))


def _uncovered(mesh: Faces, hulls: list[Polytope], random: np.random.Generator) -> float:
    corners = mesh.vertices
    if len(corners) > _MOST_CORNERS:
        corners = random.choice(corners, _MOST_CORNERS, replace=False)
    points = np.concatenate([corners, _sample_surface(mesh.vertices, mesh.faces, SAMPLES, random)])
    beyond = np.min([polytope.face_distances(points) for polytope in hulls], axis=0)
    points = points[beyond > _NEGLIGIBLE * np.ptp(mesh.vertices, axis=0).max()]
    if not len(points):
        return 0.0
    return float(
        np.min([nearest_surface_points(polytope.engine, points)[0] for polytope in hulls], axis=0).max()
    )


def _excess(mesh: Faces, hulls: list[Polytope], random: np.random.Generator) -> float:
    size = float(np.ptp(mesh.vertices, axis=0).max())
    each = max(SAMPLES // len(hulls), 100)
    points = []
    for k, polytope in enumerate(hulls):
        on = np.concatenate(
            [polytope.points, _sample_surface(polytope.points, polytope.triangles, each, random)]
        )
        # A point inside of another hull is not on the surface of the union.
        depths = [other.face_distances(on) for other in (*hulls[:k], *hulls[k + 1 :])]
        points.append(on[np.min(depths, axis=0) > -_NEGLIGIBLE * size] if depths else on)
    outermost = np.concatenate(points)
    if not len(outermost):
        return 0.0
    distances = nearest_surface_points(build_bvh(mesh.vertices, mesh.faces), outermost)[0]
    # In order of decreasing distance, the first point outside of the mesh is the answer.
    order = np.argsort(-distances, kind="stable")
    order = order[distances[order] > _NEGLIGIBLE * size]
    step = max(_PAIRS // len(mesh.faces), 1)
    for start in range(0, len(order), step):
        batch = order[start : start + step]
        outside = np.flatnonzero(np.abs(_winding_numbers(mesh, outermost[batch])) < 0.5)
        if len(outside):
            return float(distances[batch[outside[0]]])
    return 0.0


def _winding_numbers(mesh: Faces, points: Floats) -> Floats:
    """Return the winding numbers of a mesh around (N, 3) points: 1 inside, 0 outside, fractional if open.

    They are the sums of the solid angles of its triangles over 4π (Jacobson, Kavan and Sorkine-Hornung,
    2013).
    """
    a, b, c = (mesh.vertices[mesh.faces[:, k]] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=2) for side in (a, b, c))
    above = np.einsum("nfd,nfd->nf", a, np.cross(b, c))
    below = la * lb * lc
    for (one, other), length in zip(((b, c), (c, a), (a, b)), (la, lb, lc), strict=True):
        below += np.einsum("nfd,nfd->nf", one, other) * length
    return np.asarray(np.arctan2(above, below).sum(axis=1) / (2.0 * np.pi))


def nearest_surface_points(engine: Any, points: Floats) -> tuple[Floats, Floats]:
    """Return distances (N,) and nearest points (N, 3) of a geometry of coal, for points (N, 3) [m].

    Inside of a hull the distance is 0, and the nearest point is meaningless.
    """
    import coal

    point_ball, origin, shifted = coal.Sphere(1e-9), coal.Transform3s(), coal.Transform3s()
    functor = coal.ComputeDistance(engine, point_ball)
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    distances, nearest = np.empty(len(points)), np.empty((len(points), 3))
    for k, point in enumerate(points):
        shifted.setTranslation(point)
        result.clear()
        distances[k] = functor(origin, shifted, request, result)
        nearest[k] = result.getNearestPoint1()
    return np.maximum(distances, 0.0), nearest
