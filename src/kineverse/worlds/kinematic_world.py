"""World without forces: what a robot touches gives way along the normal, and a held body follows the hand.

It takes speeds of the robot alone. An object stands still unless a body of the robot would penetrate it; then
it moves by the least that its limits, speed limits and locks allow, see :mod:`.object_motion`. So objects can
be pushed and not dragged, have no inertia, and nothing falls. What cannot give way is penetrated, and
:meth:`KinematicWorld.contacts` reports it; so is furniture that never moves. What the robot moves stops at
other furniture, beyond the overlaps of the start, see :mod:`.furniture_overlaps`. The robot goes exactly
where its speeds lead, also beyond its limits.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Iterable, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np

from kineverse._checks import as_entries, finite_number
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.geometry import Scene
from kineverse.geometry.results import DistanceResult
from kineverse.grasping.gripper_detection import Gripper, find_grippers
from kineverse.lie import Array
from kineverse.model.frame import is_of_robot
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .furniture_overlaps import FurnitureOverlaps
from .kinematic_grip import TOUCH, KinematicGrip
from .quasistatic import ObjectMotion
from .sensor_sampler import SensorSampler
from .sensors import Sensors
from .world import Contact, Observation

logger = logging.getLogger(__name__)

_SUBSTEP = 0.002  # longest way of a body between two checks of its gaps, while it is near an object [m]
_HELD_SUBSTEP = 0.01
"""Longest way of a hand between two checks of what it holds [m]: thinner furniture is rare."""
_MOST_SUBSTEPS = 10_000
_UNKNOWN_WAY = 0.1
_ROUNDING = 1e-9


class _Command(NamedTuple):
    """Speeds of the robot (n,) that act from one time until another [s]; those of fingers act on."""

    speeds: Array
    start: float
    end: float


class Event(NamedTuple):
    """Something that happened in a world at a time [s], such as a hold that began."""

    time: float
    text: str


class KinematicWorld:
    """World without forces.

    Parameters
    ----------
    model
        Model of the robot and of everything that moves.
    robot
        Prefix of the robot: coordinates and bodies below it are the robot's.
    gripper
        Gripper that holds things; None for the likeliest one of the robot, if it has any.
    grasp_tolerance
        Largest gap of the second finger when a hold begins [m]: as much as a real hand gives way.
    slip
        Largest distance [m] and angle [rad] by which a held body may leave its place in the hand, measured in
        the middle between the fingers, as an arm yields and pads slide. Beyond, it is lost, and nothing is
        held before the fingers opened.
    timeout
        Age [s] of a command with a stamp beyond which the robot stops.
    delay
        Time [s] from a command to its effect.
    sensors
        Settings of the sensors whose readings :meth:`observe` returns; None for exact ones.
    leave_out
        Names of constraints that do not hold for the objects of this world.
    scene
        Collision scene of the model, which from now on is the world's; None for ``Scene(model)``.
    seed
        Seed of the sensors' noise.

    Attributes
    ----------
    timeout
        The parameter of this name.
    refused
        Number of commands since the last reset that were stale when they came.

    Raises
    ------
    MissingDependencyError
        If daqp (extra ``control``) or coal (extra ``geometry``) is not installed.
    UnknownNameError
        If no coordinate of the model is below the prefix, or it has no constraint of a name.
    InvalidValueError
        For parameters out of their range.
    """

    name = "kinematic"

    def __init__(
        self,
        model: ModelView,
        robot: str,
        gripper: Gripper | None = None,
        *,
        grasp_tolerance: float = 0.006,
        slip: tuple[float, float] = (0.01, 0.1),
        timeout: float = 0.1,
        delay: float = 0.0,
        sensors: Sensors | None = None,
        leave_out: Iterable[str] = (),
        scene: Scene | None = None,
        seed: int = 0,
    ) -> None:
        numbers = {"grasp_tolerance": grasp_tolerance, "timeout": timeout, "delay": delay}
        numbers |= {"slip[0]": slip[0], "slip[1]": slip[1]}
        for field, value in numbers.items():
            number = finite_number(value)
            if number is None or number < 0 or (field == "timeout" and not number):
                raise InvalidValueError(f"'{field}' of a world is a number from 0 on, not {value!r}.")
        self.model, self.robot, self._version = model, robot, model.version
        self._is_robot = partial(is_of_robot, robot=robot)
        self.timeout, self._delay = float(timeout), float(delay)
        if not any(self._is_robot(s.path) for s in model.degrees_of_freedom):
            prefixes = sorted({s.path.partition("/")[0] for s in model.degrees_of_freedom})
            raise UnknownNameError(
                f"No coordinate of the model is below '{robot}'. {suggest(robot, prefixes, 'prefix')}"
            )
        left_out = as_entries("leave_out=", leave_out, str, "names of constraints")
        for name in left_out:
            if name not in model.constraints:
                raise UnknownNameError(
                    f"There is no constraint '{name}'. {suggest(name, model.constraints, 'constraint')}"
                )
        if scene is not None and scene.model is not model:
            raise InvalidValueError(
                "scene= is the scene of another model. Make it of this one: Scene(model)."
            )
        remarks = [f"the constraint '{name}' is left out" for name in left_out]
        if gripper is None:
            gripper = next(iter(find_grippers(model, robot)), None)
            remarks.append(
                f"no gripper of '{robot}' is known, so it holds nothing"
                if gripper is None
                else f"the gripper at '{gripper.hand}' holds things"
            )
        fingers = () if gripper is None else gripper.joints
        objects = [v for v in model.speeds if not self._is_robot(v.path)]
        self._motion = ObjectMotion(
            FurnitureOverlaps(scene or Scene(model), robot),
            objects,
            [s.derivative() for s in fingers],
            self._is_robot,
            left_out,
        )
        remarks += [f"'{name}' is not enforced: {why}" for name, why in self._motion.skipped]
        self._grip = (
            None
            if gripper is None
            else KinematicGrip(
                self._motion, gripper, float(grasp_tolerance), (float(slip[0]), float(slip[1])), self._report
            )
        )
        own = [v for v in model.speeds if self._is_robot(v.path)]
        self._speed_count = len(own)
        # Speeds are given by symbol or by name; those of objects are known and not read.
        self._column: dict[Symbol | str, int | None] = dict.fromkeys(model.speeds)
        self._column |= {v: k for k, v in enumerate(own)}
        self._column |= {str(v): k for v, k in self._column.items()}
        self._finger = np.array([self._column[s.derivative()] for s in fingers], dtype=np.intp)
        self._integrate = model.integrator(own)
        self._state: State | None = None
        self._contacts: tuple[Contact, ...] | None = None
        self._watch_contacts()
        self._sampler = SensorSampler(sensors or Sensors(), model, robot, seed)
        self.remarks = (*remarks, "objects have no friction and no inertia, and nothing falls")
        self.reset(model.default_state())

    def __repr__(self) -> str:
        return f"<KinematicWorld of '{self.robot}' at {self.time:g} s>"

    # -- what there is -------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Time since the last reset [s]."""
        return self._time

    @property
    def state(self) -> State:
        """True values of all coordinates; its stamp is the time [s]."""
        if self._state is None:
            values = dict(zip(self._motion.symbols, self._motion.q.tolist(), strict=True))
            self._state = State(values, stamp=self._time, source=self.name)
        return self._state

    @property
    def held(self) -> str | None:
        """Frame of the body in the robot's gripper; None if it holds nothing."""
        return None if self._grip is None else self._grip.held

    @property
    def events(self) -> tuple[Event, ...]:
        """Holds that began or ended, and commands that were refused, since the last reset."""
        return tuple(self._events)

    def contacts(self) -> tuple[Contact, ...]:
        """Return the bodies of the robot that touch something else, and those of furniture that collide.

        Bodies of the robot touch from a gap of 0.1 mm on. Furniture collides if it penetrates by more than
        that, and more than at the begin and at the default state. Forces are NaN.
        """
        overlaps = self._motion.overlaps.find_beyond(TOUCH)
        deepest = {(one.a, one.b): one for one, _ in reversed(overlaps)}
        return (*self._touched(), *map(_make_contact, deepest.values()))

    def _touched(self) -> tuple[Contact, ...]:
        """Return the contacts of the robot."""
        if self._contacts is None:
            found = (one if self._is_robot(one.a) else one.swap() for one in self._touching())
            self._contacts = tuple(map(_make_contact, found))
        return self._contacts

    def observe(self) -> Observation:
        """Return the latest sensor readings that have arrived."""
        return self._sampler.observe(self._time, self.state, self._touched())

    # -- what happens --------------------------------------------------------------------------------------

    def reset(self, state: StateLike) -> None:
        """Start anew from a state, at time 0, with nothing in the gripper and all speeds zero.

        Coordinates without a value have their default one.

        Raises
        ------
        UnknownNameError
            For a symbol that the model does not have.
        """
        self._check_version()
        values = self.model.default_state().updated(_select(state, self.model))
        self._motion.reset(values.vector(self._motion.symbols))
        self._time, self.refused = 0.0, 0
        self._events: list[Event] = []
        if self._grip is not None:
            self._grip.reset()
        self._last: Array = np.zeros(self._speed_count)
        self._commands: deque[_Command] = deque()
        self._active = _Command(self._last, 0.0, 0.0)
        self._state = self._contacts = None
        self._sampler.reset()

    def apply(self, speeds: StateLike, duration: float, *, stamp: float | None = None) -> None:
        """Advance by a duration with speeds of the robot.

        Speeds of anything else are not read. Fingers keep the last speed that was given, until they close on
        something or reach a limit.

        Parameters
        ----------
        speeds
            Speeds of the robot by symbol or name [m/s], [rad/s]; an empty mapping stops it.
        duration
            Time [s].
        stamp
            Time of the state from which the speeds were computed [s]: beyond the age of the world's time-out
            they are refused, or act no longer. None for speeds that act for the whole duration.

        Raises
        ------
        InvalidValueError
            For speeds that are not finite, a duration that is not positive, and a stamp that is no number.
            Then nothing has changed.
        UnknownNameError
            For speeds that the model does not have.
        """
        self._check_version()
        length = finite_number(duration)
        if length is None or length <= 0:
            raise InvalidValueError(f"A duration is a positive number of seconds, not {duration!r}.")
        taken = None if stamp is None else finite_number(stamp)
        if stamp is not None and taken is None:
            raise InvalidValueError(f"The stamp of speeds is a time in seconds, not {stamp!r}.")
        vector, now = self._vector(speeds), self._time
        until = now + length
        if taken is not None:
            if now - self.timeout <= taken + _ROUNDING <= now + 2 * _ROUNDING:
                until = min(until, taken + self.timeout)
            else:
                self.refused += 1
                self._report(f"speeds with the stamp {taken:g} s are refused")
                vector = self._stopped(self._last)
        self._last = vector
        self._commands.append(_Command(vector, now + self._delay, until + self._delay))
        self._state = self._contacts = None
        end = now + length
        while self._time < end - _ROUNDING:
            while self._commands and self._commands[0].start <= self._time + _ROUNDING:
                self._active = self._commands.popleft()
            active = self._active
            acts = self._time < active.end - _ROUNDING
            changes = [end, *([active.end] if acts else ()), *(c.start for c in self._commands)]
            until = min(t for t in changes if t > self._time + _ROUNDING)
            self._move(active.speeds if acts else self._stopped(active.speeds), until - self._time)
            self._time = until
        self._time = end

    def _vector(self, speeds: StateLike) -> Array:
        """Return the speeds of the robot (n,); those of fingers that are not given are the last ones."""
        if not isinstance(speeds, Mapping):
            raise InvalidValueError(f"Speeds are a mapping from symbols or names to numbers, not {speeds!r}.")
        vector = self._stopped(self._last)
        for key, value in speeds.items():
            if key not in self._column:
                if isinstance(speeds, State):
                    continue  # a state may have further values
                names = [name for name in self._column if isinstance(name, str)]
                raise UnknownNameError(
                    f"The model has no free speed '{key}'. {suggest(str(key), names, 'speed')}"
                )
            column = self._column[key]
            if column is not None:
                number = finite_number(value)
                if number is None:
                    raise InvalidValueError(f"The speed '{key}' is {value!r}; it must be finite.")
                vector[column] = number
        return vector

    def _stopped(self, speeds: Array) -> Array:
        """Return zero speeds, but for those of fingers."""
        stopped = np.zeros(len(speeds))
        stopped[self._finger] = speeds[self._finger]
        return stopped

    def _move(self, speeds: Array, time: float) -> None:
        """Move robot and objects with constant speeds of the robot."""
        motion, grip = self._motion, self._grip
        arm, start, reach = speeds.copy(), motion.q.copy(), 0.0
        arm[self._finger] = 0.0
        if grip is not None:
            grip.command(speeds[self._finger])
            reach = float(np.abs(grip.steps(time)) @ np.sqrt(motion.weights[motion.count :]))
        before = motion.travel()
        motion.place(self._integrate(start, arm, time))
        moved = motion.travel() - before
        # The travel begins anew at some time.
        moved[moved < 0.0] = _UNKNOWN_WAY
        way = float(moved.max(initial=0.0)) + reach
        grips = grip is not None and (grip.held is not None or reach > 0.0)
        # What is not near now has not been touched on the way.
        longest = motion.longest_way(moved, way)
        count = 0 if longest is None else math.ceil((longest + reach) / _SUBSTEP)
        if grip is not None and grip.held is not None:
            count = max(count, math.ceil(way / _HELD_SUBSTEP))
        count = min(count, _MOST_SUBSTEPS)
        if count > 1:
            motion.place(start)
            for _ in range(count):
                motion.place(self._integrate(motion.q, arm, time / count))
                self._settle(time / count, way / count, grips)
        elif longest is not None or grips:
            self._settle(time, way, grips)

    def _settle(self, time: float, moved: float, grips: bool) -> None:
        """Move fingers and objects after the rest of the robot has moved."""
        if grips and self._grip is not None:
            self._grip.move(time, moved)
        else:
            self._motion.resolve(time, moved)
        self._motion.settle()

    def _watch_contacts(self) -> None:
        """Prepare the query of contacts."""
        motion, scene = self._motion, self._motion.scene
        robot = set(motion.robot_bodies)
        others = [b for b in scene.bodies if b not in robot]
        self._touching = scene.watch(motion.robot_bodies, others, TOUCH)

    def _check_version(self) -> None:
        """Raise InvalidValueError after an edit of the model."""
        if self.model.version != self._version:
            raise InvalidValueError(
                "The model of this world was edited. Make another world, or this one of model.snapshot()."
            )

    def _report(self, text: str) -> None:
        logger.info("%g s: %s", self._time, text)
        self._events.append(Event(self._time, text))


def _make_contact(found: DistanceResult) -> Contact:
    point = 0.5 * (found.point_a + found.point_b)
    return Contact(found.a, found.b, point, found.normal.copy(), found.distance, math.nan)


def _select(state: StateLike, model: ModelView) -> StateLike:
    """Return the values of a state that a model has; a plain mapping has no others."""
    if not isinstance(state, State):
        return state
    return {s: value for s in model.symbols if (value := state.given(s)) is not None}
