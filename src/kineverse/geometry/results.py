"""Results of distance, ray and point queries, in the world frame [m]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

from .broadphase import Indices
from .collision_world import CollisionWorld
from .mesh_files import Floats


@dataclass(frozen=True, slots=True, eq=False)
class DistanceResult:
    """How near two bodies are.

    Attributes
    ----------
    a, b
        The bodies.
    distance
        Between the nearest two of their pieces [m]; in penetration minus the shortest way out.
    point_a, point_b
        (3,) the points of a and b that are nearest to each other, or deepest in each other [m].
    normal
        (3,) unit vector from a to b, with ``distance == normal @ (point_b - point_a)``, through penetration.
    piece_a, piece_b
        Which of the shapes of each body they are on.
    """

    a: str
    b: str
    distance: float
    point_a: Floats
    point_b: Floats
    normal: Floats
    piece_a: int
    piece_b: int

    @property
    def touches(self) -> bool:
        """Whether they touch or penetrate."""
        return self.distance <= 0.0

    def __str__(self) -> str:
        return f"{self.a} and {self.b}: {self.distance:.4g} m"

    def swapped(self) -> DistanceResult:
        """Return the same, seen from b."""
        return DistanceResult(
            self.b,
            self.a,
            self.distance,
            self.point_b,
            self.point_a,
            -self.normal,
            self.piece_b,
            self.piece_a,
        )


@dataclass(frozen=True, slots=True, eq=False)
class RayHit:
    """Where a ray meets a body first.

    Attributes
    ----------
    body, piece
        What is hit, and which of its shapes.
    distance
        From the origin of the ray [m]; 0 if that is inside a shape.
    point, normal
        (3,) where [m], and the outward unit normal there; against the ray from inside.
    """

    body: str
    piece: int
    distance: float
    point: Floats
    normal: Floats


@dataclass(frozen=True, slots=True, eq=False)
class NearestPoint:
    """What is nearest to a point.

    Attributes
    ----------
    body, piece
        What is nearest, and which of its shapes.
    distance
        [m]; negative inside, by how far it is to the surface.
    point, normal
        (3,) the nearest point of the surface [m], and the unit normal there that points out of the body.
    """

    body: str
    piece: int
    distance: float
    point: Floats
    normal: Floats

    @property
    def inside(self) -> bool:
        """Whether the point is inside."""
        return self.distance < 0.0


class DistanceResults(Sequence[DistanceResult]):
    """Pairs of bodies, nearest first, each of which is made when it is looked at.

    Parameters
    ----------
    mirror
        Where the pieces are from.
    pieces, bodies, distances, witnesses
        (K, 2) pieces, (K, 2) their bodies, that first which is before the other in the model, (K,) their
        distances [m], (K, 9) the nearest points of both and the normals.

    Attributes
    ----------
    distances
        (K,) [m].
    points_a, points_b, normals
        (K, 3) each, as in :class:`DistanceResult`.
    """

    def __init__(
        self, mirror: CollisionWorld, pieces: Indices, bodies: Indices, distances: Floats, witnesses: Floats
    ) -> None:
        self._bodies, self._pieces = mirror.bodies, mirror.pieces
        self._numbers, self._owners = pieces, bodies
        self.distances = distances
        self.points_a, self.points_b, self.normals = witnesses[:, :3], witnesses[:, 3:6], witnesses[:, 6:]

    def __len__(self) -> int:
        return len(self.distances)

    @overload
    def __getitem__(self, index: int) -> DistanceResult: ...
    @overload
    def __getitem__(self, index: slice) -> list[DistanceResult]: ...
    def __getitem__(self, index: int | slice) -> DistanceResult | list[DistanceResult]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        (a, b), (i, j) = self._owners[index].tolist(), self._numbers[index].tolist()
        return DistanceResult(
            self._bodies[a],
            self._bodies[b],
            float(self.distances[index]),
            self.points_a[index],
            self.points_b[index],
            self.normals[index],
            self._pieces[i].number,
            self._pieces[j].number,
        )

    def __repr__(self) -> str:
        listed = "".join(f"\n  {pair}" for pair in self[:12])
        more = f"\n  and {len(self) - 12} more" if len(self) > 12 else ""
        return f"<{len(self)} pairs{listed}{more}>"
