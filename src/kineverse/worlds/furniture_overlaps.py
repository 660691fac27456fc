"""Overlaps of furniture that a motion made, beside those that are there by design.

Shapes of furniture overlap in many models and mean nothing by it: a drawer in a solid box, a hinge in its
frame. So two shapes overlap as far as their depth exceeds an allowance, which is the larger one of

- their depth at the start,
- their depth at the default state, so that a drawer may go back into its box.

Two shapes that overlap at the start or by default, and in all of 200 random states within limits, are made
so. Where all that moves them relative to each other has limits, any depth is allowed; else that at the start
or by default, and the least one of all states on top: a corner that turns in its place changes the depth.
Two shapes that are apart at the start and by default may not overlap at all, whatever the other states.

All pairs of shapes that objects move relative to each other count, also those of a door with its own frame,
but for pairs of bodies that a rule of the scene or of the model excepts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse.errors import NoSolutionError
from kineverse.geometry import Scene
from kineverse.geometry.collision_filter import adjacent_pairs, apply_rules
from kineverse.geometry.prepared_query import (
    PairFlags,
    PreparedQuery,
    flag_between,
    flag_relatively_moving,
)
from kineverse.geometry.results import DistanceResult, DistanceResults
from kineverse.lie import Array
from kineverse.model.body import Mesh
from kineverse.model.frame import is_of_robot
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.sampling import StateSamples
from kineverse.model.version_cache import cached_for_version
from kineverse.state import StateLike
from kineverse.symbols import Symbol

OVERLAP = 5e-4
"""Depth beyond the allowance from which on furniture overlaps [m]: less is a matter of shapes that rest."""

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
    """Overlaps of furniture in a scene, beside those that are there by design.

    The start is the default state until :meth:`begin` is called.

    Parameters
    ----------
    scene
        Collision scene of the model. The constructor leaves it at the default state.
    robot
        Prefix of the robot, which is no furniture; none if empty.
    strict
        Whether the default state excuses meshes alone. A primitive shape that is in the way there is in the
        way. A mesh is its hull, which fills a cupboard: where one overlaps something at the start or by
        default, any depth is allowed. So it is for bodies that overlap at the start and are joined by an
        articulation with limits, such as a cross in its fork.
    """

    def __init__(self, scene: Scene, robot: str, *, strict: bool = False) -> None:
        self.scene, self.robot, self._strict = scene, robot, strict
        self._objects = [v for v in scene.model.speeds if not self._is_of_robot(v.path)]
        self._query = self.watch(self._objects)
        # Scenes without rules of their own find the same.
        plain = len(scene.rules) == len(Scene(scene.model).rules)
        key = ("furniture overlaps", robot)
        design = cached_for_version(scene.model, key, self._sample) if plain else self._sample()
        self._default, self._play = design
        if strict:
            self._default = {pair: d for pair, d in self._default.items() if self._has_mesh(pair)}
        self._joined = adjacent_pairs(scene.model, scene.bodies)
        self._made_so = np.zeros_like(self._joined, dtype=bool)
        self._free = self._move_without_limits()
        self._allow(self._default)
        scene.update(scene.model.default_state())

    def watch(self, moving: list[Symbol], radius: float = 0.0) -> PreparedQuery:
        """Return the query for the near pairs of shapes of furniture that some speeds move relatively."""
        scene = self.scene

        def choose() -> PairFlags:
            bodies = scene.bodies
            furniture = np.array([not self._is_of_robot(b) for b in bodies], dtype=bool)
            flags = apply_rules(np.ones((len(bodies),) * 2, dtype=np.uint8), bodies, scene.rules)
            moved = flag_relatively_moving(scene.model, bodies, moving)
            return np.asarray(flags * moved * flag_between(furniture, furniture))

        return PreparedQuery(scene.collision_world, choose, radius, per_shape=True)

    def begin(self, *earlier: StateLike) -> None:
        """Take the state of the scene as the start; what overlaps in earlier states may do so as well."""
        depths, here = dict(self._default), self._depths()
        values = self.scene.collision_world.values
        for state in earlier:
            self.scene.update(state)
            _deepen(depths, self._depths())
        if earlier:
            self.scene.update(values)
        _deepen(depths, here)
        self._allow(depths)

    def find(self, least: float = OVERLAP) -> list[Overlap]:
        """Return the overlaps at the state of the scene beyond the allowance, the largest excess first.

        ``least`` is the excess from which on they count [m].
        """
        found = [Overlap(r.a, r.b, -r.distance, allowed) for r, allowed in self.find_beyond(least)]
        return sorted(found, key=lambda one: -one.excess)

    def find_beyond(self, excess: float) -> list[tuple[DistanceResult, float]]:
        """Return the pairs of shapes with a depth beyond their allowance by an excess [m], the deepest first.

        Each pair is there with its allowance [m].
        """
        found = self._query()
        allowed = self.allowances(found)
        beyond = np.flatnonzero(-found.distances > allowed + excess).tolist()
        return [(found[k], float(allowed[k])) for k in beyond]

    @property
    def excepted(self) -> tuple[tuple[str, str], ...]:
        """Pairs of bodies with an allowance."""
        bodies, owners = self.scene.bodies, self.scene.collision_world.table.body
        pairs = (self._decode(code) for code in self._codes.tolist())
        return tuple(dict.fromkeys((bodies[owners[i]], bodies[owners[j]]) for i, j in pairs))

    def allowances(self, found: DistanceResults) -> Array:
        """Return the depths that are allowed to pairs of shapes (K,) [m]."""
        if not len(self._codes) or not len(found):
            return np.zeros(len(found))
        codes = self.encode(found)
        place = np.minimum(np.searchsorted(self._codes, codes), len(self._codes) - 1)
        allowed = np.where(self._codes[place] == codes, self._allowed[place], 0.0)
        return np.where(self._made_so[tuple(found.body_indices.T)], math.inf, allowed)

    def _allow(self, depths: dict[int, float]) -> None:
        """Set the allowances from the largest depths by default and at the start."""
        pairs = sorted(depths)
        self._codes: Indices = np.array(pairs, dtype=np.int64)
        self._allowed = np.array([depths[pair] + self._play.get(pair, 0.0) for pair in pairs])
        if self._strict:
            self._allowed[[self._has_mesh(pair) for pair in pairs]] = math.inf
            self._made_so[:] = False
            for one, other in self.excepted:
                i, j = (self.scene.collision_world.body_index(b) for b in (one, other))
                joined = self._joined[i, j] and not self._free.moves_between(one, other)
                self._made_so[i, j] = self._made_so[j, i] = joined

    def _sample(self) -> tuple[dict[int, float], dict[int, float]]:
        """Return the depths by default, and the play of shapes that overlap everywhere, by pair of shapes."""
        scene, model = self.scene, self.scene.model
        home = model.default_state()
        scene.update(home)
        found, default = self._query(), self._depths()
        bodies = dict(zip(default, found.body_indices.tolist(), strict=True))
        least = dict(default)
        samples = StateSamples(model, count=_SAMPLES)
        columns = {s: samples.values_of(s) for s in scene.inputs if not self._is_of_robot(s.path)}
        for k in range(samples.size):
            if not least:
                break
            try:
                scene.update(home.updated({s: float(values[k]) for s, values in columns.items()}))
            except NoSolutionError:  # a loop does not close there
                continue
            here = self._depths()
            least = {pair: min(depth, here[pair]) for pair, depth in least.items() if pair in here}
        free = self._move_without_limits()
        for pair in least:
            one, other = (scene.bodies[k] for k in bodies[pair])
            if not free.moves_between(one, other):
                least[pair] = math.inf
        return default, least

    def _move_without_limits(self) -> FrameDependence:
        """Return what the coordinates of furniture without limits move."""
        model = self.scene.model
        free = [
            s for s in (v.position for v in self._objects) if not all(map(math.isfinite, model.limits(s)))
        ]
        return FrameDependence(model, [s.derivative() for s in free])

    def _depths(self) -> dict[int, float]:
        """Return the depths of the pairs of shapes that overlap at the state of the scene [m]."""
        found = self._query()
        return dict(zip(self.encode(found).tolist(), (-found.distances).tolist(), strict=True))

    def encode(self, found: DistanceResults) -> Indices:
        """Return a number for each pair of shapes (K,)."""
        pairs = np.sort(found.object_indices, axis=1).astype(np.int64)
        return np.asarray(pairs[:, 0] * len(self.scene.collision_world.objects) + pairs[:, 1])

    def _decode(self, code: int) -> tuple[int, int]:
        """Return the indices of both shapes of a pair."""
        return divmod(code, len(self.scene.collision_world.objects))

    def _has_mesh(self, code: int) -> bool:
        objects = self.scene.collision_world.objects
        return any(isinstance(objects[k].shape.geometry, Mesh) for k in self._decode(code))

    def _is_of_robot(self, name: str) -> bool:
        return bool(self.robot) and is_of_robot(name, self.robot)


def _deepen(depths: dict[int, float], others: dict[int, float]) -> None:
    """Raise depths to other ones, by pair of shapes."""
    for pair, depth in others.items():
        depths[pair] = max(depth, depths.get(pair, 0.0))
