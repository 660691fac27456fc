"""A triangle surface: what every shape becomes before it is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Triangles:
    """A surface of triangles, counter-clockwise seen from outside.

    A vertex is repeated where the surface has a crease, so that ``normals`` are smooth inside a patch and
    sharp at its border.

    Attributes
    ----------
    vertices
        (V, 3) positions in the frame of the surface [m].
    faces
        (F, 3) indices into the vertices.
    normals
        (V, 3) unit normals.
    colors
        (F, 4) red, green, blue, alpha in [0, 1] where the surface brings its own colours, else None.
    closed
        Whether nothing is ever seen from inside, so that faces turned away need not be drawn.
    """

    vertices: Floats
    faces: Integers
    normals: Floats
    colors: Floats | None = None
    closed: bool = False

    @property
    def bounds(self) -> Floats:
        """(2, 3) least and greatest coordinates [m]; zeros where there is no vertex."""
        if not len(self.vertices):
            return np.zeros((2, 3))
        return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def moved(self, a_T_b: npt.ArrayLike) -> Triangles:
        """Return the surface, given in b, in the coordinates of a (a 4×4 rigid transform)."""
        matrix = np.asarray(a_T_b, dtype=float)
        return Triangles(
            vertices=self.vertices @ matrix[:3, :3].T + matrix[:3, 3],
            faces=self.faces,
            normals=self.normals @ matrix[:3, :3].T,
            colors=self.colors,
            closed=self.closed,
        )

    def painted(self, colors: Floats) -> Triangles:
        """Return the surface with (F, 4) colours of its faces."""
        return replace(self, colors=colors)

    def unpainted(self) -> Triangles:
        """Return the surface without colours of its own."""
        return self if self.colors is None else replace(self, colors=None)

    def scaled(self, scale: npt.ArrayLike) -> Triangles:
        """Return the surface stretched along x, y, z; a mirrored one keeps its outside outside."""
        factors = np.broadcast_to(np.asarray(scale, dtype=float), (3,))
        safe = np.where(factors == 0.0, 1e-12, factors)
        # Normals are covectors: they stretch by the inverse.
        normals = unit(self.normals / safe)
        faces = self.faces
        if np.prod(np.sign(safe)) < 0:
            faces = faces[:, ::-1]
        return Triangles(self.vertices * factors, faces, normals, self.colors, self.closed)


def unit(vectors: Floats) -> Floats:
    """Return (N, 3) vectors at length one; those of length zero become z."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-300, vectors / np.maximum(length, 1e-300), np.array([0.0, 0.0, 1.0]))


def dot(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the (N,) products of two (N, 3) arrays of vectors; several times as fast as ``einsum``."""
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def join(surfaces: Sequence[Triangles]) -> Triangles:
    """Return several surfaces as one; colours are kept only if all of them have some."""
    if not surfaces:
        return Triangles(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3)))
    offsets = np.cumsum([0, *(len(s.vertices) for s in surfaces[:-1])])
    colors = [s.colors for s in surfaces if s.colors is not None]
    return Triangles(
        vertices=np.concatenate([s.vertices for s in surfaces]),
        faces=np.concatenate([s.faces + offset for s, offset in zip(surfaces, offsets, strict=True)]),
        normals=np.concatenate([s.normals for s in surfaces]),
        colors=np.concatenate(colors) if len(colors) == len(surfaces) else None,
        closed=all(s.closed for s in surfaces),
    )


def creased(vertices: npt.ArrayLike, faces: npt.ArrayLike, angle: float = 0.6) -> tuple[Triangles, Integers]:
    """Return a surface whose vertices are split where neighbouring faces meet sharply.

    Parameters
    ----------
    vertices
        (V, 3) positions; equal ones are taken as the same corner.
    faces
        (F, 3) indices; faces without area are dropped.
    angle
        Faces that meet at a larger angle than this keep normals of their own [rad].

    Returns
    -------
    The surface, and which of the given faces its faces are.

    Notes
    -----
    The normal of a corner is the sum of the area vectors of those faces around it that lie within the angle
    of its own face, so that a cylinder given as a mesh is smooth around and sharp at its ends.
    """
    points = np.asarray(vertices, dtype=float).reshape(-1, 3)
    indices = np.asarray(faces, dtype=np.int64).reshape(-1, 3)
    if not len(points) or not len(indices):
        return join([]), np.zeros(0, dtype=np.int64)
    # Corners closer than anyone can see are one; files repeat them with other last digits.
    grain = 1e-8 * max(float(np.ptp(points, axis=0).max()), 1e-12)
    _, first, merged = np.unique(np.round(points / grain), axis=0, return_index=True, return_inverse=True)
    points, indices = points[first], merged.reshape(-1)[indices]
    corners = points[indices]
    areas: Floats = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    solid = np.linalg.norm(areas, axis=1) > grain**2
    indices, areas = indices[solid], areas[solid]
    if not len(indices):
        return join([]), np.flatnonzero(solid)
    normals = _corner_normals(indices, areas, len(points), np.cos(angle))
    # Corners that agree in place and (rounded) normal become one vertex again.
    flat = indices.reshape(-1)
    keys = np.concatenate([flat[:, None].astype(float), np.round(normals, 3)], axis=1)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return Triangles(points[flat[first]], inverse.reshape(-1, 3), normals[first]), np.flatnonzero(solid)


def _corner_normals(faces: Integers, areas: Floats, count: int, cosine: float) -> Floats:
    """Return the (3F, 3) unit normals of all corners of faces with the given area vectors."""
    flat = faces.reshape(-1)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.argsort(flat, kind="stable")
    degree = np.bincount(flat, minlength=count)
    start = np.concatenate([[0], np.cumsum(degree)[:-1]])
    # All pairs (corner, face that touches the same vertex).
    repeats = degree[flat]
    corner = np.repeat(np.arange(len(flat)), repeats)
    step = np.arange(len(corner)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    other = owner[order[start[flat[corner]] + step]]
    directions = unit(areas)
    close = np.einsum("ij,ij->i", directions[owner[corner]], directions[other]) >= cosine - 1e-12
    total: Floats = np.stack(
        [np.bincount(corner[close], areas[other[close], k], minlength=len(flat)) for k in range(3)], axis=1
    )
    return unit(total)
