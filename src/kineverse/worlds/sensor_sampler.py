"""Simulated sensor readings of a robot: encoders, odometry, touch, and a camera with its line of sight."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np

from kineverse._checks import finite_number
from kineverse.compilation import CompiledFunction
from kineverse.compilation import compile as compile_expressions
from kineverse.errors import InvalidValueError, suggest
from kineverse.geometry import Scene
from kineverse.geometry.collision_world import CollisionWorld
from kineverse.geometry.gjk import support
from kineverse.lie import Array, inverse, quaternion, retract, rotation_z, transform
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

from .robot import Robot
from .robot_interface import Observation
from .sensors import Sensors
from .simulated_world import Contact

_INSET = 0.9  # points lie at this fraction of the distance from the middle of a shape to its corners
_MOST_SHAPES = 8  # largest number of shapes of a body whose points are tried


class LineOfSight:
    """Line of sight from a camera to bodies.

    A body is visible if a ray from the camera reaches a point of it and hits no other body before. The
    points are the middle and eight inner corners of each of its shapes. Bodies that never move relative to
    the camera hide nothing, nor do those of the robot that contain the camera at the default state: it is
    built into them. A camera inside of anything else sees nothing.
    """

    def __init__(self, robot: Robot, camera: str, bodies: Iterable[str]) -> None:
        model = robot.model
        motion = FrameDependence(model, model.degrees_of_freedom)
        known = Scene(model).bodies
        hidden = [name for name in known if not motion.moves_between(name, camera)]
        self._scene = _start(model, hidden)
        eye = compile_expressions(model.fk(camera))(model.default_state())[:3, 3]
        while (hit := self._scene.ray(eye, (1.0, 0.0, 0.0))) and hit.distance == 0.0 and robot.owns(hit.body):
            hidden.append(hit.body)
            self._scene = _start(model, hidden)
        world, shown = self._scene.collision_world, set(self._scene.bodies)
        self._points = {name: _inner_points(world, name) for name in bodies if name in shown}

    def update(self, state: State) -> None:
        """Compute the poses of all bodies at a state."""
        self._scene.update(state)

    def sees(self, body: str, eye: Array) -> bool:
        """Return whether a body is visible from a point (3,) in the world [m]."""
        if body not in self._points:
            return True
        world_T_body = self._scene.pose(body)
        for point in self._points[body] @ world_T_body[:3, :3].T + world_T_body[:3, 3]:
            ray = point - eye
            distance = float(np.linalg.norm(ray))
            if distance == 0.0:
                return True
            hit = self._scene.ray(eye, ray, distance)
            if hit is None or hit.body == body:
                return True
        return False


def _start(model: ModelView, hidden: Iterable[str]) -> Scene:
    scene = Scene(model, leave_out=hidden)
    scene.update(model.default_state())
    scene.collision_world.prepare()
    return scene


def _inner_points(world: CollisionWorld, body: str) -> Array:
    """Return points (n, 3) inside of the shapes of a body, in its frame [m]."""
    result: list[Array] = []
    for k in world.members[world.body_index(body)][:_MOST_SHAPES]:
        origin, solid = world.objects[k].shape.origin.matrix, world.solid(k)
        rotation, middle = origin[:3, :3], origin[:3, 3]
        if solid.core is None:
            result.append(middle)
            continue
        corners = np.array(
            [support((solid, rotation, middle), rotation @ corner / np.sqrt(3.0)) for corner in _CORNERS]
        )
        middle = corners.mean(axis=0)
        result += [middle, *(middle + _INSET * (corners - middle))]
    return np.array(result)


_CORNERS = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


class SensorSampler:
    """Source of a world's observations, at the times at which it is asked.

    Everything is read when the world asks. A delay makes the readings arrive later, with the stamp of their
    capture. The camera takes a picture if its period has passed since the one before, so at most one each
    time. A robot knows by its own readings alone where its camera is. Hence a pose in the world is
    world_T_camera as read, times camera_T_marker as seen: drift of the odometry moves all of them.

    Parameters
    ----------
    robot
        The robot, or the prefix of its names in the model; empty for a model of a robot alone.
    seed
        Seed of the noise. Equal seeds and calls give equal readings.

    Attributes
    ----------
    camera
        Frame of the camera, from which distances are measured. Without any that is named like a head or a
        camera, it is the robot's first frame.
    marked
        Frames with markers.

    Raises
    ------
    UnknownNameError
        If the model has no such robot, or no frame that the settings name.
    InvalidValueError
        If a field of view or a line of sight is asked for, but the robot has no camera.

    Examples
    --------
    >>> model = kv.load("fetch")
    >>> tags = model.include("kitchen")
    >>> sensors = kv.worlds.Sensors.parse("3mm,0.5deg,30Hz")
    >>> sampler = kv.worlds.SensorSampler(sensors, model, "fetch", seed=1)
    >>> readings = sampler.observe(0.0, model.default_state())
    >>> len(readings.poses) > 10
    True
    """

    def __init__(self, sensors: Sensors, model: ModelView, robot: Robot | str, seed: int = 0) -> None:
        self._seed, self._model = seed, model
        self._robot = robot = Robot.of(model, robot)
        self._joints = tuple(s for s in model.symbols if robot.moves(s) and not s.order)
        self._base = () if robot.base is None else robot.base.coordinates
        self._encoded = tuple(s for s in self._joints if s not in set(self._base))
        self._sight: LineOfSight | None = None
        self.camera, self.marked = "", tuple[str, ...]()
        self._configure(sensors)
        self.reset()

    def _configure(self, sensors: Sensors) -> None:
        robot = self._robot
        camera, marked = sensors.find_frames(robot)
        known = sensors.camera or robot.camera
        if not known and (sensors.field_of_view is not None or sensors.sight):
            raise InvalidValueError(
                f"What is visible depends on a camera, and no frame of '{robot.name}' is named like one. "
                f"Name it by camera=. {suggest('head', robot.frames, 'frame')}"
            )
        if (camera, marked) != (self.camera, self.marked):
            self._sight, self.camera, self.marked = None, camera, marked
            # Compiled for the first picture: many worlds are never observed.
            self._seen = [self._model.fk(name) for name in (camera, *marked)]
            for name in ("_poses", "_camera_pose"):
                self.__dict__.pop(name, None)
        if sensors.sight and self._sight is None:
            self._sight = LineOfSight(robot, camera, marked)
        self._uncovered = np.array([name not in sensors.hidden for name in marked], dtype=bool)
        self.sensors = sensors

    @cached_property
    def _poses(self) -> CompiledFunction[tuple[Array, ...]]:
        return compile_expressions(self._seen)

    @cached_property
    def _camera_pose(self) -> CompiledFunction[Array]:
        return compile_expressions(self._seen[0])

    def reset(self) -> None:
        """Start again, with the noise of the same seed and no readings pending."""
        streams = np.random.SeedSequence(self._seed).spawn(3)
        self._encoder_noise, self._odometry_noise, self._camera_noise = map(np.random.default_rng, streams)
        self._coming: deque[Observation] = deque()
        self._last: Observation | None = None
        self._time, self._picture = -math.inf, -1
        self._true_base = self._read_base = np.empty(0)
        self._drifts = False

    def change(self, sensors: Sensors) -> None:
        """Go on with other settings, from the next readings on; the odometry keeps its drift.

        Raises
        ------
        UnknownNameError, InvalidValueError
            As for the settings at first. Nothing has changed then.
        """
        self._configure(sensors)
        self._picture = math.floor(self._time * sensors.rate + 1e-6) if math.isfinite(self._time) else -1

    def take_over(self, other: SensorSampler, sensors: Sensors) -> None:
        """Go on where another sampler of the same robot is, with its noise and drift, and some settings."""
        self._configure(sensors)
        self._encoder_noise, self._odometry_noise = other._encoder_noise, other._odometry_noise
        self._camera_noise, self._coming, self._last = other._camera_noise, other._coming, other._last
        self._time, self._picture = other._time, other._picture
        self._true_base, self._read_base, self._drifts = other._true_base, other._read_base, other._drifts

    def observe(self, time: float, state: State, contacts: Iterable[Contact] = ()) -> Observation:
        """Read the sensors, and return the newest readings that have arrived.

        Poses are those of one picture that has arrived since the last call; of several, the last. Before any
        delayed reading has arrived, the first ones are returned, as if the robot had stood still before.

        Parameters
        ----------
        time
            Time of the world [s], not before that of the last call.
        state
            True state.
        contacts
            Contacts of the world, for the touch sensors.

        Raises
        ------
        InvalidValueError
            For a time before the last one.
        """
        if (now := finite_number(time)) is None or now < self._time:
            raise InvalidValueError(
                f"Sensors were read at {self._time:.6g} s, and now at {time!r} s; reset() starts again."
            )
        if now > self._time:
            self._coming.append(self._capture(now, state, contacts))
            self._time = now
        if self._last is None:
            self._last = self._coming.popleft()
            return self._last
        arrived = sum(1 for one in self._coming if one.stamp + self.sensors.delay <= now + 1e-9)
        if not arrived:
            self._last = replace(self._last, poses={})
            return self._last
        # Several arrive at once after a long step: a picture is not lost for later encoders.
        chosen = next((k for k in reversed(range(arrived)) if self._coming[k].poses), arrived - 1)
        for _ in range(chosen + 1):
            self._last = self._coming.popleft()
        return self._last

    def _capture(self, now: float, state: State, contacts: Iterable[Contact]) -> Observation:
        sensors = self.sensors
        values = state.vector(self._encoded)
        values = values + sensors.encoders * self._encoder_noise.standard_normal(len(values))
        joints = dict(zip(self._encoded, values.tolist(), strict=True))
        joints.update(zip(self._base, self._read_odometry(state.vector(self._base)).tolist(), strict=True))
        picture = math.floor(now * sensors.rate + 1e-6)
        poses = {}
        if picture > self._picture:
            self._picture = picture
            poses = self._take_picture(state, joints)
        touching = self._touched(contacts) if sensors.touch else ()
        return Observation(now, joints, poses, frozenset(touching))

    def _read_odometry(self, base: Array) -> Array:
        """Return the readings of the base's coordinates, which drift with the distance."""
        if self._last is None and not self._coming:
            self._true_base, self._read_base = base, base.copy()
            return base
        step = base - self._true_base
        noise = self._odometry_noise.standard_normal(len(base))
        if self._robot.planar_base:
            # In the base's own axes: a wrong heading leads the position astray.
            step[:2] = rotation_z(-self._true_base[2])[:2, :2] @ step[:2]
            distance = math.sqrt(np.linalg.norm(step[:2]) + abs(step[2]))
            step += distance * noise * (self.sensors.odometry, self.sensors.odometry, self.sensors.turn)
            step[:2] = rotation_z(self._read_base[2])[:2, :2] @ step[:2]
        else:
            step += self.sensors.odometry * noise * np.sqrt(np.abs(step))
        self._drifts |= bool(self.sensors.odometry or self.sensors.turn)
        self._true_base = base
        self._read_base = self._read_base + step if self._drifts else base.copy()
        return self._read_base

    def _take_picture(self, state: State, joints: dict[Symbol, float]) -> dict[str, Array]:
        sensors, count = self.sensors, len(self.marked)
        # As many numbers for each picture, whatever is visible: runs with other visibility can be compared.
        normal = self._camera_noise.standard_normal((count, 10))
        uniform = self._camera_noise.random((count, 5))
        world_T_camera, *true = self._poses(state.vector(self._poses.inputs))
        if not true:
            return {}
        world_T_markers = np.array(true)
        apart = world_T_markers[:, :3, 3] - world_T_camera[:3, 3]
        distances = np.linalg.norm(apart, axis=1)
        deviations = np.full((count, 6), sensors.orientation)
        deviations[:, :3] = sensors.position_noise(distances)[:, None]
        observed = retract(world_T_markers, deviations * normal[:, :6])
        strays = uniform[:, 1] < sensors.outliers
        cube = world_T_markers[strays, :3, 3] + sensors.reach * (uniform[strays, 2:] - 0.5)
        observed[strays] = transform(quaternion(normal[strays, 6:]), cube)
        read_T_camera = self._camera_pose(
            np.array([joints[s] if s in joints else state[s] for s in self._camera_pose.inputs])
        )
        observed = read_T_camera @ inverse(world_T_camera) @ observed
        seen = (uniform[:, 0] >= sensors.drop) & self._uncovered
        if sensors.field_of_view is not None:
            # The z axis of optical frames looks forward (REP 103).
            forward = world_T_camera[:3, 2 if "optical" in self.camera else 0]
            seen &= apart @ forward >= math.cos(0.5 * sensors.field_of_view) * distances
        if sensors.sight and self._sight is not None:
            self._sight.update(state)
            for k in np.flatnonzero(seen):
                seen[k] = self._sight.sees(self.marked[k], world_T_camera[:3, 3])
        return {self.marked[k]: observed[k] for k in np.flatnonzero(seen).tolist()}

    def _touched(self, contacts: Iterable[Contact]) -> Iterator[str]:
        """Yield the robot's bodies whose touch sensors report."""
        sensors = self.sensors
        for contact in contacts:
            known = not math.isnan(contact.force)
            if contact.force >= sensors.touch_force if known else contact.distance <= sensors.touch_gap:
                yield from (name for name in (contact.a, contact.b) if self._robot.owns(name))
