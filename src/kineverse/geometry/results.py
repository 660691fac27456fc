"""Results of distance, ray and point queries, in the world frame [m]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np

from kineverse._names import answer_foreign_names
from kineverse._synonyms import DISTANCE_SYNONYMS

from .broadphase import Indices
from .collision_world import CollisionWorld
from .mesh_files import Floats


@answer_foreign_names("A distance", DISTANCE_SYNONYMS)
@dataclass(frozen=True, slots=True, eq=False)
class DistanceResult:
    """Signed distance of two bodies, with its witness points and normal.

    Attributes
    ----------
    distance
        Smallest distance between their shapes [m]; in penetration, minus the length of the shortest
        translation that separates them.
    point_a, point_b
        (3,) the nearest points of a and b, or the deepest ones in penetration [m].
    normal
        (3,) unit vector from a to b, with ``distance == normal @ (point_b - point_a)``, also in penetration.
    shape_a, shape_b
        Index of the nearest shape of each body.

    See Also
    --------
    kineverse.geometry.Scene
    """

    a: str
    b: str
    distance: float
    point_a: Floats
    point_b: Floats
    normal: Floats
    shape_a: int
    shape_b: int

    @property
    def touches(self) -> bool:
        """True if the bodies touch or penetrate each other."""
        return self.distance <= 0.0

    def __str__(self) -> str:
        return f"{self.a} and {self.b}: {self.distance:.4g} m"

    def swap(self) -> DistanceResult:
        """Return the same result with a and b exchanged."""
        points, shapes = (self.point_b, self.point_a), (self.shape_b, self.shape_a)
        return DistanceResult(self.b, self.a, self.distance, *points, -self.normal, *shapes)


@dataclass(frozen=True, slots=True, eq=False)
class RayHit:
    """First hit of a ray.

    Attributes
    ----------
    body, shape
        The body that is hit, and the index of its shape.
    distance
        Distance from the origin of the ray [m]; 0 if the origin is inside of a shape.
    point, normal
        (3,) the point of the hit [m], and the outward unit normal there; against the ray if it starts inside.

    See Also
    --------
    kineverse.geometry.Scene.ray
    """

    body: str
    shape: int
    distance: float
    point: Floats
    normal: Floats


@dataclass(frozen=True, slots=True, eq=False)
class NearestPoint:
    """Nearest body to a query point.

    Attributes
    ----------
    body, shape
        The nearest body, and the index of its shape.
    distance
        Signed distance from the surface [m]; negative inside.
    point, normal
        (3,) the nearest point of the surface [m], and the outward unit normal there.

    See Also
    --------
    kineverse.geometry.Scene.point
    """

    body: str
    shape: int
    distance: float
    point: Floats
    normal: Floats

    @property
    def inside(self) -> bool:
        """True if the point is inside of the body."""
        return self.distance < 0.0


class DistanceResults(Sequence[DistanceResult]):
    """Sequence of distance results, nearest first, whose entries are made on access.

    Parameters
    ----------
    world
        The collision world of the query.
    objects, bodies, distances, witnesses
        (K, 2) indices of collision objects, (K, 2) of their bodies, in the order of the model, (K,) distances
        [m], and (K, 9) both nearest points and the normal.

    Attributes
    ----------
    distances
        (K,) signed distances [m].
    witnesses
        (K, 9) points of both bodies and normals side by side.
    body_indices
        (K, 2) indices of both bodies in the scene's ``bodies`` at the time of the query.
    object_indices
        (K, 2) indices of both collision objects in the scene: shapes, or hulls of decomposed meshes.

    See Also
    --------
    kineverse.geometry.Scene.pairs_within
    """

    def __init__(
        self, world: CollisionWorld, objects: Indices, bodies: Indices, distances: Floats, witnesses: Floats
    ) -> None:
        self._bodies, self._shape_numbers = world.bodies, world.shape_numbers
        self.object_indices, self.body_indices = objects, bodies
        self.distances, self.witnesses = distances, witnesses

    @property
    def points_a(self) -> Floats:
        """Nearest points of the first bodies (K, 3) [m]."""
        return self.witnesses[:, :3]

    @property
    def points_b(self) -> Floats:
        """Nearest points of the second bodies (K, 3) [m]."""
        return self.witnesses[:, 3:6]

    @property
    def normals(self) -> Floats:
        """Unit vectors (K, 3) from the first bodies to the second ones."""
        return self.witnesses[:, 6:]

    @property
    def shape_indices(self) -> Indices:
        """Indices (K, 2) of both shapes among the shapes of their bodies."""
        return np.asarray(self._shape_numbers[self.object_indices])

    def __len__(self) -> int:
        return len(self.distances)

    @overload
    def __getitem__(self, index: int) -> DistanceResult: ...
    @overload
    def __getitem__(self, index: slice) -> list[DistanceResult]: ...
    def __getitem__(self, index: int | slice) -> DistanceResult | list[DistanceResult]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        a, b = (self._bodies[k] for k in self.body_indices[index].tolist())
        shapes = self._shape_numbers[self.object_indices[index]].tolist()
        points = self.points_a[index], self.points_b[index]
        return DistanceResult(a, b, float(self.distances[index]), *points, self.normals[index], *shapes)

    def __repr__(self) -> str:
        listed = "".join(f"\n  {pair}" for pair in self[:12])
        more = f"\n  and {len(self) - 12} more" if len(self) > 12 else ""
        return f"<{len(self)} pairs{listed}{more}>"
