"""Simulated worlds: true state, resets, contacts, and the body in the hand, which no real robot tells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from kineverse.errors import UnknownNameError, suggest
from kineverse.lie import Array
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .robot_interface import Observation, RobotInterface


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Touching bodies.

    Attributes
    ----------
    a, b
        Frames of the bodies; a is of the robot, unless neither is.
    point
        Point of contact in the world (3,) [m].
    normal
        Unit vector from a to b (3,).
    distance
        Gap [m], negative for penetration.
    force
        Size of the force [N]; NaN in a world without forces.
    """

    a: str
    b: str
    point: Array
    normal: Array
    distance: float
    force: float


class SimulatedWorld(RobotInterface, Protocol):
    """A simulated robot and its furniture, of which the truth is known: for trials, metrics and pictures."""

    @property
    def state(self) -> State:
        """True values of all coordinates; its stamp is the time [s]."""

    @property
    def held(self) -> str | None:
        """Frame of the body in the robot's gripper; None if it holds nothing."""

    @property
    def peak_force(self) -> float:
        """Largest force between the robot and another body in the last step [N]; NaN without forces."""

    def reset(self, state: StateLike) -> None:
        """Start again from a state, at time 0, with nothing in the gripper."""

    def contacts(self) -> Sequence[Contact]:
        """Return the bodies of the robot that touch something else, and those of furniture that collide."""


class TrueBelief:
    """Belief that knows the truth of a simulated world, for trials of skills without sensors.

    Parameters
    ----------
    world
        World whose state is believed.
    """

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world

    def update(self, observation: Observation, time: float, commands: State | None = None) -> State:
        """Return the true state; nothing else is read."""
        return self._world.state

    def deviation(self, coordinate: Symbol) -> float:
        """Return 0, or raise UnknownNameError for a coordinate that the world does not have."""
        state = self._world.state
        if coordinate not in state:
            known = suggest(str(coordinate), map(str, state), "coordinate")
            raise UnknownNameError(f"The belief says nothing about '{coordinate}'. {known}")
        return 0.0
