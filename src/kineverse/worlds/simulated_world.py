"""Simulated worlds: true state, resets, contacts, and the body in the hand, which no real robot tells.

People change a world while it runs: they move furniture, change sensors, and edit the model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np

from kineverse._checks import as_positive, finite_number
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.lie import Array
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .robot_interface import Observation, RobotInterface
from .sensors import Sensors


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

    See Also
    --------
    kineverse.worlds.KinematicWorld
    """

    a: str
    b: str
    point: Array
    normal: Array
    distance: float
    force: float


class SimulatedWorld(RobotInterface, Protocol):
    """A simulated robot and its furniture, of which the truth is known: for trials, metrics and pictures.

    See Also
    --------
    kineverse.worlds.KinematicWorld
    """

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


class ChangeableWorld(SimulatedWorld, Protocol):
    """Simulated world that people change while it runs: time goes on, and the robot stays where it is.

    See Also
    --------
    kineverse.worlds.KinematicWorld
    """

    @property
    def sensors(self) -> Sensors:
        """Settings of the sensors. Others may be set while the world runs, also those of hidden markers."""

    @sensors.setter
    def sensors(self, sensors: Sensors) -> None: ...

    def displace(self, values: StateLike) -> None:
        """Move furniture to values of its coordinates, as a person does, by symbol or name [m], [rad].

        It is at rest there. Nothing has changed after an error.

        Raises
        ------
        UnknownNameError
            For what is no coordinate of the model.
        InvalidValueError
            For a coordinate of the robot, one that moves what the robot holds, a value that is not finite or
            beyond a limit, and a place in the robot or in other furniture.
        """

    def resume(self, state: StateLike, held: str | None = None) -> None:
        """Go on from a state that was saved, at the time of its stamp, with a body in the gripper.

        Everything is at rest, and no command is known. The body is held where it is in the hand, unless no
        finger is near it. How far it had slipped, and readings that had not arrived, are lost.
        """

    def take_over(self, other: Self) -> None:
        """Go on where another world of this kind is, whose model may be another one, and which ends there.

        That is the time, the state, commands, readings and sensors. What the robot holds stays in its hand
        if it is where it was relative to the hand. Coordinates that are new have their default.
        """

    def rebuild(self, model: ModelView) -> Self:
        """Return a world of another model, or of one that was edited, which goes on where this one is.

        It takes seconds. To go on meanwhile, let another thread do it, and let the result take over again.
        """


def displaced_state(world: SimulatedWorld, values: StateLike) -> State:
    """Return the state of a world after some furniture was moved, see :meth:`ChangeableWorld.displace`."""
    model, robot, before = world.model, world.robot, world.state
    if not isinstance(values, Mapping):
        raise InvalidValueError(
            f"Furniture is moved by a mapping from coordinates to numbers, not {values!r}."
        )
    wanted: dict[Symbol, float] = {}
    for key, value in values.items():
        symbol = model.degree_of_freedom(key)
        number = finite_number(value)
        if robot.moves(symbol):
            raise InvalidValueError(f"'{symbol}' is the robot's: it moves by its own speeds alone.")
        if number is None:
            raise InvalidValueError(f"'{symbol}' is moved to a finite number, not to {value!r}.")
        wanted[symbol] = number
    if world.held is not None and FrameDependence(model, wanted).moves(world.held):
        names = ", ".join(map(str, wanted))
        raise InvalidValueError(f"The robot holds '{world.held}', which {names} would move.")
    after = before.updated(wanted)
    known = {violation.name: violation.excess for violation in model.violations(before)}
    for violation in model.violations(after):
        name = violation.name
        if name in model.constraints and model.constraints[name].order:
            continue  # limits of speeds
        if not violation.excess <= known.get(name, 0.0) + _BEYOND:
            raise InvalidValueError(
                f"{', '.join(map(str, wanted))} cannot be there: "
                f"'{name}' is exceeded by {violation.excess:.3g}."
            )
    return after


_BEYOND = 1e-9
SAME_PLACE = 1e-4  # largest change of the entries of a pose of what did not move in the hand
DEEPER = (
    1e-4,
    1e-3,
)  # depth that a displacement may add between robot and furniture, and between furniture [m]


def refuse_overlap(one: str, other: str, values: StateLike) -> InvalidValueError:
    """Return the error for a displacement that leads into a body."""
    names = ", ".join(map(str, values))
    return InvalidValueError(f"{names} cannot be there: '{one}' would be in '{other}'.")


def saved_time(state: StateLike) -> float:
    """Return the stamp of a state [s], 0 for one without."""
    return state.stamp or 0.0 if isinstance(state, State) else 0.0


def carried_state(world: SimulatedWorld, model: ModelView) -> State:
    """Return the state of a world in another model: what both know, with furniture within its limits."""
    state, values = world.state, dict[Symbol, float]()
    for symbol in model.symbols:
        value = state.given(symbol)
        if value is not None:
            lower, upper = (-np.inf, np.inf) if world.robot.moves(symbol) else model.limits(symbol)
            values[symbol] = min(max(value, lower), upper)
    return State(values, stamp=world.time)


def carried_sensors(sensors: Sensors, model: ModelView) -> Sensors:
    """Return settings of sensors without the frames that another model does not have."""
    marked = None if sensors.marked is None else tuple(n for n in sensors.marked if n in model.frames)
    hidden = frozenset(n for n in sensors.hidden if n in model.frames)
    return replace(sensors, marked=marked, hidden=hidden)


class ForceLimit:
    """Limit of the force between a robot and other bodies, which stops the robot once exceeded for a time.

    A blow of a few milliseconds does not count, as a real sensor filters it. Without forces, where they are
    NaN, nothing ever counts.

    Parameters
    ----------
    limit
        Largest force [N].
    time
        Time for which it has to be exceeded [s].

    Attributes
    ----------
    tripped
        Whether the limit was exceeded for the time, until :meth:`release`.
    peak
        Largest force since the last release [N].

    Raises
    ------
    InvalidValueError
        For a limit or a time that is not positive.

    Examples
    --------
    >>> limit = kv.worlds.ForceLimit(50.0, time=0.05)
    >>> limit.watch(80.0, 0.02), limit.watch(80.0, 0.04)
    (False, True)
    >>> limit.peak
    80.0
    """

    def __init__(self, limit: float, time: float = 0.05) -> None:
        self.limit = as_positive(limit, "A limit of force", "number of newtons")
        self.time = as_positive(time, "The time of a limit of force", "number of seconds")
        self.release()

    def release(self) -> None:
        """Begin anew."""
        self.tripped, self.peak, self._exceeded = False, 0.0, 0.0

    def watch(self, force: float, duration: float) -> bool:
        """Watch the largest force [N] of a step with a duration [s]; return whether the robot has to stop."""
        self._exceeded = self._exceeded + duration if force > self.limit else 0.0
        self.peak = max(self.peak, force) if force >= 0.0 else self.peak
        self.tripped = self.tripped or self._exceeded > self.time - _BEYOND
        return self.tripped


class TrueBelief:
    """Belief that knows the truth of a simulated world, for trials of skills without sensors.

    Parameters
    ----------
    world
        World whose state is believed.

    Examples
    --------
    >>> world = kv.worlds.KinematicWorld(kv.load("fetch"), "fetch")
    >>> world.reset({"fetch/torso_lift_joint": 0.2})
    >>> session = kv.manipulation.Session(world, belief=kv.worlds.TrueBelief(world))
    >>> session.state["fetch/torso_lift_joint"]
    0.2
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
