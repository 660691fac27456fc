"""Swept volume of an object: what is in its way from one value of its coordinate to another.

The bodies that a coordinate moves are placed along the path so densely that no point of them moves by more
than :data:`STEP` at a time. There they are checked against everything that is not the robot's and that they
move relative to: fixed furniture, furniture that other coordinates move, and what carries the object itself.
:class:`.FurnitureOverlaps` excepts overlaps that mean nothing, as it does for worlds and metrics.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from kineverse.errors import NoSolutionError
from kineverse.geometry import Scene
from kineverse.geometry.distance_queries import PreparedQuery
from kineverse.lie import Array
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.model_view import ModelView
from kineverse.model.symbolic_view import cached_for_version
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Robot
from kineverse.worlds.furniture_overlaps import OVERLAP, FurnitureOverlaps

from .outcome import SkillError

STEP = 5e-4  # longest distance of a point of the object between two places where it is checked [m]
_COARSE = 32  # number of parts of a path whose lengths are measured
_MOST_PLACES = 100_000
_TURNED = 1e-6  # change of an entry of a rotation from which on a body has turned
_CLEAR = 3e-3  # distance before the first contact up to which a path is reported as free [m]


@dataclass(frozen=True, slots=True)
class Obstacle:
    """First thing in the way of an object."""

    coordinate: Symbol  # coordinate of the object, and the value that it was to reach [m], [rad]
    target: float
    body: str  # body of the object
    other: str  # body in its way
    value: float  # value of the coordinate from which on they overlap [m], [rad]
    depth: float  # largest depth of the two on the way to the target [m]
    free: float  # value up to which the path is free, a little before the contact [m], [rad]
    unit: str = ""  # "rad" if the object turns, "m" if it slides
    carrier: Symbol | None = None  # coordinate that moves the other body; None if none does
    aside: float | None = None  # value of the carrier at which the path is free [m], [rad]; None if none is

    @property
    def measures(self) -> dict[str, Any]:
        """Measures of a skill that is not begun: the failure, the pair, and the value that can be reached."""
        return {"failure": "collision", "in_the_way": (self.body, self.other), "free": self.free}

    def __str__(self) -> str:
        value, target, free = (f"{v:.3f} {self.unit}".rstrip() for v in (self.value, self.target, self.free))
        text = (
            f"'{self.body}' meets '{self.other}' at {value} of '{self.coordinate}': on the way to {target} "
            f"they would overlap by {1e3 * self.depth:.3g} mm. The path is free up to {free}."
        )
        if self.aside is not None:
            return f"{text} Move '{self.carrier}' to {self.aside:.3f} first."
        if self.carrier is not None:
            return f"{text} '{self.carrier}' moves what is in the way; none of its ends leaves the path free."
        return text


class BlockedError(SkillError):
    """End of a skill before something in the way of an object."""

    def __init__(self, obstacle: Obstacle) -> None:
        super().__init__("collision", str(obstacle), obstacle.measures)
        self.obstacle = obstacle


def find_obstacle(
    model: ModelView,
    coordinate: Symbol,
    state: State,
    target: float,
    *,
    robot: Robot | None = None,
    start: State | None = None,
    least: float = OVERLAP,
) -> Obstacle | None:
    """Return the first thing in the way of an object from its value to a target; None if the path is free.

    What overlaps at the start counts as far as it gets deeper than :class:`.FurnitureOverlaps` allows. The
    robot counts nowhere: it moves.
    """
    key = "swept motion", robot and robot.name
    sweep = cached_for_version(model, key, lambda: _Sweep(model, robot))
    sweep.start = start
    result = sweep.find(coordinate, state, target, least)
    return None if result is None else sweep.find_aside(result, state)


class _Sweep:
    def __init__(self, model: ModelView, robot: Robot | None) -> None:
        self._model, self._robot, self._scene = model, robot, Scene.of(model)
        self._overlaps = FurnitureOverlaps(self._scene, robot)
        self._queries: dict[tuple[Symbol, bytes], tuple[PreparedQuery, FrameDependence]] = {}
        self.start: State | None = None

    def find(
        self, coordinate: Symbol, state: State, target: float, least: float = OVERLAP
    ) -> Obstacle | None:
        scene, start = self._scene, float(state[coordinate])
        if start == target or coordinate not in scene.inputs:
            return None
        scene.update(state)
        self._overlaps.begin(*(() if self.start is None else (self.start,)))
        query, motion = self._query(coordinate)
        if not len(query.pairs):
            return None
        values = self._divide(coordinate, state, start, target)
        for k in self._find_near(query, coordinate, values):
            result = query(0.0)
            excess = -result.distances - self._overlaps.allowances(result)
            worst = int(np.argmax(excess)) if len(excess) else 0
            if not len(excess) or excess[worst] <= least:
                continue
            pair = result[worst]
            one, other = (pair.a, pair.b) if motion.moves(pair.a) else (pair.b, pair.a)
            deepest = self._find_deepest(query, coordinate, values[k:], one, other)
            first = values[max(0, k - math.ceil(_CLEAR / STEP))]
            unit = "rad" if self._turns(one, coordinate, state, target) else "m"
            return Obstacle(coordinate, target, one, other, float(values[k]), deepest, float(first), unit)
        return None

    def find_aside(self, found: Obstacle, state: State) -> Obstacle:
        """Return an obstacle with the coordinate that moves it, and where it leaves the path free."""
        model = self._model
        free = [s for s in model.degrees_of_freedom if self._robot is None or not self._robot.moves(s)]
        moving = [
            s
            for s in free
            if s != found.coordinate and FrameDependence(model, [s]).moves_between(found.body, found.other)
        ]
        carriers = [s for s in moving if FrameDependence(model, [s]).moves(found.other)]
        for carrier in carriers:
            ends = {*map(float, model.limits(carrier, state)), model.default_state()[carrier]}
            here = float(state[carrier])
            for end in sorted((v for v in ends if math.isfinite(v)), key=lambda v: -abs(v - here)):
                if end == here or self.find(carrier, state, end) is not None:
                    continue
                if self.find(found.coordinate, state.updated({carrier: end}), found.target) is None:
                    return replace(found, carrier=carrier, aside=end)
        return replace(found, carrier=carriers[0]) if carriers else found

    def _query(self, coordinate: Symbol) -> tuple[PreparedQuery, FrameDependence]:
        """Return the query for what a coordinate moves and counts since the start, and its motion."""
        key = coordinate, self._overlaps.counting.tobytes()
        if key not in self._queries:
            motion = FrameDependence(self._model, [coordinate])
            self._queries[key] = self._overlaps.watch([coordinate]), motion
        return self._queries[key]

    def _find_near(self, query: PreparedQuery, coordinate: Symbol, values: Array) -> Iterator[int]:
        """Place the scene at the values at which anything of the object touches, and yield their indices."""
        rows, k = values[:, None], 0
        at = self._scene.inputs.index(coordinate)
        while True:
            first = query.first_within([coordinate], rows[k:], 0.0)
            if first is None:
                return
            k += first
            inputs = self._scene.collision_world.values
            while True:  # what rests on something touches for long
                yield k
                k += 1
                if k == len(values):
                    return
                inputs[at] = values[k]
                try:
                    touching = query.at(inputs, 0.0)
                except NoSolutionError:
                    return
                if not len(touching):
                    break

    def _divide(self, coordinate: Symbol, state: State, start: float, target: float) -> Array:
        """Return values from the first to the last one between which no point goes further than the step.

        They end where a loop does not close any more.
        """
        scene = self._scene
        table = scene.collision_world.table
        coarse, places = np.linspace(start, target, _COARSE + 1), []
        for value in coarse.tolist():
            try:
                scene.update(state.updated({coordinate: value}))
            except NoSolutionError:
                break
            moving = slice(None, table.moving)
            places.append((table.position[moving].copy(), table.poses[moving, :, :3].copy()))
        scene.update(state)
        radius = np.where(np.isfinite(table.radius), table.radius, 0.0)[: table.moving]
        parts = [np.array([start])]
        for k, ((p, R), (p_next, R_next)) in enumerate(pairwise(places)):
            turn = np.linalg.norm((R_next - R).reshape(len(R), -1), axis=1) / math.sqrt(2.0)
            length = float((np.linalg.norm(p_next - p, axis=1) + turn * radius).max(initial=0.0))
            count = min(max(1, math.ceil(length / STEP)), _MOST_PLACES // _COARSE)
            parts.append(np.linspace(coarse[k], coarse[k + 1], count + 1)[1:])
        return np.concatenate(parts)

    def _turns(self, body: str, coordinate: Symbol, state: State, value: float) -> bool:
        """Return True if a body is turned when a coordinate changes to a value."""
        scene = self._scene
        scene.update(state)
        before = scene.pose(body)[:3, :3]
        middle = (float(state[coordinate]) + value) / 2
        scene.update(state.updated({coordinate: middle}))
        return bool(np.abs(scene.pose(body)[:3, :3] - before).max() > _TURNED)

    def _find_deepest(
        self, query: PreparedQuery, coordinate: Symbol, values: Array, one: str, other: str
    ) -> float:
        """Return the largest depth of two bodies at some values [m]."""
        pair, deepest = {one, other}, 0.0
        for _ in self._find_near(query, coordinate, values):
            depths = (-result.distance for result in query(0.0) if {result.a, result.b} == pair)
            deepest = max(deepest, *depths, 0.0)
        return deepest
