"""Convex parts of placed bodies, and bars: thin parts that protrude from their parent body.

All poses, points and directions are in the world [m].
"""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kineverse.geometry import Scene
from kineverse.geometry.gjk import PlacedSolid, directional_gaps, find_widest_gap
from kineverse.geometry.objects import CollisionObject
from kineverse.geometry.rays import intersect_ray
from kineverse.geometry.shapes import Solid, solid_from_geometry
from kineverse.lie import Array, unit_vector
from kineverse.model.body import Geometry, Mesh, Sphere

MOST_THICK = 0.09  # largest thickness of a bar [m]: hardly a gripper opens further
_LONG = 1.5  # length per width above which a part is a bar, and a knob below
_FLAT, _WIDE = 3.0, 2.0  # width by thickness of a plate, width of a panel by that of what it carries
_STANDS_OUT = 3e-3  # least length by which a bar stands out from what it is fixed to [m]
_TOUCH = 2e-3  # largest gap of parts that are fixed to each other [m]
_STEPS = 144


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Convex shape of a placed body."""

    body: str  # frame of the body
    number: int  # index of the shape
    geometry: Geometry  # shape of the model
    solid: Solid  # shape as collision scenes have it, a mesh as its hull, and its pose (4, 4) in the world
    pose: Array
    axes: Array  # box around it: axes (3, 3) in columns, the longest edge first, lengths (3,), middle (3,)
    size: Array
    middle: Array

    @property
    def placed(self) -> PlacedSolid:
        """The solid with its rotation and position."""
        return self.solid, self.pose[:3, :3], self.pose[:3, 3]

    @property
    def is_slim(self) -> bool:
        """True if a hand can close around it in some direction."""
        return bool(self.size[1] <= MOST_THICK)

    def extent(self, directions: Array) -> Array:
        """Return the largest coordinates (n,) along unit directions (n, 3)."""
        return -directional_gaps((_point(), np.eye(3), np.zeros(3)), self.placed, -directions) - _POINT_RADIUS

    def touches(self, other: Part) -> bool:
        """Return True if another part is in contact, up to some 2 mm."""
        between = other.middle - self.middle
        if np.linalg.norm(between) > np.linalg.norm(self.size) / 2 + np.linalg.norm(other.size) / 2 + _TOUCH:
            return False
        if _gap_bound(self, other) > _TOUCH:
            return False
        return find_widest_gap(self.placed, other.placed, np.zeros((0, 3)))[0] <= _TOUCH


def find_parts(
    scene: Scene,
    near: Array | None = None,
    radius: float = math.inf,
    *,
    bodies: Collection[str] | None = None,
) -> list[Part]:
    """Return the convex parts of the bodies of a scene, or of some of them, as they are placed."""
    parts = []
    for item in scene.collision_world.objects:
        if bodies is not None and item.body not in bodies:
            continue
        solid = item.make_solid()
        pose = scene.pose(item.body) @ item.shape.origin.matrix
        middle = pose[:3, :3] @ solid.centre + pose[:3, 3]
        if near is None or np.linalg.norm(middle - near) <= radius + solid.radius:
            parts.append(_make_part(item, solid, pose))
    return parts


def _make_part(item: CollisionObject, solid: Solid, pose: Array) -> Part:
    boxes = [np.eye(3)]
    if solid.core is not None and solid.core.corners.size:  # the principal axes of a hull
        corners = solid.core.corners.T
        boxes.append(np.linalg.svd(corners - corners.mean(axis=0), full_matrices=False)[2].T)
    geometry = item.shape.geometry
    local = Part(item.body, item.number, geometry, solid, np.eye(4), boxes[0], np.zeros(3), np.zeros(3))
    spans = [(solid.centre + solid.half, solid.centre - solid.half)]
    spans += [(local.extent(axes.T), -local.extent(-axes.T)) for axes in boxes[1:]]
    volumes = [float(np.prod(high - low)) for high, low in spans]
    k = 1 if volumes[-1] < 0.99 * volumes[0] else 0
    axes, (high, low) = boxes[k], spans[k]
    order = np.argsort(low - high, kind="stable")
    turned = pose[:3, :3] @ axes
    middle = turned @ ((high + low) / 2) + pose[:3, 3]
    axes, size = turned[:, order], (high - low)[order]
    return replace(local, pose=pose, axes=axes, size=size, middle=middle)


_POINT_RADIUS = 1e-7


@functools.cache
def _point() -> Solid:
    """Return a point as a solid, once it is needed: pictures import this without the extra for solids."""
    return solid_from_geometry(Sphere(_POINT_RADIUS))


@dataclass(frozen=True, slots=True, eq=False)
class ProtrudingBar:
    """Part that a hand can close around."""

    part: Part
    cluster: tuple[Part, ...]  # it and the slim parts that are fixed to it
    rotation: Array  # (3, 3): z along the bar, x away from what the bar is fixed to
    stands_out: float  # length by which it stands out along x from what it is fixed to [m]
    is_knob: bool  # True if it is short, or stands out along its length


def find_bars(link: Sequence[Part], around: Sequence[Part]) -> list[ProtrudingBar]:
    """Return the bars among the parts of a rigid link, one for each cluster of slim parts."""
    bars = []
    panel = _find_panel(link)
    for cluster in _clusters([part for part in link if part.is_slim and part is not panel]):
        inside = {id(part) for part in cluster}
        rest = [part for part in link if id(part) not in inside]
        result = [bar for part in cluster if (bar := _bar(part, cluster, rest, around))]
        if result:
            # The bar between its mounts, and not a mount, whichever stands out further.
            result = [bar for bar in result if not bar.is_knob] or result
            furthest = max(bar.stands_out for bar in result)
            outer = [bar for bar in result if bar.stands_out > furthest - _STANDS_OUT]
            bars.append(max(outer, key=lambda bar: float(bar.part.size[0])))
    return bars


def _find_panel(link: Sequence[Part]) -> Part | None:
    """Return the narrow panel that carries the other parts of a link, all slim; None if there is none."""
    plates = [part for part in link if part.size[1] >= _FLAT * part.size[2]]
    others = [part for part in link if all(part is not plate for plate in plates)]
    if not plates or not others or not all(part.is_slim for part in link):
        return None
    widest = max(plates, key=lambda part: float(part.size[0] * part.size[1]))
    return widest if widest.size[1] >= _WIDE * max(part.size[1] for part in others) else None


def _clusters(parts: Sequence[Part]) -> list[tuple[Part, ...]]:
    left, clusters = list(parts), []
    while left:
        cluster = [left.pop(0)]
        for part in cluster:
            touching = [other for other in left if part.touches(other)]
            left = [other for other in left if all(other is not one for one in touching)]
            cluster += touching
        clusters.append(tuple(cluster))
    return clusters


def _bar(
    part: Part, cluster: tuple[Part, ...], rest: Sequence[Part], around: Sequence[Part]
) -> ProtrudingBar | None:
    # A part that moves alone is fixed to something of another link, each of what it touches is tried.
    fixtures = [rest] if rest else [[other] for other in _fixed_to(part, around)]
    result = [_stand_out(part, fixture) for fixture in fixtures]
    if not result:
        return None
    stands_out, x, is_knob = max(result, key=lambda entry: entry[0])
    if stands_out < _STANDS_OUT:
        return None
    along = [axis - (axis @ x) * x for axis in part.axes.T if abs(axis @ x) < 0.5]
    z = unit_vector(along[0])
    return ProtrudingBar(part, cluster, np.stack([x, np.cross(z, x), z], axis=1), stands_out, is_knob)


def _stand_out(part: Part, fixture: Sequence[Part]) -> tuple[float, Array, bool]:
    """Return how far a part stands out from a fixture, in which direction (3,), and whether as a knob."""
    is_knob = bool(part.size[0] <= _LONG * part.size[1])
    turns = np.linspace(0.0, 2 * np.pi, _STEPS, endpoint=False)
    circle = np.outer(np.cos(turns), part.axes[:, 1]) + np.outer(np.sin(turns), part.axes[:, 2])
    knob = np.concatenate([part.axes.T, -part.axes.T])
    stands_out, x = 0.0, part.axes[:, 0]
    if not is_knob:
        normals = np.concatenate([other.axes.T for other in fixture])
        normals = normals - np.outer(normals @ part.axes[:, 0], part.axes[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        normals = normals[lengths > 0.5] / lengths[lengths > 0.5, None]
        stands_out, x = _most_outwards(part, fixture, np.concatenate([normals, -normals, circle]))
    if is_knob or (stands_out < _STANDS_OUT and part.size[0] <= 2 * MOST_THICK):
        is_knob, (stands_out, x) = True, _most_outwards(part, fixture, knob)
    return stands_out, x, is_knob


def _most_outwards(part: Part, fixture: Sequence[Part], directions: Array) -> tuple[float, Array]:
    """Return how far a part stands out from its fixture, and the direction (3,) in which that is the most.

    Directions that come first are preferred: that of a panel's normal to a direction near to it.
    """
    beyond = part.extent(directions) - np.max([other.extent(directions) for other in fixture], axis=0)
    best = int(np.argmax(beyond >= beyond.max() - 1e-4))
    return float(beyond[best]), directions[best]


def _fixed_to(part: Part, around: Sequence[Part]) -> list[Part]:
    """Return the larger parts of other links that a part touches, or else the nearest one."""
    larger = [other for other in around if other.size[1] >= part.size[1]]
    near = sorted(larger, key=lambda other: _gap_bound(part, other))[:8]
    return [other for other in near if part.touches(other)] or near[:1]


def _gap_bound(a: Part, b: Part) -> float:
    """Return a lower bound of the distance of two parts, along the axes of both."""
    axes = np.concatenate([a.axes.T, -a.axes.T, b.axes.T, -b.axes.T])
    return float(directional_gaps(a.placed, b.placed, axes).max())


def free_length(
    origin: Array,
    direction: Array,
    parts: Sequence[Part],
    *,
    but: Collection[Part] = (),
    length: float = math.inf,
    hollow: bool = False,
) -> float:
    """Return the length of a ray to the first of some parts [m]; infinite if none is within a length."""
    nearest, skipped = math.inf, {id(part) for part in but}
    for part in parts:
        radius = float(np.linalg.norm(part.size)) / 2
        to_middle = part.middle - origin
        along = float(to_middle @ direction)
        if id(part) in skipped or along < -radius or along - radius > min(nearest, length):
            continue
        if float(to_middle @ to_middle) - along * along > radius * radius:
            continue
        rotation, position = part.pose[:3, :3], part.pose[:3, 3]
        is_mesh = hollow and isinstance(part.geometry, Mesh)
        solid = solid_from_geometry(part.geometry, triangles=True) if is_mesh else part.solid
        hit = intersect_ray(solid, rotation.T @ (origin - position), rotation.T @ direction)
        if hit is not None and hit[0] <= length:
            nearest = min(nearest, hit[0])
    return nearest
