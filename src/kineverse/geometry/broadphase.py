"""Broad phase: sweep and prune with a static AABB tree, and lower bounds carried from state to state.

In one update, a point of an object at c from its centre moves by ``|Δcentre + ΔR c| <= |Δcentre| + r ‖ΔR‖``,
with r the radius of the bounding sphere. The sum of this bound over all updates is the *travel* s of the
object. Let two objects have had the distance d when their travel was s_i and s_j. Then ``d + s_i + s_j``
minus their present travel is a lower bound of their distance. Travel that is too large for exact bounds in
floating point is reset to 0.

This module is the numpy path; :mod:`.bindings` offers the same in C, several times as fast.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from .mesh_files import Floats
from .shapes import Core

Indices: TypeAlias = npt.NDArray[np.int32]
Flags: TypeAlias = npt.NDArray[np.uint8]

MAX_BOUNDED_OBJECTS = 6000  # objects for which bounds are carried; only measured pairs touch their memory
MEMORY_SLOTS = 2**13  # number of measured pairs that are remembered until an object moves; a power of two

_MEMORY = np.dtype([("pair", np.int64), ("numbers", np.float64, 12)])

_INHERITED = (
    "active", "centre", "half", "radius", "poses", "travel",
    "corners", "corner_count", "edges", "radii", "round", "tip",
)  # fmt: skip


class ObjectTable:
    """Table of M collision objects of B bodies, moving objects first."""

    def __init__(self, moving: int, body: Indices, allowed: Flags) -> None:
        count = len(body)
        self.moving = moving  # number of moving objects; the others are static
        self.body = body  # (M,) index of the body of each object
        self.allowed = allowed  # (B, B) 1 for pairs of bodies that are checked, symmetric; 0 on the diagonal
        self.active: Flags = np.zeros(count, dtype=np.uint8)  # 1 for objects that have a solid
        # Bounding box and bounding sphere in the frame of the object [m].
        self.centre, self.half, self.radius = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)
        self.poses = np.tile(np.eye(4)[:3], (count, 1, 1))  # in the world
        self.travel = np.zeros(count)  # upper bounds of the motion of any point since the last reset [m]
        # Centre in the world, and corners of the axis-aligned bounding box [m].
        self.position, self.low, self.high = (np.zeros((count, 3)) for _ in range(3))
        # Cores of the solids, see shapes.Core, which have to outlive the table: address and number of the
        # corners, -1 without a core; half edges, radii of the ellipsoid, radius of the ball, tip [m].
        self.corners, self.corner_count = np.zeros(count, dtype=np.uintp), np.full(count, -1, dtype=np.int64)
        self.edges, self.radii, self.round = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)
        self.tip = np.zeros(count)
        self.memory = np.zeros(MEMORY_SLOTS, dtype=_MEMORY)  # last results of C; later pairs overwrite them
        # Moving objects as last sorted along the axis of the sweep, then the static ones.
        self.order: Indices = np.arange(count, dtype=np.int32)
        self.axis = 0
        self.sorted_boxes = np.empty((7, moving))  # work space of C
        # For i < j, the last measured distance plus the travel of both at that time; 0 before. Minus the
        # present travel it is a lower bound of the distance. None for too many objects.
        self.bounds: Floats | None = np.zeros((count, count)) if count <= MAX_BOUNDED_OBJECTS else None
        self.binding: Any = None  # table as C reads it, once it exists
        self.resets = 0  # of travel
        self.static_changed = True  # True if a static object was placed since the static tree was built

    @property
    def count(self) -> int:
        """Number of objects."""
        return len(self.body)

    def set_solid(
        self, index: int, centre: Floats, half: Floats, radius: float, core: Core | None = None
    ) -> None:
        """Enter the bounding volumes and the core of an object's solid."""
        self.centre[index], self.half[index], self.radius[index] = centre, half, radius
        if core is not None:
            self.corners[index], self.corner_count[index] = core.corners.ctypes.data, core.corners.shape[1]
            self.edges[index], self.radii[index], self.round[index] = core.half, core.radii, core.radius
            self.tip[index] = core.tip
        self.active[index] = 1
        self.update_boxes(np.array([index]))

    def update_boxes(self, objects: npt.NDArray[np.integer[Any]]) -> None:
        """Recompute the centres and boxes of objects from their poses."""
        self.static_changed |= bool((objects >= self.moving).any())
        rotation, translation = self.poses[objects, :, :3], self.poses[objects, :, 3]
        centre = np.einsum("kij,kj->ki", rotation, self.centre[objects]) + translation
        extent = np.einsum("kij,kj->ki", np.abs(rotation), self.half[objects])
        self.position[objects] = centre
        self.low[objects], self.high[objects] = centre - extent, centre + extent

    def inherit(self, old: ObjectTable, kept: npt.NDArray[np.integer[Any]]) -> None:
        """Copy rows of another table; ``kept`` holds (K, 2) indices in this table and in the other."""
        here, there = kept[:, 0], kept[:, 1]
        for name in _INHERITED:
            getattr(self, name)[here] = getattr(old, name)[there]
        self.axis = old.axis
        if self.bounds is None or old.bounds is None:
            return
        number = np.full(old.count, -1)
        number[there] = here
        measured = np.nonzero(old.bounds)
        ones, others = (number[objects] for objects in measured)
        both = (ones >= 0) & (others >= 0)
        ones, others = ones[both], others[both]
        # Entries stand at (smaller, larger) index; the order of two objects may have changed.
        self.bounds[np.minimum(ones, others), np.maximum(ones, others)] = old.bounds[measured][both]

    def reset_travel(self) -> None:
        """Reset travel, bounds and remembered results."""
        self.travel[:] = 0.0
        self.resets += 1
        self.memory[:] = 0
        if self.bounds is not None:
            self.bounds[self.bounds != 0.0] = 0.0

    def choose_axis(self) -> None:
        """Choose the axis with the largest spread of centres for the sweep."""
        there = self.active.astype(bool)
        if there.any():
            self.axis = int(np.argmax(self.position[there].std(axis=0)))

    def lower_bounds(self, ones: Indices, others: Indices) -> Floats:
        """Return lower bounds of the distances of pairs (K,), (K,), with ones < others, [m]."""
        between = self.position[others] - self.position[ones]
        bound: Floats = np.linalg.norm(between, axis=1) - self.radius[ones] - self.radius[others]
        np.maximum(bound, self._box_to_sphere(ones, others, between), out=bound)
        np.maximum(bound, self._box_to_sphere(others, ones, -between), out=bound)
        if self.bounds is not None:
            known = self.bounds[ones, others]
            measured = known != 0.0
            known -= self.travel[ones] + self.travel[others]
            np.maximum(bound, known, out=bound, where=measured)
        return bound

    def _box_to_sphere(self, boxes: Indices, spheres: Indices, between: Floats) -> Floats:
        inside = np.einsum("kji,kj->ki", self.poses[boxes, :, :3], between)
        outside = np.maximum(np.abs(inside) - self.half[boxes], 0.0)
        distances: Floats = np.sqrt((outside**2).sum(axis=1)) - self.radius[spheres]
        # A centre inside of the box gives no bound.
        distances[~outside.any(axis=1)] = -np.inf
        return distances


class PairSelection:
    """Selected pairs of bodies of a table, for a search among these only."""

    binding: Any = None  # neighbours as C reads them, once they exist

    def __init__(self, table: ObjectTable, bodies: Flags) -> None:
        self.bodies = np.ascontiguousarray(bodies)
        involved = np.asarray(self.bodies.any(axis=1), dtype=np.uint8)
        self._objects = involved[table.body]
        self.addresses = self.bodies.ctypes.data, self._objects.ctypes.data


TREE_WIDTH = 8  # number of children of a node of the static tree, whose boxes are tested at once


def build_static_tree(low: Floats, high: Floats, objects: Indices) -> tuple[Floats, Indices]:
    """Build an AABB tree: a full tree of boxes, split at medians of the longest edge."""
    count = 1
    while TREE_WIDTH * count < len(objects):
        count *= TREE_WIDTH
    leaves = np.full((count, TREE_WIDTH), -1, dtype=np.int32)
    parts = [(objects, 0, count)]
    while parts:
        some, first, width = parts.pop()
        if width == 1:
            leaves[first, : len(some)] = some
            continue
        middle = (low[some] + high[some]) / 2
        axis = int(np.argmax(np.ptp(middle, axis=0))) if len(some) else 0
        order = some[np.argsort(middle[:, axis], kind="stable")]
        half = (len(some) + 1) // 2
        parts += [(order[:half], first, width // 2), (order[half:], first + width // 2, width // 2)]
    # Index -1 finds one more row, the empty box; there may be no object at all.
    nothing = np.full((1, 3), np.inf)
    lows, highs = np.concatenate([low, nothing])[leaves], np.concatenate([high, -nothing])[leaves]
    levels = [np.concatenate([lows, highs], axis=2)]
    while len(lows) > 1:
        lows, highs = (ends.reshape(-1, TREE_WIDTH, 3) for ends in (lows.min(axis=1), highs.max(axis=1)))
        levels.append(np.concatenate([lows, highs], axis=2))
    return np.ascontiguousarray(np.concatenate(levels[::-1]).transpose(0, 2, 1)), leaves


FURTHEST = 1e12  # largest distance of an object from the origin [m], where numbers are 0.1 mm apart
LONGEST_TRAVEL = 1e4  # travel up to which bounds are exact to about 1e-12 m [m]

PLACED, TRAVEL_EXCEEDED = -1, -2


def place_objects(table: ObjectTable, fresh: Floats) -> int:
    """Move the moving objects to new poses (moving, 3, 4) and add to their travel."""
    bad = ~(np.abs(fresh) <= FURTHEST).all(axis=(1, 2))
    if bad.any():
        return int(np.argmax(bad))
    moving = np.arange(table.moving)
    before, old = table.position[moving], table.poses[moving, :, :3]
    table.poses[moving] = fresh
    table.update_boxes(moving)
    # The spectral norm of the difference of two rotations is its Frobenius norm over √2.
    turned = np.sqrt(((fresh[:, :, :3] - old) ** 2).sum(axis=(1, 2)) / 2)
    shifted = np.sqrt(((table.position[moving] - before) ** 2).sum(axis=1))
    table.travel[moving] += shifted + table.radius[moving] * turned
    return TRAVEL_EXCEEDED if (table.travel[moving] > LONGEST_TRAVEL).any() else PLACED


def find_near_pairs(table: ObjectTable, reach: float, allowed: Flags | None = None) -> tuple[Indices, Floats]:
    """Return all pairs of objects that may be within ``reach`` [m] of each other.

    Pairs consist of active objects, at least one of which moves, of checked bodies, or of the bodies flagged
    in ``allowed``, (B, B). No pair whose measured distance is at most ``reach`` is missing.
    """
    low, high = table.low[:, table.axis], table.high[:, table.axis]
    order = np.argsort(low, kind="stable").astype(np.int32)
    order = order[table.active[order] == 1]
    ends = np.searchsorted(low[order], high[order] + reach, side="right")
    counts = np.maximum(ends - np.arange(len(order)) - 1, 0)
    first = np.repeat(np.arange(len(order)), counts)
    step = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    ones, others = order[first], order[first + step]
    ones, others = np.minimum(ones, others), np.maximum(ones, others)
    checked = table.allowed if allowed is None else allowed
    keep = (checked[table.body[ones], table.body[others]] == 1) & (ones < table.moving)
    ones, others = ones[keep], others[keep]
    gaps = np.maximum(table.low[ones] - table.high[others], table.low[others] - table.high[ones])
    keep = (np.maximum(gaps, 0.0) ** 2).sum(axis=1) <= reach * reach
    ones, others = ones[keep], others[keep]
    lows = table.lower_bounds(ones, others)
    keep = lows <= reach
    return np.stack([ones[keep], others[keep]], axis=1), lows[keep]


def rank_pairs(
    table: ObjectTable, pairs: Indices, distances: Floats, radius: float, per_shape: bool = False
) -> npt.NDArray[np.int64]:
    """Return the pairs that are the nearest of their bodies, by index, within a radius [m], nearest first.

    If ``per_shape``, all pairs within the radius are returned.
    Ties are broken by the indices of the bodies and then of the objects.
    """
    owners = table.body[pairs]
    low, high = owners.min(axis=1, initial=len(table.allowed)), owners.max(axis=1, initial=0)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], high, low, distances))
    order = order[: np.searchsorted(distances[order], radius, side="right")]
    if per_shape:
        return np.asarray(order)
    bodies = low[order].astype(np.int64) * len(table.allowed) + high[order]
    return np.asarray(order[np.sort(np.unique(bodies, return_index=True)[1])])


def gather_pairs(
    table: ObjectTable, pairs: Indices, distances: Floats, witnesses: Floats, order: npt.NDArray[np.int64]
) -> tuple[Indices, Indices, Floats, Floats]:
    """Return objects (K, 2), their bodies (K, 2), distances and witnesses in an order.

    The first body of each pair precedes the second in the model.
    """
    pairs, distances, witnesses = pairs[order], distances[order], witnesses[order]
    owners = table.body[pairs]
    turned = owners[:, 0] > owners[:, 1]
    pairs[turned], owners[turned] = pairs[turned, ::-1], owners[turned, ::-1]
    backwards = witnesses[turned]
    witnesses[turned] = np.hstack([backwards[:, 3:6], backwards[:, :3], -backwards[:, 6:]])
    return pairs, owners, distances, witnesses
