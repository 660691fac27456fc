"""Drives of a base that rolls on wheels: turns on the spot and straight lines between furniture.

Such a base has fewer speeds than coordinates, so a straight path between two configurations would slip. The
paths are searched on a lattice of places with eight headings (Dijkstra), in a tree that serves several goals.
From places near a goal a direct leg (a turn, a line and a turn) is tried, as in hybrid A* (Dolgov, Thrun,
Montemerlo and Diebel, IJRR 29, 2010).
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from kineverse.geometry import Scene
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

from .skill_run import SkillRun

_SPEED, _TURN = 0.3, 0.8  # largest speeds of a drive [m/s], [rad/s]
_ACCELERATION = 0.5  # acceleration and deceleration [m/s²], [rad/s²]
_SHARE = 0.8  # share of the limits of speeds that a drive takes
_GRID, _HEADINGS = 0.15, 8  # distance of neighbouring places of the lattice [m], and number of headings
_FINE, _FINE_TURN = 0.02, math.radians(2.0)  # distances of the places of a path that are checked [m], [rad]
_NEAR, _MOST_LEGS = 0.5, 40  # distance from a goal [m], and number of known places, for direct legs
_MOST_PLACES = 3000  # largest number of places of the lattice from one start
_ARRIVED, _TURNED = 5e-4, 5e-4  # errors at the end of a line and of a turn [m], [rad]
_CROSS, _HEADING = 3.0, 4.0  # gains: heading by distance from the line [rad/m], rate by heading [1/s]
_STEERING = 0.25  # share of the speed of turns that steers along a line
_START_SHARE = 0.8  # share of the distance at the start that a drive keeps, where it is less than the margin
_EXACT = 1e-9

Place: TypeAlias = tuple[float, float, float]  # place of a base: x [m], y [m] and angle [rad]
_Key: TypeAlias = tuple[int, int, int]  # steps ahead and to the left of the start, number of the heading


class BaseDrive:
    """Drives of a base on wheels."""

    def __init__(
        self,
        model: ModelView,
        base: Sequence[Symbol],
        scene: Scene,
        robot_bodies: Sequence[str],
        others: Sequence[str],
        margin: float,
    ) -> None:
        self._model, self.base = model, tuple(base)
        self._scene, self._watch = scene, scene.watch(robot_bodies, others, margin)
        rates = [model.rates.get(s, {}) for s in base]
        self._speeds = tuple(dict.fromkeys(v for row in rates for v in row))
        here = State(dict.fromkeys((*model.symbols, *model.speeds), 0.0))
        B = np.array([[float(row[v](here)) if v in row else 0.0 for v in self._speeds] for row in rates])
        B = B.reshape(3, len(self._speeds))
        # The rates at the angle 0: along x, and of the angle alone.
        wanted = np.eye(3)[:, [0, 2]]
        motions = np.linalg.pinv(B) @ wanted
        self.is_possible = bool(np.abs(B @ motions - wanted).max(initial=0.0) < _EXACT) and bool(rates[0])
        self._straight, self._turn = motions.T
        wanted_speeds = (_SPEED, _TURN)
        self._most = tuple(
            min(speed, _SHARE * self._find_limit(motion, here))
            for motion, speed in zip(motions.T, wanted_speeds, strict=True)
        )

    def _find_limit(self, motion: Array, here: State) -> float:
        """Return the largest multiple of a motion of the wheels within the limits of their speeds."""
        rolling = here.updated(dict(zip(self._speeds, motion.tolist(), strict=True)))
        most = math.inf
        for limit in self._model.constraints.values():
            if {*self._speeds}.isdisjoint(limit.expression.symbols):
                continue
            value = float(limit.expression(rolling))
            if abs(value) > _EXACT:
                most = min(most, float((limit.upper if value > 0.0 else limit.lower)(here)) / value)
        return most

    def search(self, state: State) -> DriveSearch:
        """Return the search of paths from the place of a state, with everything else as there."""
        start = tuple(float(state[s]) for s in self.base)
        assert len(start) == 3
        speed, turn = self._most
        self._scene.update(state)
        near = self._watch()
        # A hand that has just let go may be nearer than the margin.
        margin = min(self._watch.radius, _START_SHARE * near[0].distance) if len(near) else self._watch.radius

        def place() -> None:
            self._scene.update(state)

        def is_free(Q: Array) -> bool:
            return margin >= 0.0 and self._watch.first_within(self.base, Q, margin) is None

        return DriveSearch(start, place, is_free, speed, turn)

    def follow(self, run: SkillRun, places: Array) -> None:
        """Drive along places (K, 3), between which the base either turns or rolls straight on."""
        for start, end in pairwise(places):
            away = end[:2] - start[:2]
            length = float(np.hypot(*away))
            self._roll(run, start, end, length)

    def _roll(self, run: SkillRun, start: Array, end: Array, length: float) -> None:
        """Turn to the angle of a place, or roll straight on to it."""
        along = (end[:2] - start[:2]) / length if length > _EXACT else np.zeros(2)
        heading = np.array([math.cos(end[2]), math.sin(end[2])])
        direction = 1.0 if along @ heading >= 0.0 else -1.0
        session, speed, rest, last = run.session, 0.0, math.inf, run.session.time
        most = self._most[0 if length > _EXACT else 1]
        while True:
            x, y, angle = (session.state[s] for s in self.base)
            offset = np.array([x, y]) - end[:2]
            turned = _wrap(end[2] - angle)
            before, rest = rest, float(-along @ offset) if length > _EXACT else abs(turned)
            if session.time - last > session.interface.timeout:  # by now it has stopped by itself
                speed, before = 0.0, math.inf
            last = session.time
            # Near the end noise may keep the error above its tolerance: no progress ends the leg as well.
            if rest < (_ARRIVED if length > _EXACT else _TURNED) or (speed < 0.02 and rest > before):
                return
            speed = min(most, speed + _ACCELERATION * session.dt, math.sqrt(2.0 * _ACCELERATION * rest))
            speed = min(speed, rest / session.dt)
            if length > _EXACT:
                aside = float(along[0] * offset[1] - along[1] * offset[0])
                wanted = end[2] - math.atan(_CROSS * aside)
                steering = _STEERING * self._most[1]
                rate = min(max(_HEADING * _wrap(wanted - angle), -steering), steering)
                rolling = direction * speed
            else:
                rate, rolling = math.copysign(speed, turned), 0.0
            vector = rolling * self._straight + rate * self._turn
            run.act(dict(zip(self._speeds, vector.tolist(), strict=True)))


class DriveSearch:
    """Search of paths from one place to several goals; what was found for one helps the others."""

    def __init__(
        self,
        start: Place,
        place: Callable[[], object],
        is_free: Callable[[Array], bool],
        speed: float,
        turn: float,
    ) -> None:
        self._start, self._place, self._is_free = start, place, is_free
        self._speed, self._turn = speed, turn
        root = (0, 0, 0)
        self._parents: dict[_Key, _Key | None] = {root: None}
        self._costs = {root: 0.0}
        self._done: list[_Key] = []
        self._heap = [(0.0, root)]
        turn_angle = 2.0 * math.pi / _HEADINGS
        self._headings = [start[2] + turn_angle * k for k in range(_HEADINGS)]

    @cached_property
    def begins_free(self) -> bool:
        """True if the robot touches nothing at the start."""
        self._place()
        return self._is_free(np.array([self._start]))

    def find(self, goal: Place) -> Array | None:
        """Return a path (K, 3) to a goal; None if there is none among the places of the lattice."""
        self._place()
        if not self._is_free(np.array([goal])):
            return None
        known = sorted((k for k in self._done if self._is_near(k, goal)), key=lambda k: self._costs[k])
        if (path := self._leg(self._start, goal)) is not None:
            return path
        for key in known[:_MOST_LEGS]:
            if (path := self._finish(key, goal)) is not None:
                return path
        while self._heap and len(self._done) < _MOST_PLACES:
            cost, key = heapq.heappop(self._heap)
            if cost > self._costs[key]:
                continue
            self._done.append(key)
            self._expand(key)
            if self._is_near(key, goal) and (path := self._finish(key, goal)) is not None:
                return path
        return None

    def _is_near(self, key: _Key, goal: Place) -> bool:
        x, y, _ = self._at(key)
        return math.hypot(goal[0] - x, goal[1] - y) < _NEAR

    def _at(self, key: _Key) -> Place:
        """Return a place of the lattice, whose axes are those of the start."""
        c, s = math.cos(self._start[2]), math.sin(self._start[2])
        i, j, k = key
        return (
            self._start[0] + _GRID * (c * i - s * j),
            self._start[1] + _GRID * (s * i + c * j),
            self._headings[k],
        )

    def _expand(self, key: _Key) -> None:
        """Add the neighbours of a place: turned by one heading, before it and behind it."""
        i, j, k = key
        angle = 2.0 * math.pi * k / _HEADINGS
        di, dj = round(math.cos(angle)), round(math.sin(angle))
        turned = [(i, j, (k + turn) % _HEADINGS) for turn in (1, -1)]
        for other in (*turned, (i + di, j + dj, k), (i - di, j - dj, k)):
            here, there = self._at(key), self._at(other)
            length = math.hypot(there[0] - here[0], there[1] - here[1])
            cost = self._costs[key] + length / self._speed + abs(_wrap(there[2] - here[2])) / self._turn
            if cost < self._costs.get(other, math.inf) and self._is_free(_between(here, there)):
                self._costs[other], self._parents[other] = cost, key
                heapq.heappush(self._heap, (cost, other))

    def _leg(self, start: Place, goal: Place) -> Array | None:
        """Return a turn, a line and a turn to a goal, ahead or backwards; None if both touch something."""
        x, y = goal[0] - start[0], goal[1] - start[1]
        if math.hypot(x, y) < _EXACT:
            paths = [np.array([start, goal])]
        else:
            ahead = math.atan2(y, x)
            paths = [
                np.array([start, (*start[:2], angle), (*goal[:2], angle), goal])
                for angle in (ahead, ahead + math.pi)
            ]
        paths.sort(key=lambda path: sum(abs(_wrap(b[2] - a[2])) for a, b in pairwise(path)))
        return next((w for w in paths if all(self._is_free(_between(a, b)) for a, b in pairwise(w))), None)

    def _finish(self, key: _Key, goal: Place) -> Array | None:
        """Return the path by a place of the lattice to a goal, shortened; None if no leg leads on."""
        leg = self._leg(self._at(key), goal)
        if leg is None:
            return None
        places = []
        step: _Key | None = key
        while step is not None:
            places.append(self._at(step))
            step = self._parents[step]
        return self._shorten([*reversed(places), *map(tuple, leg[1:].tolist())])

    def _shorten(self, places: list[Place]) -> Array:
        """Return places with direct legs instead of several, wherever they touch nothing."""
        path, at = [np.array([places[0]])], 0
        while at < len(places) - 1:
            legs = ((to, self._leg(places[at], places[to])) for to in range(len(places) - 1, at + 1, -1))
            step = np.array(places[at : at + 2])
            at, leg = next(((to, leg) for to, leg in legs if leg is not None), (at + 1, step))
            path.append(leg[1:])
        return np.concatenate(path)


def _between(start: Sequence[float], end: Sequence[float]) -> Array:
    """Return places (N, 3) from one to another, turning the shorter way."""
    a, b = np.array(start), np.array(end)
    away = np.array([b[0] - a[0], b[1] - a[1], _wrap(float(b[2] - a[2]))])
    count = max(math.hypot(away[0], away[1]) / _FINE, abs(away[2]) / _FINE_TURN)
    return np.asarray(a + np.linspace(0.0, 1.0, math.ceil(count) + 1)[:, None] * away)


def _wrap(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi)
