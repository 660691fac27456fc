"""Triangle meshes with normals and colours, and those of primitive shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Sphere

Floats = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMesh:
    """Surface of triangles, counter-clockwise as seen from outside.

    A vertex is repeated where the surface has a crease, so that ``normals`` are smooth inside a patch and
    sharp at its border.
    """

    vertices: Floats  # (V, 3) positions in the frame of the surface [m]
    faces: Integers  # (F, 3) indices into the vertices
    normals: Floats  # (V, 3) unit normals
    colors: Floats | None = None  # (F, 4)
    closed: bool = False  # True if the inside is never visible, so that back faces need not be drawn

    @property
    def bounds(self) -> Floats:
        """(2, 3) least and greatest coordinates [m]; zeros if there is no vertex."""
        if not len(self.vertices):
            return np.zeros((2, 3))
        return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def transform(self, a_T_b: npt.ArrayLike) -> TriangleMesh:
        """Return the surface, given in b, in the coordinates of a (a 4×4 rigid transform)."""
        matrix = np.asarray(a_T_b, dtype=float)
        rotation = matrix[:3, :3].T
        return replace(
            self, vertices=self.vertices @ rotation + matrix[:3, 3], normals=self.normals @ rotation
        )

    def scale(self, scale: npt.ArrayLike) -> TriangleMesh:
        """Return the surface scaled along x, y, z; a mirrored one keeps its outside outside."""
        factors = np.broadcast_to(np.asarray(scale, dtype=float), (3,))
        safe = np.where(factors == 0.0, 1e-12, factors)
        # Normals are covectors: they scale by the inverse.
        normals = normalize_rows(self.normals / safe)
        faces = self.faces[:, ::-1] if np.prod(np.sign(safe)) < 0 else self.faces
        return replace(self, vertices=self.vertices * factors, faces=faces, normals=normals)


def normalize_rows(vectors: Floats) -> Floats:
    """Return (N, 3) vectors at length one; those of length zero become z."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-300, vectors / np.maximum(length, 1e-300), np.array([0.0, 0.0, 1.0]))


def dot_rows(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the (N,) dot products of two (N, 3) arrays; several times as fast as ``einsum``."""
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def concatenate_meshes(surfaces: Sequence[TriangleMesh]) -> TriangleMesh:
    """Return several surfaces as one; colours are kept only if all of them have some."""
    if not surfaces:
        return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3)))
    offsets = np.cumsum([0, *(len(s.vertices) for s in surfaces[:-1])])
    colors = [s.colors for s in surfaces if s.colors is not None]
    return TriangleMesh(
        vertices=np.concatenate([s.vertices for s in surfaces]),
        faces=np.concatenate([s.faces + offset for s, offset in zip(surfaces, offsets, strict=True)]),
        normals=np.concatenate([s.normals for s in surfaces]),
        colors=np.concatenate(colors) if len(colors) == len(surfaces) else None,
        closed=all(s.closed for s in surfaces),
    )


def build_creased_mesh(
    vertices: npt.ArrayLike, faces: npt.ArrayLike, angle: float = 0.6
) -> tuple[TriangleMesh, Integers]:
    """Return a surface whose vertices are split along the sharp edges between faces.

    Notes
    -----
    The normal of a corner is the sum of the area vectors of those faces around it that lie within the angle
    of its own face, so that a cylinder given as a mesh is smooth around and sharp at its ends.
    """
    points = np.asarray(vertices, dtype=float).reshape(-1, 3)
    indices = np.asarray(faces, dtype=np.int64).reshape(-1, 3)
    if not len(points) or not len(indices):
        return concatenate_meshes([]), np.zeros(0, dtype=np.int64)
    # Corners at an invisible distance are one; files repeat them with other last digits.
    grain = 1e-8 * max(float(np.ptp(points, axis=0).max()), 1e-12)
    _, first, merged = np.unique(np.round(points / grain), axis=0, return_index=True, return_inverse=True)
    points, indices = points[first], merged.reshape(-1)[indices]
    corners = points[indices]
    areas: Floats = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    solid = np.linalg.norm(areas, axis=1) > grain**2
    indices, areas = indices[solid], areas[solid]
    if not len(indices):
        return concatenate_meshes([]), np.flatnonzero(solid)
    normals = _corner_normals(indices, areas, len(points), np.cos(angle))
    # Corners with equal position and (rounded) normal become one vertex again.
    flat = indices.reshape(-1)
    keys = np.concatenate([flat[:, None].astype(float), np.round(normals, 3)], axis=1)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return TriangleMesh(points[flat[first]], inverse.reshape(-1, 3), normals[first]), np.flatnonzero(solid)


def _corner_normals(faces: Integers, areas: Floats, count: int, cosine: float) -> Floats:
    """Return the (3F, 3) unit normals of all corners of faces with the given area vectors."""
    flat = faces.reshape(-1)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.argsort(flat, kind="stable")
    degree = np.bincount(flat, minlength=count)
    start = np.concatenate([[0], np.cumsum(degree)[:-1]])
    # All pairs of a corner and a face at the same vertex.
    repeats = degree[flat]
    corner = np.repeat(np.arange(len(flat)), repeats)
    step = np.arange(len(corner)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    other = owner[order[start[flat[corner]] + step]]
    directions = normalize_rows(areas)
    close = np.einsum("ij,ij->i", directions[owner[corner]], directions[other]) >= cosine - 1e-12
    total: Floats = np.stack(
        [np.bincount(corner[close], areas[other[close], k], minlength=len(flat)) for k in range(3)], axis=1
    )
    return normalize_rows(total)


CIRCLE_SEGMENTS = 40
"""Segments of a circle: with so many a silhouette looks round at the sizes of rooms and robots."""


@lru_cache(maxsize=4096)
def mesh_primitive(geometry: Box | Cylinder | Capsule | Sphere | Ellipsoid | Cone) -> TriangleMesh:
    """Return the surface of a primitive, in its own frame [m]; equal primitives share it."""
    if isinstance(geometry, Box):
        return _unit_box().scale(geometry.size)
    if isinstance(geometry, Cylinder):
        return _unit_cylinder().scale((geometry.radius, geometry.radius, geometry.length))
    if isinstance(geometry, Sphere):
        return _unit_sphere().scale(geometry.radius)
    if isinstance(geometry, Ellipsoid):
        return _unit_sphere().scale(geometry.radii)
    if isinstance(geometry, Cone):
        return _unit_cone().scale((geometry.radius, geometry.radius, geometry.length))
    return _capsule(geometry.radius, geometry.length)


@lru_cache(maxsize=1)
def _unit_box() -> TriangleMesh:
    """Return the cube of edge length 1, with four vertices for each face."""
    corners: list[Floats] = []
    for axis in range(3):
        for sign in (-0.5, 0.5):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            face = np.zeros((4, 3))
            face[:, axis] = sign
            turn = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]
            face[:, [u, v]] = turn if sign > 0 else turn[::-1]
            corners.append(face)
    vertices = np.concatenate(corners)
    quads = np.arange(24).reshape(6, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    normals = np.repeat(np.kron(np.eye(3), [[-1.0], [1.0]]), 4, axis=0)
    return TriangleMesh(vertices, faces, normals, closed=True)


@lru_cache(maxsize=1)
def _unit_cylinder() -> TriangleMesh:
    """Return the cylinder of radius 1 and length 1 around z: a smooth wall and two flat discs."""
    ring, up = _ring(), np.array([0.0, 0.0, 0.5])
    i = np.arange(CIRCLE_SEGMENTS)
    j = (i + 1) % CIRCLE_SEGMENTS
    wall = TriangleMesh(
        vertices=np.concatenate([ring - up, ring + up]),
        faces=np.concatenate(
            [
                np.stack([i, j, j + CIRCLE_SEGMENTS], axis=1),
                np.stack([i, j + CIRCLE_SEGMENTS, i + CIRCLE_SEGMENTS], axis=1),
            ]
        ),
        normals=np.concatenate([ring, ring]),
        closed=True,
    )
    return concatenate_meshes([wall, _disc(up), _disc(-up)])


@lru_cache(maxsize=1)
def _unit_cone() -> TriangleMesh:
    """Return the cone of radius 1 and length 1 around z: a wall that is smooth around it, and a flat disc."""
    ring, up = _ring(), np.array([0.0, 0.0, 0.5])
    i = np.arange(CIRCLE_SEGMENTS)
    outward = (ring + 2.0 * up) / np.sqrt(2.0)
    between = outward + np.roll(outward, -1, axis=0)  # at the tip each triangle has a normal of its own
    wall = TriangleMesh(
        vertices=np.concatenate([ring - up, np.tile(up, (CIRCLE_SEGMENTS, 1))]),
        faces=np.stack([i, (i + 1) % CIRCLE_SEGMENTS, i + CIRCLE_SEGMENTS], axis=1),
        normals=np.concatenate([outward, between / np.linalg.norm(between, axis=1, keepdims=True)]),
        closed=True,
    )
    return concatenate_meshes([wall, _disc(-up)])


def _ring() -> Floats:
    angle = np.linspace(0.0, 2.0 * np.pi, CIRCLE_SEGMENTS, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(CIRCLE_SEGMENTS)], axis=1)


def _disc(centre: Floats) -> TriangleMesh:
    """Return the disc of radius 1 around a point above or below the origin, facing outwards."""
    i = np.arange(CIRCLE_SEGMENTS)
    fan = np.stack([np.zeros(CIRCLE_SEGMENTS - 2, dtype=np.int64), i[1:-1], i[2:]], axis=1)
    way = np.array([0.0, 0.0, np.sign(centre[2])])
    return TriangleMesh(
        _ring() + centre, fan if way[2] > 0 else fan[:, ::-1], np.tile(way, (CIRCLE_SEGMENTS, 1)), closed=True
    )


@lru_cache(maxsize=1)
def _unit_sphere() -> TriangleMesh:
    """Return the sphere of radius 1, by latitude and longitude."""
    return _profile(np.linspace(-np.pi / 2, np.pi / 2, CIRCLE_SEGMENTS // 2 + 1), radius=1.0, half=0.0)


def _capsule(radius: float, length: float) -> TriangleMesh:
    """Return a capsule around z: a sphere of latitudes pulled apart at its equator."""
    lower = np.linspace(-np.pi / 2, 0.0, CIRCLE_SEGMENTS // 4 + 1)
    return _profile(np.concatenate([lower, -lower[::-1]]), radius, length / 2)


def _profile(latitudes: Floats, radius: float, half: float) -> TriangleMesh:
    """Return the surface around z of a circle whose halves are ``half`` above and below z = 0 [m]."""
    longitude = np.linspace(0.0, 2.0 * np.pi, CIRCLE_SEGMENTS, endpoint=False)
    lat, lon = np.meshgrid(latitudes, longitude, indexing="ij")
    normals = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    shift = np.where(np.arange(len(latitudes)) < len(latitudes) / 2, -half, half)
    vertices = radius * normals
    vertices[..., 2] += shift[:, None]
    rows, columns = len(latitudes), CIRCLE_SEGMENTS
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    quads = np.stack([a, b, b + columns, a + columns], axis=-1).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return TriangleMesh(vertices.reshape(-1, 3), faces, normals.reshape(-1, 3), closed=True)


@lru_cache(maxsize=1)
def mesh_placeholder() -> TriangleMesh:
    """Return the surface that replaces a mesh that cannot be read: a small octahedron [m]."""
    tips = 0.05 * np.concatenate([np.eye(3), -np.eye(3)])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    return build_creased_mesh(tips, faces, angle=0.1)[0]
