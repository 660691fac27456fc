"""Overlaps of furniture that a motion caused, other than those at the start.

In many models shapes of furniture overlap without meaning: a drawer in a solid box, a hinge in its
frame. Only overlaps that were not there at the start count. Shapes overlap from 0.5 mm on, and:

- Two bodies that overlap at the start are *made to overlap*, and count no more at all, if an articulation
  with limits joins them, or if they overlap in all of 200 random states. Where something between them has no
  limits, the depth must not grow in these states either: a rod may turn in its sleeve, no door in its box.
- Of two other shapes that overlap at the start, the depth beyond the one at the start counts.
- A mesh is its hull, which fills a cupboard. Where one overlaps something at the start or at the default
  state, that pair of shapes counts no more.
- Everything else counts, a door and its own frame included, but for pairs of bodies that a rule of the scene
  or of the model excepts.

Skills that look ahead, the kinematic world, metrics, and the execution of unlocking plans share this
rule. The default state excuses nothing but hulls: a drawer that stands fully out of a solid box at the start
is in its way.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse.errors import NoSolutionError
from kineverse.geometry import Scene
from kineverse.geometry.collision_filter import adjacent_pairs, apply_rules
from kineverse.geometry.distance_queries import PairFlags, PreparedQuery, flag_between, flag_relatively_moving
from kineverse.geometry.results import DistanceResult, DistanceResults
from kineverse.lie import Array
from kineverse.model.body import Mesh
from kineverse.model.sampling import StateSamples
from kineverse.model.symbolic_view import cached_for_version
from kineverse.state import StateLike
from kineverse.symbols import Symbol

from .robot import Robot

OVERLAP = 5e-4  # depth from which on furniture overlaps, beyond the allowance [m]: less is resting

_SAMPLES = 200

Indices = npt.NDArray[np.int64]


class Overlap(NamedTuple):
    """Two bodies of furniture that overlap, the depth of their shapes, and what is allowed of it [m]."""

    a: str
    b: str
    depth: float
    allowed: float

    @property
    def excess(self) -> float:
        """Depth beyond the allowance [m]."""
        return self.depth - self.allowed


class FurnitureOverlaps:
    """Overlaps of furniture in a scene, other than those at the start.

    The start is the default state until :meth:`begin` is called. Without a robot all bodies are furniture.
    """

    def __init__(self, scene: Scene, robot: Robot | None) -> None:
        self.scene = scene
        self._robot = robot = None if robot is None or robot.is_mechanism else robot
        self._objects = [v for v in scene.model.speeds if robot is None or not robot.moves(v)]
        self.counting = np.ones((len(scene.bodies),) * 2, dtype=bool)
        self._query = self.watch(self._objects)
        # Scenes without rules of their own find the same.
        plain = len(scene.rules) == len(Scene.of(scene.model).rules)
        key = (
            "furniture overlaps",
            None if robot is None else robot.name,
            *scene.bodies,
            len(scene.collision_world.objects),
        )
        self._by_default, self._always = (
            cached_for_version(scene.model, key, self._sample) if plain else self._sample()
        )
        scene.update(scene.model.default_state())
        self.begin()

    def watch(self, moving: list[Symbol], radius: float = 0.0) -> PreparedQuery:
        """Return the query for the near pairs of shapes of furniture that some speeds move relatively.

        Bodies that are made to overlap are left out, as of now.
        """
        scene, counting = self.scene, self.counting.copy()

        def choose() -> PairFlags:
            bodies, robot = scene.bodies, self._robot
            furniture = np.array([robot is None or not robot.owns(b) for b in bodies], dtype=bool)
            flags = apply_rules(np.ones((len(bodies),) * 2, dtype=np.uint8), bodies, scene.rules)
            moved = flag_relatively_moving(scene.model, bodies, moving)
            return np.asarray(flags * moved * flag_between(furniture, furniture) * counting)

        return PreparedQuery(scene.collision_world, choose, radius, per_shape=True)

    def begin(self, *earlier: StateLike) -> None:
        """Take the state of the scene as the start; what overlaps in earlier states may do so as well."""
        self._depths = self._measure()
        values = self.scene.collision_world.values
        for state in earlier:
            self.scene.update(state)
            for pair, depth in self._measure().items():
                self._depths[pair] = max(depth, self._depths.get(pair, 0.0))
        if earlier:
            self.scene.update(values)
        self._allow()

    def find(self, least: float = OVERLAP) -> list[Overlap]:
        """Return the overlaps at the state of the scene beyond the allowance, the largest excess first.

        ``least`` is the excess from which on they count [m].
        """
        result = [Overlap(r.a, r.b, -r.distance, allowed) for r, allowed in self.find_beyond(least)]
        return sorted(result, key=lambda one: -one.excess)

    def find_beyond(self, excess: float) -> list[tuple[DistanceResult, float]]:
        """Return the pairs of shapes with a depth beyond their allowance by an excess [m], the deepest first.

        Each pair is there with its allowance [m].
        """
        result = self._query()
        allowed = self.allowances(result)
        beyond = np.flatnonzero(-result.distances > allowed + excess).tolist()
        return [(result[k], float(allowed[k])) for k in beyond]

    @property
    def excepted(self) -> tuple[tuple[str, str], ...]:
        """Pairs of bodies with an allowance."""
        bodies = self.scene.bodies
        pairs = (self._owners(code) for code in self._codes.tolist())
        return tuple(dict.fromkeys((bodies[i], bodies[j]) for i, j in pairs))

    def allowances(self, found: DistanceResults) -> Array:
        """Return the depths that are allowed to pairs of shapes (K,) [m]."""
        if not len(self._codes) or not len(found):
            return np.zeros(len(found))
        codes = self.encode(found)
        place = np.minimum(np.searchsorted(self._codes, codes), len(self._codes) - 1)
        allowed = np.where(self._codes[place] == codes, self._allowed[place], 0.0)
        return np.where(self.counting[tuple(found.body_indices.T)], allowed, math.inf)

    def _allow(self) -> None:
        depths = dict.fromkeys(self._by_default, math.inf)
        made_so = np.zeros_like(self.counting)
        for code, depth in self._depths.items():
            depths[code] = math.inf if self._has_mesh(code) else depth
            one, other = self._owners(code)
            if self._always[one, other]:
                made_so[one, other] = made_so[other, one] = True
        self._codes: Indices = np.array(sorted(depths), dtype=np.int64)
        self._allowed = np.array([depths[code] for code in sorted(depths)])
        # Bodies all of whose shapes have any depth count no more, too.
        free = np.zeros(self.counting.shape, dtype=int)
        for code in self._codes[np.isinf(self._allowed)].tolist():
            free[self._owners(code)] += 1
        shapes = np.bincount(self.scene.collision_world.table.body, minlength=len(free))
        self.counting = ~(made_so | (free + free.T >= np.outer(shapes, shapes)))

    def _sample(self) -> tuple[list[int], npt.NDArray[np.bool_]]:
        """Return the pairs of shapes with a mesh that overlap by default, and (B, B) flags of bodies.

        These are the bodies that are made to overlap if they do so at the start.
        """
        scene, model, robot = self.scene, self.scene.model, self._robot
        home = model.default_state()
        scene.update(home)
        default = self._measure()
        endless = [v for v in self._objects if not all(map(math.isfinite, model.limits(v.position)))]
        limited = ~flag_relatively_moving(model, scene.bodies, endless)
        always = limited & adjacent_pairs(model, scene.bodies).astype(bool)
        most = {
            pair: math.inf if limited[pair] else depth + OVERLAP
            for pair, depth in self._deepest(default).items()
            if not always[pair]
        }
        samples = StateSamples(model, count=_SAMPLES)
        free = [s for s in scene.inputs if robot is None or not robot.moves(s)]
        columns = {s: samples.values_of(s) for s in free}
        for k in range(samples.size):
            if not most:
                break
            try:
                scene.update(home.updated({s: float(values[k]) for s, values in columns.items()}))
            except NoSolutionError:  # a loop does not close there
                continue
            here = self._deepest(self._measure())
            most = {pair: depth for pair, depth in most.items() if 0.0 < here.get(pair, 0.0) <= depth}
        for i, j in most:
            always[i, j] = always[j, i] = True
        return [code for code in default if self._has_mesh(code)], always

    def _deepest(self, depths: dict[int, float]) -> dict[tuple[int, int], float]:
        """Return the largest depths [m] by pair of bodies, of those by pair of shapes."""
        result: dict[tuple[int, int], float] = {}
        for code, depth in depths.items():
            pair = self._owners(code)
            result[pair] = max(depth, result.get(pair, 0.0))
        return result

    def _measure(self) -> dict[int, float]:
        """Return the depths of the pairs of shapes that overlap at the state of the scene [m]."""
        result = self._query()
        pairs = zip(self.encode(result).tolist(), (-result.distances).tolist(), strict=True)
        return {code: depth for code, depth in pairs if depth > OVERLAP}

    def encode(self, found: DistanceResults) -> Indices:
        """Return a number for each pair of shapes (K,)."""
        pairs = np.sort(found.object_indices, axis=1).astype(np.int64)
        return np.asarray(pairs[:, 0] * len(self.scene.collision_world.objects) + pairs[:, 1])

    def _decode(self, code: int) -> tuple[int, int]:
        return divmod(code, len(self.scene.collision_world.objects))

    def _owners(self, code: int) -> tuple[int, int]:
        """Return the indices of the bodies of a pair of shapes, the smaller one first."""
        i, j = self.scene.collision_world.table.body[list(self._decode(code))].tolist()
        return min(i, j), max(i, j)

    def _has_mesh(self, code: int) -> bool:
        objects = self.scene.collision_world.objects
        return any(isinstance(objects[k].shape.geometry, Mesh) for k in self._decode(code))
