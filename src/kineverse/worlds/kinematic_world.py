"""Quasi-static world: touched bodies are displaced along the contact normal, a held body follows the hand.

It takes speeds of the robot alone. An object stands still unless a body of the robot would penetrate it, or
its spring moves it; then it moves by the least that its limits, speed limits and locks allow, see
:mod:`.quasistatic`. So objects can be pushed and not dragged, have no inertia, and nothing falls. What cannot
give way is penetrated, and :meth:`KinematicWorld.contacts` reports it; so is furniture that never moves. What
the robot moves stops at other furniture, beyond the overlaps of the start, see :mod:`.furniture_overlaps`.
The robot goes exactly where its speeds lead, also beyond its limits.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from kineverse._checks import as_entries
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.geometry import Scene
from kineverse.geometry.results import DistanceResult
from kineverse.grasping.gripper_detection import Gripper
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .furniture_overlaps import FurnitureOverlaps
from .kinematic_grip import TOUCH, KinematicGrip
from .quasistatic import ObjectMotion
from .robot import Robot
from .robot_interface import Observation
from .sensor_sampler import SensorSampler
from .sensors import Sensors
from .simulated_world import (
    SAME_PLACE,
    Contact,
    carried_sensors,
    carried_state,
    displaced_state,
    refuse_overlap,
    saved_time,
)
from .speed_commands import ROUNDING, SpeedCommands, check_settings

logger = logging.getLogger(__name__)

_SUBSTEP = 0.002  # longest motion of a body between two checks of its gaps, while it is near an object [m]
_HELD_SUBSTEP = 0.01  # longest motion of a hand between two checks of what it holds [m]
_MOST_SUBSTEPS = 10_000
_UNKNOWN_TRAVEL = 0.1


class Event(NamedTuple):
    """Something that happened in a world at a time [s], such as a hold that began.

    See Also
    --------
    kineverse.worlds.KinematicWorld
    """

    time: float
    text: str


class KinematicWorld:
    """World without forces.

    Parameters
    ----------
    model
        Model of the robot and of everything that moves.
    robot
        The robot, or the prefix of its names in the model.
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

    Raises
    ------
    MissingDependencyError
        If daqp (extra ``control``) or coal (extra ``geometry``) is not installed.
    UnknownNameError
        If the model has no such robot, or no constraint of a name.
    InvalidValueError
        For parameters out of their range.

    Examples
    --------
    >>> model = kv.load("fetch")
    >>> world = kv.worlds.KinematicWorld(model, "fetch")
    >>> world.reset({"fetch/torso_lift_joint": 0.1})
    >>> world.apply({"fetch/torso_lift_joint:velocity": 0.05}, 0.1)
    >>> round(world.state["fetch/torso_lift_joint"], 3), round(world.time, 2)
    (0.105, 0.1)
    >>> world.contacts()
    ()
    """

    name = "kinematic"
    peak_force = math.nan

    def __init__(
        self,
        model: ModelView,
        robot: Robot | str,
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
        sizes = {"grasp_tolerance": grasp_tolerance, "delay": delay, "slip[0]": slip[0], "slip[1]": slip[1]}
        check_settings({"timeout": timeout}, sizes)
        self.robot = robot = Robot.of(model, robot)
        self.model, self._version, self.timeout = model, model.version, float(timeout)
        left_out = as_entries("leave_out=", leave_out, str, "names of constraints")
        self._settings: dict[str, Any] = {
            "gripper": gripper, "grasp_tolerance": grasp_tolerance, "slip": slip, "timeout": timeout,
            "delay": delay, "seed": seed,
        }  # fmt: skip
        self._left_out = left_out
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
            gripper = next(iter(robot.grippers), None)
            remarks.append(
                f"no gripper of '{robot.name}' is known, so it holds nothing"
                if gripper is None
                else f"the gripper at '{gripper.hand}' holds things"
            )
        fingers = () if gripper is None else gripper.joints
        objects = [v for v in model.speeds if not robot.moves(v)]
        self._motion = ObjectMotion(
            FurnitureOverlaps(scene or Scene(model), robot),
            objects,
            [s.derivative() for s in fingers],
            robot,
            left_out,
        )
        remarks += [f"'{name}' is not enforced: {why}" for name, why in self._motion.skipped]
        remarks += [
            f"the spring of '{name}' does nothing, as it carries a weight, and nothing has one here"
            for name in self._motion.springs.skipped
        ]
        self._grip = (
            None
            if gripper is None
            else KinematicGrip(
                self._motion, gripper, float(grasp_tolerance), (float(slip[0]), float(slip[1])), self._report
            )
        )
        own = robot.speeds
        columns: dict[Symbol | str, int | None] = dict.fromkeys(model.speeds)
        columns |= {v: k for k, v in enumerate(own)}
        columns |= {str(v): k for v, k in columns.items()}
        finger_speeds = {s.derivative() for s in fingers}
        self._finger = np.array([columns[s.derivative()] for s in fingers], dtype=np.intp)
        is_finger = np.array([v in finger_speeds for v in own], dtype=bool)
        self._commands = SpeedCommands(columns, is_finger, self.timeout, float(delay), self._report)
        self._integrate = model.integrator(own)
        self._state: State | None = None
        self._contacts: tuple[Contact, ...] | None = None
        bodies, scene = self._motion.robot_bodies, self._motion.scene
        self._touching = scene.watch(bodies, [b for b in scene.bodies if b not in {*bodies}], TOUCH)
        self._sampler = SensorSampler(sensors or Sensors(), model, robot, seed)
        self.remarks = (*remarks, "objects have no friction and no inertia, and nothing falls")
        self.reset(model.default_state())

    def __repr__(self) -> str:
        return f"<KinematicWorld of '{self.robot.name}' at {self.time:g} s>"

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
    def refused(self) -> int:
        """Number of commands since the last reset that were stale when they came."""
        return self._commands.refused

    @property
    def events(self) -> tuple[Event, ...]:
        """Holds that began or ended, and commands that were refused, since the last reset."""
        return tuple(self._events)

    def contacts(self) -> tuple[Contact, ...]:
        """Return the bodies of the robot that touch something else, and those of furniture that collide.

        Bodies of the robot touch from a gap of 0.1 mm on. Furniture collides if it penetrates by more than
        that, and more than at the start and at the default state. Forces are NaN.
        """
        overlaps = self._motion.overlaps.find_beyond(TOUCH)
        deepest = {(one.a, one.b): one for one, _ in reversed(overlaps)}
        return (*self._touched(), *map(_make_contact, deepest.values()))

    def _touched(self) -> tuple[Contact, ...]:
        if self._contacts is None:
            result = (one if self.robot.owns(one.a) else one.swap() for one in self._touching())
            self._contacts = tuple(map(_make_contact, result))
        return self._contacts

    def observe(self) -> Observation:
        """Return the latest sensor readings that have arrived."""
        return self._sampler.observe(self._time, self.state, self._touched())

    # -- what happens --------------------------------------------------------------------------------------

    def reset(self, state: StateLike) -> None:
        """Start again from a state, at time 0, with nothing in the gripper and all speeds zero.

        Coordinates without a value have their default one.

        See Also
        --------
        kineverse.worlds.KinematicWorld
        """
        self._check_version()
        values = self.model.default_state().updated(_select(state, self.model))
        self._motion.reset(values.vector(self._motion.symbols))
        self._time = 0.0
        self._events: list[Event] = []
        if self._grip is not None:
            self._grip.reset()
        self._commands.reset()
        self._state = self._contacts = None
        self._sampler.reset()

    @property
    def sensors(self) -> Sensors:
        """Settings of the sensors; others take effect with the next readings."""
        return self._sampler.sensors

    @sensors.setter
    def sensors(self, sensors: Sensors) -> None:
        self._sampler.change(sensors)

    def displace(self, values: StateLike) -> None:
        """Move furniture as a person does, see :meth:`.ChangeableWorld.displace`."""
        self._check_version()
        state = displaced_state(self, values)
        if (bodies := self._motion.displace(state.vector(self._motion.symbols))) is not None:
            raise refuse_overlap(*bodies, values)
        self._state = self._contacts = None

    def resume(self, state: StateLike, held: str | None = None) -> None:
        """Go on from a state that was saved, see :meth:`.ChangeableWorld.resume`."""
        self.reset(state)
        self._time = saved_time(state)
        if held is not None and self._grip is not None:
            self._grip.hold(held)

    def take_over(self, other: KinematicWorld) -> None:
        """Go on where another world is, see :meth:`.ChangeableWorld.take_over`."""
        held = other.held
        self.resume(carried_state(other, self.model))
        self._events = [*other._events]
        self._commands.take_over(other._commands)
        self._sampler.take_over(other._sampler, carried_sensors(other.sensors, self.model))
        if held is not None and self._grip is not None and other._grip is not None:
            known = held in self._motion.scene.bodies
            before, after = (
                grip.place_of(held) if known else np.eye(4) for grip in (other._grip, self._grip)
            )
            if known and np.allclose(before, after, rtol=0.0, atol=SAME_PLACE):
                self._grip.hold(held)
            else:
                self._report(f"'{held}' is released: it was moved, or is gone")

    def rebuild(self, model: ModelView) -> KinematicWorld:
        """Return a world of another model that goes on where this one is; its scene is ``Scene(model)``."""
        kept = [name for name in self._left_out if name in model.constraints]
        sensors = carried_sensors(self.sensors, model)
        result = KinematicWorld(model, self.robot, sensors=sensors, leave_out=kept, **self._settings)
        result.take_over(self)
        return result

    def apply(self, speeds: StateLike, duration: float, *, stamp: float | None = None) -> None:
        """Advance by a duration with speeds of the robot, as :meth:`.RobotInterface.apply`.

        Fingers stop at what they close on, and at their limits. Nothing has changed after an error.
        """
        self._check_version()
        end = self._commands.take(speeds, duration, stamp, self._time)
        self._state = self._contacts = None
        while self._time < end - ROUNDING:
            acting = self._commands.acting(self._time)
            until = min(end, self._commands.next_change(self._time))
            self._move(acting, until - self._time)
            self._time = until
        self._time = end

    def _move(self, speeds: Array, time: float) -> None:
        motion, grip = self._motion, self._grip
        arm, start, reach = speeds.copy(), motion.q.copy(), 0.0
        arm[self._finger] = 0.0
        if grip is not None:
            grip.command(speeds[self._finger])
            reach = float(np.abs(grip.steps(time)) @ np.sqrt(motion.weights[motion.count :]))
        before = motion.travel()
        motion.place(self._integrate(start, arm, time))
        moved = motion.travel() - before
        # The travel restarts at some time.
        moved[moved < 0.0] = _UNKNOWN_TRAVEL
        sprung = motion.spring_travel(time)
        travel = float(moved.max(initial=0.0)) + reach + sprung
        grips = grip is not None and (grip.held is not None or reach > 0.0)
        # What is not near now has not been touched on the way.
        longest = motion.longest_motion(moved, travel)
        count = 0 if longest is None else math.ceil((longest + reach + sprung) / _SUBSTEP)
        if grip is not None and grip.held is not None:
            count = max(count, math.ceil(travel / _HELD_SUBSTEP))
        count = min(count, _MOST_SUBSTEPS)
        if count > 1:
            motion.place(start)
            for _ in range(count):
                motion.place(self._integrate(motion.q, arm, time / count))
                self._settle(time / count, travel / count, grips)
        elif longest is not None or grips or sprung:
            self._settle(time, travel, grips)

    def _settle(self, time: float, moved: float, grips: bool) -> None:
        """Move fingers and objects after the rest of the robot has moved."""
        if grips and self._grip is not None:
            self._grip.move(time, moved)
        else:
            self._motion.resolve(time, moved)
        self._motion.settle()

    def _check_version(self) -> None:
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
