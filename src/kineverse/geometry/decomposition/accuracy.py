"""Accuracy of a convex decomposition, measured by sampling."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from kineverse.geometry.mesh_files import Faces, Floats, Integers
from kineverse.geometry.shapes import convex_hull

SAMPLES = 4000
"""So many points are looked at on each surface, and so many in each hull, beside all corners."""

# At most so many corners of the mesh itself are looked at.
_MOST_CORNERS = 20_000
# Lengths below this part of the size are rounding errors.
_NOTHING = 1e-7
# So many pairs of a point and a triangle are looked at in one piece, which bounds the memory.
_PAIRS = 2_000_000


@dataclass(frozen=True, slots=True)
class Accuracy:
    """What was measured of a decomposition.

    Lengths are the largest among samples, so that the true ones may be a little larger.

    Attributes
    ----------
    mesh_volume
        What the surface of the mesh encloses [m³]; None if it is not closed.
    volume
        Of the union of the hulls [m³]. Exact where no two of them overlap, else estimated from samples.
    hull_volume
        Of the convex hull of the whole mesh [m³].
    excess
        How far the union of the hulls stands out from the mesh [m]: the largest distance from the surface of
        the mesh to a point on a hull that is outside of the mesh.
    uncovered
        How far the mesh stands out from the hulls [m]: the largest distance from their union to a corner, or
        another point on the surface, of the mesh.
    """

    mesh_volume: float | None
    volume: float
    hull_volume: float
    excess: float
    uncovered: float


@dataclass(frozen=True, slots=True, eq=False)
class Polytope:
    """A convex hull: corners (n, 3), triangles (F, 3), the points x with ``normals @ x <= offsets`` [m]."""

    engine: Any
    points: Floats
    triangles: Integers
    normals: Floats
    offsets: Floats

    @staticmethod
    def from_points(points: Floats) -> Polytope:
        """Return the hull of (n, 3) points [m]; flat ones are given a thickness.

        Raises
        ------
        InvalidValueError
            If they span nothing.
        """
        convex = convex_hull(points)
        corners = np.array(convex.points())
        polygons = (convex.polygons(i) for i in range(convex.num_polygons))
        triangles = np.array([[p[0], p[1], p[2]] for p in polygons], dtype=np.int64)
        a, b, c = (corners[triangles[:, k]] for k in range(3))
        across = np.cross(b - a, c - a)
        lengths = np.linalg.norm(across, axis=1)
        across, a, triangles = (array[lengths > 0.0] for array in (across, a, triangles))
        normals = across / lengths[lengths > 0.0, None]
        offsets = np.einsum("ij,ij->i", normals, a)
        # The triangles of the engine are not all seen counterclockwise.
        inwards = normals @ corners.mean(axis=0) > offsets
        normals[inwards] *= -1.0
        offsets[inwards] *= -1.0
        triangles[inwards] = triangles[inwards, ::-1]
        return Polytope(convex, corners, triangles, normals, offsets)

    def face_distances(self, points: Floats) -> Floats:
        """Return how far (N, 3) points are beyond the face that they are furthest beyond, (N,) [m].

        Negative inside. Outside, the distance is no less.
        """
        return np.asarray((points @ self.normals.T - self.offsets).max(axis=1))

    @property
    def volume(self) -> float:
        """What it encloses [m³]."""
        return enclosed_volume(self.points, self.triangles)


def measure_accuracy(mesh: Faces, hulls: list[Polytope]) -> Accuracy:
    """Measure how well hulls stand for a mesh.

    Parameters
    ----------
    mesh
        Without faces that have no area.
    hulls
        At least one.
    """
    random = np.random.default_rng(0)
    return Accuracy(
        mesh_volume=abs(enclosed_volume(mesh.vertices, mesh.faces)) if is_closed(mesh.faces) else None,
        volume=_union_volume(hulls, random),
        hull_volume=Polytope.from_points(mesh.vertices).volume,
        excess=_excess(mesh, hulls, random),
        uncovered=_uncovered(mesh, hulls, random),
    )


def enclosed_volume(vertices: Floats, faces: Integers) -> float:
    """Return the volume that triangles enclose, positive if they are seen counterclockwise [m³]."""
    a, b, c = (vertices[faces[:, k]] - vertices[faces[0, 0]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def is_closed(faces: Integers) -> bool:
    """Return whether every edge is passed once in each direction, so that there is an inside."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    return bool((counts == 1).all()) and np.array_equal(unique, np.unique(edges[:, ::-1], axis=0))


def _union_volume(hulls: list[Polytope], random: np.random.Generator) -> float:
    """Return ``Σ V_i · mean of 1/m(x) over x in convex_hull i``, where m(x) counts the hulls that hold x."""
    total = 0.0
    for k, polytope in enumerate(hulls):
        inside = _sample_volume(polytope, random)
        held = np.ones(len(inside))
        for other in (*hulls[:k], *hulls[k + 1 :]):
            held += other.face_distances(inside) < 0.0
        total += polytope.volume * float((1.0 / held).mean())
    return total


def _sample_volume(polytope: Polytope, random: np.random.Generator) -> Floats:
    """Return points spread evenly in a hull: in tetrahedra over its triangles."""
    centre = polytope.points.mean(axis=0)
    corners = polytope.points[polytope.triangles] - centre
    volumes = np.abs(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))
    chosen = random.choice(len(volumes), SAMPLES, p=volumes / volumes.sum())
    weights = random.dirichlet(np.ones(4), SAMPLES)[:, :3]
    return np.asarray(centre + np.einsum("nk,nkd->nd", weights, corners[chosen]))


def _sample_surface(vertices: Floats, faces: Integers, count: int, random: np.random.Generator) -> Floats:
    """Return points spread evenly on triangles."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = random.choice(len(areas), count, p=areas / areas.sum())
    weights = random.dirichlet(np.ones(3), count)
    return np.asarray(np.einsum("nk,nkd->nd", weights, vertices[faces[chosen]]))


def _uncovered(mesh: Faces, hulls: list[Polytope], random: np.random.Generator) -> float:
    corners = mesh.vertices
    if len(corners) > _MOST_CORNERS:
        corners = random.choice(corners, _MOST_CORNERS, replace=False)
    points = np.concatenate([corners, _sample_surface(mesh.vertices, mesh.faces, SAMPLES, random)])
    beyond = np.min([polytope.face_distances(points) for polytope in hulls], axis=0)
    points = points[beyond > _NOTHING * np.ptp(mesh.vertices, axis=0).max()]
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
        points.append(on[np.min(depths, axis=0) > -_NOTHING * size] if depths else on)
    outermost = np.concatenate(points)
    if not len(outermost):
        return 0.0
    distances = nearest_surface_points(_triangles(mesh), outermost)[0]
    # Beginning with the furthest, so that the first one outside of the mesh is the answer.
    order = np.argsort(-distances, kind="stable")
    order = order[distances[order] > _NOTHING * size]
    step = max(_PAIRS // len(mesh.faces), 1)
    for start in range(0, len(order), step):
        some = order[start : start + step]
        out = np.flatnonzero(np.abs(_winding_numbers(mesh, outermost[some])) < 0.5)
        if len(out):
            return float(distances[some[out[0]]])
    return 0.0


def _winding_numbers(mesh: Faces, points: Floats) -> Floats:
    """Return how often a mesh winds around (N, 3) points: 1 inside, 0 outside, between them if it is open.

    The sum of the solid angles of its triangles over 4π (Jacobson, Kavan and Sorkine-Hornung, 2013).
    """
    a, b, c = (mesh.vertices[mesh.faces[:, k]] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=2) for side in (a, b, c))
    above = np.einsum("nfd,nfd->nf", a, np.cross(b, c))
    below = la * lb * lc
    for (one, other), length in zip(((b, c), (c, a), (a, b)), (la, lb, lc), strict=True):
        below += np.einsum("nfd,nfd->nf", one, other) * length
    return np.asarray(np.arctan2(above, below).sum(axis=1) / (2.0 * np.pi))


def _triangles(mesh: Faces) -> Any:
    import coal

    engine = coal.BVHModelOBBRSS()
    engine.beginModel(len(mesh.faces), len(mesh.vertices))
    engine.addVertices(np.ascontiguousarray(mesh.vertices))
    engine.addTriangles(np.ascontiguousarray(mesh.faces))
    engine.endModel()
    return engine


def nearest_surface_points(engine: Any, points: Floats) -> tuple[Floats, Floats]:
    """Return how near points are to what coal computes with, and where it is nearest.

    (N, 3) -> (N,), (N, 3) [m]. Inside of a hull the distance is 0, and the place means nothing.
    """
    import coal

    speck, here, there = coal.Sphere(1e-9), coal.Transform3s(), coal.Transform3s()
    measured, request, result = (
        coal.ComputeDistance(engine, speck),
        coal.DistanceRequest(),
        coal.DistanceResult(),
    )
    distances, places = np.empty(len(points)), np.empty((len(points), 3))
    for k, point in enumerate(points):
        there.setTranslation(point)
        result.clear()
        distances[k] = measured(here, there, request, result)
        places[k] = result.getNearestPoint1()
    return np.maximum(distances, 0.0), places
