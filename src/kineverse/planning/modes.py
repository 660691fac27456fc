"""Planning through modes: moving freely, holding a handle, pressing a button (Hauser and Latombe 2010)."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_entries
from kineverse.compilation.build_queue import working_seconds
from kineverse.control.configuration_space import find_coordinates
from kineverse.control.tasks import Hold
from kineverse.errors import DuplicateNameError, InvalidValueError
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .collision_checker import BodyPairs
from .manifold import FrameHold
from .planning_scene import PlanningScene

_NO_PAIRS: BodyPairs = frozenset()
_CANDIDATES = 12
_BATCHES, _EDGES = 2, 2000
"""Effort for the configurations of one change of modes and for one path: numbers, so that the same seed
leads to the same path. Each round of the search has four times as much."""
_DEPTH = 4  # largest number of changes of modes in the first round; each round allows as many more
_SAME = 1e-4


@dataclass(frozen=True, eq=False)
class Mode:
    """Way in which some coordinates may move: a manifold of configurations.

    Parameters
    ----------
    name
        Name in results and messages.
    along
        Holds that are met in this mode, such as the grasp of a handle; none for moving freely.
    moves
        Coordinates of objects that move in this mode, as symbols or names. An object that is named by some
        mode stands still in all others. Coordinates that no mode names, such as those of the robot, always
        move.

    See Also
    --------
    kineverse.planning.Planner
    """

    name: str
    along: tuple[Hold, ...] = ()
    moves: tuple[Symbol | str, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise InvalidValueError(f"The name of a mode is a text, not {self.name!r:.80}.")
        moves = as_entries("moves=", self.moves, (str, Symbol), "coordinates, as symbols or names")
        object.__setattr__(self, "along", as_entries("along=", self.along, Hold, "holds, one or several"))
        object.__setattr__(self, "moves", moves)


@dataclass(frozen=True, slots=True)
class ModeSegment:
    """Part of a path in one mode: its points (N, n), and the pairs of bodies that may touch on it."""

    mode: Mode
    points: Array
    touching: BodyPairs


@dataclass(frozen=True, slots=True)
class ModePath:
    """Path through modes: its segments, the number of searches, and the problem without a goal."""

    segments: list[ModeSegment]
    iterations: int
    problem: str = ""


@dataclass(frozen=True, slots=True)
class _Node:
    """Configuration in a mode, and the segment by which it was reached."""

    mode: int
    q: Array
    parent: _Node | None
    points: Array
    touching: BodyPairs = frozenset()
    depth: int = 0

    def segments(self, modes: Sequence[Mode]) -> list[ModeSegment]:
        if self.parent is None:
            return []
        last = ModeSegment(modes[self.parent.mode], self.points, self.touching)
        return [*self.parent.segments(modes), last]


class ModeSearch:
    """Search of a path through modes: a tree of changes from one mode to another."""

    def __init__(
        self,
        scene: PlanningScene,
        modes: Iterable[Mode],
        tasks: Sequence[Hold],
        ends: Array | None,
        seconds: float,
        seed: int,
    ) -> None:
        self._scene = scene
        self._modes = as_entries("modes=", modes, Mode, "kv.planning.Mode, one or several")
        self._tasks, self._ends, self._seconds, self._seed = tasks, ends, seconds, seed
        if not self._modes:
            raise InvalidValueError("modes= takes kv.planning.Mode, one at least.")
        names = [mode.name for mode in self._modes]
        if len(set(names)) < len(names):
            raise DuplicateNameError(f"Two modes have one name: {', '.join(map(repr, names))}.")
        moved = [find_coordinates(scene.model, mode.moves, "moves") for mode in self._modes]
        objects = frozenset[Symbol]().union(*moved)
        foreign = objects - {*scene.space.symbols}
        if foreign:
            raise InvalidValueError(
                f"A mode moves {', '.join(map(repr, map(str, foreign)))}, which the planner does not: add it "
                "to move=."
            )
        self._objects = np.array([s in objects for s in scene.space.symbols], dtype=bool)
        still = [objects - movable for movable in moved]
        self._still = [np.array([s in each for s in scene.space.symbols], dtype=bool) for each in still]
        self._touching = [scene.touching_pairs(mode.along) for mode in self._modes]
        self._searches = 0
        self._generator = np.random.default_rng(seed)

    def run(self, q: Array) -> ModePath:
        """Search a path through the modes from a configuration (n,)."""
        self._end = working_seconds() + self._seconds
        first = self._find_mode(q)
        if first is None:
            names = ", ".join(mode.name for mode in self._modes)
            return ModePath([], 0, f"The start is in none of the modes {names}.")
        nodes = [_Node(first, q, None, q[None])]
        seen = {self._signature(nodes[0])}
        self._round, k, tried = 0, 0, 0
        while self._left() > 0.0:
            if k == len(nodes):
                # All are tried: again, with more effort and other values of the objects.
                k, self._round = 0, self._round + 1
                if tried == self._searches:
                    break
                tried = self._searches
            node = nodes[k]
            k += 1
            if node.depth > _DEPTH * (self._round + 1):
                continue
            last = self._reach_goal(node)
            if last is not None:
                return ModePath([*node.segments(self._modes), last], self._searches)
            for other in range(len(self._modes)):
                if other == node.mode or self._left() <= 0.0 or self._exclude(node.mode, other):
                    continue
                for values in self._object_values(node):
                    change = self._change(node, other, values)
                    if change is not None and self._signature(change) not in seen:
                        seen.add(self._signature(change))
                        nodes.append(change)
        best = max(nodes, key=lambda node: len(node.segments(self._modes)))
        reached = ", ".join(sorted({self._modes[node.mode].name for node in nodes}))
        problem = (
            f"No path through the modes was found in {self._seconds:g} s: {len(nodes) - 1} changes of modes "
            f"were reached, in {reached}. More seconds=, another place of the base, or other holds may help; "
            "plan() to the holds of one mode alone says what is in the way."
        )
        return ModePath(best.segments(self._modes), self._searches, problem)

    def _compile(self, holds: Sequence[Hold]) -> None:
        """Compile programs for holds; that happens once, so its time does not count."""
        begin = working_seconds()
        self._scene.manifold(holds)
        self._end += working_seconds() - begin

    def _left(self) -> float:
        return self._end - working_seconds()

    def _find_mode(self, q: Array) -> int | None:
        manifolds = (self._scene.manifold(mode.along) for mode in self._modes)
        met = (m is None or float(m.residuals(q[None])[0]) < 1e-2 for m in manifolds)
        return next(itertools.compress(itertools.count(), met), None)

    def _signature(self, node: _Node) -> tuple[object, ...]:
        """Return the mode of a node and the rounded places of the objects, by which nodes are told apart."""
        return node.mode, tuple(np.round(node.q[self._objects] / _SAME).astype(int).tolist())

    def _exclude(self, one: int, other: int) -> bool:
        """Return True if two modes would hold one frame at two others."""
        a, b = (
            {hold.frames[0]: hold.frames[1] for hold in self._modes[k].along if isinstance(hold, FrameHold)}
            for k in (one, other)
        )
        return any(a[frame] != b[frame] for frame in a.keys() & b.keys())

    def _object_values(self, node: _Node) -> list[Array]:
        """Choose coordinates for the next change of modes: objects at their limits first, then anywhere."""
        moving = self._objects & ~self._still[node.mode]
        if not moving.any():
            return [node.q]
        lower, upper = self._scene.space.bounds(node.q, node.q[None])
        count = len(node.q)
        shares = [self._generator.random(count)] if self._round else [np.ones(count), np.zeros(count)]
        return [np.where(moving, lower + share * (upper - lower), node.q) for share in shares]

    def _change(self, node: _Node, other: int, values: Array) -> _Node | None:
        """Search a node in another mode, with the objects at the values of some coordinates."""
        mode = self._modes[node.mode]
        holds = tuple(dict.fromkeys((*mode.along, *self._modes[other].along)))
        touching = self._touching_around(node) | self._touching[other]
        ends = self._solve(holds, values, touching, self._objects) if holds else values[None]
        points = self._connect(node, ends, touching)
        if points is None:
            return None
        return _Node(other, np.asarray(points[-1]), node, points, touching, node.depth + 1)

    def _touching_around(self, node: _Node) -> BodyPairs:
        """Return the pairs that may touch in a node's mode, and where it was entered."""
        before = _NO_PAIRS if node.parent is None else self._touching[node.parent.mode]
        return before | self._touching[node.mode]

    def _reach_goal(self, node: _Node) -> ModeSegment | None:
        still, mode = self._still[node.mode], self._modes[node.mode]
        touching = self._touching_around(node) | self._scene.touching_pairs(self._tasks)
        if self._ends is not None:
            ends = self._ends[np.abs(self._ends - node.q)[:, still].max(axis=1, initial=0.0) < _SAME].copy()
            ends[:, still] = node.q[still]
        elif self._concerns_still(node):
            return None
        else:
            ends = self._solve((*mode.along, *self._tasks), node.q, touching, still)
        points = self._connect(node, ends, touching)
        return None if points is None else ModeSegment(mode, points, touching)

    def _concerns_still(self, node: _Node) -> bool:
        """Return True if a task is about objects that do not move in the mode, and is not met."""
        moving = set(itertools.compress(self._scene.space.symbols, ~self._still[node.mode]))
        for task in self._tasks:
            if moving.isdisjoint(self._scene.model.rates.resolve(task.expression).symbols):
                manifold = self._scene.manifold([task])
                if manifold is not None and float(manifold.residuals(node.q[None])[0]) > _SAME:
                    return True
        return False

    def _solve(
        self, holds: Sequence[Hold], near: Array, touching: BodyPairs, still: npt.NDArray[np.bool_]
    ) -> Array:
        self._searches += 1
        self._compile(holds)
        seed, batches = self._seed + self._searches, _BATCHES * 4**self._round
        return self._scene.solutions(
            holds, near, _CANDIDATES, max(self._left(), 0.0), seed, touching, still, batches
        )

    def _connect(self, node: _Node, ends: Array, touching: BodyPairs) -> Array | None:
        if not len(ends):
            return None
        self._searches += 1
        mode, still, edges = self._modes[node.mode], self._still[node.mode], _EDGES * 4**self._round
        self._compile(mode.along)
        left = max(self._left(), 0.0)
        path = self._scene.between(
            node.q, ends, mode.along, touching, left, self._seed, still, edges, around=self._round > 0
        )
        return path.points if path.found else None
