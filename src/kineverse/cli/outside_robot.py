"""Robots outside of this process: ``--world live``, and those that other distributions connect."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
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
    from kineverse.live import LiveRobot
    from kineverse.manipulation import Belief
    from kineverse.planning.trajectories.trajectory import Trajectory

ENTRY_POINTS = "kineverse.robots"
"""Group of entry points by which other distributions connect robots; each names a :class:`Connect`."""

_OUTSIDE, _LIVE = "ros", "live"
_LOOKING, _STEP = 5.0, 0.05  # longest time until an object is seen, and time between two looks [s]
_SETTLING = 0.5  # time in which the estimate of an object at rest settles [s]


class ConnectedRobot(RobotInterface, Protocol):
    """Robot outside of this process."""

    observed: Sequence[str]  # frames whose poses come with its readings

    def follow(self, trajectory: Trajectory) -> None:
        """Follow a path, and return at its end; a SimulationError if it is given up."""


class Connect(Protocol):
    """Function that an entry point names."""

    def __call__(
        self, model: ModelView, robot: Robot, settings: str | None, *, observed: Sequence[str]
    ) -> AbstractContextManager[ConnectedRobot]:
        """Connect a robot by settings from a file, until its context is left.

        Frames are observed where the settings name none.
        """


def is_outside(world: str) -> bool:
    """Return whether ``--world`` is a robot outside of this process."""
    return world == _LIVE or world.partition(":")[0] == _OUTSIDE


def check_world(world: str, simulated: Sequence[str] = ()) -> None:
    """Check ``--world``: one of some simulated ones, or a robot outside."""
    name, colon, file = world.partition(":")
    if world not in (*simulated, _LIVE) and (name != _OUTSIDE or bool(colon) != bool(file)):
        known = ", ".join([*simulated, _LIVE, _OUTSIDE])
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
            raise InvalidValueError(
                f"{option} is for simulated worlds; with --world {arguments.world.partition(':')[0]}, {why}."
            )


def is_live(world: str | None) -> bool:
    """Return whether ``--world`` is that of a live system."""
    return world == _LIVE


def check_served(model: str) -> None:
    """Check that a model is the served one, for ``--world live``."""
    from kineverse.exchange.address import SCHEME  # for start-up time

    if not model.startswith(SCHEME):
        raise InvalidValueError(f"--world live is for a served model, {SCHEME}NAME, not {model!r}.")


@contextmanager
def _connect_live(robot: Robot, server: str) -> Iterator[LiveRobot]:
    """Connect the robot of a live system."""
    from kineverse.exchange import Connection  # for start-up time
    from kineverse.exchange.address import Address  # for start-up time
    from kineverse.live import LiveRobot  # for start-up time

    with (
        closing(Connection(Address.parse(server))) as connection,
        closing(LiveRobot(robot.model, robot, connection)) as connected,
    ):
        yield connected


def connect_robot(
    world: str, robot: Robot, observed: Sequence[str], server: str = ""
) -> AbstractContextManager[ConnectedRobot]:
    """Return the robot of ``--world``: that of a live server, or by the distribution that knows how.

    Frames are observed where the settings name none.
    """
    if is_live(world):
        return _connect_live(robot, server)
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

    def __init__(
        self, world: str, robot: Robot, coordinate: Symbol, *, whole: bool, server: str = ""
    ) -> None:
        """Connect the robot; by default it observes the object, or with ``whole`` what carries it as well.

        The robot of a live system is that of a model server, whose tracker says what is believed.
        """
        from kineverse.manipulation import TrackedBelief  # for start-up time
        from kineverse.manipulation.belief import USUAL  # for start-up time

        self._coordinate, model = coordinate, robot.model
        wanted = [name for name in robot.markers if coordinate in model.symbols_of(name)]
        carriers = {one.parent for one in model.articulations.values() if coordinate in one.coordinates}
        more = [name for name in robot.markers if name in carriers and name not in wanted] if whole else []
        self._stack = ExitStack()
        observed = [*wanted, *more]
        self.interface = self._stack.enter_context(connect_robot(world, robot, observed, server))
        with self._stack:
            if is_live(world):
                from kineverse.live import LiveBelief  # for start-up time

                self.belief = LiveBelief(cast("LiveRobot", self.interface))
                self._stack = self._stack.pop_all()
                return
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
        begin = seen = None
        while seen is None or time.monotonic() < seen + _SETTLING:
            state = self.belief.update(interface.observe(), interface.time)
            begin = begin or time.monotonic()  # after the first, which prepares the estimator
            if seen is None and coordinate in getattr(self.belief, "seen", {}):
                seen = time.monotonic()
            if seen is None and time.monotonic() > begin + _LOOKING:
                problem = getattr(self.belief, "problem", "") or " ".join(interface.remarks)
                raise OfflineError(f"'{coordinate}' has not been seen for {_LOOKING:g} s. {problem}".strip())
            time.sleep(_STEP)
        return state
