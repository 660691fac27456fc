"""Boxes, cylinders, capsules, spheres, ellipsoids and cones as triangles."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Sphere
from kineverse.view.triangles import Floats, Triangles, creased, join

SEGMENTS = 40
"""Around a full turn: at this number a silhouette looks round at the sizes of rooms and robots."""


@lru_cache(maxsize=4096)
def primitive(geometry: Box | Cylinder | Capsule | Sphere | Ellipsoid | Cone) -> Triangles:
    """Return the surface of a primitive, in its own frame [m]; equal ones share it."""
    if isinstance(geometry, Box):
        return _unit_box().scaled(geometry.size)
    if isinstance(geometry, Cylinder):
        return _unit_cylinder().scaled((geometry.radius, geometry.radius, geometry.length))
    if isinstance(geometry, Sphere):
        return _unit_sphere().scaled(geometry.radius)
    if isinstance(geometry, Ellipsoid):
        return _unit_sphere().scaled(geometry.radii)
    if isinstance(geometry, Cone):
        return _unit_cone().scaled((geometry.radius, geometry.radius, geometry.length))
    return _capsule(geometry.radius, geometry.length)


@lru_cache(maxsize=1)
def _unit_box() -> Triangles:
    """Return the cube of edge length 1, four vertices of its own for each face."""
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
    return Triangles(vertices, faces, normals, closed=True)


@lru_cache(maxsize=1)
def _unit_cylinder() -> Triangles:
    """Return the cylinder of radius 1 and length 1 around z: a smooth wall and two flat discs."""
    ring, up = _ring(), np.array([0.0, 0.0, 0.5])
    i = np.arange(SEGMENTS)
    j = (i + 1) % SEGMENTS
    wall = Triangles(
        vertices=np.concatenate([ring - up, ring + up]),
        faces=np.concatenate(
            [np.stack([i, j, j + SEGMENTS], axis=1), np.stack([i, j + SEGMENTS, i + SEGMENTS], axis=1)]
        ),
        normals=np.concatenate([ring, ring]),
        closed=True,
    )
    return join([wall, _disc(up), _disc(-up)])


@lru_cache(maxsize=1)
def _unit_cone() -> Triangles:
    """Return the cone of radius 1 and length 1 around z: a wall that is smooth around it, and a flat disc."""
    ring, up = _ring(), np.array([0.0, 0.0, 0.5])
    i = np.arange(SEGMENTS)
    outward = (ring + 2.0 * up) / np.sqrt(2.0)
    between = outward + np.roll(outward, -1, axis=0)  # at the tip each triangle has a direction of its own
    wall = Triangles(
        vertices=np.concatenate([ring - up, np.tile(up, (SEGMENTS, 1))]),
        faces=np.stack([i, (i + 1) % SEGMENTS, i + SEGMENTS], axis=1),
        normals=np.concatenate([outward, between / np.linalg.norm(between, axis=1, keepdims=True)]),
        closed=True,
    )
    return join([wall, _disc(-up)])


def _ring() -> Floats:
    angle = np.linspace(0.0, 2.0 * np.pi, SEGMENTS, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(SEGMENTS)], axis=1)


def _disc(centre: Floats) -> Triangles:
    """Return the disc of radius 1 around a point above or below the origin, seen from outside."""
    i = np.arange(SEGMENTS)
    fan = np.stack([np.zeros(SEGMENTS - 2, dtype=np.int64), i[1:-1], i[2:]], axis=1)
    way = np.array([0.0, 0.0, np.sign(centre[2])])
    return Triangles(
        _ring() + centre, fan if way[2] > 0 else fan[:, ::-1], np.tile(way, (SEGMENTS, 1)), closed=True
    )


@lru_cache(maxsize=1)
def _unit_sphere() -> Triangles:
    """Return the sphere of radius 1, by latitude and longitude."""
    return _profile(np.linspace(-np.pi / 2, np.pi / 2, SEGMENTS // 2 + 1), radius=1.0, half=0.0)


def _capsule(radius: float, length: float) -> Triangles:
    """Return a capsule around z: a sphere of latitudes pulled apart at its equator."""
    lower = np.linspace(-np.pi / 2, 0.0, SEGMENTS // 4 + 1)
    return _profile(np.concatenate([lower, -lower[::-1]]), radius, length / 2)


def _profile(latitudes: Floats, radius: float, half: float) -> Triangles:
    """Return the surface around z of a circle whose halves are ``half`` above and below z = 0 [m]."""
    longitude = np.linspace(0.0, 2.0 * np.pi, SEGMENTS, endpoint=False)
    lat, lon = np.meshgrid(latitudes, longitude, indexing="ij")
    normals = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    shift = np.where(np.arange(len(latitudes)) < len(latitudes) / 2, -half, half)
    vertices = radius * normals
    vertices[..., 2] += shift[:, None]
    rows, columns = len(latitudes), SEGMENTS
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    quads = np.stack([a, b, b + columns, a + columns], axis=-1).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Triangles(vertices.reshape(-1, 3), faces, normals.reshape(-1, 3), closed=True)


@lru_cache(maxsize=1)
def placeholder() -> Triangles:
    """Return the surface that stands in for a mesh that cannot be read: a small octahedron [m]."""
    tips = 0.05 * np.concatenate([np.eye(3), -np.eye(3)])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    return creased(tips, faces, angle=0.1)[0]
