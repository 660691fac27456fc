"""Session of a robot: speeds go to its interface, readings come back and become the believed state."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from queue import SimpleQueue
from threading import Event, Thread
from time import perf_counter, thread_time
from traceback import extract_tb
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np

from kineverse._checks import as_positive, finite_number
from kineverse.control import Command
from kineverse.errors import (
    InvalidValueError,
    ShapeError,
    SimulationError,
    StoppedError,
    UnknownNameError,
    suggest,
)
from kineverse.expressions import Expression
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Observation, PlannedContact, Robot, RobotInterface

from .outcome import SkillError

if TYPE_CHECKING:
    from .opening.base_placement import BasePlacement

Speeds = Mapping[Symbol, float]
Result = TypeVar("Result")

STALE = 0.06  # age of the latest readings from which on the robot waits for newer ones [s]
_RIGID = 1e-4  # largest element of RᵀR - I, and of the last row from (0, 0, 0, 1), of a pose
_STOPPING = 2.0  # longest wall time that a stop waits for an answer, also after an interruption [s]
_MADE = 64  # number of motions that are remembered
_NAMED = 3  # number of names that a message lists


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


class Belief(Protocol):
    """Source of the state that a controller uses.

    See Also
    --------
    kineverse.worlds.TrueBelief
    """

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


class Session:
    """Steps of skills with a robot.

    A skill reads :attr:`state`, computes speeds within :meth:`timed`, and calls :meth:`act`::

        while not done:
            with session.timed("open"):
                command = controller.step(session.state)
            session.act(command.speeds)

    Readings that are old or wrong do not end a skill: the robot stands still and waits for better ones. A
    session is used by one thread at a time.

    Parameters
    ----------
    interface
        The robot: a simulated one, one in another process, or a real one.
    dt
        Time of a step [s].
    belief
        Source of the state; by default a :class:`.TrackedBelief` with usual noise of cameras and encoders.
    on_step
        Is called with the session after each step, for recordings, metrics and pictures.
    on_search
        Is called with a text on the progress of a search that takes long, while nothing moves.
    timeout
        Longest wall time of a step of the interface [s]; None to wait for ever.
    patience
        Longest time to wait for readings of the present [s].

    Attributes
    ----------
    model, robot
        Model of the robot and its furniture, and the robot in it.
    belief
        Source of the state.
    state
        The believed state.
    start
        The believed state at the first look.
    time
        Time of the robot after the last step [s].
    observation
        The latest readings of the sensors.
    commands
        The speeds of the last step.
    command
        The controller's command from which they come; None if there is none.
    reference
        The path of the hand that a controller follows; None if there is none.
    vectors
        Vectors of the controller by name, each with its origin in the world [m], for pages and recordings.
    contact
        The bodies that the skill means to bring together; None if there are none.
    phase
        Name of the present phase of the skill, for recordings and messages.
    steps
        Number of steps.
    cpu, wall
        Durations of the computations of each step by the name given to :meth:`timed` [s].
    made
        Placements of completed grasped motions, oldest first; reversed, they serve to move the object back.
    fault
        Why the robot's interface has ended the present skill, or the last one; empty if it has not.
    broken
        Why the robot's interface can be used no more; empty if it can.

    Raises
    ------
    InvalidValueError
        For a time of a step, a time-out or a patience that is not positive, and for steps that are longer
        than the interface's own time-out, after which it stops the robot.

    Examples
    --------
    >>> world = kv.worlds.KinematicWorld(kv.load("fetch"), "fetch")
    >>> world.reset({"fetch/torso_lift_joint": 0.1})
    >>> session = kv.manipulation.Session(world, belief=kv.worlds.TrueBelief(world), dt=0.02)
    >>> for _ in range(10):
    ...     session.act({kv.velocity("fetch/torso_lift_joint"): 0.05})
    >>> session.stop()
    >>> round(session.state["fetch/torso_lift_joint"], 2), session.steps
    (0.11, 11)
    """

    def __init__(
        self,
        interface: RobotInterface,
        *,
        dt: float = 0.02,
        belief: Belief | None = None,
        on_step: Callable[[Session], object] | None = None,
        on_search: Callable[[str], object] | None = None,
        timeout: float | None = 10.0,
        patience: float = 10.0,
    ) -> None:
        for name, value in (("dt", dt), ("timeout", timeout), ("patience", patience)):
            if value is not None or name != "timeout":
                as_positive(value, f"{name}=", "time in s, such as 0.02")
        if not (isinstance(interface.timeout, (int, float)) and interface.timeout > 0.0):
            raise InvalidValueError(
                f"timeout of a robot's interface is a positive time in s, not {interface.timeout!r}."
            )
        if dt > interface.timeout + 1e-9:
            raise InvalidValueError(
                f"dt={dt:g} s is longer than the time-out of the robot, {interface.timeout:g} s: it would "
                f"stand still for the rest of each step. Make its interface with timeout={dt:g} or more."
            )
        self.interface, self.dt = interface, dt
        self.model = interface.model
        self.robot = Robot.of(self.model, interface.robot)
        self.belief: Belief = belief or _make_belief(self.model, self.robot)
        self.fault = self.broken = ""
        self._version = self.model.version
        self._patience = patience
        self._caller = None if timeout is None else _Caller(timeout)
        self._speeds: dict[object, Symbol] = {name: s for s in self.model.speeds for name in (s, str(s))}
        self._coordinates = frozenset(self.robot.coordinates)
        self._on_step, self._on_search = on_step, on_search
        self.commands: Speeds = {}
        self.command: Command | None = None
        self.reference: HandReference | None = None
        self.vectors: Mapping[str, tuple[Array, Array]] = {}
        self.contact: PlannedContact | None = None
        self.phase, self.steps, self.time = "", 0, 0.0
        self.cpu: dict[str, list[float]] = {}
        self.wall: dict[str, list[float]] = {}
        self.made: deque[BasePlacement] = deque(maxlen=_MADE)
        self._problem = ""  # what is wrong with the latest readings
        self._frames = frozenset(self.model.frames)
        self._unknown: dict[str, None] = {}  # observed frames that the model does not have
        self._not_rigid: dict[str, None] = {}  # frames of which poses have been observed that are none
        self.state: State = self.model.default_state()
        self.start = self.state
        self.observation = Observation(-math.inf, {})
        with suppress(SkillError):  # of what does not answer now, the first skill says it
            self.refresh()

    # -- what is known ---------------------------------------------------------------------------------------

    def deviation(self, what: Symbol | str | Expression) -> float:
        """Return the standard deviation of a coordinate, or of an expression of coordinates [m], [rad].

        That of an expression is to first order, and takes the errors of coordinates as independent.

        Raises
        ------
        ShapeError
            For an expression that is no number.
        UnknownNameError
            For a coordinate that the belief does not have.
        """
        if isinstance(what, str):
            what = self.model.symbol(what)
        if isinstance(what, Symbol):
            if what not in self.state:
                known = suggest(str(what), map(str, self.state), "coordinate")
                raise UnknownNameError(f"The belief says nothing about '{what}'. {known}")
            return self.belief.deviation(what)
        if what.shape != ():
            raise ShapeError(f"Only a scalar has a deviation, not an expression of shape {what.shape}.")
        own = {s: self.deviation(s) for s in what.symbols}
        slopes = {s: float(what.partial([s])(self.state)[0]) for s, deviation in own.items() if deviation}
        return math.hypot(*(k * own[s] for s, k in slopes.items() if k))

    def time_unseen(self, coordinate: Symbol) -> float:
        """Return for how long no marker of a coordinate has been seen [s]; 0 if the belief has no markers.

        It is infinite if none has been seen since the belief began.
        """
        seen = getattr(self.belief, "seen", None)
        return 0.0 if seen is None else max(0.0, self.time - float(seen.get(coordinate, -math.inf)))

    def refresh(self) -> None:
        """Read the sensors without a step, such as after a search, or after a reset of a simulated world.

        Raises
        ------
        InvalidValueError
            If the model was edited since the session was made.
        SkillError
            If the robot does not answer, or its interface raises something.
        """
        self._check_version()
        self.observation, self.time = self._call(self._read)
        self._update({})

    @contextmanager
    def believing(self, belief: Belief) -> Iterator[None]:
        """Use another source of the state for a while."""
        before, self.belief = self.belief, belief
        try:
            self.refresh()
            yield
        finally:
            self.belief = before
            self._update({})  # so that the state is never that of the other one

    # -- what is computed ------------------------------------------------------------------------------------

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Measure the time that the computations of a step take."""
        cpu, wall = thread_time(), perf_counter()
        yield
        self.cpu.setdefault(name, []).append(thread_time() - cpu)
        self.wall.setdefault(name, []).append(perf_counter() - wall)

    @contextmanager
    def search(self, text: str = "") -> Iterator[None]:
        """Search or plan something that takes long, while nothing moves; then the sensors are read anew.

        The text tells what is searched.
        """
        if text:
            self.report_search(text)
        wall = perf_counter()
        yield
        if perf_counter() - wall > self.interface.timeout and not self.broken:
            self.refresh()

    def report_search(self, text: str) -> None:
        """Tell the progress of a search, in which nothing moves."""
        if self._on_search is not None:
            self._on_search(text)

    # -- what is done ----------------------------------------------------------------------------------------

    def act(
        self, speeds: Mapping[Symbol, float] | Mapping[str, float], command: Command | None = None
    ) -> None:
        """Command speeds for one step, and update the belief. Speeds of objects are not sent.

        The belief gets them all. Where readings are old or wrong afterwards, the robot stands still until
        better ones come.

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
            For speeds that the model does not have, those that are not finite, and a model that was edited
            since the session was made. Then nothing has changed.
        SkillError
            If the robot does not answer within the time-out, or its interface raises something, its
            simulation is not to be trusted, or no readings of the present have come within the patience.
            Robots stop by themselves then.
        """
        self._check_version()
        resolved = self._resolve(speeds)
        before, self.command = self.time, command
        self._advance(resolved, stamp=self.state.stamp if resolved else None)
        if self._find_problem(before):
            self.await_readings(before)

    def await_readings(self, before: float = -math.inf) -> None:
        """Stand still until readings are right, and of the present, after a time [s].

        Raises
        ------
        SkillError
            Saying what is wrong, if that takes longer than the patience, by any clock.
        """
        begin, wall = self.time, time.monotonic()
        while problem := self._find_problem(before):
            waited = max(self.time - begin, time.monotonic() - wall)
            if waited > self._patience:
                self.fault = f"{problem} The robot has waited for {waited:.3g} s."
                raise SkillError("other", self.fault)
            earlier = self.time
            self._advance(self._fingers_at_rest, stamp=None)
            if self.time <= earlier:
                time.sleep(self.dt)  # an interface that does not wait by itself

    @cached_property
    def _fingers_at_rest(self) -> Speeds:
        """Speeds of fingers that close on nothing any more, and keep the force on what they hold."""
        return {s.derivative(): 0.0 for gripper in self.robot.grippers for s in gripper.joints}

    def stop(self) -> None:
        """Command zero speeds for one step; nothing if the robot does not answer."""
        self.command = None
        if not self.broken:
            with suppress(SkillError):
                self._advance({}, stamp=None, longest=_STOPPING)

    def _check_version(self) -> None:
        if self.model.version != self._version:
            raise InvalidValueError(
                "The model of this session was edited, and its robot and its belief are of the model before. "
                "Make another session, or this one of model.snapshot()."
            )

    def _find_problem(self, before: float) -> str:
        """Return why the robot must not move by the present state; empty if it may."""
        name, now, stamp = self.interface.name, self.time, self.state.stamp
        if self._problem:
            return self._problem
        if now <= before:
            return f"The robot's time '{name}' stands still at {now:g} s."
        if stamp is None:
            return f"The robot '{name}' has not been observed."
        if now - stamp > STALE:
            return f"The robot '{name}' was observed last at {stamp:.3f} s, {now - stamp:.3f} s ago."
        return ""

    def _resolve(self, speeds: Mapping[Symbol, float] | Mapping[str, float]) -> Speeds:
        if not isinstance(speeds, Mapping):
            raise InvalidValueError(f"Speeds are a mapping from symbols or names to numbers, not {speeds!r}.")
        resolved: dict[Symbol, float] = {}
        for key, value in speeds.items():
            speed = self._speeds.get(key)
            if speed is None and isinstance(key, Symbol) and not self.robot.moves(key):
                speed = key  # of an object that only the skill's own model has
            if speed is None:
                known = map(str, self.model.speeds)
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

    def _advance(self, speeds: Speeds, stamp: float | None, longest: float = math.inf) -> None:
        """Command speeds for one step, with the time of their state; a stop has None and is never too old."""
        self.commands = {s: v for s, v in speeds.items() if self.robot.moves(s)}

        def step() -> tuple[Observation, float]:
            self.interface.apply(self.commands, self.dt, stamp=stamp)
            return self._read()

        before = self.time
        self.observation, self.time = self._call(step, longest)
        # Over a longer time the robot has stopped by itself, and speeds of the step say nothing.
        self._update(speeds if self.time - before <= self.dt + self.interface.timeout else {})
        self.steps += 1
        if self._on_step is not None:
            self._on_step(self)

    def _read(self) -> tuple[Observation, float]:
        observation, now = self.interface.observe(), float(self.interface.time)
        if not isinstance(observation, Observation):
            raise InvalidValueError(f"observe() returned {observation!r:.60}, and no Observation.")
        for name in ("joints", "poses"):
            if not isinstance(given := getattr(observation, name), Mapping):
                raise InvalidValueError(f"{name}= of an Observation is a mapping, not {given!r:.60}.")
        return observation, now

    def _call(self, function: Callable[[], Result], longest: float = math.inf) -> Result:
        """Call a function of the interface; raise SkillError if it fails or takes too long."""
        if self.broken:
            self.fault = self.broken
            raise SkillError("other", self.broken)
        name = self.interface.name
        try:
            return function() if self._caller is None else self._caller.call(function, longest)
        except _NoAnswerError as error:
            self.commands = {}
            self.fault = self.broken = f"The robot '{name}' has not answered for {error} s."
            raise SkillError("other", self.broken) from None
        except StoppedError as error:  # until it is released
            self.fault = str(error)
            raise SkillError("other", self.fault) from error
        except SimulationError as error:
            self.fault = self.broken = str(error)
            raise SkillError("other", self.broken) from error
        except Exception as error:  # a driver raises what it likes
            where = extract_tb(error.__traceback__)[-1]
            self.fault = self._problem = (
                f"The interface of the robot '{name}' raised {type(error).__name__}: {error} "
                f"({Path(where.filename).name}, line {where.lineno})."
            )
            raise SkillError("other", self._problem) from error

    def _update(self, speeds: Speeds) -> None:
        """Update the belief by the latest readings, unless something is wrong with them."""
        self._problem = self._check_joints()
        if not self._problem:
            self._check_poses()
            self.state = self.belief.update(self.observation, self.time, State(speeds))
            if self.start.stamp is None:  # the first look, of a robot that did not answer before
                self.start = self.state

    def _check_joints(self) -> str:
        """Return what is wrong with the latest stamp and encoders; empty if nothing is."""
        observation = self.observation
        if finite_number(observation.stamp) is None or not math.isfinite(self.time):
            return f"The robot's readings have the stamp {observation.stamp!r} at {self.time!r} s."
        if (early := observation.stamp - self.time) > STALE:  # nobody could tell when they are old
            return f"The robot's readings are of {observation.stamp:.3f} s, {early:.3f} s after its time."
        if missing := self._coordinates.difference(observation.joints):
            return f"The robot's readings lack {_list(map(str, missing))}."
        bad = [str(s) for s, v in observation.joints.items() if finite_number(v) is None]
        return f"The robot's readings of {_list(bad)} are no finite numbers." if bad else ""

    def _check_poses(self) -> None:
        """Leave out observed poses that are not rigid, and those of frames that the model does not have."""
        poses = self.observation.poses
        frames = self._frames
        self._unknown |= dict.fromkeys(name for name in poses if name not in frames)
        good = {name: pose for name, pose in poses.items() if name in frames}
        if good and not _are_rigid([*good.values()]):
            bad = dict.fromkeys(name for name, pose in good.items() if not _are_rigid([pose]))
            self._not_rigid |= bad
            good = {name: pose for name, pose in good.items() if name not in bad}
        if len(good) < len(poses):
            self.observation = replace(self.observation, poses=good)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks on the readings, such as on poses of frames that the model does not have."""
        texts = {
            "Poses are observed of frames that the model does not have": self._unknown,
            "Poses were observed that are no rigid transforms": self._not_rigid,
        }
        return tuple(f"{text}: {_list(names)}." for text, names in texts.items() if names)


def _list(names: Iterator[str] | list[str] | Mapping[str, None]) -> str:
    known = sorted(names)
    more = f" and {len(known) - _NAMED} more" if len(known) > _NAMED else ""
    return ", ".join(f"'{name}'" for name in known[:_NAMED]) + more


def _are_rigid(poses: list[Any]) -> bool:
    """Return whether all poses are rigid transforms (4, 4)."""
    try:
        matrices = np.array(poses, dtype=float)
    except (TypeError, ValueError):
        return False
    if matrices.shape[1:] != (4, 4) or not np.isfinite(matrices).all():
        return False
    rotations = matrices[:, :3, :3]
    off = np.abs(rotations.transpose(0, 2, 1) @ rotations - np.eye(3)).max()
    last = np.abs(matrices[:, 3] - (0.0, 0.0, 0.0, 1.0)).max()
    return bool(max(off, last) <= _RIGID and (np.linalg.det(rotations) > 0.0).all())


def _make_belief(model: ModelView, robot: Robot) -> Belief:
    """Return a belief from sensors that nobody has described, of all that can be observed."""
    if not any(model.symbols_of(name) for name in robot.markers):
        return EncoderBelief(model, robot)
    from .belief import USUAL, TrackedBelief  # for start-up time: it needs all of estimation

    return TrackedBelief(model, robot, USUAL)


class _NoAnswerError(Exception):
    """End of the time-out of a call [s]; a driver's own TimeoutError is another thing."""


class _Caller:
    """Calls in a thread of its own, so that one that never returns does not hold up the caller."""

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._calls: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._thread: Thread | None = None

    def __del__(self) -> None:
        self._calls.put(None)

    def call(self, function: Callable[[], Result], longest: float = math.inf) -> Result:
        """Return the result of a function, or raise what it raises; _NoAnswerError after a time [s]."""
        if self._thread is None:
            self._thread = Thread(target=_serve, args=(self._calls,), daemon=True, name="robot interface")
            self._thread.start()
        results: list[Result] = []
        errors: list[BaseException] = []
        done = Event()

        def run() -> None:
            try:
                results.append(function())
            except BaseException as error:
                errors.append(error)
            finally:
                done.set()

        self._calls.put(run)
        timeout = min(self._timeout, longest)
        if not done.wait(timeout):
            raise _NoAnswerError(f"{timeout:g}")
        if errors:
            raise errors[0]
        return results[0]


def _serve(calls: SimpleQueue[Callable[[], object] | None]) -> None:
    while (call := calls.get()) is not None:
        call()
        del call  # it has the session, whose end ends this thread
