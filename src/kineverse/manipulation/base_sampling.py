"""Sampling of mobile bases: random places in front of a point to reach."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from kineverse.geometry import Scene
from kineverse.lie import Array
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Robot

_NEAREST, _FARTHEST = 0.3, 1.1  # distance of a base from the point that the hand has to reach [m]
_SIDE, _TURN = math.radians(110.0), math.radians(60.0)  # of base from hand, of its front from the point [rad]


class BaseSampler:
    """Random places of a mobile base at which it touches nothing, as far as there are some."""

    def __init__(self, scene: Scene, robot: Robot, base: Sequence[Symbol], margin: float) -> None:
        self.base, self._scene = tuple(base), scene
        others = [b for b in scene.bodies if not robot.owns(b)]
        carried = [b for b in scene.bodies if robot.owns(b) and {*scene.model.symbols_of(b)} <= {*base}]
        self._watch = scene.watch(carried, others, margin) if base and carried else None

    def draw(
        self,
        random: np.random.Generator,
        states: Sequence[State],
        points: Array,
        directions: Array,
        tries: int = 5,
    ) -> Array:
        """Return places (B, 3) of the base: x [m], y [m] and angle [rad]."""
        places = self._draw(random, points, directions)
        for _ in range(tries - 1):
            hits = self.find_touching(states, places)
            if not hits.any():
                break
            places[hits] = self._draw(random, points[hits], directions[hits])
        return places

    def find_touching(self, states: Sequence[State], places: Array) -> npt.NDArray[np.bool_]:
        """Return flags (B,) of places (B, 3) at which the base is too near to something in a state."""
        return np.array([any(self._touches(state, place) for state in states) for place in places.tolist()])

    def _touches(self, state: State, place: Sequence[float]) -> bool:
        if self._watch is None:
            return False
        self._scene.update(state.updated(dict(zip(self.base, place, strict=True))))
        return len(self._watch()) > 0

    def _draw(self, random: np.random.Generator, points: Array, directions: Array) -> Array:
        count = len(points)
        angle = np.arctan2(directions[:, 1], directions[:, 0]) + random.uniform(-_SIDE, _SIDE, count)
        from_above = np.hypot(*directions.T) <= 0.02
        angle = np.where(from_above, random.uniform(-math.pi, math.pi, count), angle)
        distance = random.uniform(_NEAREST, _FARTHEST, count)
        turn = random.uniform(-_TURN, _TURN, count)
        at = points + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return np.column_stack([at, angle + math.pi + turn])
