"""Gaps between pieces of furniture, one of which a robot moves, see :mod:`.object_motion`.

What a robot moves pushes other furniture along, and stops where that cannot yield. It does not push what
its contact jams: where the normal is 60° or more off the motion that a coordinate causes there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse.geometry.prepared_query import PreparedQuery
from kineverse.geometry.results import DistanceResults
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .furniture_overlaps import OVERLAP, FurnitureOverlaps
from .object_gaps import JAM, project_twists

RESTING = OVERLAP / 2
"""Depth beyond the allowance at which furniture stops [m]: shapes that rest on each other slide freely."""

_REACH = 0.001
"""Largest gap of pairs that have met [m]."""

Flags = npt.NDArray[np.bool_]


class FurnitureGaps(NamedTuple):
    """Gaps of pairs of shapes of furniture that meet."""

    distances: Array  # (K,) ways to where the shapes stop [m]
    rows: Array  # (K, n) derivatives by the displacement of objects
    jammed: Flags  # (K,) flags of contacts that move nothing
    moved: Flags  # (n,) flags of coordinates that move, those that are pushed along included


class FurnitureContacts:
    """Search of the gaps of furniture that moves."""

    def __init__(
        self,
        overlaps: FurnitureOverlaps,
        speeds: Sequence[Symbol],
        group: npt.NDArray[np.intp],
        twists: Callable[[], Array],
        link: Callable[[Flags], Flags],
    ) -> None:
        self._overlaps, self._speeds, self._group = overlaps, tuple(speeds), group
        self._twists, self._link = twists, link
        self._queries: dict[bytes, PreparedQuery] = {}
        self._met: set[int] = set()

    def begin(self) -> None:
        """Begin a motion, in which nothing has met anything so far."""
        self._met.clear()

    def measure(self, driven: Flags, moved: Flags) -> FurnitureGaps:
        """Return the gaps of what moves, and of what it pushes, to all that it has met in this motion."""
        n, moved = len(self._speeds), self._link(moved)
        while True:
            pairs = self._query(moved)(_REACH)
            index = self._select(pairs)
            if not len(index):
                return FurnitureGaps(np.zeros(0), np.zeros((0, n)), np.zeros(0, dtype=bool), moved)
            distances = (pairs.distances + self._overlaps.allowances(pairs))[index] + RESTING
            twists = self._twists()[:, :, :n]
            a, b = self._group[pairs.body_indices[index]].T
            normals, of_a, of_b = pairs.normals[index], twists[a], twists[b]
            rows = project_twists(normals, pairs.points_b[index], of_b)
            rows -= project_twists(normals, pairs.points_a[index], of_a)
            jammed, driven = np.zeros(len(index), dtype=bool), self._link(driven)
            for k in np.flatnonzero(distances < 0.0).tolist():
                relative, point = of_b[k] - of_a[k], pairs.points_b[index[k]]
                ways = np.linalg.norm(relative[:3] + np.cross(relative[3:].T, point).T, axis=0)
                yields = driven | (np.abs(rows[k]) >= JAM * ways)
                jammed[k] = not rows[k, yields].any()
                if not jammed[k]:
                    rows[k, ~yields] = 0.0
            pushed = (rows[distances < 0.0] != 0.0).any(axis=0) & ~moved
            if not pushed.any():
                rows[:, ~moved] = 0.0
                return FurnitureGaps(distances, rows, jammed, moved)
            moved = self._link(moved | pushed)

    def _select(self, pairs: DistanceResults) -> npt.NDArray[np.intp]:
        """Return the indices of the pairs that have met in this motion."""
        if not len(pairs):
            return np.zeros(0, dtype=np.intp)
        meets = pairs.distances + self._overlaps.allowances(pairs) < -RESTING
        if not self._met and not meets.any():
            return np.zeros(0, dtype=np.intp)
        codes = self._overlaps.encode(pairs).tolist()
        self._met.update(code for code, new in zip(codes, meets.tolist(), strict=True) if new)
        return np.array([k for k, code in enumerate(codes) if code in self._met], dtype=np.intp)

    def _query(self, moved: Flags) -> PreparedQuery:
        """Return the query for what some coordinates move, and counts since the start."""
        key = moved.tobytes() + self._overlaps.counting.tobytes()
        if key not in self._queries:
            speeds = [v for v, flag in zip(self._speeds, moved.tolist(), strict=True) if flag]
            self._queries[key] = self._overlaps.watch(speeds)
        return self._queries[key]
