"""Compiled searches: RRT-Connect and shortcuts over a collision checker."""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import numpy as np

from .bindings import FOUND, SearchStruct, planning_functions
from .checker import LEAST_INFLATION, RESOLUTION, CollisionChecker
from .manifold import Manifold
from .obstacles import Floats32

RANGE = 1.0
"""Largest length of an edge of a tree [rad], [m]; longer where a goal is thousands of them away."""
_MOST_NODES = 200_000
MOST_EDGES = 1 << 40
"""Number of edges of a search that only its time ends."""
PATH_ROOM = 16_384
"""Largest number of points of a path."""


class SearchResult(NamedTuple):
    """Outcome of a search: points (N, n), whether they lead to a goal, and what was done."""

    points: Floats32
    status: int
    iterations: int
    nodes: tuple[int, int]
    gap: float

    @property
    def found(self) -> bool:
        """True if the points lead to a goal."""
        return self.status == FOUND


class RrtConnect:
    """RRT-Connect over a checker, in the whole space or on a manifold."""

    def __init__(self, checker: CollisionChecker, manifold: Manifold | None = None) -> None:
        self._checker, self._manifold, self._code = checker, manifold, planning_functions()
        self._path = np.empty((PATH_ROOM, len(checker.coordinates)), dtype=np.float32)
        self._struct = SearchStruct()

    def solve(
        self,
        starts: Floats32,
        goals: Floats32,
        seconds: float,
        seed: int,
        resolution: float = RESOLUTION,
        edges: int = MOST_EDGES,
    ) -> SearchResult:
        """Search a path from any of (S, n) starts to any of (G, n) goals."""
        s = self._setup(seconds, seed, resolution)
        s.nodes, s.most_edges = _MOST_NODES, edges
        count = self._code.kineverse_rrt_connect(
            ctypes.addressof(s), starts.ctypes.data, len(starts), goals.ctypes.data, len(goals),
            self._path.ctypes.data, PATH_ROOM,
        )  # fmt: skip
        points = self._path[:count].copy() if count > 0 else starts[:1]
        return SearchResult(points, s.status, s.iterations, (s.count_start, s.count_goal), s.gap)

    def shorten(self, points: Floats32, seconds: float, seed: int, patience: int) -> Floats32:
        """Return a shorter path: points on it are joined where the way between them is certainly free."""
        s = self._setup(seconds, seed, RESOLUTION)
        room = len(points) + 64
        work = np.zeros((room, points.shape[1]), dtype=np.float32)
        work[: len(points)] = points
        count = self._code.kineverse_shortcut(
            ctypes.addressof(s), work.ctypes.data, len(points), room, patience, LEAST_INFLATION
        )
        found = work[:count]
        apart = np.abs(np.diff(found, axis=0)).max(axis=1, initial=0.0) > 1e-6
        # The ends stay exact, whatever is dropped.
        keep = np.concatenate([[True], apart])
        keep[-1] = True
        return np.ascontiguousarray(found[keep])

    def contract(self, points: Floats32, seconds: float) -> Floats32:
        """Return a shorter path on the manifold: it contracts like a band, while its samples are free."""
        s = self._setup(seconds, 0, RESOLUTION)
        work = np.zeros((3 * len(points) + 64, points.shape[1]), dtype=np.float32)
        work[: len(points)] = points
        given = ctypes.addressof(s), work.ctypes.data, len(points), len(work)
        return work[: self._code.kineverse_relax(*given)]

    def _setup(self, seconds: float, seed: int, resolution: float) -> SearchStruct:
        s = self._struct
        s.checker = self._checker.address
        s.projection = None if self._manifold is None else self._manifold.address
        s.range, s.resolution, s.seconds, s.seed = RANGE, resolution, seconds, seed
        return s
