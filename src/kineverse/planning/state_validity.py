"""Validity of configurations and paths by the collision scene, in double precision."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kineverse.compilation.build_queue import working_seconds
from kineverse.geometry import Rule, Scene
from kineverse.geometry.results import DistanceResult, DistanceResults
from kineverse.lie import Array
from kineverse.state import State
from kineverse.symbols import Symbol

from .collision_checker import LateCheckError
from .path import densify, sample_path

_AT_ONCE = 512
"""Number of samples after which the time is looked at."""


class SceneJudge:
    """Contacts of configurations of some coordinates, by the scene."""

    def __init__(self, scene: Scene, coordinates: Sequence[Symbol], rules: Sequence[Rule]) -> None:
        self._scene, self._coordinates = scene, tuple(coordinates)
        self._query = scene.watch(moving=coordinates, rules=rules, radius=0.0)
        place = {s: k for k, s in enumerate(scene.inputs)}
        self._columns = np.array([place.get(s, -1) for s in coordinates], dtype=int)
        self._moved = self._columns >= 0
        self._values = np.zeros(len(scene.inputs))
        self._state: State | None = None

    def place(self, state: State) -> None:
        """Set the values of everything else."""
        if state is not self._state:
            self._state = state
            self._values[:] = state.vector(self._scene.inputs)

    def contacts(self, q: Array, radius: float = 0.0) -> DistanceResults:
        """Return the pairs of bodies within a radius [m] at a configuration (n,), deepest first."""
        self._update(q)
        return self._query(radius)

    def _update(self, q: Array) -> None:
        self._values[self._columns[self._moved]] = q[self._moved]
        self._scene.update(self._values)

    def first_contact(
        self, points: Array, step: float, until: float = math.inf
    ) -> tuple[Array, DistanceResult] | None:
        """Return the first sample of a polyline (N, n) with a contact, and the contact."""
        if not len(points):
            return None
        samples = sample_path(points, step)
        for begin in range(0, len(samples), _AT_ONCE):
            some = samples[begin : begin + _AT_ONCE]
            self._update(some[0])
            k = self._query.first_within(self._coordinates, some)
            if k is not None:
                return some[k], self._query()[0]
            if working_seconds() > until:
                raise LateCheckError
        return None

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
