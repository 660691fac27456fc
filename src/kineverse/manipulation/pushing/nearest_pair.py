"""Nearest pair of pusher and object: points, normal and velocities of a contact."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from kineverse.control.contact_slots import ContactSlots
from kineverse.geometry.results import DistanceResults
from kineverse.lie import Array

from .contact_points import PushPoint, cross_product, find_alignment
from .program import PRESS, TOUCHING

_MOST_PAIRS = 6


@dataclass(frozen=True, slots=True, eq=False)
class PushView:
    """Points and vectors of a push in the world, for drawings (2022 paper, Fig. 6).

    Attributes
    ----------
    p, r
        Nearest points on the object and on the robot (3,) [m].
    n
        Contact normal from p to r.
    push
        Direction -∇p in which p has to move.
    tangent
        Active tangent v, towards places where n opposes the push more.
    target
        Contact point that was chosen (3,) [m].
    distance
        Gap [m]; infinite beyond the radius of queries.
    """

    p: Array
    r: Array
    n: Array
    push: Array
    tangent: Array
    target: Array
    distance: float

    @property
    def vectors(self) -> dict[str, tuple[Array, Array]]:
        """Normal, push direction and tangent by name, each with its origin p; empty without a near pair."""
        if not math.isfinite(self.distance):
            return {}
        return {"n": (self.p, self.n), "push": (self.p, self.push), "tangent": (self.p, self.tangent)}


@dataclass(frozen=True, slots=True, eq=False)
class PushPair:
    """Body of a pusher and body of an object that are near each other.

    Attributes
    ----------
    robot, thing
        Indices of the bodies in the scene.
    r, p
        Nearest points on the robot and on the object (3,) [m].
    normal
        Unit vector from p to r.
    gap
        Distance [m].
    velocity
        Velocity (3,) of p per unit of the object's motion to the target.
    alignment
        Cosine between the velocity and -normal.
    """

    robot: int
    thing: int
    r: Array
    p: Array
    normal: Array
    gap: float
    velocity: Array
    alignment: float

    @property
    def tangents(self) -> Array:
        """Two unit vectors (2, 3) that are orthogonal to the normal and to each other."""
        across = cross_product(self.normal, np.eye(3)[int(np.argmin(np.abs(self.normal)))])
        across /= math.sqrt(float(across @ across))
        return np.array([across, cross_product(self.normal, across)])


def make_view(pair: PushPair | None, point: PushPoint, tip: Array) -> PushView:
    """Return the points and vectors of a push with a near pair, or with a tip that is still far."""
    p, n, r, velocity, distance = point.point, point.normal, tip, point.velocity, math.inf
    if pair is not None:
        p, n, r, velocity, distance = pair.p, pair.normal, pair.r, pair.velocity, pair.gap
    push = velocity / max(math.sqrt(float(velocity @ velocity)), 1e-9)
    tangent = cross_product(cross_product(push, n), n)
    return PushView(p, r, n, push, tangent, point.point, distance)


class PairFinder:
    """Search of the near pair of pusher and object that pushes best.

    Parameters
    ----------
    bodies
        Bodies of the scene.
    pusher, object_bodies
        Those of the pusher and of the object.
    slots
        Contact slots with the Jacobians of points.
    column
        Index of the object's speed among the columns of the slots.
    sign
        Direction of the coordinate towards its target.
    """

    def __init__(
        self,
        bodies: Sequence[str],
        pusher: Collection[str],
        object_bodies: Collection[str],
        slots: ContactSlots,
        column: int,
        sign: float,
    ) -> None:
        pushers = np.array([b in pusher for b in bodies])
        pushed = np.array([b in object_bodies for b in bodies])
        forward = np.outer(pushers, pushed)
        # 1 for pairs of pusher and object, -1 for the other order, 0 for all others.
        self._kinds = forward.astype(np.int8) - forward.T.astype(np.int8)
        self._slots, self._column, self._sign = slots, column, sign

    def nearest(self, found: DistanceResults) -> PushPair | None:
        """Return the pair that pushes best among those that are about the nearest; None if none is near."""
        if not len(found):
            return None
        a, b = found.body_indices.T
        kinds = self._kinds[a, b]
        rows = np.flatnonzero(kinds)
        if not len(rows):
            return None
        least = found.distances[rows[0]]
        best = None
        for row in rows[:_MOST_PAIRS].tolist():
            gap = float(found.distances[row])
            if gap > max(least + TOUCHING, PRESS):
                break
            if kinds[row] > 0:
                robot, thing = int(a[row]), int(b[row])
                r, p, normal = found.points_a[row], found.points_b[row], -found.normals[row]
            else:
                robot, thing = int(b[row]), int(a[row])
                r, p, normal = found.points_b[row], found.points_a[row], found.normals[row]
            velocity = self._sign * self._slots.point_velocity(thing, p, self._column)
            alignment = find_alignment(normal, velocity)
            if best is None or alignment > best.alignment:
                best = PushPair(robot, thing, r, p, normal, gap, velocity, alignment)
        return best

    def clearance(self, found: DistanceResults) -> float:
        """Return the least distance of all other pairs [m], infinite if none is near."""
        a, b = found.body_indices.T
        distances = found.distances[self._kinds[a, b] == 0]
        return float(distances[0]) if len(distances) else math.inf
