"""The table of pieces: where each is, what encloses it, how far it has moved, what is known of pairs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from .mesh_files import Floats
from .solids import Core

Indices: TypeAlias = npt.NDArray[np.int32]
Flags: TypeAlias = npt.NDArray[np.uint8]

MOST_CARRIED = 6000
"""Bounds are carried for so many pieces at most; memory is touched only for pairs that were measured."""

REMEMBERED = 2**13
"""So many pairs are not measured again where nothing has moved; a power of two."""

_MEMORY = np.dtype([("pair", np.int64), ("numbers", np.float64, 12)])

_TAKEN_OVER = (
    "active", "centre", "half", "radius", "poses", "travel",
    "corners", "corner_count", "edges", "radii", "round", "tip",
)  # fmt: skip


@dataclass(eq=False)
class Table:
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
        box, (M, 3) ellipsoid, (M,) ball and (M,) tip of its core [m]. See :class:`.solids.Core`, which has to
        outlive this.
    memory
        What C measured last, of each pair that has not given way to another one.
    order
        (M,) the moving pieces sorted along ``axis`` when that was last done, and then the others.
    sorted_boxes
        Room for C: the corners of the boxes of the moving pieces in that order, and a row of gaps.
    standing_changed
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
    native: Any = None
    standing_changed: bool = True

    def __post_init__(self) -> None:
        count = len(self.body)
        self.active = np.zeros(count, dtype=np.uint8)
        self.centre, self.half = np.zeros((count, 3)), np.zeros((count, 3))
        self.radius, self.travel = np.zeros(count), np.zeros(count)
        self.poses = np.tile(np.eye(4)[:3], (count, 1, 1))
        self.place, self.low, self.high = (np.zeros((count, 3)) for _ in range(3))
        self.corners, self.corner_count = np.zeros(count, dtype=np.uintp), np.full(count, -1, dtype=np.int64)
        self.edges, self.radii, self.round = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)
        self.tip, self.memory = np.zeros(count), np.zeros(REMEMBERED, dtype=_MEMORY)
        self.order = np.arange(count, dtype=np.int32)
        self.sorted_boxes = np.empty((7, self.moving))
        self.bounds = np.zeros((count, count)) if count <= MOST_CARRIED else None

    @property
    def count(self) -> int:
        """How many pieces there are."""
        return len(self.body)

    def give_solid(
        self, piece: int, centre: Floats, half: Floats, radius: float, core: Core | None = None
    ) -> None:
        """Enter what encloses a piece, and what it is."""
        self.centre[piece], self.half[piece], self.radius[piece] = centre, half, radius
        if core is not None:
            self.corners[piece], self.corner_count[piece] = core.corners.ctypes.data, core.corners.shape[1]
            self.edges[piece], self.radii[piece], self.round[piece] = core.half, core.radii, core.radius
            self.tip[piece] = core.tip
        self.active[piece] = 1
        self.put(np.array([piece]))

    def put(self, pieces: npt.NDArray[np.integer[Any]]) -> None:
        """Compute where pieces are from their poses."""
        self.standing_changed |= bool((pieces >= self.moving).any())
        rotation, position = self.poses[pieces, :, :3], self.poses[pieces, :, 3]
        place = np.einsum("kij,kj->ki", rotation, self.centre[pieces]) + position
        extent = np.einsum("kij,kj->ki", np.abs(rotation), self.half[pieces])
        self.place[pieces], self.low[pieces], self.high[pieces] = place, place - extent, place + extent

    def take_over(self, old: Table, kept: npt.NDArray[np.integer[Any]]) -> None:
        """Enter what another table knew of pieces: (K, 2) their numbers here and there."""
        here, there = kept[:, 0], kept[:, 1]
        for name in _TAKEN_OVER:
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

    def forget_travel(self) -> None:
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

    def remember(self, i: int, j: int, distance: float) -> None:
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
