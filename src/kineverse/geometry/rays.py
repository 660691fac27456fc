"""Ray casts against solids, and ray and point queries in a collision world.

The part of a ray inside of a convex solid is an interval: a polytope cuts the ray by half-spaces, a round
solid by quadrics.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, ShapeError
from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Sphere

from .broadphase import FURTHEST
from .collision_world import CollisionWorld
from .distance_queries import check_radius
from .mesh_files import Faces, Floats
from .narrowphase import ACCURACY, distance_to_point
from .results import NearestPoint, RayHit
from .shapes import Hull, Primitive, Solid

RayEntry = tuple[float, Floats]  # distance along the ray [m], and the outward normal at the point of entry

_PARALLEL = 1e-14


def intersect_ray(solid: Solid, origin: Floats, direction: Floats) -> RayEntry | None:
    """Return first point of a ray in a solid: distance [m], 0 from inside, and normal; None if it misses."""
    surface = solid.surface
    if isinstance(surface, Faces):
        return _intersect_triangles(surface, origin, direction)
    if isinstance(surface, Hull):
        return _intersect_polytope(surface.normals, surface.offsets, origin, direction)
    return _intersect_primitive(surface, origin, direction)


def _intersect_primitive(shape: Primitive, origin: Floats, direction: Floats) -> RayEntry | None:
    if isinstance(shape, Box):
        half = np.array(shape.size, dtype=float) / 2
        return _intersect_polytope(_AXES, np.concatenate([half, half]), origin, direction)
    if isinstance(shape, Sphere):
        return _intersect_ellipsoid(np.full(3, shape.radius), origin, direction)
    if isinstance(shape, Ellipsoid):
        return _intersect_ellipsoid(np.array(shape.radii, dtype=float), origin, direction)
    if isinstance(shape, Capsule):
        return _intersect_capsule(shape, origin, direction)
    return _intersect_cylinder_or_cone(shape, origin, direction)


_AXES = np.concatenate([np.eye(3), -np.eye(3)])


def _intersect_polytope(
    normals: Floats, offsets: Floats, origin: Floats, direction: Floats
) -> RayEntry | None:
    speed, gap = normals @ direction, offsets - normals @ origin
    if ((np.abs(speed) < _PARALLEL) & (gap < 0.0)).any():
        return None
    inwards, outwards = speed <= -_PARALLEL, speed >= _PARALLEL
    times = np.divide(gap, speed, out=np.zeros_like(gap), where=inwards | outwards)
    first = int(np.argmax(np.where(inwards, times, -math.inf)))
    enters = times[first] if inwards.any() else -math.inf
    leaves = times[outwards].min() if outwards.any() else math.inf
    return _entry_between(float(enters), float(leaves), normals[first], direction)


def _entry_between(enters: float, leaves: float, normal: Floats, direction: Floats) -> RayEntry | None:
    if enters > leaves or leaves < 0.0:
        return None
    return (enters, normal) if enters >= 0.0 else (0.0, -direction)


def _intersect_ellipsoid(radii: Floats, origin: Floats, direction: Floats) -> RayEntry | None:
    span = _ball_interval(origin / radii, direction / radii, 1.0)
    if span is None:
        return None
    point = (origin + span[0] * direction) / radii**2
    return _entry_between(*span, point / np.linalg.norm(point), direction)


def _ball_interval(origin: Floats, direction: Floats, radius: float) -> tuple[float, float] | None:
    """Return the interval of the line parameter inside of a ball; None if the line misses it."""
    a, b = float(direction @ direction), float(origin @ direction)
    # The distance of the line from the centre loses fewer digits than the difference of squares.
    nearest = origin - b / a * direction
    inside = radius * radius - float(nearest @ nearest)
    if inside < 0.0:
        return None
    root = math.sqrt(inside / a)
    return -b / a - root, -b / a + root


def _intersect_capsule(shape: Capsule, origin: Floats, direction: Floats) -> RayEntry | None:
    half, radii = np.array([0.0, 0.0, shape.length / 2]), np.full(3, shape.radius)
    result = [_intersect_cylinder_or_cone(Cylinder(shape.radius, shape.length), origin, direction)]
    result += [_intersect_ellipsoid(radii, origin + end, direction) for end in (half, -half)]
    hits = [hit for hit in result if hit is not None]
    # A ray that starts inside of any of the three starts inside of the capsule.
    return min(hits, key=lambda hit: hit[0]) if hits else None


def _intersect_cylinder_or_cone(shape: Cylinder | Cone, origin: Floats, direction: Floats) -> RayEntry | None:
    """Intersect the slab |z| <= length/2 with the wall x² + y² = r(z)², where r is linear in z."""
    radius, half = shape.radius, shape.length / 2
    slope = radius / shape.length if isinstance(shape, Cone) else 0.0
    start = radius / 2 if isinstance(shape, Cone) else radius
    caps = _slab_interval(half, origin[2], direction[2])
    if caps is None:
        return None
    # r(z) = start - slope z. Inside, q(t) = x² + y² - r² <= 0; the caps ensure r >= 0.
    r, dr = start - slope * origin[2], -slope * direction[2]
    a = float(direction[:2] @ direction[:2]) - dr * dr
    b = float(origin[:2] @ direction[:2]) - r * dr
    c = float(origin[:2] @ origin[:2]) - r * r
    best: RayEntry | None = None
    for low, high in _intervals_below_zero(a, b, c):
        enters, leaves = max(low, caps[0]), min(high, caps[1])
        if caps[0] >= low:
            normal = np.array([0.0, 0.0, -math.copysign(1.0, direction[2])])
        else:
            point = origin + enters * direction
            side = math.hypot(point[0], point[1])
            normal = np.array([point[0], point[1], slope * side]) / max(side * math.hypot(1.0, slope), 1e-300)
        hit = _entry_between(enters, leaves, normal, direction)
        if hit is not None and (best is None or hit[0] < best[0]):
            best = hit
    return best


def _slab_interval(half: float, z: float, speed: float) -> tuple[float, float] | None:
    if abs(speed) < _PARALLEL:
        return (-math.inf, math.inf) if abs(z) <= half else None
    one, other = (-half - z) / speed, (half - z) / speed
    return min(one, other), max(one, other)


def _intervals_below_zero(a: float, b: float, c: float) -> list[tuple[float, float]]:
    """Return the intervals of t in which a t² + 2 b t + c <= 0."""
    if abs(a) < _PARALLEL:
        if abs(b) < _PARALLEL:
            return [(-math.inf, math.inf)] if c <= 0.0 else []
        root = -c / (2 * b)
        return [(-math.inf, root)] if b > 0.0 else [(root, math.inf)]
    discriminant = b * b - a * c
    if discriminant < 0.0:
        return [] if a > 0.0 else [(-math.inf, math.inf)]
    # The root of larger magnitude first, without cancellation; the other one by Vieta.
    q = -(b + math.copysign(math.sqrt(discriminant), b))
    roots = sorted((q / a, c / q if q else 0.0))
    return [(roots[0], roots[1])] if a > 0.0 else [(-math.inf, roots[0]), (roots[1], math.inf)]


def _intersect_triangles(mesh: Faces, origin: Floats, direction: Floats) -> RayEntry | None:
    """Return the nearest intersection with either side of a triangle (Möller and Trumbore 1997)."""
    corners = mesh.vertices[mesh.faces]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(direction, other)
    volume = np.einsum("ij,ij->i", one, across)
    usable = np.abs(volume) > _PARALLEL * np.abs(one).max(axis=1) * np.abs(other).max(axis=1)
    scale = np.divide(1.0, volume, out=np.zeros_like(volume), where=usable)
    arm = origin - corners[:, 0]
    u = np.einsum("ij,ij->i", arm, across) * scale
    turn = np.cross(arm, one)
    v = (turn @ direction) * scale
    times = np.einsum("ij,ij->i", other, turn) * scale
    edge = 1e-12
    hits = usable & (u >= -edge) & (v >= -edge) & (u + v <= 1 + edge) & (times >= 0.0)
    if not hits.any():
        return None
    first = int(np.argmin(np.where(hits, times, math.inf)))
    normal = np.cross(one[first], other[first])
    normal /= np.linalg.norm(normal)
    return float(times[first]), -normal if normal @ direction > 0.0 else normal


def cast_ray(
    world: CollisionWorld, origin: npt.ArrayLike, direction: npt.ArrayLike, length: float
) -> RayHit | None:
    """Return the first hit of a ray within a length [m], or None."""
    start, heading = _check_point(origin, "origin"), _check_vector(direction, "direction")
    size = float(np.abs(heading).max())
    if size == 0.0:
        raise InvalidValueError("The direction of a ray is a vector other than 0.")
    if not length > 0.0:
        raise InvalidValueError(f"The length of a ray is positive [m], not {length!r}.")
    heading = heading / size  # first, so that squares neither overflow nor vanish
    heading /= np.linalg.norm(heading)
    world.prepare()
    table = world.table
    # Distance along the ray at which each bounding sphere begins, if the ray passes through it.
    to_centre = table.position - start
    along = to_centre @ heading
    aside = ((to_centre - np.outer(along, heading)) ** 2).sum(axis=1)
    through = np.flatnonzero((aside <= (table.radius * (1 + 1e-9)) ** 2) & (along >= -table.radius))
    begins = np.maximum(along[through] - table.radius[through], 0.0)
    best: tuple[float, int, Floats] | None = None
    limit = length
    for k in through[np.argsort(begins, kind="stable")].tolist():
        if along[k] - table.radius[k] > limit:
            break
        rotation, position = table.poses[k, :, :3], table.poses[k, :, 3]
        entry = intersect_ray(world.solid(k), rotation.T @ (start - position), rotation.T @ heading)
        if entry is not None and entry[0] <= limit and (best is None or (entry[0], k) < best[:2]):
            best = entry[0], k, rotation @ entry[1]
            limit = entry[0]
    if best is None:
        return None
    distance, k, normal = best
    hit = world.objects[k]
    return RayHit(hit.body, hit.number, distance, start + distance * heading, normal)


def find_nearest_point(world: CollisionWorld, point: npt.ArrayLike, radius: float) -> NearestPoint | None:
    """Return the body nearest to a point within a radius [m], or in which it is deepest; None if none is."""
    location = _check_point(point, "point")
    check_radius(radius)
    world.prepare()
    table = world.table
    to_point = location - table.position
    lows = np.linalg.norm(to_point, axis=1) - table.radius
    outside = np.maximum(np.abs(np.einsum("kji,kj->ki", table.poses[:, :, :3], to_point)) - table.half, 0.0)
    lows = np.maximum(lows, np.where(outside.any(axis=1), np.linalg.norm(outside, axis=1), -math.inf))
    best: NearestPoint | None = None
    for k in np.argsort(lows, kind="stable").tolist():
        if lows[k] > (radius if best is None else best.distance) + ACCURACY:
            break
        distance, nearest, normal = distance_to_point(world.solid(k), table.poses[k], location)
        if distance <= radius and (best is None or distance < best.distance):
            item = world.objects[k]
            best = NearestPoint(item.body, item.number, distance, nearest, normal)
    return best


def _check_point(values: npt.ArrayLike, what: str) -> Floats:
    point = _check_vector(values, what)
    if np.abs(point).max() > FURTHEST:
        raise InvalidValueError(f"The {what} {point} is further than {FURTHEST:g} m away.")
    return point


def _check_vector(values: npt.ArrayLike, what: str) -> Floats:
    try:
        vector = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,):
        raise ShapeError(f"The {what} is a vector of three numbers in the world, not {values!r}.")
    if not np.isfinite(vector).all():
        raise InvalidValueError(f"The {what} {vector} is not finite.")
    return vector
