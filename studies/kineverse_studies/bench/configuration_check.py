"""Collision check of configurations and paths by a scene, in double precision."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from kineverse.geometry import Scene
from kineverse.lie import Array
from kineverse.state import StateLike
from kineverse.symbols import Symbol

CHECKS_PER_RADIAN = 32.0
"""Configurations that planners check over a motion of length 1 of all coordinates [1/rad], [1/m]."""

FINER = 20.0
"""Factor by which a returned path is sampled finer than that."""


class ConfigurationCheck:
    """Collision check of configurations, for planners that call Python for each of them."""

    def __init__(self, scene: Scene, symbols: Sequence[Symbol], state: StateLike | None = None) -> None:
        self.scene, self._symbols = scene, tuple(symbols)
        # Faster than the first contact of the scene, which asks about pairs that stand still as well.
        self._query = scene.watch(moving=symbols, radius=0.0)
        inputs = scene.inputs
        whole = scene.model.default_state()
        if state is not None:
            whole = whole.updated(state)
        self._values = np.array([whole[symbol] for symbol in inputs])
        place = {symbol: k for k, symbol in enumerate(inputs)}
        # A coordinate on which no pose depends is no input.
        self._columns = np.array([place[s] for s in symbols if s in place], dtype=int)
        self._kept = np.array([s in place for s in symbols], dtype=bool)

    def __call__(self, q: Sequence[float] | Array) -> bool:
        """Return True for a configuration without contacts of what the coordinates move."""
        self._values[self._columns] = np.asarray(q)[self._kept]
        self.scene.update(self._values)
        return len(self._query()) == 0

    def count_contacts(self, points: Array, density: float = FINER * CHECKS_PER_RADIAN) -> int:
        """Return the number of samples of a path that are in contact."""
        samples, contacts = interpolate_path(points, density), 0
        self(samples[0])
        while (k := self._query.first_within(self._symbols, samples)) is not None:
            samples, contacts = samples[k + 1 :], contacts + 1
        return contacts


def interpolate_path(points: Array, density: float) -> Array:
    """Return configurations (N, n) along a path of straight edges, its points included."""
    parts = [points[:1]]
    for a, b in pairwise(points):
        steps = max(1, int(np.ceil(density * np.linalg.norm(b - a))))
        parts.append(a + (b - a) * (np.arange(1, steps + 1) / steps)[:, None])
    return np.concatenate(parts)
