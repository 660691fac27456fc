"""Narrow phase: distance of two solids by coal, with checked and corrected results.

The signed distance of two convex solids is the largest gap over all directions n,

    d = max_n (min_{b in B} nᵀb - max_{a in A} nᵀa).

In penetration it is minus the length of the shortest translation that separates them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from msgspec.structs import replace

from kineverse.model.body import Sphere

from .gjk import (
    PlacedSolid,
    directional_gaps,
    find_widest_gap,
    gjk_distance,
    gjk_distance_to_faces,
    smoothed_support,
)
from .mesh_files import Faces, Floats
from .shapes import Solid, import_coal, scale_solid, solid_from_geometry

APART_TOLERANCE, DEPTH_TOLERANCE = 1e-12, 1e-6
"""Tolerances of coal's iterations, for separated solids and for penetration [m].

At a distance d the error of the normal is at most √(2 · tolerance / d). A small first tolerance costs few
iterations. With a second tolerance below 1e-6, one depth of coal in a thousand is grossly wrong.
"""

ACCURACY = 1e-4  # largest error of a distance [m]; between polytopes, spheres and capsules it is 1e-8
_TOUCH = 1e-6  # below this distance the direction between the closest points consists of rounding errors [m]
# Tolerance between a distance and the gap along its normal [m], a multiple of coal's tolerance; it is
# relative for solids above 1 m.
_GAP_TOLERANCE = 3 * DEPTH_TOLERANCE
# Translation that separates touching solids to find their normal [m], and its largest part of their radius.
_SHIFT, _SHIFT_OF_RADIUS = 1e-5, 1e-3
# Part of the smaller radius by which solids are moved apart to find where they face each other.
_APART_OF_RADIUS = 0.1
# Solids below the first radius are enlarged to the second, up to the third: the tolerances inside of coal
# suit decimetres [m].
_SMALL, _ENLARGED, _LARGEST = 5e-3, 0.1, 1e3
_MAX_CONTACTS = 256
_POINT_RADIUS = 1e-7  # radius of the ball that represents a point [m]

Witness: TypeAlias = tuple[Floats, Floats, Floats]
"""Closest points of two solids and the unit normal from the first to the second, each (3,), in the world."""


class Narrowphase:
    """Distance computation between placed solids by coal, for one thread."""

    def __init__(self, solids: Sequence[Solid | None], poses: Floats) -> None:
        self._coal = coal = import_coal()
        self._solids = solids
        self._pose_views = [(pose[:, :3], pose[:, 3]) for pose in poses]
        self._transforms = [coal.Transform3s() for _ in poses]
        self._placed = bytearray(len(poses))
        self._functors: dict[tuple[int, int], Any] = {}
        self._referenced: list[tuple[Solid, Solid]] = []
        # Pairs of triangle meshes, for which coal does not write the normal.
        self._triangle_pairs: set[tuple[int, int]] = set()
        self._enlarged: dict[tuple[int, int], tuple[float, Floats, Narrowphase]] = {}
        self._request, *self._coarser = (_request(coal, factor) for factor in (1.0, 10.0, 100.0))
        self._coarsest = _request(coal, 1e5)
        self._result = coal.DistanceResult()
        self._witness: Witness | None = None
        self.calls = 0

    def invalidate_poses(self, count: int) -> None:
        """Discard the cached transforms of the first objects, whose poses have changed."""
        self._placed[:count] = bytes(count)

    def distance(self, i: int, j: int) -> float:
        """Return the signed distance of two objects [m], and store its :meth:`witness`."""
        self.calls += 1
        placed = self._placed
        for k in (i, j):
            if not placed[k]:
                self._transforms[k].setTransform(*self._pose_views[k])
                placed[k] = 1
        functor = self._functors.get((i, j)) or self._functor(i, j)
        if self._enlarged and (i, j) in self._enlarged:
            return self._measure_enlarged(i, j)
        pose_a, pose_b, result = self._transforms[i], self._transforms[j], self._result
        result.clear()
        self._witness = None
        distance: float = functor(pose_a, pose_b, self._request, result)
        if _TOUCH < distance < 1e300:
            if (i, j) in self._triangle_pairs:
                point_a, point_b = result.getNearestPoint1(), result.getNearestPoint2()
                self._witness = point_a, point_b, (point_b - point_a) / distance
                return distance
            a, b = self._pair(i, j)
            if not (a.is_convex and b.is_convex):
                return self._check_triangles(i, j, distance, functor)
            return distance if self._normal_confirms(i, j, distance) else self._solve(i, j)
        a, b = self._pair(i, j)
        if not (a.is_convex and b.is_convex):
            return self._measure_touching_triangles(i, j, functor)
        for request in (*self._coarser, None):
            is_deep = -1e300 < distance < -_TOUCH and self._is_unit_normal()
            if is_deep and self._normal_confirms(i, j, distance):
                return distance
            if request is None or abs(distance) <= _TOUCH:
                break
            result.clear()
            distance = functor(pose_a, pose_b, request, result)
            if distance > _TOUCH and self._normal_confirms(i, j, distance):
                return distance
        return self._measure_shifted(i, j, functor)

    def witness(self) -> Witness:
        """Return the closest points and the unit normal of the last distance, each (3,), in the world.

        They satisfy ``distance == normal @ (point_b - point_a)``.
        """
        if self._witness is not None:
            return self._witness
        result = self._result
        return result.getNearestPoint1(), result.getNearestPoint2(), np.array(result.normal)

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
        self._referenced.append((a, b))  # coal's functors hold pointers only
        if not (a.is_convex or b.is_convex):
            self._triangle_pairs.add((i, j))
        factor = _enlargement(a, b)
        if factor > 1.0:
            poses = np.tile(np.eye(4)[:3], (2, 1, 1))
            solids = [scale_solid(a, factor), scale_solid(b, factor)]
            self._enlarged[i, j] = factor, poses, Narrowphase(solids, poses)
        return functor

    def _measure_enlarged(self, i: int, j: int) -> float:
        """Measure two convex solids, of which one is small, at an enlarged scale."""
        factor, poses, narrow = self._enlarged[i, j]
        (poses[0, :, :3], start), (poses[1, :, :3], end) = self._pose_views[i], self._pose_views[j]
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
        """Return True if the gap along the normal equals the distance of two convex solids.

        Nor may it be wider along the axes of the solids, or the other way: coal sometimes takes solids that
        touch for deep in each other.
        """
        (a, rotation, _), (b, other, _) = placed = self._placed_solids(i, j)
        axes = np.concatenate([self.witness()[2][None], rotation.T, other.T])
        gaps = directional_gaps(*placed, np.concatenate([axes, -axes]))
        tolerance = _GAP_TOLERANCE * max(1.0, distance, a.radius, b.radius)
        return bool(abs(distance - gaps[0]) <= tolerance and gaps.max() <= gaps[0] + tolerance)

    def _solve(self, i: int, j: int) -> float:
        """Measure two separated convex solids by GJK, without coal."""
        result = gjk_distance(*self._placed_solids(i, j))
        if result is None:
            return self._search(i, j)
        distance, point, normal = result
        self._witness = point, point + distance * normal, normal
        return distance

    def _check_triangles(self, i: int, j: int, distance: float, functor: Any) -> float:
        """Check the distance of a pair with triangles, for which no separating plane has to exist.

        Wrong distances of coal come from iterations that do not converge. A second run with other tolerances
        then gives another distance, and all triangles that may be nearest are measured without coal.
        """
        witness = self.witness()
        a, b = self._pair(i, j)
        again = self._remeasure(i, j, functor)
        self._witness = witness
        if abs(again - distance) <= _GAP_TOLERANCE * max(1.0, distance, a.radius, b.radius):
            return distance
        solved = self._solve_triangles(i, j)
        return self._measure_contacts(i, j) if solved is None else solved

    def _measure_touching_triangles(self, i: int, j: int, functor: Any) -> float:
        """Measure a pair with triangles that coal reports in touch, after checking that it is."""
        a, b = self._pair(i, j)
        if (a.is_convex or b.is_convex) and self._remeasure(i, j, functor) > _TOUCH:
            solved = self._solve_triangles(i, j)
            if solved is not None:
                return solved
        return self._measure_contacts(i, j)

    def _remeasure(self, i: int, j: int, functor: Any) -> float:
        self._result.clear()
        return float(functor(self._transforms[i], self._transforms[j], self._coarsest, self._result))

    def _solve_triangles(self, i: int, j: int) -> float | None:
        """Measure a convex solid and triangles by GJK, without coal; None if they touch."""
        swapped = not self._pair(i, j)[0].is_convex
        solid, mesh = (j, i) if swapped else (i, j)
        surface = self._pair(mesh, mesh)[0].surface
        assert isinstance(surface, Faces)
        result = gjk_distance_to_faces(self._placed_solids(solid, solid)[0], surface, *self._pose_views[mesh])
        if result is None:
            return None
        distance, point, normal = result
        other = point + distance * normal
        self._witness = (other, point, -normal) if swapped else (point, other, normal)
        return distance

    def _measure_shifted(self, i: int, j: int, functor: Any) -> float:
        """Measure two convex solids that touch, or on which coal failed, after a small translation.

        The component of the translation along the normal is subtracted again. That is exact for flat faces;
        for round ones the error is of second order in 0.01 mm. The last resort is a search over directions.
        """
        pose_a, result = self._transforms[i], self._result
        rotation, position = self._pose_views[j]
        far = min(_SHIFT, _SHIFT_OF_RADIUS * min(solid.radius for solid in self._pair(i, j)))
        start, end = self._centres(i, j)
        # A translation along the line between two inner points separates touching convex solids.
        for shift in (far * _unit(end - start), *(far * np.eye(3))):
            shifted = self._coal.Transform3s(rotation, position + shift)
            for request in (self._request, *self._coarser):
                result.clear()
                self._witness = None
                distance: float = functor(pose_a, shifted, request, result)
                if abs(distance) < 1e300 and self._is_unit_normal():
                    point_a, point_b, normal = self.witness()
                    distance -= float(normal @ shift)
                    self._witness = point_a, point_b - shift, normal
                    if self._normal_confirms(i, j, distance):
                        return distance
        return self._search(i, j)

    def _search(self, i: int, j: int) -> float:
        """Search for a separating translation of two convex solids that is nearly the shortest."""
        a, b = self._placed_solids(i, j)
        start, end = self._centres(i, j)
        distance, normal = find_widest_gap(a, b, _unit(end - start)[None])
        # Moved apart along the normal, they have their nearest points where they face each other.
        solid, rotation, position = b
        moved = position + (_APART_OF_RADIUS * min(a[0].radius, solid.radius) - distance) * normal
        if (result := gjk_distance(a, (solid, rotation, moved))) is not None:
            self._witness = result[1], result[1] + distance * normal, normal
        else:
            self._witness = smoothed_support(a, normal), smoothed_support(b, -normal), normal
        return distance

    def _placed_solids(self, i: int, j: int) -> tuple[PlacedSolid, PlacedSolid]:
        a, b = self._pair(i, j)
        return (a, *self._pose_views[i]), (b, *self._pose_views[j])

    def _centres(self, i: int, j: int) -> tuple[Floats, Floats]:
        a, b = self._pair(i, j)
        (rotation_a, position_a), (rotation_b, position_b) = self._pose_views[i], self._pose_views[j]
        return rotation_a @ a.centre + position_a, rotation_b @ b.centre + position_b

    def _measure_contacts(self, i: int, j: int) -> float:
        """Measure a touching pair with triangles: the depth in the triangle that is penetrated the most."""
        (a, b), pose_a, pose_b = self._pair(i, j), self._transforms[i], self._transforms[j]
        coal = self._coal
        request = coal.CollisionRequest(coal.CollisionRequestFlag.CONTACT, _MAX_CONTACTS)
        result = coal.CollisionResult()
        one, other = a.stand_in or a.engine, b.stand_in or b.engine
        coal.collide(one, pose_a, other, pose_b, request, result)
        deepest, depth = None, -1.0
        for k in range(result.numContacts()):
            contact = result.getContact(k)
            if depth < -contact.penetration_depth < 1e300 and abs(np.linalg.norm(contact.normal) - 1) < 1e-6:
                deepest, depth = contact, -contact.penetration_depth
        if deepest is None:
            if (a.is_convex or b.is_convex) and (solved := self._solve_triangles(i, j)) is not None:
                return solved
            point = np.array(self._result.getNearestPoint1())
            if not np.isfinite(point).all():
                point = np.array(pose_a.getTranslation())
            normal = _unit(np.array(pose_b.getTranslation()) - np.array(pose_a.getTranslation()))
            self._witness = point, point, normal
            return 0.0
        normal = np.array(deepest.normal)
        point = np.array(deepest.pos)
        self._witness = point + normal * depth / 2, point - normal * depth / 2, normal
        return -depth


def distance_to_point(solid: Solid, pose: Floats, point: Floats) -> tuple[float, Floats, Floats]:
    """Return signed distance of a point from a placed solid [m], its nearest point, and the normal there."""
    # The radius of the solid bounds the translations of _measure_shifted, not that of the ball.
    point_ball = replace(solid_from_geometry(Sphere(_POINT_RADIUS)), radius=solid.radius)
    narrow = Narrowphase([solid, point_ball], np.stack([pose, np.column_stack([np.eye(3), point])]))
    distance = narrow.distance(0, 1) + _POINT_RADIUS
    nearest, _, normal = narrow.witness()
    return distance, nearest, normal


def _request(coal: Any, factor: float) -> Any:
    request = coal.DistanceRequest()
    request.gjk_tolerance, request.epa_tolerance = factor * APART_TOLERANCE, factor * DEPTH_TOLERANCE
    request.gjk_max_iterations = request.epa_max_iterations = 256
    return request


def _enlargement(a: Solid, b: Solid) -> float:
    """Return the power of two by which a pair is enlarged; 1 for large enough solids, and for triangles."""
    small, large = sorted((a.radius, b.radius))
    if small >= _SMALL or not (a.is_convex and b.is_convex):
        return 1.0
    return float(2.0 ** math.floor(math.log2(min(2 * _ENLARGED / small, _LARGEST / large))))


def _unit(vector: Floats) -> Floats:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-12 else np.array([0.0, 0.0, 1.0])
