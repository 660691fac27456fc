"""Extent of a part: points of its shapes in one frame, its hull, and distances from it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cached_property

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.geometry.decomposition.accuracy import Polytope
from kineverse.geometry.mesh_files import Faces, Floats
from kineverse.geometry.shapes import Solid, solid_from_geometry
from kineverse.lie import rotation_along_z
from kineverse.model.body import Shape

DIRECTIONS, ROUNDS = 61, 4  # directions of a round: each divides the step by 30, the last is 0.2 µrad


class PartShape:
    """Points whose convex hull is that of some placed shapes."""

    def __init__(self, points: Floats) -> None:
        self.points = points

    @cached_property
    def size(self) -> float:
        """Largest edge of the box around the points [m]."""
        return float(np.ptp(self.points, axis=0).max()) if len(self.points) else 0.0

    @cached_property
    def middle(self) -> Floats:
        """Middle of the box around the points, (3,) [m]."""
        return np.asarray((self.points.min(axis=0) + self.points.max(axis=0)) / 2)

    @cached_property
    def hull(self) -> Polytope | None:
        """Convex hull; None if all points lie on a line."""
        try:
            return Polytope.from_points(self.points) if len(self.points) else None
        except InvalidValueError:
            return None

    @cached_property
    def principal_extents(self) -> tuple[Floats, Floats]:
        """Principal axes of the points as rows (3, 3), and the extents along them (3,), largest first [m]."""
        centred = self.points - self.points.mean(axis=0)
        axes = np.linalg.svd(centred.T @ centred)[2]
        extents = np.ptp(centred @ axes.T, axis=0)
        order = np.argsort(-extents)
        return axes[order], extents[order]

    @property
    def thickness(self) -> float:
        """Least of the principal extents [m]."""
        return float(self.principal_extents[1][2])

    def distance_to(self, point: Floats) -> float:
        """Return the distance of a point (3,) from the hull, at least [m]; 0 inside."""
        if self.hull is None:
            return float(np.linalg.norm(self.points - point, axis=1).min()) if len(self.points) else math.inf
        return max(0.0, float(self.hull.face_distances(point[None])[0]))

    def distance_to_line(self, point: Floats, direction: Floats) -> float:
        """Return the distance of a line from the hull [m]; 0 if it passes through.

        It is the widest gap between the line and the hull over all directions across the line. That is
        searched in a circle, then around the best direction.
        """
        across = (self.points - point) @ rotation_along_z(direction)[:, :2]
        best, step = 0.0, math.pi
        for _ in range(ROUNDS):
            angles = best + np.linspace(-step, step, DIRECTIONS)
            gaps = (np.stack([np.cos(angles), np.sin(angles)]).T @ across.T).min(axis=1)
            best, step = float(angles[np.argmax(gaps)]), 2.0 * step / (DIRECTIONS - 1)
        return max(0.0, float(gaps.max()))

    def moved(self, pose: Floats) -> PartShape:
        """Return the part at a pose (4, 4)."""
        return PartShape(self.points @ pose[:3, :3].T + pose[:3, 3])


def shape_points(shapes: Iterable[Shape]) -> Floats:
    """Return points (n, 3) of some shapes in the frame of their body [m]."""
    points = [np.zeros((0, 3))]
    for shape in shapes:
        pose = shape.origin.matrix
        points.append(solid_points(solid_from_geometry(shape.geometry)) @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(points)


def solid_points(solid: Solid) -> Floats:
    """Return points (n, 3) whose hull is a solid, or contains a round one [m].

    A round solid is replaced by planes that touch it in some directions, and by its box.
    """
    if isinstance(solid.surface, Faces):
        return solid.surface.vertices
    assert solid.core is not None
    if solid.core.corners.size:
        return np.asarray(solid.core.corners.T)
    return np.asarray(solid.centre + _CORNERS * solid.half)


_CORNERS = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
