"""A robot that acts in a world: commands go to the world, the belief comes back, both are measured."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from threading import Thread
from time import perf_counter, thread_time
from typing import TYPE_CHECKING

import numpy as np

from kineverse._checks import finite_number
from kineverse.control import Command
from kineverse.errors import InvalidValueError, ShapeError, SimulationError, UnknownNameError, suggest
from kineverse.expressions import Expression
from kineverse.lie import Array
from kineverse.model.frame import is_of_robot
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Observation, World

from .belief import Belief, TrueBelief
from .outcome import SkillError

if TYPE_CHECKING:
    from .opening.base_placement import BasePlacement


@dataclass(slots=True, eq=False)
class HandReference:
    """Path of a hand that a controller follows."""

    poses: Array  # world poses (K, 4, 4) along the path [m]
    share: float = 0.0  # share of the path that was passed, in [0, 1]

    @property
    def pose(self) -> Array:
        """Pose (4, 4) on the path that is wanted now."""
        pose: Array = self.poses[round(self._place)].copy()
        pose[:3, 3] = self.ahead[0]
        return pose

    @property
    def ahead(self) -> Array:
        """Points (k, 3) of the rest of the path [m], the present one first."""
        points, place = self.poses[:, :3, 3], self._place
        before = int(place)
        after = min(before + 1, len(points) - 1)
        here = points[before] + (place - before) * (points[after] - points[before])
        rest: Array = np.concatenate([here[None], points[after:]])
        return rest

    @property
    def _place(self) -> float:
        return float(np.clip(self.share, 0.0, 1.0)) * (len(self.poses) - 1)


Speeds = Mapping[Symbol, float]

STALE = 0.06  # age of the latest readings from which on a skill ends [s]
_MADE = 64  # number of motions that are remembered


class Session:
    """Steps of a skill in a world.

    A skill reads :attr:`state`, computes speeds within :meth:`timed`, and calls :meth:`act`::

        while not done:
            with session.timed("open"):
                command = controller.step(session.state)
            session.act(command.speeds)

    Parameters
    ----------
    dt
        Time of a step [s].
    belief
        Source of the state; the truth by default.
    on_step
        Is called with the session after each step, for recordings, measurements and pictures.
    on_search
        Is called with a text on the progress of a search that takes long, while nothing moves.
    timeout
        Longest wall time of a step of the world [s], for worlds that are elsewhere; None to wait for ever.

    Attributes
    ----------
    belief
        Source of the state.
    start
        The true state at the begin of the session.
    commands
        The speeds of the last step.
    command
        The controller's command from which they come; None if there is none.
    reference
        The path of the hand that a controller follows; None if there is none.
    vectors
        Vectors of the controller by name, each with its origin in the world [m], for pages and recordings.
    phase
        Name of the present phase of the skill, for recordings and messages.
    steps
        Number of steps.
    cpu, wall
        Durations of the computations of each step by the name given to :meth:`timed` [s].
    made
        Placements of completed grasped motions, oldest first; reversed, they serve to move the object back.
    answers
        Whether the world has answered the last step within the time-out.
    untrusted
        Why the world's simulation is not to be trusted any more, until a restart; empty if it is.
    peak_force
        Largest force between the robot and another body so far [N]; NaN in a world that does not say it.

    Raises
    ------
    InvalidValueError
        For a time of a step, or a time-out, that is not positive, and for steps that are longer than the
        world's own time-out, after which it stops the robot.
    """

    def __init__(
        self,
        world: World,
        *,
        dt: float = 0.02,
        belief: Belief | None = None,
        on_step: Callable[[Session], object] | None = None,
        on_search: Callable[[str], object] | None = None,
        timeout: float | None = None,
    ) -> None:
        if not 0.0 < dt < math.inf:
            raise InvalidValueError(f"dt= is the time of a step in s, such as 0.02, not {dt!r}.")
        if timeout is not None and not timeout > 0.0:
            raise InvalidValueError(
                f"timeout= is a positive time in s, or None to wait for ever, not {timeout!r}."
            )
        if dt > world.timeout + 1e-9:
            raise InvalidValueError(
                f"dt={dt:g} s is longer than the time-out of the world, {world.timeout:g} s: the robot would "
                f"stand still for the rest of each step. Make the world with timeout={dt:g} or more."
            )
        self.world, self.dt = world, dt
        self._timeout, self.answers, self.untrusted = timeout, True, ""
        self.peak_force = math.nan
        self._speeds: dict[object, Symbol] = {name: s for s in world.model.speeds for name in (s, str(s))}
        self.belief = belief or TrueBelief()
        self._on_step, self._on_search = on_step, on_search
        self.state: State = self.belief.update(world)
        self.start: State = world.state
        self.commands: Speeds = {}
        self.command: Command | None = None
        self.reference: HandReference | None = None
        self.vectors: Mapping[str, tuple[Array, Array]] = {}
        self.phase, self.steps = "", 0
        self.cpu: dict[str, list[float]] = {}
        self.wall: dict[str, list[float]] = {}
        self.made: deque[BasePlacement] = deque(maxlen=_MADE)

    @property
    def observation(self) -> Observation | None:
        """The sensor readings from which the state was estimated; None if it is the truth."""
        return self.belief.observation

    def deviation(self, what: Symbol | str | Expression) -> float:
        """Return the standard deviation of a coordinate, or of an expression of coordinates [m], [rad].

        That of an expression is to first order, and takes the errors of coordinates as independent.

        Raises
        ------
        ShapeError
            For an expression that is no number.
        """
        if isinstance(what, str):
            what = self.world.model.symbol(what)
        if isinstance(what, Symbol):
            return self.belief.deviation(what)
        if what.shape != ():
            raise ShapeError(f"Only a scalar has a deviation, not an expression of shape {what.shape}.")
        own = {s: self.belief.deviation(s) for s in what.symbols}
        slopes = {s: float(what.partial([s])(self.state)[0]) for s, deviation in own.items() if deviation}
        return math.hypot(*(k * own[s] for s, k in slopes.items() if k))

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Measure the time that the computations of a step take."""
        cpu, wall = thread_time(), perf_counter()
        yield
        self.cpu.setdefault(name, []).append(thread_time() - cpu)
        self.wall.setdefault(name, []).append(perf_counter() - wall)

    def report_search(self, text: str) -> None:
        """Tell the progress of a search, in which nothing moves."""
        if self._on_search is not None:
            self._on_search(text)

    def act(
        self, speeds: Mapping[Symbol, float] | Mapping[str, float], command: Command | None = None
    ) -> None:
        """Command speeds for one step, and update the belief. Speeds of objects are not sent.

        The belief gets them all.

        Parameters
        ----------
        speeds
            Speeds of the robot, and possibly those planned for objects, by symbol or name [m/s], [rad/s];
            none to stop.
        command
            The controller's command that has these speeds, for pages.

        Raises
        ------
        UnknownNameError, InvalidValueError
            For speeds that the model does not have, and those that are not finite. Then nothing has changed.
        SkillError
            If the world does not answer within the time-out, stands still, is not to be trusted, or has not
            been observed for more than :data:`STALE`. Worlds refuse commands from then on, and their robots
            stop.
        """
        resolved = self._resolve(speeds)
        before, self.command = self.world.time, command
        self._advance(resolved)
        now, stamp = self.world.time, self.state.stamp
        if now <= before:
            raise SkillError("other", f"The world '{self.world.name}' stands still at {now:g} s.")
        if stamp is not None and now - stamp > STALE:
            raise SkillError(
                "other",
                f"The world '{self.world.name}' was observed last at {stamp:.3f} s, {now - stamp:.3f} s ago.",
            )

    def _resolve(self, speeds: Mapping[Symbol, float] | Mapping[str, float]) -> Speeds:
        if not isinstance(speeds, Mapping):
            raise InvalidValueError(f"Speeds are a mapping from symbols or names to numbers, not {speeds!r}.")
        resolved: dict[Symbol, float] = {}
        for key, value in speeds.items():
            speed = self._speeds.get(key)
            if speed is None and isinstance(key, Symbol) and not is_of_robot(key.path, self.world.robot):
                speed = key  # of an object that only the skill's own model has
            if speed is None:
                known = map(str, self.world.model.speeds)
                raise UnknownNameError(
                    f"The model has no free speed '{key}'. {suggest(str(key), known, 'speed')}"
                )
            number = finite_number(value)
            if number is None:
                raise InvalidValueError(
                    f"The speed '{key}' is {value!r}; it must be a finite number. act({{}}) stops the robot."
                )
            resolved[speed] = number
        return resolved

    def _advance(self, speeds: Speeds) -> None:
        robot = self.world.robot
        self.commands = {s: v for s, v in speeds.items() if is_of_robot(s.path, robot)}
        try:
            self._wait(lambda: self.world.apply(self.commands, self.dt, stamp=self.state.stamp))
        except SimulationError as error:
            self.untrusted = str(error)
            raise SkillError("other", self.untrusted) from error
        force = getattr(self.world, "peak_force", math.nan)
        if not force <= self.peak_force:
            self.peak_force = force
        self._wait(lambda: self._update(speeds))
        self.steps += 1
        if self._on_step is not None:
            self._on_step(self)

    def _wait(self, call: Callable[[], object]) -> None:
        """Call a function of the world; raise SkillError if it takes longer than the time-out."""
        if self._timeout is None:
            call()
            return
        errors: list[Exception] = []

        def run() -> None:
            try:
                call()
            except Exception as error:
                errors.append(error)

        thread = Thread(target=run, daemon=True)
        thread.start()
        thread.join(self._timeout)
        if thread.is_alive():
            self.answers, self.commands = False, {}
            raise SkillError(
                "other", f"The world '{self.world.name}' has not answered for {self._timeout:g} s."
            )
        if errors:
            raise errors[0]

    def restart(self, state: State) -> None:
        """Reset the world to a state, at time 0, and update the belief."""
        self.world.reset(state)
        self.untrusted = ""
        self._update({})

    def _update(self, speeds: Speeds) -> None:
        self.state = self.belief.update(self.world, State(speeds))

    def stop(self) -> None:
        """Command zero speeds for one step; nothing if the world does not answer."""
        if self.answers:
            with suppress(SkillError):
                self._advance({})
