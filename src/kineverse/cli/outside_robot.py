"""Robots outside of this process, which other distributions connect: ``--world ros``, or ``ros:FILE``."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Protocol, cast

from kineverse.errors import (
    InvalidValueError,
    MissingDependencyError,
    OfflineError,
    UnknownNameError,
    list_some,
)
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Robot, RobotInterface

from .output import join_lines

if TYPE_CHECKING:
    from kineverse.manipulation import Belief
    from kineverse.planning.trajectories.trajectory import Trajectory

ENTRY_POINTS = "kineverse.robots"
"""Group of entry points by which other distributions connect robots; each names a :class:`Connect`."""

_OUTSIDE = "ros"
_LOOKING, _STEP = 5.0, 0.05  # longest time until an object is seen, and time between two looks [s]
_SETTLING = 0.5  # time in which the estimate of an object at rest settles [s]


class ConnectedRobot(RobotInterface, AbstractContextManager["ConnectedRobot"], Protocol):
    """Robot outside of this process, until its context is left."""

    observed: Sequence[str]  # frames whose poses come with its readings

    def follow(self, trajectory: Trajectory) -> None:
        """Follow a path, and return at its end; a SimulationError if it is given up."""


class Connect(Protocol):
    """Function that an entry point names."""

    def __call__(
        self, model: ModelView, robot: Robot, settings: str | None, *, observed: Sequence[str]
    ) -> ConnectedRobot:
        """Connect a robot by settings from a file; frames are observed where these name none."""


def is_outside(world: str) -> bool:
    """Return whether ``--world`` is a robot outside of this process."""
    return world.partition(":")[0] == _OUTSIDE


def check_world(world: str, simulated: Sequence[str] = ()) -> None:
    """Check ``--world``: one of some simulated ones, or a robot outside."""
    name, colon, file = world.partition(":")
    if world not in simulated and (name != _OUTSIDE or bool(colon) != bool(file)):
        known = ", ".join([*simulated, _OUTSIDE])
        raise UnknownNameError(
            f"--world {world}: there is no such world. There is {known}, also with a file of settings: "
            f"{_OUTSIDE}:robot.toml."
        )


def refuse_start(arguments: argparse.Namespace) -> None:
    """Refuse options of which a robot outside knows nothing."""
    for option, given, why in (
        ("--from", arguments.start, "the robot sees where the object is"),
        ("--set", arguments.assignments, "the robot begins where it is, and so does all else"),
        ("--noise", arguments.noise, "its sensors are what they are"),
    ):
        if given:
            raise InvalidValueError(f"{option} is for simulated worlds; with --world {_OUTSIDE}, {why}.")


def connect_robot(world: str, robot: Robot, observed: Sequence[str]) -> ConnectedRobot:
    """Connect the robot of ``--world`` by the distribution that knows how.

    Frames are observed where the settings name none.
    """
    name, _, file = world.partition(":")
    found = [*entry_points(group=ENTRY_POINTS, name=name)]
    if not found:
        raise MissingDependencyError(
            f"--world {name} is brought by kineverse_ros, which is not installed: pip install -e "
            "ros/kineverse_ros in a checkout, or build it in a colcon workspace."
        )
    try:
        connect = cast(Connect, found[0].load())
    except ImportError as error:
        raise MissingDependencyError(f"--world {name}: {join_lines(error)}.") from error
    return connect(robot.model, robot, file or None, observed=observed)


class OutsideRobot(AbstractContextManager["OutsideRobot"]):
    """Robot outside of this process, with a belief from what it sees."""

    interface: ConnectedRobot
    belief: Belief  # source of the state

    def __init__(self, world: str, robot: Robot, coordinate: Symbol, *, whole: bool) -> None:
        """Connect the robot; by default it observes the object, or with ``whole`` what carries it as well."""
        from kineverse.manipulation import TrackedBelief  # for start-up time
        from kineverse.manipulation.belief import USUAL  # for start-up time

        self._coordinate, model = coordinate, robot.model
        wanted = [name for name in robot.markers if coordinate in model.symbols_of(name)]
        carriers = {one.parent for one in model.articulations.values() if coordinate in one.coordinates}
        more = [name for name in robot.markers if name in carriers and name not in wanted] if whole else []
        self._stack = ExitStack()
        self.interface = self._stack.enter_context(connect_robot(world, robot, [*wanted, *more]))
        with self._stack:
            if not {*wanted} & {*self.interface.observed}:
                raise InvalidValueError(
                    f"Nobody observes '{coordinate}'. [observed] in the settings of the robot is to name the "
                    f"poses of a frame that it moves: {list_some(wanted, 3) or 'the model has none'}."
                )
            sensors = replace(USUAL, marked=tuple(self.interface.observed))
            self.belief = TrackedBelief(model, robot, sensors)
            self._stack = self._stack.pop_all()

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def look(self) -> State:
        """Return the believed state when the object has been seen for a while."""
        interface, coordinate = self.interface, self._coordinate
        begin, seen = time.monotonic(), None
        while seen is None or time.monotonic() < seen + _SETTLING:
            state = self.belief.update(interface.observe(), interface.time)
            if seen is None and coordinate in getattr(self.belief, "seen", {}):
                seen = time.monotonic()
            if seen is None and time.monotonic() > begin + _LOOKING:
                raise OfflineError(
                    f"'{coordinate}' has not been seen for {_LOOKING:g} s. {' '.join(interface.remarks)}"
                )
            time.sleep(_STEP)
        return state
