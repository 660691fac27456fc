"""Beliefs of a skill about the state: the truth of its world, or an estimate from its observations."""

from __future__ import annotations

from typing import Protocol

from kineverse.state import State
from kineverse.worlds import World


class Belief(Protocol):
    """Source of the state that a controller uses."""

    def update(self, world: World, commands: State | None = None) -> State:
        """Return the believed state of all coordinates after a step; its stamp is a time of the world [s].

        Parameters
        ----------
        world
            The world, of which only observations may be read by an estimate.
        commands
            The speeds that were commanded last.
        """


class TrueBelief:
    """The truth of a world as the belief."""

    def update(self, world: World, commands: State | None = None) -> State:
        """Return the true state."""
        return world.state
