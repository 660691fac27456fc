"""Selection of contact points of a push: ranking, progress, and points that were given up."""

from __future__ import annotations

import math

import numpy as np

from kineverse.lie import Array
from kineverse.state import State

from .contact_points import PushContacts, PushPoint, PushSurface
from .vectors import Vector, length

CONE, CONE_END = math.cos(math.radians(25.0)), math.cos(math.radians(40.0))  # to choose, and to keep
_DISTANCE_COST, _GIVEN_UP_COST = 0.5, 0.6
"""Cost of a contact point by its distance from the tip [1/m], and by the times that it was given up."""
_SURROUNDINGS = 0.1  # distance within which other points count as given up, too [m]
_OUT_OF_REACH = 0.02
"""Distance of the tip from a point that is given up from which on points beyond are out of reach, too [m]."""
_BLOCKED_STEPS = 60
_BLOCKED_WAY = 0.004
_MOST_JAMMED = 3  # number of contact points at which the object does not move before it counts as jammed


class ContactSelection:
    """Contact point at which an object is pushed, and those that were given up."""

    def __init__(self, surface: PushSurface) -> None:
        self._surface = surface
        self.reset()

    def reset(self) -> None:
        """Forget all contact points."""
        self.chosen: int | None = None
        self.contacts = self.blocked = self.jammed = 0
        self._given_up: dict[int, int] = {}
        self._out_of_reach: list[tuple[int, Array]] = []
        self.restart()

    def restart(self) -> None:
        """Start counting progress again."""
        self._best, self._since = math.inf, 0

    @property
    def is_jammed(self) -> bool:
        """True if the object did not move at several contact points."""
        return self.jammed >= _MOST_JAMMED

    def score(self, points: PushContacts) -> Array:
        """Return how well the object can be pushed at each point (N,)."""
        inside = points.alignment > CONE
        return np.asarray(
            np.where(inside, 0.0, -3.0)
            + points.alignment
            + np.minimum(points.leverage, 0.8)
            + 0.7 * self._surface.room
        )

    def rank(self, state: State, tip: Vector, limit: float) -> list[int]:
        """Return contact points at a state, the best first, each some distance from better ones [m]."""
        points = self._surface.at(state)
        score = self.score(points) - _DISTANCE_COST * np.sqrt(
            ((points.points - np.array(tip)) ** 2).sum(axis=1)
        )
        for k, times in self._given_up.items():
            near = ((points.points - points.points[k]) ** 2).sum(axis=1) < _SURROUNDINGS**2
            score = score - np.where(near, _GIVEN_UP_COST * times, 0.0)
        for k, rest in self._out_of_reach:
            beyond = (points.points - points.points[k]) @ rest > 0.0
            score = score - np.where(beyond, _GIVEN_UP_COST, 0.0)
        ranked: list[int] = []
        while score.max() > -math.inf:
            best = int(np.argmax(score))
            ranked.append(best)
            near = ((points.points - points.points[best]) ** 2).sum(axis=1) < limit**2
            score = np.where(near, -math.inf, score)
        return ranked

    def choose(self, state: State, tip: Vector, index: int | None = None) -> PushPoint:
        """Choose a contact point, by default the best, and return it."""
        self.chosen = self.rank(state, tip, math.inf)[0] if index is None else index
        self.contacts += 1
        self.restart()
        return self._surface.point_at(state, self.chosen)

    def give_up(self, touching: bool, rest: Vector) -> None:
        """Leave the present contact point for another one."""
        self.jammed += touching
        if self.chosen is not None:
            if length(rest) > _OUT_OF_REACH:
                self._out_of_reach.append((self.chosen, np.array(rest)))
            self._given_up[self.chosen] = self._given_up.get(self.chosen, 0) + 1
            self.blocked += 1
        self.chosen = None
        self.restart()

    def is_stuck(self, rest: float) -> bool:
        """Return True after a while without progress of a rest [m], [rad] that has to become 0."""
        if rest < self._best - _BLOCKED_WAY:
            self._best, self._since = rest, 0
        else:
            self._since += 1
        return self._since > _BLOCKED_STEPS
