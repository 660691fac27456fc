"""Beliefs of a skill about the state, from the readings of the robot's sensors."""

from __future__ import annotations

import math
from typing import Protocol

from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Observation, Robot


class Belief(Protocol):
    """Source of the state that a controller uses."""

    def update(self, observation: Observation, time: float, commands: State | None = None) -> State:
        """Return the believed state of all coordinates after a step; its stamp is a time of the robot [s].

        Parameters
        ----------
        observation
            The latest readings of the robot's sensors.
        time
            The present time, in that of the readings' stamps [s].
        commands
            The speeds since the last update: commanded ones of the robot, and planned ones of objects.
        """

    def deviation(self, coordinate: Symbol) -> float:
        """Return the standard deviation of a coordinate [m], [rad]; 0 if it is known exactly."""


class EncoderBelief:
    """Belief that reads encoders alone: of a driven mechanism, or a robot that has nothing to see.

    All other coordinates keep their default values, and their deviations are infinite.
    """

    def __init__(self, model: ModelView, robot: Robot) -> None:
        self._state, self._robot = model.default_state(), robot

    def update(self, observation: Observation, time: float, commands: State | None = None) -> State:
        """Return the state with the readings of the encoders."""
        read = {s: value for s, value in observation.joints.items() if s in self._state}
        self._state = State({**self._state, **read}, stamp=observation.stamp, source="encoders")
        return self._state

    def deviation(self, coordinate: Symbol) -> float:
        """Return 0 for a coordinate of the robot, and infinity for others."""
        return 0.0 if self._robot.moves(coordinate) else math.inf
