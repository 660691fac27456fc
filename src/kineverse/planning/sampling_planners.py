"""Sampling-based planners in C: RRT-Connect, and a probabilistic roadmap."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_count
from kineverse.compilation.batch import allocate_aligned
from kineverse.errors import InvalidValueError
from kineverse.symbols import Symbol

from .bindings import FOUND, RoadmapStruct, SearchStruct, planning_functions
from .collision_checker import LEAST_INFLATION, RESOLUTION, CollisionChecker
from .collision_geometry import Floats32
from .manifold import Manifold

RANGE = 1.0  # largest length of an edge of a tree [rad], [m]; longer where a goal is thousands of them away
_MOST_NODES = 200_000
MOST_EDGES = 1 << 40  # number of edges of a search that is limited by time alone
PATH_ROOM = 16_384  # largest number of points of a path


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
        """Shorten a path (N, n): join points on it by straight lines that are certainly free."""
        s = self._setup(seconds, seed, RESOLUTION)
        room = len(points) + 64
        work = np.zeros((room, points.shape[1]), dtype=np.float32)
        work[: len(points)] = points
        count = self._code.kineverse_shortcut(
            ctypes.addressof(s), work.ctypes.data, len(points), room, patience, LEAST_INFLATION
        )
        result = work[:count]
        keep = np.concatenate([[True], np.abs(np.diff(result, axis=0)).max(axis=1, initial=0.0) > 1e-6])
        keep[-1] = True  # the ends stay exact
        return np.ascontiguousarray(result[keep])

    def contract(self, points: Floats32, seconds: float) -> Floats32:
        """Contract a path on the manifold like a rubber band, while its samples are free."""
        s = self._setup(seconds, 0, RESOLUTION)
        work = np.zeros((3 * len(points) + 64, points.shape[1]), dtype=np.float32)
        work[: len(points)] = points
        count = self._code.kineverse_relax(ctypes.addressof(s), work.ctypes.data, len(points), len(work))
        return work[:count]

    def _setup(self, seconds: float, seed: int, resolution: float) -> SearchStruct:
        s = self._struct
        s.checker = self._checker.address
        s.projection = None if self._manifold is None else self._manifold.address
        s.range, s.resolution, s.seconds, s.seed = RANGE, resolution, seconds, seed
        return s


MOST_NODES = 20_000  # default largest number of nodes of a roadmap
_DEGREE, _MOST_DEGREE = 12, 64
_GREED = 5.0  # weight of the distance to the goal in a search: shortcuts make up for longer paths
_LEAST_BATCH = 32
_UNKNOWN, _BLOCKED = 0, 2
_PADDING = 64
_VISIT = np.dtype("i8, i8, f4, f4, i4, i4")  # state of a node: closed, seen, cost, rest, from, edge


class Roadmap:
    """Lazy probabilistic roadmap in the whole space, kept between queries.

    A query searches from both sides at once. Samples of an edge are checked when the search comes to it,
    and what is between them when it is on a path. If the sides do not meet, nodes are added: half of them
    anywhere, half about the side that has reached fewer. What is known of nodes and edges is kept as long
    as nothing moves but the coordinates; nodes stay even then. The same queries in the same order lead to
    the same paths, unless the time is up.

    It pays for many queries at one place through the same narrow passage: most searches into a cage take
    less than half of the time of RRT-Connect, once the first one has taken six times as long. In the open
    its median is up to 1.5 times as long, and its mean up to 2.3 times.

    Sources: Kavraki et al. 1996; Bohlin and Kavraki 2000 (lazy checks); Cohen, Phillips and Likhachev 2014
    (edges checked in the order of A*). There are as many neighbours for all numbers of nodes, since more
    did not pay here; with 2 e log N of them paths would become the shortest ones (Karaman and Frazzoli
    2011).
    """

    def __init__(
        self,
        symbols: Sequence[Symbol],
        turning: npt.NDArray[np.bool_],
        nodes: int = MOST_NODES,
        degree: int = _DEGREE,
    ) -> None:
        room, n = as_count("nodes", nodes, 256), len(turning)
        if not 1 <= as_count("degree", degree, 1) <= _MOST_DEGREE:
            raise InvalidValueError(f"degree is {degree}; it has to be at most {_MOST_DEGREE}.")
        if room * degree >= 2**31:
            limit = 2**31 // degree
            raise InvalidValueError(f"nodes is {nodes}; with {degree} edges each there may be {limit}.")
        self._symbols, self._turning = tuple(symbols), turning.copy()
        self._code = planning_functions()
        self._path = np.zeros((PATH_ROOM, n), dtype=np.float32)
        self._period = np.where(turning, 2 * np.pi, np.inf).astype(np.float32)
        # Columns are read in whole vectors, the last one included.
        columns = allocate_aligned((room + _PADDING) * n // 2 + 1).view(np.float32)
        self._arrays: dict[str, npt.NDArray[Any]] = {"period": self._period, "columns": columns}
        of_nodes: dict[str, npt.DTypeLike] = {"incoming": np.int32, "node": np.uint8, "passing": np.uint8}
        of_nodes |= dict.fromkeys(("visits_start", "visits_goal"), _VISIT)
        of_nodes |= dict.fromkeys(("order_start", "order_goal"), np.int32)
        of_edges = {"lengths": np.float32, "targets": np.int32, "next": np.int32, "edge": np.uint8}
        self._arrays |= {name: np.zeros(room, dtype=kind) for name, kind in of_nodes.items()}
        self._arrays |= {name: np.zeros(room * degree, dtype=kind) for name, kind in of_edges.items()}
        self._node, self._edge = self._arrays["node"], self._arrays["edge"]
        self._struct = s = RoadmapStruct(
            resolution=RESOLUTION, least=LEAST_INFLATION, greed=_GREED, degree=degree, room=room,
            least_batch=_LEAST_BATCH,
        )  # fmt: skip
        for name, array in self._arrays.items():
            setattr(s, name, array.ctypes.data)
        self._version: object = None
        self._margin = 0.0
        self.nodes_checked = self.edges_checked = 0

    def __len__(self) -> int:
        return int(self._struct.count)

    def suits(self, symbols: Sequence[Symbol], turning: npt.NDArray[np.bool_]) -> bool:
        """Return whether the roadmap is of n coordinates that turn fully where flags (n,) are set."""
        return self._symbols == tuple(symbols) and np.array_equal(self._turning, turning)

    def solve(
        self, checker: CollisionChecker, starts: Floats32, goals: Floats32, seconds: float, seed: int
    ) -> SearchResult:
        """Search a path from any of (S, n) starts to any of (G, n) goals.

        Coordinates that turn fully may end full turns away from a goal.
        """
        self._forget(checker)
        s = self._struct
        s.checker, s.seconds, s.seed = checker.address, seconds, seed
        count = self._code.kineverse_roadmap(
            ctypes.addressof(s), starts.ctypes.data, len(starts), goals.ctypes.data, len(goals),
            self._path.ctypes.data, len(self._path),
        )  # fmt: skip
        self.nodes_checked, self.edges_checked = s.nodes_checked, s.edges_checked
        points = self._path[:count].copy() if count > 0 else starts[:1]
        return SearchResult(points, s.status, s.samples, (s.reached_start, s.reached_goal), s.gap)

    def _forget(self, checker: CollisionChecker) -> None:
        """Forget results that another placement, other pairs or another margin may have changed."""
        margin, count = checker.struct.margin, len(self)
        for states in (self._node[:count], self._edge[: count * self._struct.degree]):
            if checker.version != self._version:
                states[:] = _UNKNOWN
            elif margin < self._margin:
                states[states == _BLOCKED] = _UNKNOWN
            elif margin > self._margin:
                states[states != _BLOCKED] = _UNKNOWN
        self._version, self._margin = checker.version, margin

    def describe(self) -> str:
        """Return how large the roadmap is and what the last query checked, as the end of a sentence."""
        return f" in a roadmap of {len(self)} nodes, of which {self.edges_checked} edges were checked"

    def __repr__(self) -> str:
        return f"<Roadmap: {len(self)} nodes of at most {self._struct.room}>"
