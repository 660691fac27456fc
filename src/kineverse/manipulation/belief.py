"""Beliefs of a skill about the state: the truth of its world, or an estimate from its observations."""

from __future__ import annotations

from collections.abc import Collection
from typing import Protocol

from kineverse.errors import UnknownNameError, suggest
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Observation, World


class Belief(Protocol):
    """Source of the state that a controller uses.

    Attributes
    ----------
    observation
        The readings of the last update; None if it took none.
    """

    @property
    def observation(self) -> Observation | None:
        """The readings of the last update; None if it took none."""

    def update(self, world: World, commands: State | None = None) -> State:
        """Return the believed state of all coordinates after a step; its stamp is a time of the world [s].

        Parameters
        ----------
        world
            The world, of which only observations may be read by an estimate.
        commands
            The speeds since the last update: commanded ones of the robot, and planned ones of objects.
        """

    def deviation(self, coordinate: Symbol) -> float:
        """Return the standard deviation of a coordinate [m], [rad]; 0 if it is known exactly."""


class TrueBelief:
    """The truth of a world as the belief."""

    observation = None

    def __init__(self) -> None:
        self._state: State = State({})

    def update(self, world: World, commands: State | None = None) -> State:
        """Return the true state."""
        self._state = world.state
        return self._state

    def deviation(self, coordinate: Symbol) -> float:
        """Return 0."""
        check_believed(self._state, coordinate)
        return 0.0


def check_believed(state: Collection[Symbol], coordinate: Symbol) -> None:
    """Check that the coordinates of a state have one."""
    if coordinate not in state:
        raise UnknownNameError(
            f"The belief says nothing about '{coordinate}'. "
            f"{suggest(str(coordinate), map(str, state), 'coordinate')}"
        )


class BelievedStep(Protocol):
    """Step of a skill, as :class:`.Session` has it."""

    @property
    def world(self) -> World:
        """The world."""

    @property
    def state(self) -> State:
        """The believed state."""


class EstimateError:
    """Error of a believed coordinate over the steps of a session; call it after each of them."""

    def __init__(self, coordinate: Symbol) -> None:
        self._coordinate = coordinate
        self._errors: list[float] = []

    def __call__(self, session: BelievedStep) -> None:
        """Take the error of the present step."""
        error = session.state[self._coordinate] - session.world.state[self._coordinate]
        self._errors.append(abs(error))

    @property
    def measures(self) -> dict[str, float]:
        """Mean and largest error [m], [rad]: ``estimate_mean``, ``estimate_largest``; empty without steps."""
        if not self._errors:
            return {}
        mean = sum(self._errors) / len(self._errors)
        return {"estimate_mean": mean, "estimate_largest": max(self._errors)}
