"""Robot and belief of a live system: what skills see of its processes."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence

import numpy as np

from kineverse.errors import (
    DuplicateNameError,
    InvalidValueError,
    OfflineError,
    SimulationError,
    StoppedError,
)
from kineverse.exchange import Connection
from kineverse.exchange.state import Newest
from kineverse.model.model_view import ModelView
from kineverse.planning.trajectories.trajectory import Trajectory
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol
from kineverse.worlds import Observation, Robot
from kineverse.worlds.speed_commands import parse_speeds

from .streams import (
    COMMANDS,
    ROBOT,
    TICK,
    TRACKER,
    CommandNote,
    ObservationReader,
    RobotNote,
    TrackerNote,
    decode,
    encode,
)

_CONNECTING = 10.0  # longest time until the first reading [s]
_FOLLOWING, _BESIDE_PATH = 5.0, 0.1
"""Gain on a path of joints [1/s], and the distance from it at which it waits [m], [rad]."""
_SETTLING, _PATIENCE = 0.5, 4.0  # time at the end of such a path, and longest time to wait [s]
_SILENT = 0.5  # time without a word from a process after which it is named [s]
_ESTIMATING = 0.004  # longest time that the estimate of a reading is waited for [s]


class LiveRobot:
    """Robot that a world process of a live system moves, as :class:`.RobotInterface`.

    Parameters
    ----------
    model
        Model of the robot and of everything around it: a snapshot of the served one.
    robot
        The robot in it, or the prefix of its names.
    connection
        Connection to the model server.

    Attributes
    ----------
    planned
        Speeds planned for objects, by name, which the tracker gets with the next command.

    Raises
    ------
    OfflineError
        If no world is there, or one of another version.
    InvalidValueError
        If it has another robot.
    DuplicateNameError
        If another process sends commands already.

    See Also
    --------
    kineverse.live.WorldProcess
    """

    remarks: tuple[str, ...] = ()
    observed: Sequence[str] = ()  # the camera of its world chooses the frames

    def __init__(self, model: ModelView, robot: Robot | str, connection: Connection) -> None:
        self.model, self.robot = model, Robot.of(model, robot)
        self.reader = connection.reader()
        self._speeds = self.robot.speeds
        fingers = {s.derivative() for gripper in self.robot.grippers for s in gripper.joints}
        self._fingers = [k for k, v in enumerate(self._speeds) if v in fingers]
        columns: dict[Symbol | str, int | None] = dict.fromkeys(model.speeds)
        columns |= {v: k for k, v in enumerate(self._speeds)}
        self._columns = columns | {str(v): k for v, k in columns.items()}
        self._symbols = {str(s): s for s in self.robot.coordinates}
        self._observations = ObservationReader(self.reader)
        self._number, self._now = 0, -math.inf
        self.planned: Mapping[str, float] = {}
        self._observation = Observation(-math.inf, {})
        try:
            self._commands = connection.publisher(COMMANDS, self._speeds)
        except DuplicateNameError:
            self.reader.close()
            raise DuplicateNameError(
                f"Another process commands the robot of '{connection.address}' already ('{COMMANDS}'): end "
                "it first, or leave the robot to it."
            ) from None
        try:
            self._connect()
        except BaseException:
            self.close()
            raise

    def _connect(self) -> None:
        end = time.monotonic() + _CONNECTING
        while (note := self._read()) is None:
            if time.monotonic() > end:
                newest = self.reader.newest(ROBOT)
                raise OfflineError(
                    "No world moves the robot: 'kineverse world' starts one for this model server."
                    if newest is None
                    else "The world is of another version than this process: end it, and start it again."
                )
            self.reader.wait(TICK)
        if missing := [str(s) for s in self.robot.coordinates if s not in self._observation.joints]:
            raise InvalidValueError(
                f"The world has another robot than '{self.robot.name}': it does not report '{missing[0]}'. "
                "Name its robot, or start a world with this one."
            )
        self.name, self.timeout = note.world, max(note.timeout, TICK)

    def close(self) -> None:
        """Send no commands any more."""
        self._commands.close()
        self.reader.close()

    @property
    def time(self) -> float:
        """The present time of the robot, which does not go back [s]."""
        newest = self.reader.newest(ROBOT)
        if newest is not None:
            self._now = max(self._now, newest.stamp + time.monotonic() - newest.arrival)
        return self._now

    @property
    def problem(self) -> str:
        """Reason why the robot takes no commands at present; empty if it does."""
        newest = self.reader.newest(ROBOT)
        age = math.inf if newest is None else time.monotonic() - newest.arrival
        if age > _SILENT:
            return f"The world has said nothing for {age:.1f} s."
        why = self.stopped
        return f"The robot is stopped: {why}." if why else ""

    @property
    def stopped(self) -> str:
        """Reason why people or guards have stopped the robot; empty if they have not."""
        note = self._read()
        return "" if note is None else note.stopped

    def apply(self, speeds: StateLike, duration: float, *, stamp: float | None = None) -> None:
        """Send speeds, and return at the first reading after the duration, as :meth:`.RobotInterface.apply`.

        Raises
        ------
        StoppedError
            With the reason, while the robot takes no commands.
        """
        latest = self.reader.newest(ROBOT)
        begin = self.time if latest is None else latest.stamp
        given = np.full(len(self._speeds), np.nan)
        parse_speeds(speeds, self._columns, given)
        absent = np.isnan(given)
        kept = [k for k in self._fingers if absent[k]]
        self._number += 1
        note = CommandNote(self._number, duration, stamp is not None, kept, dict(self.planned))
        self._commands.put(np.where(absent, 0.0, given), begin if stamp is None else stamp, encode(note))
        end = begin + duration - TICK / 2
        limit = time.monotonic() + duration + TICK
        while (newest := self.reader.newest(ROBOT)) is None or newest.stamp < end:
            if (left := limit - time.monotonic()) <= 0.0:
                break
            self.reader.wait(left)
        if why := self.stopped:
            raise StoppedError(f"The robot is stopped: {why}.")

    def follow(self, trajectory: Trajectory) -> None:
        """Follow a path of joints, and return at its end.

        Raises
        ------
        SimulationError
            If it is given up, as the robot is too far from the path, or is stopped.
        """
        speeds = [s.derivative() for s in trajectory.symbols]
        time_on_path, moved = 0.0, self.time
        while time_on_path < trajectory.duration + _SETTLING:
            joints = self.observe()
            now = trajectory.positions_at(time_on_path)
            away = now - np.array([joints.joints[s] for s in trajectory.symbols])
            off = float(np.abs(away).max(initial=0.0))
            ahead = time_on_path + TICK if off < _BESIDE_PATH else time_on_path  # it waits
            rates = (trajectory.positions_at(ahead) - now) / TICK + _FOLLOWING * away
            try:
                self.apply(dict(zip(speeds, rates.tolist(), strict=True)), TICK, stamp=joints.stamp)
            except StoppedError as error:
                raise SimulationError(str(error)) from None
            if ahead > time_on_path:
                time_on_path, moved = ahead, self.time
            elif self.time - moved > _PATIENCE:
                raise SimulationError(f"The robot is {off:.2g} (m or rad) from its path.")
        self.apply({}, TICK)

    def observe(self) -> Observation:
        """Return the latest sensor readings that have arrived."""
        self._read()
        return self._observation

    def _read(self) -> RobotNote | None:
        newest = self.reader.newest(ROBOT)
        note = None if newest is None else decode(newest.note, RobotNote)
        if newest is None or note is None:
            return None
        if newest.stamp > self._observation.stamp:
            self._observation = self._observations.read(newest, note.touching, self._symbols)
        return note


class LiveBelief:
    """Belief that a tracker of a live system publishes.

    See Also
    --------
    kineverse.live.WorldProcess
    """

    def __init__(self, robot: LiveRobot) -> None:
        self._robot, self._model = robot, robot.model
        self._symbols = {str(s): s for s in self._model.symbols if not s.order}
        self._state = self._model.default_state()
        self._deviations: dict[Symbol, float] = {}
        self._note: TrackerNote | None = None
        self.seen: dict[Symbol, float] = {}

    @property
    def problem(self) -> str:
        """Reason why nothing is believed at present; empty if the tracker goes on."""
        newest = self._robot.reader.newest(TRACKER)
        if newest is None:
            return "No tracker says where things are: 'kineverse track' starts one."
        if decode(newest.note, TrackerNote) is None:
            return "The tracker is of another version than this process: end it, and start it again."
        age = time.monotonic() - newest.arrival
        return f"The tracker has said nothing for {age:.1f} s." if age > _SILENT else ""

    @property
    def lost(self) -> tuple[str, ...]:
        """Names of coordinates that were never seen, or whose track is lost."""
        return () if self._note is None else tuple(self._note.lost)

    def update(self, observation: Observation, time: float, commands: State | None = None) -> State:
        """Return the newest state of the tracker, that of these readings if it comes soon."""
        if commands is not None:
            planned = {str(v): value for v, value in commands.items() if not self._robot.robot.moves(v)}
            self._robot.planned = planned
        newest = self._wait_for(observation.stamp)
        note = None if newest is None else decode(newest.note, TrackerNote)
        if newest is None or note is None:
            return self._state
        self._note = note
        values = {self._symbols[name]: value for name, value in newest.named.items() if name in self._symbols}
        self._state = State({**self._state, **values}, stamp=newest.stamp, source=TRACKER)
        deviations = np.frombuffer(note.deviations).tolist()
        known = zip(newest.names, deviations, strict=False)
        self._deviations = {self._symbols[name]: value for name, value in known if name in self._symbols}
        self.seen = {self._symbols[name]: at for name, at in note.seen.items() if name in self._symbols}
        return self._state

    def _wait_for(self, stamp: float) -> Newest | None:
        reader, end = self._robot.reader, time.monotonic() + _ESTIMATING
        while (newest := reader.newest(TRACKER)) is None or newest.stamp < stamp - TICK / 2:
            if (left := end - time.monotonic()) <= 0.0:
                break
            reader.wait(left)
        return newest

    def deviation(self, coordinate: Symbol) -> float:
        """Return the standard deviation of a coordinate [m], [rad]; infinite where nothing is known."""
        return self._deviations.get(coordinate, math.inf)
