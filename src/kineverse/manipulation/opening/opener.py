"""Shared parts of openings by one gripper: placements, planner, grasps and controllers."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

from kineverse.control import Controller
from kineverse.grasping import Grasp, Gripper, Handle, sample_grasps
from kineverse.model.frame import is_of_robot
from kineverse.model.model_view import ModelView
from kineverse.state import State

from .approach_planner import ApproachPlanner
from .placement import PlacementSearch

_GRASPS = 96
_KEPT = 15
"""Number of sets of grasps that are kept."""


class Opener:
    """Searches and controllers of a gripper in a model, made once."""

    def __init__(self, model: ModelView, gripper: Gripper, state: State) -> None:
        self.model, self.gripper = model, gripper
        self.search = PlacementSearch(model, gripper, state)
        self.controllers: dict[Hashable, tuple[Controller, Any]] = {}
        self._approaches: ApproachPlanner | None = None
        self._grasps: dict[tuple[object, ...], tuple[Grasp, ...]] = {}

    @property
    def approaches(self) -> ApproachPlanner:
        """Planner of the robot's ways with the hand empty."""
        if self._approaches is None:
            self._approaches = ApproachPlanner(self.search)
        return self._approaches

    def grasps(self, handle: Handle, state: State, seed: int, slant: float = 0.0) -> tuple[Grasp, ...]:
        """Return the grasps of a handle where everything but the robot is as in a state, up to a slant."""
        robot = self.gripper.robot
        others = tuple(v for s, v in state.items() if not robot or not is_of_robot(s.path, robot))
        key = handle.frame, handle.coordinate, seed, slant, others
        if key not in self._grasps:
            found = sample_grasps(self.model, self.gripper, handle, _GRASPS, seed, state=state, slant=slant)
            self._grasps = {**dict([*self._grasps.items()][-_KEPT:]), key: found}
        return self._grasps[key]
