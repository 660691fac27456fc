"""Judgement of configurations and paths by the collision scene, in double precision."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kineverse.geometry import PreparedQuery, Rule, Scene
from kineverse.geometry.prepared_query import PairFlags
from kineverse.geometry.results import DistanceResult, DistanceResults
from kineverse.lie import Array
from kineverse.state import State
from kineverse.symbols import Symbol

from .path import densify, sample_along, sample_path

FINE = 1 / 640
"""Step of samples where no certificate vouches for what lies between them [rad], [m]."""
_UNCOVERED = 4 * FINE
"""Largest step of samples for pairs without spheres [rad], [m]: 6 mm at the edge of a door."""


class SceneJudge:
    """Contacts of configurations of some coordinates, by the scene.

    Parameters
    ----------
    scene
        The scene; it is left at the last configuration.
    coordinates
        The n coordinates that move.
    rules
        Rules about pairs that do not count.
    uncovered
        Pairs of bodies that nobody else checks: they are looked at more often.
    """

    def __init__(
        self,
        scene: Scene,
        coordinates: Sequence[Symbol],
        rules: Sequence[Rule],
        uncovered: Sequence[tuple[str, str]],
    ) -> None:
        self._scene, self._coordinates = scene, tuple(coordinates)
        excepted = {frozenset(rule[:2]) for rule in rules}
        left = [pair for pair in uncovered if frozenset(pair) not in excepted]
        moving = {s for a, b in left for s in scene.model.fk(a, b).symbols}
        self._concerned = np.array([s in moving for s in coordinates], dtype=bool)
        self._uncovered = PreparedQuery(scene.collision_world, lambda: self._flag(left), 0.0)
        self._query = scene.watch(moving=coordinates, rules=rules, radius=0.0)
        place = {s: k for k, s in enumerate(scene.inputs)}
        self._columns = np.array([place.get(s, -1) for s in coordinates], dtype=int)
        self._moved = self._columns >= 0
        self._values = np.zeros(len(scene.inputs))

    def place(self, state: State) -> None:
        """Set the values of everything else."""
        self._values[:] = state.vector(self._scene.inputs)

    def contacts(self, q: Array, radius: float = 0.0) -> DistanceResults:
        """Return the pairs of bodies within a radius [m] at a configuration (n,), deepest first."""
        self._update(q)
        return self._query(radius)

    def _update(self, q: Array) -> None:
        self._values[self._columns[self._moved]] = q[self._moved]
        self._scene.update(self._values)

    def _flag(self, pairs: Sequence[tuple[str, str]]) -> PairFlags:
        world = self._scene.collision_world
        flags = np.zeros_like(world.table.allowed)
        for a, b in pairs:
            i, j = world.body_index(a), world.body_index(b)
            flags[i, j] = flags[j, i] = 1
        return flags

    def first_contact(self, points: Array, step: float) -> tuple[Array, DistanceResult] | None:
        """Return the first sample of a polyline (N, n) with a contact, and the contact.

        Pairs that nobody else checks are looked at 160 times a unit at least.
        """
        if not len(points):
            return None
        found = self._first(self._query, sample_path(points, step))
        if found is not None:
            return found
        if not self._concerned.any():
            return None
        moved = np.abs(np.diff(points[:, self._concerned], axis=0)).sum(axis=1)
        return (
            None
            if not moved.any()
            else self._first(self._uncovered, sample_along(points, moved, min(step, _UNCOVERED)))
        )

    def _first(self, query: PreparedQuery, samples: Array) -> tuple[Array, DistanceResult] | None:
        """Return the first sample (N, n) with a contact, and the contact."""
        self._update(samples[0])
        k = query.first_within(self._coordinates, samples)
        return None if k is None else (samples[k], query()[0])

    def uncovered_contacts(self, q: Array) -> DistanceResults | None:
        """Return the touching pairs that nobody else checks, at a configuration (n,); None without any."""
        if not self._concerned.any():
            return None
        self._update(q)
        found = self._uncovered()
        return found if len(found) else None

    def free_interval(self, q: Array, column: int, lower: float, upper: float) -> tuple[float, float]:
        """Return bounds of a coordinate about a configuration (n,) between which these pairs are apart."""
        if not self._concerned.any():
            return lower, upper
        ends = []
        for bound in (lower, upper):
            values = np.linspace(q[column], bound, max(int(abs(bound - q[column]) / _UNCOVERED), 2))
            samples = np.tile(q, (len(values), 1))
            samples[:, column] = values
            self._update(q)
            k = self._uncovered.first_within(self._coordinates, samples)
            ends.append(float(q[column] if k == 0 else values[-1 if k is None else k - 1]))
        return min(ends), max(ends)

    def clearance(self, points: Array, step: float, radius: float = 0.5) -> float:
        """Return the least distance of a pair at samples of a polyline [m]; infinite beyond a radius."""
        samples = densify(points, step)
        self._update(samples[0])
        return self._query.least_distance(self._coordinates, samples, radius)


def describe_contacts(found: Sequence[DistanceResult], most: int = 3) -> str:
    """Return the names of touching pairs of bodies, and how deep they penetrate [mm]."""
    pairs = [f"'{f.a}' and '{f.b}' ({-1e3 * f.distance:.1f} mm deep)" for f in list(found)[:most]]
    more = f" and {len(found) - most} more pairs" if len(found) > most else ""
    return ", ".join(pairs) + more
