"""Broad phase: sweep and prune with a static AABB tree, and lower bounds carried from state to state.

A point of a piece at c from its centre moves by ``|Δcentre + ΔR c| <= |Δcentre| + r ‖ΔR‖``, with r the radius
of its sphere. The sum of this over all updates is its *travel* s. Two pieces that were at a distance d when
they had travelled s_i and s_j are therefore at least ``d + s_i + s_j`` less their present travel apart. What
has gone too far for that to be exact in floating point begins again at 0.

This is the whole of it in numpy; :mod:`.sweep_native` has the same in C, several times as fast.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from .mesh_files import Floats
from .shapes import Core

Indices: TypeAlias = npt.NDArray[np.int32]
Flags: TypeAlias = npt.NDArray[np.uint8]

MAX_BOUNDED_OBJECTS = 6000
"""Bounds are carried for so many pieces at most; memory is touched only for pairs that were measured."""

MEMORY_SLOTS = 2**13
"""So many pairs are not measured again where nothing has moved; a power of two."""

_MEMORY = np.dtype([("pair", np.int64), ("numbers", np.float64, 12)])

_INHERITED = (
    "active", "centre", "half", "radius", "poses", "travel",
    "corners", "corner_count", "edges", "radii", "round", "tip",
)  # fmt: skip


@dataclass(eq=False)
class ObjectTable:
    """M pieces of B bodies, those that move first.

    Attributes
    ----------
    moving
        How many move; the others stand where they were first put.
    body
        (M,) the number of the body of each.
    allowed
        (B, B) 1 for pairs of bodies that are looked at, symmetric; 0 on the diagonal.
    active
        (M,) 1 for pieces that have a solid.
    centre, half, radius
        (M, 3), (M, 3), (M,) the box and the sphere around each in its own frame [m].
    poses
        (M, 3, 4) in the world.
    travel
        (M,) by how much any point of a piece can have moved since the beginning, at most [m].
    place, low, high
        (M, 3) each: the centre in the world, and the corners of the box around the piece there [m].
    corners, corner_count, edges, radii, round, tip
        (M,) the address of a piece's corners, how many these are, -1 for a piece without a core; the (M, 3)
        box, (M, 3) ellipsoid, (M,) ball and (M,) tip of its core [m]. See :class:`.shapes.Core`, which has to
        outlive this.
    memory
        What C measured last, of each pair that has not given way to another one.
    order
        (M,) the moving pieces sorted along ``axis`` when that was last done, and then the others.
    sorted_boxes
        Room for C: the corners of the boxes of the moving pieces in that order, and a row of gaps.
    static_changed
        Whether any of the others was put somewhere since somebody took notice.
    bounds
        (M, M) for i < j, the distance when it was measured, plus the travel of both at that time; 0 if it
        never was. Less their travel now it is a lower bound of the distance. None for too many pieces.
    """

    moving: int
    body: Indices
    allowed: Flags
    active: Flags = field(init=False)
    centre: Floats = field(init=False)
    half: Floats = field(init=False)
    radius: Floats = field(init=False)
    poses: Floats = field(init=False)
    travel: Floats = field(init=False)
    place: Floats = field(init=False)
    low: Floats = field(init=False)
    high: Floats = field(init=False)
    corners: npt.NDArray[np.uintp] = field(init=False)
    corner_count: npt.NDArray[np.int64] = field(init=False)
    edges: Floats = field(init=False)
    radii: Floats = field(init=False)
    round: Floats = field(init=False)
    tip: Floats = field(init=False)
    memory: npt.NDArray[np.void] = field(init=False)
    order: Indices = field(init=False)
    sorted_boxes: Floats = field(init=False)
    bounds: Floats | None = field(init=False)
    axis: int = 0
    binding: Any = None
    static_changed: bool = True

    def __post_init__(self) -> None:
        count = len(self.body)
        self.active = np.zeros(count, dtype=np.uint8)
        self.centre, self.half = np.zeros((count, 3)), np.zeros((count, 3))
        self.radius, self.travel = np.zeros(count), np.zeros(count)
        self.poses = np.tile(np.eye(4)[:3], (count, 1, 1))
        self.place, self.low, self.high = (np.zeros((count, 3)) for _ in range(3))
        self.corners, self.corner_count = np.zeros(count, dtype=np.uintp), np.full(count, -1, dtype=np.int64)
        self.edges, self.radii, self.round = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)
        self.tip, self.memory = np.zeros(count), np.zeros(MEMORY_SLOTS, dtype=_MEMORY)
        self.order = np.arange(count, dtype=np.int32)
        self.sorted_boxes = np.empty((7, self.moving))
        self.bounds = np.zeros((count, count)) if count <= MAX_BOUNDED_OBJECTS else None

    @property
    def count(self) -> int:
        """How many pieces there are."""
        return len(self.body)

    def set_solid(
        self, piece: int, centre: Floats, half: Floats, radius: float, core: Core | None = None
    ) -> None:
        """Enter what encloses a piece, and what it is."""
        self.centre[piece], self.half[piece], self.radius[piece] = centre, half, radius
        if core is not None:
            self.corners[piece], self.corner_count[piece] = core.corners.ctypes.data, core.corners.shape[1]
            self.edges[piece], self.radii[piece], self.round[piece] = core.half, core.radii, core.radius
            self.tip[piece] = core.tip
        self.active[piece] = 1
        self.update_boxes(np.array([piece]))

    def update_boxes(self, pieces: npt.NDArray[np.integer[Any]]) -> None:
        """Compute where pieces are from their poses."""
        self.static_changed |= bool((pieces >= self.moving).any())
        rotation, position = self.poses[pieces, :, :3], self.poses[pieces, :, 3]
        place = np.einsum("kij,kj->ki", rotation, self.centre[pieces]) + position
        extent = np.einsum("kij,kj->ki", np.abs(rotation), self.half[pieces])
        self.place[pieces], self.low[pieces], self.high[pieces] = place, place - extent, place + extent

    def inherit(self, old: ObjectTable, kept: npt.NDArray[np.integer[Any]]) -> None:
        """Enter what another table knew of pieces: (K, 2) their numbers here and there."""
        here, there = kept[:, 0], kept[:, 1]
        for name in _INHERITED:
            getattr(self, name)[here] = getattr(old, name)[there]
        self.axis = old.axis
        if self.bounds is None or old.bounds is None:
            return
        number = np.full(old.count, -1)
        number[there] = here
        measured = np.nonzero(old.bounds)
        ones, others = (number[pieces] for pieces in measured)
        both = (ones >= 0) & (others >= 0)
        ones, others = ones[both], others[both]
        # Kept for the smaller number first; numbers may have changed places.
        self.bounds[np.minimum(ones, others), np.maximum(ones, others)] = old.bounds[measured][both]

    def reset_travel(self) -> None:
        """Begin to count again, with nothing known of any pair."""
        self.travel[:] = 0.0
        self.memory[:] = 0
        if self.bounds is not None:
            self.bounds[self.bounds != 0.0] = 0.0

    def choose_axis(self) -> None:
        """Sort along the axis on which the pieces are spread the most, from now on."""
        there = self.active.astype(bool)
        if there.any():
            self.axis = int(np.argmax(self.place[there].std(axis=0)))

    def record_distance(self, i: int, j: int, distance: float) -> None:
        """Keep a measured distance of two pieces, i < j."""
        if self.bounds is not None:
            self.bounds[i, j] = distance + self.travel[i] + self.travel[j]

    def lower_bounds(self, ones: Indices, others: Indices) -> Floats:
        """Return lower bounds of the distances of pairs (K,), (K,), with ones < others, [m]."""
        between = self.place[others] - self.place[ones]
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
        """Return the distances of the spheres of some pieces from the boxes of others."""
        inside = np.einsum("kji,kj->ki", self.poses[boxes, :, :3], between)
        outside = np.maximum(np.abs(inside) - self.half[boxes], 0.0)
        distances: Floats = np.sqrt((outside**2).sum(axis=1)) - self.radius[spheres]
        # From inside the box there is nothing to be said.
        distances[~outside.any(axis=1)] = -np.inf
        return distances


LEAF_SIZE = 4
"""So many pieces are in a leaf."""


def build_static_tree(low: Floats, high: Floats, pieces: Indices) -> tuple[Floats, Indices]:
    """Return a full binary tree over pieces, halved along the longest edge again and again.

    Parameters
    ----------
    low, high
        (M, 3) the corners of the boxes around all pieces [m].
    pieces
        (K,) which of them are in the tree.

    Returns
    -------
    boxes, leaves
        (2 L - 1, 6) the corners of the box around all below a node k, whose children are 2 k + 1 and 2 k + 2;
        and (L, 4) the pieces of the leaves, which are the last L nodes; -1 for none.
    """
    count = 1
    while LEAF_SIZE * count < len(pieces):
        count *= 2
    leaves = np.full((count, LEAF_SIZE), -1, dtype=np.int32)
    parts = [(pieces, 0, count)]
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
    boxes = np.empty((2 * count - 1, 6))
    # A row more, which -1 finds: the box around nothing. There may be no piece at all.
    nothing = np.full((1, 3), np.inf)
    boxes[count - 1 :, :3] = np.concatenate([low, nothing])[leaves].min(axis=1)
    boxes[count - 1 :, 3:] = np.concatenate([high, -nothing])[leaves].max(axis=1)
    for k in range(count - 2, -1, -1):
        one, other = boxes[2 * k + 1], boxes[2 * k + 2]
        boxes[k, :3], boxes[k, 3:] = np.minimum(one[:3], other[:3]), np.maximum(one[3:], other[3:])
    return boxes, leaves


FURTHEST = 1e12
"""Nothing is put further than this from the origin, where numbers are 0.1 mm apart [m]."""

LONGEST_TRAVEL = 1e4
"""Up to this, bounds are right to some 1e-12 m [m]."""

PLACED, TRAVEL_EXCEEDED = -1, -2


def place_objects(table: ObjectTable, fresh: Floats) -> int:
    """Put the moving pieces at new poses (moving, 3, 4) and add to their travel.

    Returns the first piece whose pose is not finite or too far away, and then nothing has happened; otherwise
    :data:`PLACED`, or :data:`TRAVEL_EXCEEDED` if a piece's travel is above :data:`LONGEST_TRAVEL`.
    """
    bad = ~(np.abs(fresh) <= FURTHEST).all(axis=(1, 2))
    if bad.any():
        return int(np.argmax(bad))
    moving = np.arange(table.moving)
    before, old = table.place[moving], table.poses[moving, :, :3]
    table.poses[moving] = fresh
    table.update_boxes(moving)
    # The spectral norm of the difference of two rotations is its Frobenius norm by the root of 2.
    turned = np.sqrt(((fresh[:, :, :3] - old) ** 2).sum(axis=(1, 2)) / 2)
    shifted = np.sqrt(((table.place[moving] - before) ** 2).sum(axis=1))
    table.travel[moving] += shifted + table.radius[moving] * turned
    return TRAVEL_EXCEEDED if (table.travel[moving] > LONGEST_TRAVEL).any() else PLACED


def find_near_pairs(table: ObjectTable, reach: float, allowed: Flags | None = None) -> tuple[Indices, Floats]:
    """Return the pairs that may be within ``reach`` [m] of each other.

    Only active pieces of pairs of bodies that are looked at, or ``allowed``, (B, B), of which one moves; no
    pair is missing whose distance, when it was or would be measured, is at most ``reach``.

    Returns
    -------
    pairs, lows
        (K, 2) pieces, the smaller number first, in no particular order; (K,) lower bounds of distances [m].
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
    looked_at = table.allowed if allowed is None else allowed
    keep = (looked_at[table.body[ones], table.body[others]] == 1) & (ones < table.moving)
    ones, others = ones[keep], others[keep]
    gaps = np.maximum(table.low[ones] - table.high[others], table.low[others] - table.high[ones])
    keep = (np.maximum(gaps, 0.0) ** 2).sum(axis=1) <= reach * reach
    ones, others = ones[keep], others[keep]
    lows = table.lower_bounds(ones, others)
    keep = lows <= reach
    return np.stack([ones[keep], others[keep]], axis=1), lows[keep]


def rank_pairs(table: ObjectTable, pairs: Indices, distances: Floats, radius: float) -> npt.NDArray[np.int64]:
    """Return which pairs are the nearest ones of their bodies and within a radius [m], nearest first.

    Of equal distances that of the pieces, and then of the bodies, comes first that was there first.

    Parameters
    ----------
    pairs, distances
        (K, 2) pieces and (K,) how far apart they are [m].
    """
    owners = table.body[pairs]
    low, high = owners.min(axis=1, initial=len(table.allowed)), owners.max(axis=1, initial=0)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], high, low, distances))
    order = order[: np.searchsorted(distances[order], radius, side="right")]
    bodies = low[order].astype(np.int64) * len(table.allowed) + high[order]
    leading = np.unique(bodies, return_index=True)[1]
    return np.asarray(order[np.sort(leading)])


def gather_pairs(
    table: ObjectTable, pairs: Indices, distances: Floats, witnesses: Floats, order: npt.NDArray[np.int64]
) -> tuple[Indices, Indices, Floats, Floats]:
    """Return pieces (K, 2), their bodies (K, 2), distances and witnesses in an order.

    The first body of each pair is before the other in the model.
    """
    pairs, distances, witnesses = pairs[order], distances[order], witnesses[order]
    owners = table.body[pairs]
    turned = owners[:, 0] > owners[:, 1]
    pairs[turned], owners[turned] = pairs[turned, ::-1], owners[turned, ::-1]
    backwards = witnesses[turned]
    witnesses[turned] = np.hstack([backwards[:, 3:6], backwards[:, :3], -backwards[:, 6:]])
    return pairs, owners, distances, witnesses
