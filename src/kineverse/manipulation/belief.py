"""Belief from sensor readings: encoders, odometry, and poses that a camera sees at its rate.

Coordinates of objects are estimated by a :class:`.Tracker` of all marked frames, at the times of pictures.
Their process noise is that of a part in motion while it is commanded to move, or its prediction is refuted,
and for a while afterwards; else that of a part at rest, so that pictures average. From the last picture to
the present the state is predicted with the commanded speeds, those that a controller plans for objects among
them. If the odometry drifts, a :class:`.BaseFilter` corrects it by marked frames that never move.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from kineverse.compilation import compile
from kineverse.errors import InvalidValueError
from kineverse.estimation import ObservedPose, Outliers, Tracker, pose_covariance
from kineverse.estimation.noise import CHI_SQUARED_6
from kineverse.lie import Array, inverse, pose_difference, rotation_z, transform
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Observation, Robot, Sensors


class BaseFilter:
    """Filter of the position and the heading of a base.

    The error is a twist (vx, vy, ω) in the axes of the base: the pose is the estimate times exp(error). A
    motion M turns it to Ad(M⁻¹) error (Solà et al., A micro Lie theory, 2018).
    """

    def __init__(self, odometry: float, turn: float, has_outliers: bool) -> None:
        self._variance = np.array([odometry, odometry, turn]) ** 2
        self._has_outliers = has_outliers
        self.reset(np.zeros(3))

    def reset(self, pose: Array) -> None:
        """Begin at a known pose (3,), which is also what the odometry reads."""
        self.pose, self._read = pose.copy(), pose.copy()
        self.covariance = np.zeros((3, 3))

    @property
    def deviations(self) -> Array:
        """Standard deviations of x, y and heading (3,)."""
        turned = np.eye(3)
        turned[:2, :2] = rotation_z(self.pose[2])[:2, :2]
        return np.asarray(np.sqrt(np.diag(turned @ self.covariance @ turned.T)))

    def move(self, read: Array) -> None:
        """Follow the odometry to its next reading (3,)."""
        step = read - self._read
        if not step.any():
            return
        step[:2] = rotation_z(-self._read[2])[:2, :2] @ step[:2]
        self._read = read.copy()
        self.pose[:2] += rotation_z(self.pose[2])[:2, :2] @ step[:2]
        self.pose[2] += step[2]
        adjoint = np.eye(3)
        adjoint[:2, 2] = -step[1], step[0]
        adjoint[:2] = rotation_z(-step[2])[:2, :2] @ adjoint[:2]
        distance = float(np.linalg.norm(step[:2]) + abs(step[2]))
        self.covariance = adjoint @ self.covariance @ adjoint.T + distance * np.diag(self._variance)

    def correct(self, seen: Array, known: Array, deviations: Array) -> None:
        """Correct the estimate by landmarks."""
        expected = inverse(place(self.pose)) @ known
        errors = pose_difference(seen, expected)
        slopes = -motion_of(expected)
        variances = np.repeat(deviations, 3, axis=1) ** 2
        if self._has_outliers:
            spread = slopes @ self.covariance @ np.swapaxes(slopes, 1, 2) + variances[:, :, None] * np.eye(6)
            squares = (errors * np.linalg.solve(spread, errors[:, :, None])[:, :, 0]).sum(axis=1)
            kept = squares < CHI_SQUARED_6
            errors, slopes, variances = errors[kept], slopes[kept], variances[kept]
        weighted = slopes / variances[:, :, None]
        information = np.einsum("kia,kib->ab", weighted, slopes)
        self.covariance = np.linalg.solve(np.eye(3) + self.covariance @ information, self.covariance)
        self.covariance = (self.covariance + self.covariance.T) / 2
        step = self.covariance @ np.einsum("kia,ki->a", weighted, errors)
        self.pose[:2] += rotation_z(self.pose[2])[:2, :2] @ step[:2]
        self.pose[2] += step[2]


def place(pose: Array) -> Array:
    """Return the transform (4, 4) of x, y and a heading (3,)."""
    return np.asarray(transform(rotation_z(pose[2]), np.array([pose[0], pose[1], 0.0])))


def motion_of(poses: Array) -> Array:
    """Return the motion (m, 6, 3) of frames (m, 4, 4) that a twist (vx, vy, ω) of their parent carries."""
    slopes = np.zeros((len(poses), 6, 3))
    slopes[:, 0, 0] = slopes[:, 1, 1] = slopes[:, 5, 2] = 1.0
    slopes[:, 0, 2], slopes[:, 1, 2] = -poses[:, 1, 3], poses[:, 0, 3]
    return slopes


USUAL = Sensors(
    position=0.003, position_per_metre=0.003, orientation=math.radians(0.5), encoders=1e-4, outliers=0.02
)
"""Noise that is expected of a robot whose sensors nobody has described: that of markers and a good camera."""
_FLOOR = 1e-4, 1e-4  # least noise of poses [m], [rad], for sensors without noise
_MOVING, _RESTING = 0.04, 4e-4
"""Shares of the tracker's default process noise: .02 rad/√s and .013 m/√s for a door and a drawer in motion,
and .002 rad/√s and .0013 m/√s at rest."""
_MOVED, _REFUTED = 1.0, 0.3
"""Times for which a part counts as moving after a command, and after a refuted prediction [s].
In the latter all of the tracker's process noise counts."""
_STILL = 1e-3  # largest speed of a part that rests [m/s], [rad/s]
_JOINT_SHARE, _JOINT_DRIFT = 0.2, 0.002
"""Error of the motion of joints relative to the commanded one, and independent of it [rad/√s], [m/√s]."""
_HORIZON = 0.02  # longest prediction beyond the delay of the sensors [s]; then the stamp of the state stays


class TrackedBelief:
    """Belief that reads observations and commands, and never the truth.

    Coordinates that were never seen have their default value, and half the width of their limits as
    deviation. If the time goes back, as by a reset of a simulated world, all starts again: objects are
    believed where they were, with that same deviation until they are seen.

    Parameters
    ----------
    model
        Model of the robot and of everything that moves.
    robot
        The robot in the model, or the prefix of its names.
    sensors
        The noise to expect, with the frames of camera and markers.

    Attributes
    ----------
    tracker
        Tracker of the coordinates of objects.
    camera
        Frame from which distances to markers count; the robot's first frame if none is named like a camera.
    remarks
        Texts on what limits the estimates: a robot without a camera, odometry that nothing corrects.
    seen
        Time [s] at which a marker of a coordinate was seen last, by coordinate.

    Raises
    ------
    InvalidValueError
        If no marked frame moves with an object, or odometry drifts under a base that is not planar.

    Examples
    --------
    >>> model = kv.load("fetch")
    >>> tags = model.include("kitchen")
    >>> world = kv.worlds.KinematicWorld(model, "fetch", sensors=kv.worlds.Sensors.parse("3mm,0.5deg"))
    >>> world.reset(model.default_state() | {"kitchen/fridge_door": 0.3})
    >>> belief = kv.manipulation.TrackedBelief(model, "fetch", kv.worlds.Sensors.parse("3mm,0.5deg"))
    >>> state = belief.update(world.observe(), world.time)
    >>> abs(state["kitchen/fridge_door"] - 0.3) < 0.05
    True
    """

    def __init__(self, model: ModelView, robot: Robot | str, sensors: Sensors | None = None) -> None:
        self.sensors = sensors = Sensors() if sensors is None else sensors
        self.model = model
        robot = Robot.of(model, robot)
        remarks = []
        self.camera, marked = sensors.find_frames(robot)
        if sensors.camera is None and robot.camera is None:
            remarks.append(
                f"No frame of '{robot.name}' is named like a camera, so markers are seen from "
                f"'{self.camera}'; camera= names another one."
            )
        coordinates = {*model.degrees_of_freedom}
        moving = {name: coordinates.intersection(model.fk(name).symbols) for name in marked}
        self._landmarks = {name: np.asarray(model.fk(name)({})) for name in marked if not moving[name]}
        self._frames = tuple(
            name for name in marked if moving[name] and not any(robot.moves(s) for s in moving[name])
        )
        if not self._frames:
            raise InvalidValueError(
                "No marked frame moves with an object, so nothing can be tracked. Sensors(marked=) are "
                f"{', '.join(marked) or 'none'}."
            )
        self._index = {name: k for k, name in enumerate(self._frames)}
        self.tracker = self._make_tracker()
        self._estimate = self.tracker.estimate
        speeds = {*self.tracker.process_noise}
        self._speeds_of = {
            s: tuple(speeds.intersection(model.rates[s] if s in model.rates else (s.derivative(),)))
            for s in self.tracker.symbols
        }
        self._groups = {s: group for group in self.tracker.groups for s in group}
        self._coordinates_of = {
            name: tuple(s for s in moving[name] if s in self._groups) for name in self._frames
        }
        base = robot.base
        drifts = base is not None and (sensors.odometry > 0.0 or sensors.turn > 0.0)
        if base is not None and drifts and not base.is_planar:
            raise InvalidValueError(
                f"The odometry of '{base.child}' drifts, and its joint is none of x, y and a heading: there "
                "is no filter for it. Give sensors without odometry= and turn=."
            )
        self._base = base if drifts else None
        if self._base is not None and not self._landmarks:
            remarks.append("No marked frame stands still, so nothing corrects the drift of the odometry.")
        self.remarks = tuple(remarks)
        self._exact = () if base is None else base.coordinates
        self._filter = BaseFilter(sensors.odometry, sensors.turn, sensors.outliers > 0.0)
        self._speeds = tuple(speeds)
        self._shared: Array | None = None
        self._carried = np.zeros((len(self._frames), 6, 3))
        if self._base is not None:
            jacobians = [
                model.jacobian(name, form="world_aligned", symbols=self._speeds) for name in self._frames
            ]
            self._jacobians = compile(np.concatenate([J.reshape(-1) for J in jacobians]))
            origin = dict.fromkeys(self._base.coordinates, 0.0)
            offset = model.fk(self._base.child, relative_to=self._base.parent)(origin)
            self._plane = np.asarray(model.fk(self._base.parent)({}) @ offset)
        self._encoded = tuple(
            s for s in model.symbols if robot.moves(s) and not s.order and s not in self._exact
        )
        self._spread: Array = np.zeros(len(self._encoded))
        start = model.default_state()
        self._values = np.array([start[s] for s in start])
        self._symbols = tuple(start)
        self._place = {s: k for k, s in enumerate(self._symbols)}
        if self._base is not None:
            self._jacobian_places = [self._place[s] for s in self._jacobians.inputs]
        self._integrate = model.integrator(symbols=self._symbols)
        self._column = {v: k for k, v in enumerate(self._integrate.speeds)}
        self._of_robot = np.array([float(robot.moves(v)) for v in self._integrate.speeds])
        limits = np.array([model.limits(s) for s in self._symbols])
        bounded = np.array([sensors.encoders > 0.0 or not robot.moves(s) for s in self._symbols])
        self._lower = np.where(bounded, limits[:, 0], -np.inf)
        self._upper = np.where(bounded, limits[:, 1], np.inf)
        self._camera_pose = compile([model.fk(self.camera)])
        self.seen: dict[Symbol, float] = {}
        self._history: list[tuple[float, float, Array]] = []
        self._moved: dict[Symbol, float] = {}
        self._refuted: dict[Symbol, float] = {}
        self._now = self._picture = self._read = self._looked = -math.inf

    def _make_tracker(self) -> Tracker:
        sensors = self.sensors
        covariance = pose_covariance(*sensors.pose_noise(0.0, *_FLOOR))
        outliers = Outliers(min(sensors.outliers, 0.5), sensors.reach) if sensors.outliers > 0.0 else None
        observed = [ObservedPose(name, covariance=covariance) for name in self._frames]
        tracker = Tracker(self.model, observed, outliers=outliers, process="position")
        start = self.model.default_state()
        tracker.reset({s: start[s] for s in tracker.symbols})
        return tracker

    def update(self, observation: Observation, time: float, commands: State | None = None) -> State:
        """Return the believed state of all coordinates at the present time.

        The first call, and the first one after a reset, wait for compiled code of the tracker. Readings with
        the stamp of the last ones are the same again.

        Parameters
        ----------
        observation
            The latest readings.
        time
            The present time [s].
        commands
            Speeds since the last update: commanded ones of the robot, and planned ones of objects.
        """
        if time < self._now or math.isinf(self._now):
            self._begin(observation.stamp)
        elif time > self._now:
            self._history.append((self._now, time, self._vector(commands)))
        self._now = time
        self._read_robot(observation)
        if observation.poses and observation.picture_stamp > self._looked:
            self._looked = observation.picture_stamp
            self._look(observation)
        oldest = min(self._read, self._picture)
        self._history = [one for one in self._history if one[1] > oldest]
        horizon = min(time, observation.stamp + self.sensors.delay + _HORIZON)
        return self._predict(horizon)

    def take_over(self, other: TrackedBelief) -> None:
        """Begin with what another one believes, of another version of the model: values, and when seen.

        They have the deviation of what was never seen, until they are seen.
        """
        before = other.tracker.estimate.state
        values = dict(self.tracker.estimate.state)
        values |= {s: before[s] for s in self.tracker.symbols if s in before}
        self._estimate = self.tracker.reset(values, at=other.tracker.estimate.state.stamp or 0.0)
        for symbol, place in self._place.items():
            if symbol in other._place:
                self._values[place] = other._values[other._place[symbol]]
        self.seen = {s: at for s, at in other.seen.items() if s in self._place}

    def _begin(self, stamp: float) -> None:
        """Start again at a time, with objects where they were believed."""
        self.tracker.wait()  # each update before would take a hundred times as long
        if not math.isinf(self._now):
            self._estimate = self.tracker.reset(dict(self.tracker.estimate.state), at=stamp)
            self.seen.clear()
        self._history.clear()
        self._moved.clear()
        self._refuted.clear()
        self._now = self._read = self._looked = -math.inf
        self._picture = stamp

    def _vector(self, commands: Mapping[Symbol, float] | None) -> Array:
        vector = np.zeros(len(self._column))
        for speed, value in ({} if commands is None else commands).items():
            if (column := self._column.get(speed)) is not None:
                vector[column] = value
        return vector

    def _displacement(self, begin: float, end: float) -> Array:
        """Return the integral of all speeds from a time to another one (m,) [m], [rad]."""
        total = np.zeros(len(self._column))
        for start, stop, speeds in self._history:
            overlap = min(stop, end) - max(start, begin)
            if overlap > 0.0:
                total += overlap * speeds
        return total

    def _read_robot(self, observation: Observation) -> None:
        stamp, joints = observation.stamp, observation.joints
        known = [s for s in joints if s in self._place]
        if stamp <= self._read:
            return
        before = self._values.copy()
        self._values[[self._place[s] for s in known]] = [joints[s] for s in known]
        if self.sensors.encoders > 0.0:
            self._filter_joints(before, stamp)
        if self._base is not None:
            read = np.array([joints[s] for s in self._base.coordinates])
            if math.isinf(self._read):
                self._filter.reset(read)
            else:
                self._filter.move(read)
        self._read = stamp

    def _filter_joints(self, before: Array, stamp: float) -> None:
        columns = [self._place[s] for s in self._encoded]
        variance = self.sensors.encoders**2
        if math.isinf(self._read):
            self._spread[:] = variance
            return
        motion = self._of_robot * self._displacement(self._read, stamp)
        expected = np.asarray(self._integrate(before, motion, 1.0))[columns]
        moved = expected - before[columns]
        drift = _JOINT_DRIFT**2 * (stamp - self._read)
        spread = self._spread + (_JOINT_SHARE * moved) ** 2 + drift
        gain = spread / (spread + variance)
        self._values[columns] = expected + gain * (self._values[columns] - expected)
        self._spread = (1.0 - gain) * spread

    def _look(self, observation: Observation) -> None:
        stamp, self._shared = observation.picture_stamp, None
        poses = np.tile(np.eye(4), (len(self._index), 1, 1))
        mask = np.zeros(len(poses), dtype=bool)
        names = [name for name in observation.poses if name in self._index]
        for name in names:
            poses[self._index[name]] = observation.poses[name]
            mask[self._index[name]] = True
        state = dict(zip(self._symbols, self._values.tolist(), strict=True)) | dict(observation.joints)
        eye = self._camera_pose(np.array([state[s] for s in self._camera_pose.inputs]))[0][:3, 3]
        more: Array | float = 0.0
        if self._base is not None:
            poses, more = self._correct(observation, poses, eye)
        if not names:
            return
        variances = np.repeat(self._deviations(poses, eye), 3, axis=1) ** 2
        covariances = variances[:, :, None] * np.eye(6) + more
        travel = self._displacement(self._picture, stamp)
        duration = stamp - self._picture
        commands: dict[Symbol, float] = {}
        noise: dict[Symbol, float] = {}
        for s, speeds in self._speeds_of.items():
            for v in speeds:
                if duration > 0.0 and abs(travel[self._column[v]]) > _STILL * duration:
                    commands[v] = travel[self._column[v]] / duration
                    self._moved[s] = stamp
            noise |= dict.fromkeys(speeds, self._noise_share(s, stamp))
        usual = self.tracker.process_noise
        noise = {v: share * usual[v] for v, share in noise.items()}
        self._estimate = estimate = self.tracker.update_poses(
            poses, mask, covariances=covariances, at=stamp, commands=commands, process_noise=noise
        )
        for group in estimate.refuted_groups:
            self._refuted |= dict.fromkeys(group, stamp)
        for name in names:
            self.seen |= dict.fromkeys(self._coordinates_of[name], stamp)
        self._picture = stamp
        for s in self.tracker.symbols:
            self._values[self._place[s]] = estimate.state[s]

    def _noise_share(self, coordinate: Symbol, now: float) -> float:
        if now - self._refuted.get(coordinate, -math.inf) <= _REFUTED:
            return 1.0
        return _MOVING if now - self._moved.get(coordinate, -math.inf) <= _MOVED else _RESTING

    def _deviations(self, poses: Array, eye: Array) -> Array:
        """Return the stated deviations (m, 2) of positions and rotations of poses (m, 4, 4) [m], [rad]."""
        return self.sensors.pose_noise(np.linalg.norm(poses[:, :3, 3] - eye, axis=1), *_FLOOR).T

    def _correct(self, observation: Observation, poses: Array, eye: Array) -> tuple[Array, Array]:
        """Correct the base by landmarks; return poses that it carries, and the covariance it adds to them."""
        assert self._base is not None
        read = np.array([observation.joints[s] for s in self._base.coordinates])
        base_T_world = inverse(place(read)) @ inverse(self._plane)
        names = [name for name in observation.poses if name in self._landmarks]
        if names:
            seen = np.array([observation.poses[name] for name in names])
            known = inverse(self._plane) @ np.array([self._landmarks[name] for name in names])
            self._filter.correct(base_T_world @ seen, known, self._deviations(seen, eye))
        carried = base_T_world @ poses
        world_T_base = self._plane @ place(self._filter.pose)
        motion = motion_of(carried)
        for rows in slice(3), slice(3, 6):
            motion[:, rows] = world_T_base[:3, :3] @ motion[:, rows]
        self._carried = motion
        return world_T_base @ carried, motion @ self._filter.covariance @ np.swapaxes(motion, 1, 2)

    def _shared_variance(self, coordinate: Symbol) -> float:
        """Return the variance of a coordinate by the base's error, which no number of pictures averages."""
        if self._base is None:
            return 0.0
        if self._shared is None:
            J = self._jacobians(self._values[self._jacobian_places]).reshape(-1, 6, len(self._speeds))
            weights = np.repeat([self.sensors.position, self.sensors.orientation], 3)
            W = 1.0 / np.maximum(weights, _FLOOR[0]) ** 2
            A = np.einsum("kia,i,kib->ab", J, W, J) + 1e-9 * np.eye(len(self._speeds))
            X = np.linalg.solve(A, np.einsum("kia,i,kib->ab", J, W, self._carried))
            self._shared = np.einsum("ia,ab,ib->i", X, self._filter.covariance, X)
        return float(sum(self._shared[self._speeds.index(v)] for v in self._speeds_of[coordinate]))

    def _predict(self, now: float) -> State:
        """Return the state predicted from the last readings to a time."""
        values = self._values
        if self._base is not None:
            values = values.copy()
            values[[self._place[s] for s in self._base.coordinates]] = self._filter.pose
        motion = (1.0 - self._of_robot) * self._displacement(self._picture, now)
        if now > self._read:
            motion += self._of_robot * self._displacement(self._read, now)
        if motion.any():
            values = np.asarray(self._integrate(values, motion, 1.0))
        values = np.clip(values, self._lower, self._upper)
        return State(dict(zip(self._symbols, values.tolist(), strict=True)), stamp=now, source="tracker")

    def deviation(self, coordinate: Symbol) -> float:
        """Return the standard deviation of a coordinate at the present time [m], [rad].

        It is infinite for one that no marker shows, and one whose track is lost.
        """
        if coordinate in self._groups:
            estimate = self._estimate
            if self._groups[coordinate] in estimate.lost_groups:
                return math.inf
            usual, share = self.tracker.process_noise, self._noise_share(coordinate, self._now)
            rate = sum(share * usual[v] for v in self._speeds_of[coordinate])
            later = rate * max(self._now - self._picture, 0.0)
            return math.sqrt(estimate.deviation[coordinate] ** 2 + later + self._shared_variance(coordinate))
        if coordinate in self._encoded:
            return math.sqrt(float(self._spread[self._encoded.index(coordinate)]))
        if self._base is not None and coordinate in self._base.coordinates:
            return float(self._filter.deviations[self._base.coordinates.index(coordinate)])
        return 0.0 if coordinate in self._exact else math.inf
