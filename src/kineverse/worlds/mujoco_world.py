"""World with physics: a robot and its furniture in MuJoCo, and bounds beyond which it is not trusted."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal

import numpy as np

from kineverse._checks import finite_number
from kineverse.errors import InvalidValueError, SimulationError, UnknownNameError, suggest
from kineverse.formats.mjcf.mujoco_api import mujoco
from kineverse.grasping.gripper_detection import Gripper
from kineverse.lie import Array, inverse, transform
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from . import mujoco_model
from .mujoco_model import add_floor
from .mujoco_servos import BANDWIDTH, GripperDrive, JointServos, SpeedMap, base_coordinates
from .mujoco_state import MujocoContacts, MujocoCoordinates, MujocoLocks
from .robot import Robot
from .robot_interface import Observation
from .sensor_sampler import SensorSampler
from .sensors import Sensors
from .simulated_world import (
    DEEPER,
    SAME_PLACE,
    Contact,
    carried_sensors,
    carried_state,
    displaced_state,
    refuse_overlap,
    saved_time,
)
from .speed_commands import ROUNDING, SpeedCommands, check_settings

_MARGIN = 10.0
_UNSTATED = 1.0  # limit of a speed that states none [m/s], [rad/s]: walking pace


class SimulationBounds:
    """Largest credible speeds and force of one ``MjModel``: what is beyond them was made by the solver.

    They follow from what the robot can do, with a wide margin. Its coordinates move at ten times their limits
    at most. Another coordinate moves no point faster than twice the fastest point of the robot, as after an
    elastic impact, plus a fall through the scene. The force on the robot stops it from the largest speed of
    its base within a time step, plus ten times what all servos press at their farthest points.
    """

    def __init__(
        self,
        compiled: Any,
        coordinates: MujocoCoordinates,
        model: ModelView,
        efforts: Mapping[Symbol, float],
        robot: Robot,
        is_robot: Callable[[str], bool],
    ) -> None:
        engine, data = mujoco(), mujoco().MjData(compiled)
        self._names = [compiled.joint(int(k)).name for k in compiled.dof_jntid]
        data.qpos[:] = coordinates.positions(coordinates.default)
        engine.mj_forward(compiled, data)
        of_robot = np.array([is_robot(compiled.body(k).name) for k in range(compiled.nbody)])
        limits, base = np.zeros(compiled.nv), np.zeros(compiled.nv)
        for symbol, dof in coordinates.dof.items():
            if robot.moves(symbol):
                limit = float(np.abs(model.limits(symbol.derivative())).min())
                limits[dof] = limit if 0.0 < limit < math.inf else _UNSTATED
        for symbol in base_coordinates(model) & coordinates.dof.keys():
            base[coordinates.dof[symbol]] = limits[coordinates.dof[symbol]]
        levers, fastest = np.zeros(compiled.nv), 0.0
        slide, turn = np.zeros((3, compiled.nv)), np.zeros((3, compiled.nv))
        for geom in range(compiled.ngeom):
            body = int(compiled.geom_bodyid[geom])
            engine.mj_jac(compiled, data, slide, turn, data.geom_xpos[geom], body)
            reaches = (
                np.linalg.norm(slide, axis=0) + np.linalg.norm(turn, axis=0) * compiled.geom_rbound[geom]
            )
            np.maximum(levers, reaches, out=levers)
            if of_robot[body]:
                fastest = max(fastest, float(limits @ reaches))
        fall = math.sqrt(2.0 * abs(float(compiled.opt.gravity[2])) * float(compiled.stat.extent))
        with np.errstate(divide="ignore"):
            others = (2.0 * fastest + fall) / levers
        self.speeds: Array = np.where(limits > 0.0, _MARGIN * limits, others)
        mass = float(compiled.body_mass[of_robot].sum())
        reach = {s: max(float(levers[coordinates.dof[s]]), 1e-3) for s in efforts}
        pressed = sum(effort / reach[s] for s, effort in efforts.items())
        step = float(compiled.opt.timestep)
        self.force = mass * max(float(base.max(initial=0.0)), _UNSTATED) / step + _MARGIN * pressed

    def find_problem(self, data: Any, force: float) -> str:
        """Return what is beyond reason after a time step, or an empty text."""
        speeds = data.qvel
        if not (np.abs(speeds) <= self.speeds).all():
            k = int(np.argmax(np.abs(speeds) / self.speeds))
            return f"'{self._names[k]}' has a speed of {speeds[k]:.3g}, beyond {self.speeds[k]:.3g}"
        if not force <= self.force:
            return f"a force is {force:.3g} N, beyond {self.force:.3g} N"
        return ""


logger = logging.getLogger(__name__)
_SAMPLES = 60
_GRASPS = ("friction", "tie")


class MujocoWorld:
    """World with physics.

    Servos turn speeds of the robot into forces; forces move everything. :attr:`remarks` say what was added to
    the model and what was left out. The world knows nothing of where the speeds come from.

    Parameters
    ----------
    model, robot, gripper, timeout, delay, sensors
        As for :class:`.KinematicWorld`.
    step
        Time step [s].
    grip
        Force of each finger on what is held [N].
    friction
        Coefficient of sliding friction of all bodies.
    grasp
        ``"friction"``: contacts alone hold. ``"tie"``: a body that both fingers touch is welded to the hand.
    leave_out
        Names of constraints that are left out without another remark, as of :meth:`kineverse.Model.save`.
    door_friction
        Friction of furniture by coordinate [N], [N m], in place of that of the model.
    bandwidth
        Bandwidth of the servos [1/s].
    press
        Force with which a servo presses at most on what stops it [N], at the farthest point that it moves.
        The default is what two fingers of 50 N hold by friction: a robot pushes as strongly as it pulls.
    floor
        Whether there is a floor at z = 0, if no furniture and nothing of the robot reaches below it at first.
    seed
        Seed of sampled configurations.

    Raises
    ------
    MissingDependencyError
        If MuJoCo is not installed.
    FormatError
        Naming all motions of the model that MuJoCo cannot represent.
    UnknownNameError
        If the model has no such robot, or no furniture has a coordinate of ``door_friction``.
    InvalidValueError
        For parameters out of their range.

    Examples
    --------
    >>> model = kv.load("fetch")
    >>> world = kv.worlds.MujocoWorld(model, "fetch")
    >>> world.reset({"fetch/torso_lift_joint": 0.1})
    >>> world.apply({"fetch/torso_lift_joint:velocity": 0.05}, 0.1)
    >>> round(world.state["fetch/torso_lift_joint"], 1)
    0.1
    """

    name = "mujoco"

    def __init__(
        self,
        model: ModelView,
        robot: Robot | str,
        gripper: Gripper | None = None,
        *,
        step: float = 0.002,
        grip: float = 50.0,
        friction: float = 1.0,
        grasp: Literal["friction", "tie"] = "friction",
        timeout: float = 0.04,
        delay: float = 0.0,
        sensors: Sensors | None = None,
        leave_out: Iterable[str] = (),
        door_friction: Mapping[Symbol, float] | Mapping[str, float] | None = None,
        bandwidth: float = BANDWIDTH,
        press: float = 120.0,
        floor: bool = True,
        seed: int = 0,
    ) -> None:
        positive = {"step": step, "grip": grip, "timeout": timeout, "bandwidth": bandwidth, "press": press}
        check_settings(positive, {"friction": friction, "delay": delay})
        if grasp not in _GRASPS:
            raise InvalidValueError(f"'grasp' of a world is 'friction' or 'tie', not {grasp!r}.")
        self.robot = robot = Robot.of(model, robot)
        self.model = model
        self._step, self.timeout = float(step), float(timeout)
        self._remarks: dict[str, None] = {}
        furniture = [s.path for s in model.degrees_of_freedom if not robot.moves(s)]
        frictions = _friction_by_name(door_friction or {}, furniture)
        self._left_out = left_out = tuple(leave_out)
        self._settings: dict[str, Any] = {
            "gripper": gripper, "step": step, "grip": grip, "friction": friction, "grasp": grasp,
            "timeout": timeout, "delay": delay, "door_friction": frictions, "bandwidth": bandwidth,
            "press": press, "floor": floor, "seed": seed,
        }  # fmt: skip
        if gripper is None:
            gripper = next(iter(robot.grippers), None)
        fingers = () if gripper is None else gripper.fingers
        self._locks = MujocoLocks(model, robot, left_out)
        spec = mujoco_model.export_spec(model, left_out, self._locks.names, self._remark)
        spec.option.timestep = self._step
        mujoco_model.add_masses(spec, self._remark)
        mujoco_model.remark_missing_shapes(spec, self._is_robot, self._remark)
        compiled = mujoco_model.compile_world(spec)
        mujoco_model.add_joint_friction(spec, compiled, furniture, frictions, self._remark)
        mujoco_model.add_tipping_springs(spec, model, self._remark)
        mujoco_model.add_contact_rules(spec, model, fingers, friction, robot, self._remark)
        for body in spec.bodies:
            if self._is_robot(body.name):
                body.gravcomp = 1.0
        self._remark(f"gravity does not act on '{robot.name}': its servos are taken to carry the weight")
        compiled = mujoco_model.compile_world(spec)
        self._coordinates = MujocoCoordinates(model, compiled)
        for name in self._locks.keep(self._coordinates.address):
            self._remark(f"'{name}' is not enforced: it is about something else than positions of joints")
        pairs = mujoco_model.exclude_overlaps(
            spec, compiled, model, self._coordinates, self._is_robot, _SAMPLES, seed
        )
        if pairs:
            self._remark(
                "these pairs overlap at the default state, or of the robot always, and do not collide there: "
                + ", ".join(f"{a} with {b}" for a, b in pairs)
            )
        if floor:
            add_floor(spec, self._coordinates, self._is_robot, model.frames, _SAMPLES, seed, self._remark)
        else:
            self._remark("there is no floor, as asked for")
        compiled = mujoco_model.compile_world(spec)
        self._drive, self._gripper = None, gripper
        if gripper is None:
            self._remark(f"no gripper of '{robot.name}' is known, so it holds nothing")
        else:
            self._drive = GripperDrive(
                spec, compiled, self._coordinates, gripper, grip, self._step, grasp == "tie", self._remark
            )
            compiled = mujoco_model.compile_world(spec)
        held = () if self._drive is None else self._drive.coordinates
        driven = [s for s in robot.coordinates if s in self._coordinates.address and s not in held]
        idle = [str(s) for s in robot.coordinates if s not in self._coordinates.address]
        if idle:
            self._remark(
                f"no servo drives {', '.join(idle)}: each is not the position of one joint in MuJoCo"
            )
        self._servos = JointServos(
            spec, compiled, self._coordinates, driven, model, self._step, bandwidth, press, seed, self._remark
        )
        self._compiled = mujoco_model.compile_world(spec)
        moving = np.flatnonzero(self._compiled.body_weldid).tolist()
        mujoco_model.weigh_contacts(
            self._compiled, [k for k in moving if not self._is_robot(self._compiled.body(k).name)]
        )
        self._data = mujoco().MjData(self._compiled)
        self._contacts = MujocoContacts(self._compiled, self._is_robot, fingers)
        self._servos.connect(self._compiled)
        self._locks.connect(self._compiled, self._coordinates.address)
        self._bounds = SimulationBounds(
            self._compiled, self._coordinates, model, self._servos.efforts, robot, self._is_robot
        )
        if self._drive is not None:
            self._drive.connect(self._compiled, self._contacts, seed)
        self._map = SpeedMap(model, [*driven, *held], self._coordinates.address)
        is_finger = self._map.columns_of(held)
        self._commands = SpeedCommands(self._map.columns, is_finger, self.timeout, float(delay), logger.info)
        self._count = len(driven)
        self._state: State | None = None
        self._sampler = SensorSampler(sensors or Sensors(), model, robot, seed)
        self.remarks = tuple(self._remarks)
        self.reset(model.default_state())

    def __repr__(self) -> str:
        return f"<MujocoWorld of '{self.robot.name}' at {self.time:g} s>"

    @property
    def time(self) -> float:
        """Time since the last reset [s]."""
        return self._ticks * self._step

    @property
    def state(self) -> State:
        """True values of all coordinates; its stamp is the time [s]."""
        if self._state is None:
            self._state = self._coordinates.state(self._data.qpos, self.time)
        return self._state

    @property
    def held(self) -> str | None:
        """Frame of the body that both fingers press, or that is tied to them; None if there is none."""
        if self._drive is None:
            return None
        held = self._drive.tied or self._drive.pressed(self._data)
        return held if held in self.model.frames else None  # fingers may press the floor

    @property
    def refused(self) -> int:
        """Number of commands since the last reset that were stale when they came."""
        return self._commands.refused

    @property
    def peak_force(self) -> float:
        """Largest normal force between the robot and another body in all steps of the last apply [N].

        :meth:`contacts` has the forces of the last step alone, so it may miss a short blow.
        """
        return self._peak_force

    def reset(self, state: StateLike) -> None:
        """Start again from a state, at time 0, with nothing in the gripper and all speeds zero."""
        qpos = self._coordinates.positions(state)
        self._state = None
        engine, data = mujoco(), self._data
        engine.mj_resetData(self._compiled, data)
        data.qpos[:] = qpos
        engine.mj_forward(self._compiled, data)
        self._ticks, self._end, self._peak_force = 0, 0.0, 0.0
        self._broken = ""
        self._commands.reset()
        self._servos.reset(data)
        self._locks.reset()
        if self._drive is not None:
            self._drive.reset(data)
        engine.mj_forward(self._compiled, data)
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
        engine, data, coordinates = mujoco(), self._data, self._coordinates
        state = displaced_state(self, values)
        qpos, qvel = data.qpos.copy(), data.qvel.copy()
        before = {(c.a, c.b): c.distance for c in self.contacts()}
        moved = [s for s in state if state[s] != self.state[s]]
        data.qpos[:] = coordinates.positions(state)
        columns = [coordinates.dof[s] for s in moved if s in coordinates.dof]
        data.qvel[np.any(coordinates.followers[:, columns] != 0.0, axis=1)] = 0.0
        engine.mj_forward(self._compiled, data)
        for contact in self.contacts():
            allowed = DEEPER[0] if self._is_robot(contact.a) else DEEPER[1]
            if contact.distance < min(before.get((contact.a, contact.b), 0.0), 0.0) - allowed:
                data.qpos[:], data.qvel[:] = qpos, qvel
                engine.mj_forward(self._compiled, data)
                raise refuse_overlap(contact.a, contact.b, values)
        self._locks.reset()
        self._state = None

    def resume(self, state: StateLike, held: str | None = None) -> None:
        """Go on from a state that was saved, see :meth:`.ChangeableWorld.resume`."""
        self.reset(state)
        self._ticks = round(saved_time(state) / self._step)
        self._end = self.time
        if held is not None:
            self._hold(held)

    def _hold(self, body: str) -> None:
        """Press a body that a finger touches."""
        gripper, drive, data = self._gripper, self._drive, self._data
        if gripper is None or drive is None:
            return
        fingers = {name for finger in gripper.fingers for name in finger}
        if any(c.a in fingers and c.b == body for c in self.contacts()):
            drive.hold(data, body)
            mujoco().mj_forward(self._compiled, data)

    def take_over(self, other: MujocoWorld) -> None:
        """Go on where another world is, see :meth:`.ChangeableWorld.take_over`; speeds are kept."""
        data, coordinates, held = self._data, self._coordinates, other.held
        before = other._place_in_hand(held)
        self.resume(carried_state(other, self.model))
        free = np.zeros(self._compiled.nv)
        for symbol, dof in coordinates.dof.items():
            if symbol in other._coordinates.dof:
                free[dof] = other._data.qvel[other._coordinates.dof[symbol]]
        data.qvel[:] = coordinates.followers @ free
        self._servos.take_over(other._servos, data)
        self._commands.take_over(other._commands)
        self._sampler.take_over(other._sampler, carried_sensors(other.sensors, self.model))
        self._end = self.time
        mujoco().mj_forward(self._compiled, data)
        after = self._place_in_hand(held)
        if held is not None and before is not None and after is not None:
            if np.allclose(before, after, rtol=0.0, atol=SAME_PLACE):
                self._hold(held)

    def _place_in_hand(self, body: str | None) -> Array | None:
        """Return the pose of a body in the hand (4, 4); None without one."""
        engine, compiled, data = mujoco(), self._compiled, self._data
        if self._gripper is None or body is None:
            return None
        if engine.mj_name2id(compiled, engine.mjtObj.mjOBJ_BODY, body) < 0:
            return None
        result = []
        for name in (self._gripper.hand, body):
            k = compiled.body(name).id
            result.append(transform(data.xmat[k].reshape(3, 3), data.xpos[k]))
        place: Array = inverse(result[0]) @ result[1]
        return place

    def rebuild(self, model: ModelView) -> MujocoWorld:
        """Return a world of another model that goes on where this one is."""
        kept = [name for name in self._left_out if name in model.constraints]
        known = {s.path for s in model.degrees_of_freedom}
        settings = dict(self._settings)
        settings["door_friction"] = {k: v for k, v in settings["door_friction"].items() if k in known}
        sensors = carried_sensors(self.sensors, model)
        result = MujocoWorld(model, self.robot, sensors=sensors, leave_out=kept, **settings)
        result.take_over(self)
        return result

    def apply(self, speeds: StateLike, duration: float, *, stamp: float | None = None) -> None:
        """Advance by a duration with speeds of the robot, as :meth:`.RobotInterface.apply`.

        The world stops at the first time step that is not before the end. Once both fingers touch one body
        they press it with the world's force, until a speed opens them.

        Raises
        ------
        SimulationError
            If speeds or forces are beyond :class:`SimulationBounds`. The state is that before then, and the
            world does not go on until it is reset.
        """
        if self._broken:
            raise SimulationError(self._broken)
        self._end = self._commands.take(speeds, duration, stamp, self._end)
        if self._drive is not None:
            self._drive.update_limits(self._data)
        self._peak_force, self._state = 0.0, None
        engine, warnings = mujoco(), list[str]()
        handler = engine.get_mju_user_warning()
        engine.set_mju_user_warning(warnings.append)  # else to the terminal, and to a file
        try:
            while self.time < self._end - ROUNDING:
                before = self._data.qpos.copy()
                self._advance()
                force = self._contacts.largest_force(self._data)
                problem = self._find_unstable() if warnings else self._bounds.find_problem(self._data, force)
                if problem:
                    self._break_off(before, problem)
                self._peak_force = max(self._peak_force, force)
        finally:
            engine.set_mju_user_warning(handler)

    def _find_unstable(self) -> str:
        """Return the part of the state of which MuJoCo warns that it is no number or huge."""
        kinds = mujoco().mjtWarning
        names = {"positions": kinds.mjWARN_BADQPOS, "speeds": kinds.mjWARN_BADQVEL}
        names["accelerations"] = kinds.mjWARN_BADQACC
        bad = [name for name, kind in names.items() if self._data.warning[int(kind)].number]
        return f"{' and '.join(bad)} are no numbers, or beyond 1e10" if bad else ""

    def _break_off(self, qpos: Array, problem: str) -> None:
        engine, data, now = mujoco(), self._data, self.time
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = qpos, 0.0, 0.0
        engine.mj_forward(self._compiled, data)
        self._broken = (
            f"The simulation is not to be trusted: {problem} at {now:.3f} s. The state is that before. "
            "A start without overlaps, or a smaller time step (step=), may help; reset() starts again."
        )
        logger.warning(self._broken)
        raise SimulationError(self._broken)

    def contacts(self) -> tuple[Contact, ...]:
        """Return the bodies of the robot that touch something else, and those of furniture that collide."""
        return self._contacts.contacts(self._data)

    def observe(self) -> Observation:
        """Return the latest sensor readings that have arrived."""
        return self._sampler.observe(self.time, self.state, self.contacts())

    def _advance(self) -> None:
        data = self._data
        rates = self._map.rates(self._commands.acting(self.time), data.qpos)
        self._servos.drive(data, rates[: self._count])
        if self._drive is not None:
            self._drive.drive(data, rates[self._count :])
        self._locks.update(data)
        mujoco().mj_step(self._compiled, data)
        self._ticks += 1

    def _is_robot(self, name: str) -> bool:
        """Return whether a body in MuJoCo is the robot's: of a frame's several ones most have a number."""
        return self.robot.owns(name) or self.robot.owns(name.rpartition("/")[0])

    def _remark(self, text: str) -> None:
        self._remarks[text] = None


def _friction_by_name(given: Mapping[Any, float], furniture: list[str]) -> dict[str, float]:
    result = {}
    for key, value in given.items():
        number = finite_number(value)
        if str(key) not in furniture:
            raise UnknownNameError(
                f"No furniture moves by '{key}', so it has no friction. "
                f"{suggest(str(key), furniture, 'coordinate')}"
            )
        if number is None or number < 0:
            raise InvalidValueError(f"The friction of '{key}' is a number of N or N m, not {value!r}.")
        result[str(key)] = number
    return result
