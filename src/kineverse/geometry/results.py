"""What a scene answers: everything in the world frame, [m]."""

from __future__ import annotations

from dataclasses import dataclass

from .mesh_files import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Closest:
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

    def swapped(self) -> Closest:
        """Return the same, seen from b."""
        return Closest(
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
class Hit:
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
class Nearby:
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
