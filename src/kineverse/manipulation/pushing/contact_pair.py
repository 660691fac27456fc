"""Nearest pair of pusher and object: points, normal and velocities of a contact."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kineverse.compilation import compile
from kineverse.control import Target
from kineverse.control.contact_constraints import ContactSlots
from kineverse.expressions.expression import Expression, array
from kineverse.geometry.results import DistanceResults
from kineverse.lie import Array

from .contact_points import PushPoint, find_alignment
from .push_program import PRESS, TOUCHING
from .vectors import Vector, cross_product, length, move_point, scale

_MOST_PAIRS = 6


@dataclass(frozen=True, slots=True, eq=False)
class PushView:
    """Points and vectors of a push in the world, for drawings (2022 paper, Fig. 6)."""

    p: Array  # nearest points on the object and on the robot (3,) [m]
    r: Array
    n: Array  # contact normal from p to r
    push: Array  # direction -∇p in which p has to move
    tangent: Array  # active tangent v, towards places where n opposes the push more
    target: Array  # contact point that was chosen (3,) [m]
    distance: float  # gap [m]; infinite beyond the radius of queries

    @property
    def vectors(self) -> dict[str, tuple[Array, Array]]:
        """Normal, push direction and tangent by name, each with its origin p; empty without a near pair."""
        if not math.isfinite(self.distance):
            return {}
        return {"n": (self.p, self.n), "push": (self.p, self.push), "tangent": (self.p, self.tangent)}


class PushPair(NamedTuple):
    """Body of a pusher and body of an object that are near each other."""

    robot: int  # indices of the bodies in the scene
    thing: int
    r: Vector  # nearest points on the robot and on the object [m]
    p: Vector
    normal: Vector  # unit vector from p to r
    gap: float  # distance [m]
    velocity: Vector  # velocity of p per unit of the object's motion to the target
    alignment: float  # cosine between the velocity and -normal

    @property
    def tangents(self) -> tuple[Vector, Vector]:
        """Two unit vectors that are orthogonal to the normal and to each other.

        They may turn about the normal between two steps: both count alike. Duff et al., "Building an
        Orthonormal Basis, Revisited" (2017).
        """
        x, y, z = self.normal
        sign = math.copysign(1.0, z)
        a = -1.0 / (sign + z)
        b = a * x * y
        return (1.0 + sign * a * x * x, sign * b, -sign * x), (b, sign + a * y * y, -y)


def make_view(pair: PushPair | None, point: PushPoint, tip: Vector) -> PushView:
    """Return the points and vectors of a push with a near pair, or with a tip that is still far."""
    p, n, r, velocity, distance = point.point, point.normal, tip, point.velocity, math.inf
    if pair is not None:
        p, n, r, velocity, distance = pair.p, pair.normal, pair.r, pair.velocity, pair.gap
    push = scale(1.0 / max(length(velocity), 1e-9), velocity)
    tangent = cross_product(cross_product(push, n), n)
    p_, r_, n_, push_, tangent_, target = np.array([p, r, n, push, tangent, point.point])
    return PushView(p_, r_, n_, push_, tangent_, target, distance)


class ContactRates:
    """Derivatives of a contact over speeds: of the gap, and of the motion of a tip on the object.

    They follow from the twists of the touching body, of the object and of the hand, by one compiled function.
    """

    def __init__(self, slots: ContactSlots, columns: Sequence[int], hand: int) -> None:
        self._slots, self._hand = slots, hand
        twists = Target("push/twist", np.zeros((3, *slots.twist(hand).shape)))
        vectors = Target("push/vector", np.zeros((6, 3)))
        r, p, normal, tip, *tangents = vectors.expression
        robot, thing, carrier = (twist[:, list(columns)] for twist in twists.expression)
        rows = [_along(normal, r, robot) - _along(normal, p, thing)]
        rows += [_along(t, tip, carrier) - _along(t, tip, thing) for t in tangents]
        self._first = len(twists.parameters)
        inputs = (*twists.parameters, *vectors.parameters)
        self._rows = compile([array([e for row in rows for e in row])], inputs).bind()

    def __call__(self, contact: PushPair, tangents: tuple[Vector, Vector], tip: Vector) -> Array:
        """Return the derivatives (3 n) of the gap, and of the motion along both tangents.

        The array is overwritten by the next call.
        """
        rows, first = self._rows, self._first
        rows.input[:first] = self._slots.twists([contact.robot, contact.thing, self._hand]).ravel()
        one, other = tangents
        rows.input[first:] = [*contact.r, *contact.p, *contact.normal, *tip, *one, *other]
        rows()
        return np.asarray(rows.outputs[0])


def _along(direction: Expression, point: Expression, twist: Expression) -> Expression:
    """Return the speeds (n,) along a direction of a point of a body with a twist (6, n)."""
    return direction @ twist[:3] + np.cross(point, direction) @ twist[3:]


class PairFinder:
    """Search of the near pair of pusher and object that pushes best, and of the nearest other pair."""

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
        kinds = forward.astype(np.int8) - forward.T.astype(np.int8)
        self._kinds: list[list[int]] = kinds.tolist()
        self._slots, self._column, self._sign = slots, column, sign

    def nearest(self, found: DistanceResults) -> tuple[PushPair | None, float]:
        """Return the pair that pushes best, and the clearance."""
        best, clearance = None, math.inf
        most, count = math.inf, 0
        gaps = found.distances.tolist()
        for row, (a, b) in enumerate(found.body_indices.tolist()):
            kind, gap = self._kinds[a][b], gaps[row]
            if not kind:
                clearance = min(clearance, gap)
            elif gap <= most and count < _MOST_PAIRS:
                if not count:
                    most = max(gap + TOUCHING, PRESS)
                count += 1
                pair = self._make_pair(found, row, gap, kind < 0)
                if best is None or pair.alignment > best.alignment:
                    best = pair
            if clearance < math.inf and gap > most:
                break
        return best, clearance

    def _make_pair(self, found: DistanceResults, row: int, gap: float, swapped: bool) -> PushPair:
        robot, thing = found.body_indices[row].tolist()
        a, b, c, d, e, f, u, v, w = found.witnesses[row].tolist()
        r, p, n = (a, b, c), (d, e, f), (-u, -v, -w)
        if swapped:
            robot, thing, r, p, n = thing, robot, p, r, (u, v, w)
        twist = self._slots.twist(thing)[:, self._column].tolist()
        velocity = scale(self._sign, move_point(twist, p))
        return PushPair(robot, thing, r, p, n, gap, velocity, find_alignment(n, velocity))
