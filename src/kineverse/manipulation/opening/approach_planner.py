"""Approaches: drive of a base on wheels, path of the rest, and what all openings by one gripper share."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from kineverse.control import Controller
from kineverse.grasping import Grasp, Gripper, Handle, sample_grasps
from kineverse.lie import Array
from kineverse.manipulation.base_drive import BaseDrive, DriveSearch, Place
from kineverse.model.symbolic_view import cached_for_version
from kineverse.planning import Planner, Trajectory
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Robot

from .base_placement import BasePlacement, PlacementSearch

_PLANNING = 2.0  # largest time to plan the path to the handle [s]
_TUCKED = 300  # number of random arms among which a compact one is chosen
_MOST_TUCKED, _TUCKING = (3, 2.0)  # number of compact arms that are tried, and the time to plan for each [s]
_KEPT = 4  # number of searches of drives that are kept
_HERE = 1e-3  # distance of a base from its place at which it stays [m], [rad]


@dataclass(frozen=True, eq=False)
class Approach:
    """Path of a robot to a configuration."""

    why: str = ""  # why there is none; empty if there is one
    trajectory: Trajectory | None = None
    tuck: Trajectory | None = None  # path of the arm before the drive; None if it stays
    places: Array | None = None  # places (K, 3) of the drive; None if there is none

    def __bool__(self) -> bool:
        return not self.why


class ApproachPlanner:
    """Planner of paths to configurations, with the hand empty.

    A base that moves freely is planned with the arm. One on wheels drives first, with the arm as it is or,
    where that leads nowhere, with a compact one.
    """

    def __init__(self, search: PlacementSearch) -> None:
        self.search = search
        self.planner = Planner(search.model, search.moving, rules=search.scene.rules)
        self.drive: BaseDrive | None = None
        if search.standing and {*search.standing} == {*search.base}:
            bodies = search.robot_bodies, search.others
            self.drive = BaseDrive(search.model, search.base, search.scene, *bodies, search.margin)
        self._searches: dict[State, DriveSearch] = {}
        self._tucked: dict[State, tuple[Trajectory, State] | None] = {}

    def plan(
        self, state: State, wanted: Mapping[Symbol, float], *, seconds: float, seed: int = 0
    ) -> Approach:
        """Plan a path from a state to values of the robot's coordinates."""
        planner, base = self.planner, {s: float(wanted[s]) for s in self.search.standing}
        places, tuck, arms = None, None, state
        if max((abs(state[s] - v) for s, v in base.items()), default=0.0) > _HERE:
            if why := self.explain_standing(state):
                return Approach(why)
            result = self._find_drive(state, base)
            if result is None:
                return Approach("no path for the base, with the arm as it is or compact")
            places, tuck, arms = result
        planner.place(state.updated(base))
        here = arms.vector(planner.symbols)
        end = np.array([wanted[s] for s in planner.symbols])
        path = planner.plan(here, planner.space.nearest_turn(end, here), seconds=seconds, seed=seed)
        if not path.found:
            return Approach(path.why)
        return Approach("", path.trajectory(), tuck, places)

    def explain_standing(self, state: State) -> str:
        """Return why a base on wheels cannot drive from where it is; empty if it can, or has no wheels."""
        if not self.search.standing:
            return ""
        if self.drive is None or not self.drive.is_possible:
            return "The base cannot turn on the spot, so it does not drive by itself."
        if not self._drives(state).begins_free:
            return "The robot begins in contact, so its base does not drive."
        return ""

    def plan_to(self, state: State, placement: BasePlacement, seed: int) -> Approach:
        """Plan a path from a state to the pose before the handle of a placement, within 2 s."""
        wanted = dict(zip(placement.coordinates, placement.approach.tolist(), strict=True))
        return self.plan(state, wanted, seconds=_PLANNING, seed=seed)

    def _drives(self, state: State) -> DriveSearch:
        assert self.drive is not None
        if state not in self._searches:
            if len(self._searches) >= _KEPT:
                self._searches.pop(next(iter(self._searches)))
            self._searches[state] = self.drive.search(state)
        return self._searches[state]

    def _find_drive(
        self, state: State, base: Mapping[Symbol, float]
    ) -> tuple[Array, Trajectory | None, State] | None:
        """Return places of a drive, the path of the arm before it, and the state of the arm on the way."""
        x, y, angle = (base[s] for s in self.search.base)
        goal: Place = (x, y, angle)
        places = self._drives(state).find(goal)
        if places is not None:
            return places, None, state
        if state not in self._tucked:
            self._tucked = {state: self._plan_tuck(state)}
        tucked = self._tucked[state]
        if tucked is None:
            return None
        places = self._drives(tucked[1]).find(goal)
        return None if places is None else (places, *tucked)

    def _plan_tuck(self, state: State) -> tuple[Trajectory, State] | None:
        """Return a path of the arm to a compact configuration, and the state there; None without one."""
        planner = self.planner
        planner.place(state)
        here = state.vector(planner.symbols)
        for row in self._find_compact(state)[:_MOST_TUCKED]:
            path = planner.plan(here, planner.space.nearest_turn(row, here), seconds=_TUCKING)
            if path.found:
                trajectory = path.trajectory()
                # Joints that turn without end may arrive whole turns away from the wanted values.
                return trajectory, state.updated(trajectory.at(trajectory.duration))
        return None

    def _find_compact(self, state: State) -> Array:
        """Return free configurations (K, n) of the arm, the one with the least radius first."""
        search, scene, symbols = self.search, self.search.scene, self.planner.symbols
        limits = np.array([search.model.limits(s) for s in symbols])
        lower, upper = np.where(np.isfinite(limits), limits, np.array([-np.pi, np.pi])).T
        rows = np.random.default_rng(0).uniform(lower, upper, (_TUCKED, len(lower)))
        itself = scene.watch(search.robot_bodies, search.robot_bodies, 0.0)
        touching = itself, scene.watch(search.robot_bodies, search.others, search.margin)
        x, y, _ = (state[s] for s in search.base)
        result: list[tuple[float, int]] = []
        for k, row in enumerate(rows):
            scene.update(state.updated(dict(zip(symbols, row.tolist(), strict=True))))
            if not any(len(watch()) for watch in touching):
                places = np.array([scene.pose(b)[:2, 3] for b in search.robot_bodies])
                result.append((float(np.hypot(*(places - [x, y]).T).max()), k))
        return rows[[k for _, k in sorted(result)]]


_GRASPS = 96
_KEPT_GRASPS = 15  # number of sets of grasps that are kept


class Opener:
    """Searches, planner and controllers of a gripper in a version of a model, made once."""

    def __init__(self, robot: Robot, gripper: Gripper, state: State) -> None:
        self.model, self.robot, self.gripper = robot.model, robot, gripper
        self.search = PlacementSearch(robot.model, robot, gripper, state)
        self.approaches = ApproachPlanner(self.search)
        self.controllers: dict[Hashable, tuple[Controller, Any]] = {}
        self._grasps: dict[tuple[object, ...], tuple[Grasp, ...]] = {}

    @classmethod
    def of(cls, robot: Robot, gripper: Gripper, state: State) -> Opener:
        """Return the one of a gripper, for openings from any state; it is made for the first one."""
        key = "opener", robot.name, gripper  # itself: another one of the same hand may have other fingers
        return cached_for_version(robot.model, key, lambda: cls(robot, gripper, state))

    def grasps(self, handle: Handle, state: State, seed: int, slant: float = 0.0) -> tuple[Grasp, ...]:
        """Return the grasps of a handle where everything but the robot is as in a state, up to a slant."""
        others = tuple(v for s, v in state.items() if not self.robot.moves(s))
        key = handle.frame, handle.coordinate, seed, slant, others
        if key not in self._grasps:
            result = sample_grasps(self.model, self.gripper, handle, _GRASPS, seed, state=state, slant=slant)
            self._grasps = {**dict([*self._grasps.items()][-_KEPT_GRASPS:]), key: result}
        return self._grasps[key]
