"""A robot that is reached by topics of ROS 2, as skills use robots."""

from __future__ import annotations

import logging
import math
import os
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable
from functools import cache
from importlib.util import find_spec
from types import NoneType
from typing import Any

import numpy as np

from kineverse._checks import as_entries, as_positive
from kineverse.compilation import compile
from kineverse.errors import (
    InvalidValueError,
    MissingDependencyError,
    OfflineError,
    SimulationError,
    list_some,
)
from kineverse.lie import Array, inverse, quaternion, transform
from kineverse.model.model_view import ModelView
from kineverse.planning.trajectories.trajectory import Trajectory
from kineverse.state import StateLike
from kineverse.symbols import Symbol
from kineverse.worlds import Observation, Robot
from kineverse.worlds.speed_commands import SpeedCommands

from .robot_link import Beat, End, Follow, Link, Note, Pose, Readings, Speeds, Start, now
from .robot_node import start_process
from .robot_settings import RobotSettings, connect_names, read_settings

PYTHON = "KINEVERSE_ROS_PYTHON"
"""Environment variable that names a Python with rclpy, where the present one has none."""

logger = logging.getLogger("kineverse.ros")

_START, _WAIT = 30.0, 6.0  # longest times until the robot node is there, and then the first readings [s]
_HISTORY = 1.0  # time for which readings are kept: where the robot was when its camera saw something [s]
_LATER = 0.01  # how much older than the readings a picture is, so that all of its poses have come [s]
_PICTURE = 0.002  # difference of times of poses in a picture [s]
_NOTES = 8  # number of sentences that are kept
_STEP = 0.02  # time between two looks at a path [s]
_LAST = 1.0  # longest time until it is known why a robot node is gone [s]
_ENDED = "The robot node has ended, and the robot was stopped."
_LAG = 0.5  # time by which a robot may be late on its path [s]
_ARRIVAL = 2.0  # time in which it has to be at the end of its path [s]


class RosRobot:
    """Robot behind topics of ROS 2: it takes speeds and reports readings, as :class:`.RobotInterface` says.

    The topics are the business of a process of its own, the robot node. If this process here is gone or
    hangs, or the readings do not come any more, it stops the robot within 0.1 s.

    Parameters
    ----------
    model
        Model of the robot and of everything around it.
    robot
        The robot, or the prefix of its names in the model.
    settings
        Settings, or a TOML file of them; None for those that follow from the model.
    observed
        Frames with markers, whose poses come on topics ``poses/FRAME``, where the settings name none; by
        default those of all articulated objects.

    Attributes
    ----------
    observed
        Frames whose poses are observed.

    Raises
    ------
    UnknownNameError, DuplicateNameError, InvalidValueError, FormatError
        For settings that do not fit the model.
    MissingDependencyError
        Without ROS 2.
    OfflineError
        If the robot does not report, with what is missing.
    """

    name = "ros"

    def __init__(
        self,
        model: ModelView,
        robot: Robot | str,
        settings: RobotSettings | str | os.PathLike[str] | None = None,
        *,
        observed: Iterable[str] | None = None,
    ) -> None:
        self.model, self.robot = model, Robot.of(model, robot)
        if not isinstance(settings, (RobotSettings, str, os.PathLike, NoneType)):
            raise InvalidValueError(f"settings= is the path of a file, not {settings!r:.60}.")
        if not isinstance(settings, RobotSettings):
            settings = RobotSettings() if settings is None else read_settings(settings)
        marked = self.robot.markers
        if observed is not None:
            marked = as_entries("observed=", observed, str, "names of frames")
        self._names = connect_names(self.robot, settings, marked)
        wiring = self._names.wiring
        self.observed = (*wiring.poses, *wiring.transforms.values())
        self.timeout = wiring.timeout
        self._make_columns()
        self._prepare_base()
        self._parents: dict[str, Any] = {}
        self._lock = threading.Condition()
        self._history: deque[tuple[float, Array]] = deque()
        self._poses: dict[str, Pose] = {}
        self._notes: deque[str] = deque(maxlen=_NOTES)
        self._begins = True
        self._ended = ""  # why the robot node is gone
        self._tick = -math.inf
        self._begin = now()
        self._link, end = Link.pair()
        try:
            self._process = _start_node(end)
        except BaseException:
            self._link.close()
            raise
        self._link.send(Start(wiring))
        self._reader = threading.Thread(target=self._listen, daemon=True, name="robot node")
        self._reader.start()
        try:
            self._await_readings()
        except BaseException:
            self.close()
            raise

    def __repr__(self) -> str:
        return f"<RosRobot '{self.robot.name}' on {self._names.wiring.joint_states}>"

    def __enter__(self) -> RosRobot:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the robot, and end its node."""
        self._link.send(End(), wait=self.timeout)
        try:
            self._process.wait(2.0)
        except subprocess.TimeoutExpired:
            self._process.kill()  # its guard stops the robot
            self._process.wait()
        self._link.close()
        self._reader.join()

    # -- what there is -------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Time since the robot was connected [s]."""
        return now() - self._begin

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the robot node has found wrong of late."""
        return tuple(self._notes)

    def observe(self) -> Observation:
        """Return the latest sensor readings that have arrived, and poses of one picture if there is one."""
        with self._lock:
            self._check()
            stamp, values = self._history[-1]
            due = [pose for pose in self._poses.values() if pose.stamp <= stamp - _LATER]
            first = min((pose.stamp for pose in due), default=stamp)
            picture = [pose for pose in due if pose.stamp <= first + _PICTURE]
            for pose in picture:
                del self._poses[pose.frame]
            then = self._values_at(first) if picture else values
        joints = dict(zip(self._read, values.tolist(), strict=True))
        poses = {pose.frame: self._locate(pose, then) for pose in picture}
        seen = first - self._begin if picture else None
        return Observation(stamp - self._begin, joints, poses, seen=seen)

    # -- what is commanded ---------------------------------------------------------------------------------

    def apply(self, speeds: StateLike, duration: float, *, stamp: float | None = None) -> None:
        """Let the robot move with speeds for a duration, as :meth:`.RobotInterface.apply`.

        The robot goes on with them until the next call, at most for the time-out. Steps that follow each
        other end at equal distances in time, so what is computed between two of them takes from the time that
        the second one waits.
        """
        time = self.time
        with self._lock:
            self._check()
            values = self._history[-1][1]
        self._commands.take(speeds, duration, stamp, time)
        vector = self._commands.acting(time)
        twist = (0.0, 0.0, 0.0)
        if self._base_columns:
            moved = self._base_jacobian(values[self._base_inputs]) @ vector[self._base_columns]
            twist = (float(moved[0]), float(moved[1]), float(moved[5]))
        groups = tuple(tuple(vector[columns].tolist()) for columns in self._controllers)
        made = self._begin + (time if stamp is None else stamp)
        self._send(Speeds(now(), made, twist, groups))
        late = time - self._tick - duration
        self._tick = time + duration if late > self.timeout else max(self._tick + duration, time)
        with self._lock:
            self._lock.wait_for(lambda: bool(self._ended), self._tick - self.time)
            self._check()

    def follow(
        self,
        trajectory: Trajectory,
        *,
        tolerance: float = 0.1,
        report: Callable[[float], object] | None = None,
    ) -> None:
        """Let the robot's controller of trajectories follow a path, and watch it until it is over.

        It is given up, and the joints stop where they are, if the robot leaves the path, is late or silent,
        or if the caller is interrupted.

        Parameters
        ----------
        trajectory
            Path of joints, which begins where they are now.
        tolerance
            Largest distance of a joint from the path [rad], [m].
        report
            Is called with the time on the path while it is followed [s].

        Raises
        ------
        InvalidValueError
            For a path of something that no joint is, and one that begins elsewhere.
        SimulationError
            If it is given up.
        """
        as_positive(tolerance, "tolerance=", "distance")
        columns = self._find_columns(trajectory.symbols)
        with self._lock:
            self._check()
            stamp, values = self._history[-1]
        off = np.abs(values[columns] - trajectory.positions[0])
        if off.max(initial=0.0) > tolerance:
            worst = int(off.argmax())
            raise InvalidValueError(
                f"The path begins {off[worst]:.3g} from where '{trajectory.symbols[worst]}' is now."
            )
        names = tuple(self._names.joints.to_ros(str(s)) for s in trajectory.symbols)
        times = trajectory.times[1:] if len(trajectory.times) > 1 else trajectory.times
        tables = (trajectory.positions[-len(times) :], trajectory.velocities[-len(times) :])
        positions, velocities = (tuple(map(tuple, table.tolist())) for table in tables)
        begin = now()
        self._send(Follow(begin, stamp, names, tuple(times.tolist()), positions, velocities))
        try:
            self._watch(trajectory, columns, begin, tolerance, report)
        except BaseException:
            self._link.send(Beat(now(), False))
            raise
        self.apply({}, _STEP)

    def _watch(
        self,
        trajectory: Trajectory,
        columns: list[int],
        begin: float,
        tolerance: float,
        report: Callable[[float], object] | None,
    ) -> None:
        while True:
            with self._lock:
                self._lock.wait_for(lambda: bool(self._ended), _STEP)
                self._check()
                stamp, values = self._history[-1]
            self._send(Beat(now(), True))
            passed = stamp - begin
            if now() - stamp > self.timeout:
                raise SimulationError(f"The robot's readings are {now() - stamp:.2f} s old on its path.")
            if report is not None:
                report(passed)
            end = np.abs(values[columns] - trajectory.positions[-1]).max(initial=0.0)
            if passed >= trajectory.duration and end <= 0.1 * tolerance:
                return
            if passed >= trajectory.duration + _ARRIVAL:
                raise SimulationError(f"The robot is still {end:.3g} (rad, m) from the end of its path.")
            near = trajectory.positions_at(np.linspace(max(passed - _LAG, 0.0), max(passed, 0.0), 26))
            off = np.abs(near - values[columns]).max(axis=1, initial=0.0).min()
            if off > tolerance:
                raise SimulationError(f"The robot has left its path by {off:.3g} (rad, m).")

    def _find_columns(self, symbols: tuple[Symbol, ...]) -> list[int]:
        moved = {s.position: None for s in self._controlled}
        if bad := [str(s) for s in symbols if s not in moved]:
            raise InvalidValueError(
                f"The path moves {list_some(bad, 3)}; a controller of trajectories moves joints of "
                f"'{self.robot.name}' alone, and not its base."
            )
        return [self._read.index(s) for s in symbols]

    # -- the model -----------------------------------------------------------------------------------------

    def _make_columns(self) -> None:
        """Order readings and speeds."""
        model, robot, wiring = self.model, self.robot, self._names.wiring
        base = () if robot.base is None or wiring.odometry is None else robot.base.coordinates
        self._read = (*(model.symbol(name) for name in wiring.read), *base)
        place = {v: k for k, v in enumerate(robot.speeds)}
        self._controlled = [v for group in self._names.controllers for v in group]
        self._controllers = [[place[v] for v in group] for group in self._names.controllers]
        self._base_columns = [place[v] for v in self._names.base_speeds]
        columns: dict[Symbol | str, int | None] = dict.fromkeys(model.speeds)
        columns |= {v: k for k, v in enumerate(robot.speeds)}
        columns |= {str(v): k for v, k in columns.items()}
        fingers = {s.derivative() for gripper in robot.grippers for s in gripper.joints}
        is_finger = np.array([v in fingers for v in robot.speeds], dtype=bool)
        self._commands = SpeedCommands(columns, is_finger, self.timeout, 0.0, logger.info)

    def _prepare_base(self) -> None:
        """Compile what leads from TF to the base's coordinates, and from its speeds to a Twist."""
        base = self.robot.base
        if base is None:
            return
        origin = dict.fromkeys(base.coordinates, 0.0)
        offset = np.asarray(self.model.fk(base.child, relative_to=base.parent)(origin))
        self._plane_T_parent = inverse(offset)
        self._frame_T_base = inverse(self._names.frame_in_base)
        jacobian = self.model.jacobian(
            self._names.base_frame, relative_to=base.parent, form="body", symbols=self._names.base_speeds
        )
        function = compile(jacobian)
        self._base_jacobian = function
        self._base_inputs = [self._read.index(s) for s in function.inputs]

    def _to_coordinates(self, numbers: tuple[float, ...], before: float) -> list[float]:
        """Return x, y and the heading of the base, near another heading, from the pose of its frame in TF."""
        pose = self._plane_T_parent @ _to_pose(numbers) @ self._frame_T_base
        angle = math.atan2(pose[1, 0], pose[0, 0])
        return [float(pose[0, 3]), float(pose[1, 3]), before + math.remainder(angle - before, math.tau)]

    def _locate(self, pose: Pose, values: Array) -> Array:
        """Return an observed pose (4, 4) in the world, of a robot whose readings were others (n,)."""
        if pose.parent not in self._parents:
            function = compile(self.model.fk(pose.parent))
            self._parents[pose.parent] = function, [self._read.index(s) for s in function.inputs]
        function, places = self._parents[pose.parent]
        return np.asarray(function(values[places])) @ _to_pose(pose.numbers)

    def _values_at(self, stamp: float) -> Array:
        """Return the readings at a time [s], between those of two messages."""
        last = len(self._history) - 1
        later = next((k for k, (time, _) in enumerate(self._history) if time >= stamp), last)
        (begin, start), (end, stop) = self._history[max(later - 1, 0)], self._history[later]
        share = min(max((stamp - begin) / (end - begin), 0.0), 1.0) if end > begin else 1.0
        return start + share * (stop - start)

    # -- the robot node ------------------------------------------------------------------------------------

    def _listen(self) -> None:
        """Take what the robot node says, in a thread of its own."""
        try:
            while (message := self._link.receive()) is not None:
                with self._lock:
                    if isinstance(message, Readings):
                        self._take(message)
                    elif isinstance(message, Note):
                        self._note(message)
                    else:
                        self._begins = False
                    self._lock.notify_all()
        except EOFError:
            with self._lock:
                self._ended = self._ended or _ENDED
                self._lock.notify_all()

    def _take(self, message: Readings) -> None:
        values = [*message.joints]
        if message.base is not None:
            before = self._history[-1][1][-1] if self._history else 0.0
            values += self._to_coordinates(message.base, before)
        if not self._history or message.stamp > self._history[-1][0]:
            self._history.append((message.stamp, np.array(values)))
        while self._history[0][0] < message.stamp - _HISTORY:
            self._history.popleft()
        self._poses |= {pose.frame: pose for pose in message.poses}

    def _note(self, message: Note) -> None:
        if message.fatal:
            self._ended = message.text
        elif message.text not in self._notes:
            self._notes.append(message.text)
        if self._history:  # before, the error has them
            logger.warning(message.text)

    def _check(self) -> None:
        if self._ended:
            raise SimulationError(self._ended)

    def _send(self, message: Any) -> None:
        if not self._link.send(message, wait=self.timeout):
            with self._lock:  # a node that has just ended is found out here before its last words are read
                self._lock.wait_for(lambda: bool(self._ended), _LAST)
                self._check()
            raise SimulationError("The robot node takes no commands.")

    def _await_readings(self) -> None:
        with self._lock:
            self._lock.wait_for(lambda: bool(self._ended or not self._begins), _START)
            self._lock.wait_for(lambda: bool(self._ended or self._history), _WAIT)
            if self._ended == _ENDED and self._begins:
                raise MissingDependencyError(
                    "The robot node has ended at once. Its Python needs ROS 2, kineverse and kineverse_ros."
                )
            if self._ended:
                raise OfflineError(self._ended)
            if not self._history:
                missing = " ".join(self._notes) or "The robot node says nothing."
                raise OfflineError(f"'{self.robot.name}' has not reported for {_WAIT:g} s. {missing}")


def _to_pose(numbers: tuple[float, ...]) -> Array:
    values = np.array(numbers)
    return np.asarray(transform(quaternion(values[3:]), values[:3]))


def _start_node(end: Any) -> subprocess.Popen[bytes]:
    """Start the robot node by this Python if it has ROS 2, else by the one that is named."""
    named = os.environ.get(PYTHON)
    python = sys.executable if _has_ros() else named
    with end:
        if not python:
            raise MissingDependencyError(
                "This Python has no ROS 2 (rclpy). With an installed ROS 2, source it: source "
                "/opt/ros/DISTRO/setup.bash, in an environment of the same Python; or name a Python that has "
                f"it and kineverse: {PYTHON}=.venv/ros/bin/python, which make ros makes in a checkout."
            )
        try:
            return start_process("node", end, python)
        except OSError as error:
            raise MissingDependencyError(f"{PYTHON}={python} cannot be started: {error.strerror}.") from None


@cache
def _has_ros() -> bool:
    return find_spec("rclpy") is not None
