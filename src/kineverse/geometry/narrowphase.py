"""Narrow phase: distance of two solids by coal, with checked and corrected results.

For convex solids the signed distance is the largest gap that any direction n shows,

    d = max_n (min_{b in B} nᵀb - max_{a in A} nᵀa),

which in penetration is minus the shortest translation that separates them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from kineverse.model.body import Sphere

from .gjk import gjk_distance, gjk_distance_to_faces
from .mesh_files import Faces, Floats
from .shapes import Solid, import_coal, scale_solid, solid_from_geometry
from .support import PlacedSolid, directional_gaps, find_widest_gap, smoothed_support

APART_TOLERANCE, DEPTH_TOLERANCE = 1e-12, 1e-6
"""What coal's iterations stop at, between things apart and in penetration [m].

At a distance d the normal is off by up to the root of 2 · tolerance / d. The first costs hardly any steps.
With less than 1e-6 its depth is wrong altogether once in a thousand times.
"""

ACCURACY = 1e-4
"""No distance is further off than this [m], and few as far; between polytopes, spheres and capsules 1e-8."""

# Nearer than this the direction between the closest points is made of rounding errors.
_TOUCH = 1e-6
# Along its normal a depth may be off by so much, some of what coal stops at; it grows with what is larger
# than 1 m [m].
_SHOWN = 3 * DEPTH_TOLERANCE
# So far things are moved apart to see in which direction they touch, and no further than this part of them.
_APART, _APART_OF_RADIUS = 1e-5, 1e-3
# What coal is asked about is made at least so large: the tolerances in it are made for decimetres [m].
_SMALL, _LARGE_ENOUGH, _TOO_LARGE = 5e-3, 0.1, 1e3
_CONTACTS = 256
# The radius of a ball that is taken for a point [m].
_SPECK = 1e-7


Witness: TypeAlias = tuple[Floats, Floats, Floats]
"""The closest points of two solids and the unit normal from one to the other, each (3,), in the world."""


class Narrowphase:
    """Measures pairs of placed solids, for one thread.

    Parameters
    ----------
    solids
        By the number of the piece; None for those that are not made yet.
    poses
        (M, 3, 4) where they are in the world, which others rewrite and announce by :meth:`invalidate_poses`.
    """

    def __init__(self, solids: Sequence[Solid | None], poses: Floats) -> None:
        self._coal = coal = import_coal()
        self._solids = solids
        self._parts = [(pose[:, :3], pose[:, 3]) for pose in poses]
        self._transforms = [coal.Transform3s() for _ in poses]
        self._placed = bytearray(len(poses))
        self._functors: dict[tuple[int, int], Any] = {}
        self._kept: list[tuple[Solid, Solid]] = []
        # Pairs of triangle meshes, for which coal leaves the normal as it was in memory.
        self._triangle_pairs: set[tuple[int, int]] = set()
        self._enlarged: dict[tuple[int, int], tuple[float, Floats, Narrowphase]] = {}
        self._request, *self._coarser = (_request(coal, factor) for factor in (1.0, 10.0, 100.0))
        self._coarsest = _request(coal, 1e5)
        self._result = coal.DistanceResult()
        self._witness: Witness | None = None
        self.calls = 0

    def invalidate_poses(self, count: int) -> None:
        """Note that the poses of so many pieces, the first ones, have changed."""
        self._placed[:count] = bytes(count)

    def distance(self, i: int, j: int) -> float:
        """Return the signed distance of two pieces [m], and keep where it is for :meth:`witness`."""
        self.calls += 1
        placed = self._placed
        for k in (i, j):
            if not placed[k]:
                self._transforms[k].setTransform(*self._parts[k])
                placed[k] = 1
        functor = self._functors.get((i, j)) or self._functor(i, j)
        if self._enlarged and (i, j) in self._enlarged:
            return self._measure_enlarged(i, j)
        at_a, at_b, result = self._transforms[i], self._transforms[j], self._result
        result.clear()
        self._witness = None
        distance: float = functor(at_a, at_b, self._request, result)
        if _TOUCH < distance < 1e300:
            if (i, j) in self._triangle_pairs:
                self._witness = self._witness_from_points(distance)
                return distance
            a, b = self._pair(i, j)
            if not (a.is_convex and b.is_convex):
                return self._check_triangles(i, j, distance, functor)
            return distance if self._normal_confirms(i, j, distance) else self._solve(i, j)
        a, b = self._pair(i, j)
        if not (a.is_convex and b.is_convex):
            return self._measure_touching_triangles(i, j, functor)
        for request in (*self._coarser, None):
            if (
                -1e300 < distance < -_TOUCH
                and self._is_unit_normal()
                and self._normal_confirms(i, j, distance)
            ):
                return distance
            if request is None or abs(distance) <= _TOUCH:
                break
            result.clear()
            distance = functor(at_a, at_b, request, result)
            if distance > _TOUCH and self._normal_confirms(i, j, distance):
                return distance
        return self._measure_shifted(i, j, functor)

    def witness(self) -> Witness:
        """Return the closest points and the unit normal from the first to the second, of the last distance.

        All are in the world, (3,), and ``distance == normal @ (point_b - point_a)``.
        """
        if self._witness is not None:
            return self._witness
        result = self._result
        return result.getNearestPoint1(), result.getNearestPoint2(), np.array(result.normal)

    def _witness_from_points(self, distance: float) -> Witness:
        point_a, point_b = self._result.getNearestPoint1(), self._result.getNearestPoint2()
        return point_a, point_b, (point_b - point_a) / distance

    def _pair(self, i: int, j: int) -> tuple[Solid, Solid]:
        a, b = self._solids[i], self._solids[j]
        assert a is not None
        assert b is not None
        return a, b

    def _functor(self, i: int, j: int) -> Any:
        a, b = self._pair(i, j)
        cylinder = self._coal.Cylinder
        one = a.stand_in if a.stand_in and isinstance(b.engine, cylinder) else a.engine
        other = b.stand_in if b.stand_in and isinstance(a.engine, cylinder) else b.engine
        functor = self._functors[i, j] = self._coal.ComputeDistance(one, other)
        self._kept.append((a, b))  # coal does not keep what it computes with
        if not (a.is_convex or b.is_convex):
            self._triangle_pairs.add((i, j))
        factor = _enlargement(a, b)
        if factor > 1.0:
            poses = np.tile(np.eye(4)[:3], (2, 1, 1))
            self._enlarged[i, j] = (
                factor,
                poses,
                Narrowphase([scale_solid(a, factor), scale_solid(b, factor)], poses),
            )
        return functor

    def _measure_enlarged(self, i: int, j: int) -> float:
        """Measure two convex solids of which one is small as if both were larger."""
        factor, poses, narrow = self._enlarged[i, j]
        (poses[0, :, :3], start), (poses[1, :, :3], end) = self._parts[i], self._parts[j]
        poses[1, :, 3] = factor * (end - start)
        narrow.invalidate_poses(2)
        distance = narrow.distance(0, 1) / factor
        point_a, point_b, normal = narrow.witness()
        self._witness = start + point_a / factor, start + point_b / factor, normal
        return distance

    def _is_unit_normal(self) -> bool:
        x, y, z = self._result.normal.tolist()
        return bool(abs(x * x + y * y + z * z - 1.0) < 1e-6)

    def _normal_confirms(self, i: int, j: int, distance: float) -> bool:
        """Whether the normal shows the distance of two convex solids.

        Apart, that is the gap of the planes that hold them; in each other, so far they have to be moved.
        """
        a, b = self._pair(i, j)
        shown = float(directional_gaps(*self._placed_solids(i, j), self.witness()[2][None])[0])
        return abs(distance - shown) <= _SHOWN * max(1.0, distance, a.radius, b.radius)

    def _solve(self, i: int, j: int) -> float:
        """Measure two convex solids without coal."""
        found = gjk_distance(*self._placed_solids(i, j))
        if found is None:
            return self._search(i, j)
        distance, point, normal = found
        self._witness = point, point + distance * normal, normal
        return distance

    def _check_triangles(self, i: int, j: int, distance: float, functor: Any) -> float:
        """Check the distance of a convex solid from triangles, between which there is no plane.

        coal goes wrong where its iterations cannot end, so they are given another end; where that gives
        another distance, all triangles that may be nearest are measured without coal.
        """
        witness = self.witness()
        a, b = self._pair(i, j)
        again = self._remeasure(i, j, functor)
        self._witness = witness
        if abs(again - distance) <= _SHOWN * max(1.0, distance, a.radius, b.radius):
            return distance
        solved = self._solve_triangles(i, j)
        return self._measure_contacts(i, j) if solved is None else solved

    def _measure_touching_triangles(self, i: int, j: int, functor: Any) -> float:
        """Measure in touch where triangles take part, if that is so."""
        a, b = self._pair(i, j)
        if (a.is_convex or b.is_convex) and self._remeasure(i, j, functor) > _TOUCH:
            solved = self._solve_triangles(i, j)
            if solved is not None:
                return solved
        return self._measure_contacts(i, j)

    def _remeasure(self, i: int, j: int, functor: Any) -> float:
        self._result.clear()
        distance: float = functor(self._transforms[i], self._transforms[j], self._coarsest, self._result)
        return distance

    def _solve_triangles(self, i: int, j: int) -> float | None:
        """Measure a convex solid and triangles without coal; None if they touch."""
        turned = not self._pair(i, j)[0].is_convex
        solid, mesh = (j, i) if turned else (i, j)
        surface = self._pair(mesh, mesh)[0].surface
        assert isinstance(surface, Faces)
        found = gjk_distance_to_faces(self._placed_solids(solid, solid)[0], surface, *self._parts[mesh])
        if found is None:
            return None
        distance, point, normal = found
        other = point + distance * normal
        self._witness = (other, point, -normal) if turned else (point, other, normal)
        return distance

    def _measure_shifted(self, i: int, j: int, functor: Any) -> float:
        """Measure two convex solids in touch, or that coal failed on, when they are a little apart.

        By how much and in which direction they were moved is taken off again. For flat faces that is exact,
        for round ones the rest is of second order in 0.01 mm. If that fails too, a way out is searched for.
        """
        at_a, result = self._transforms[i], self._result
        rotation, position = self._parts[j]
        for shift in self._shifts(i, j):
            shifted = self._coal.Transform3s(rotation, position + shift)
            for request in (self._request, *self._coarser):
                result.clear()
                self._witness = None
                distance: float = functor(at_a, shifted, request, result)
                if abs(distance) < 1e300 and self._is_unit_normal():
                    point_a, point_b, normal = self.witness()
                    distance -= float(normal @ shift)
                    self._witness = point_a, point_b - shift, normal
                    if self._normal_confirms(i, j, distance):
                        return distance
        return self._search(i, j)

    def _search(self, i: int, j: int) -> float:
        """Measure two convex solids by a search: a way out for certain, and nearly the shortest."""
        a, b = self._placed_solids(i, j)
        start, end = self._centres(i, j)
        distance, normal = find_widest_gap(a, b, _unit(end - start)[None])
        self._witness = smoothed_support(a, normal), smoothed_support(b, -normal), normal
        return distance

    def _placed_solids(self, i: int, j: int) -> tuple[PlacedSolid, PlacedSolid]:
        a, b = self._pair(i, j)
        return (a, *self._parts[i]), (b, *self._parts[j])

    def _shifts(self, i: int, j: int) -> list[Floats]:
        far = min(_APART, _APART_OF_RADIUS * min(solid.radius for solid in self._pair(i, j)))
        start, end = self._centres(i, j)
        # Convex things in touch come apart along the line between any two points of their insides.
        return [far * _unit(end - start), *(far * np.eye(3))]

    def _centres(self, i: int, j: int) -> tuple[Floats, Floats]:
        a, b = self._pair(i, j)
        (rotation_a, at_a), (rotation_b, at_b) = self._parts[i], self._parts[j]
        return rotation_a @ a.centre + at_a, rotation_b @ b.centre + at_b

    def _measure_contacts(self, i: int, j: int) -> float:
        """Measure in touch where triangles take part: how deep in the triangle that is entered the most."""
        (a, b), at_a, at_b = self._pair(i, j), self._transforms[i], self._transforms[j]
        coal = self._coal
        request = coal.CollisionRequest(coal.CollisionRequestFlag.CONTACT, _CONTACTS)
        found = coal.CollisionResult()
        one, other = a.stand_in or a.engine, b.stand_in or b.engine
        coal.collide(one, at_a, other, at_b, request, found)
        deepest, depth = None, -1.0
        for k in range(found.numContacts()):
            contact = found.getContact(k)
            if depth < -contact.penetration_depth < 1e300 and abs(np.linalg.norm(contact.normal) - 1) < 1e-6:
                deepest, depth = contact, -contact.penetration_depth
        if deepest is None:
            if (a.is_convex or b.is_convex) and (solved := self._solve_triangles(i, j)) is not None:
                return solved
            point = np.array(self._result.getNearestPoint1())
            if not np.isfinite(point).all():
                point = np.array(at_a.getTranslation())
            normal = _unit(np.array(at_b.getTranslation()) - np.array(at_a.getTranslation()))
            self._witness = point, point, normal
            return 0.0
        normal = np.array(deepest.normal)
        point = np.array(deepest.pos)
        self._witness = point + normal * depth / 2, point - normal * depth / 2, normal
        return -depth


def distance_to_point(solid: Solid, pose: Floats, point: Floats) -> tuple[float, Floats, Floats]:
    """Return the signed distance of a placed solid to a point [m], its surface there, and the outward normal.

    Parameters
    ----------
    solid, pose, point
        The solid, its (3, 4) pose and the (3,) point, in the world.
    """
    ball = solid_from_geometry(Sphere(_SPECK))
    # In touch, its own size is no measure of how far it may be moved.
    speck = replace(ball, radius=solid.radius)
    narrow = Narrowphase([solid, speck], np.stack([pose, np.column_stack([np.eye(3), point])]))
    distance = narrow.distance(0, 1) + _SPECK
    nearest, _, normal = narrow.witness()
    return distance, nearest, normal


def _request(coal: Any, factor: float) -> Any:
    request = coal.DistanceRequest()
    request.gjk_tolerance, request.epa_tolerance = factor * APART_TOLERANCE, factor * DEPTH_TOLERANCE
    request.gjk_max_iterations = request.epa_max_iterations = 256
    return request


def _enlargement(a: Solid, b: Solid) -> float:
    """Return by which power of two a pair is enlarged; 1 for what is large enough, and for triangles."""
    small, large = sorted((a.radius, b.radius))
    if small >= _SMALL or not (a.is_convex and b.is_convex):
        return 1.0
    return float(2.0 ** math.floor(math.log2(min(2 * _LARGE_ENOUGH / small, _TOO_LARGE / large))))


def _unit(vector: Floats) -> Floats:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-12 else np.array([0.0, 0.0, 1.0])
