"""State estimator of a live system: from readings of the robot and pictures to the believed state."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from kineverse.exchange import LiveModel
from kineverse.manipulation import TrackedBelief
from kineverse.model.commits.follower import follow
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol, parse_symbol_name
from kineverse.worlds import Sensors

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

_SILENT = 2.0  # time without a word from the world after which it is named [s]


class TrackerProcess:
    """Tracker that publishes a believed state for each reading of the robot.

    Parameters
    ----------
    live
        The served model. After an edit the tracker is made anew, and begins with what was believed.
    robot
        Prefix of the robot's names.
    sensors
        The noise to expect.

    See Also
    --------
    kineverse.live.WorldProcess
    """

    def __init__(self, live: LiveModel, robot: str, sensors: Sensors) -> None:
        self._robot, self._sensors = robot, sensors
        self._follower = follow(live, self._make)
        self.belief, self._version = self._follower.current
        self._list_symbols()
        self._reader = live.exchange.reader()
        self._observations = ObservationReader(self._reader)
        self._publisher = live.exchange.publisher(TRACKER, self._symbols)
        self._stamp, self._ticks = 0.0, 0

    def _make(self, model: ModelView) -> TrackedBelief:
        belief = TrackedBelief(model, self._robot, self._sensors)
        belief.tracker.wait()
        return belief

    def _list_symbols(self) -> None:
        self._symbols = [s for s in self.belief.model.symbols if not s.order]
        self._known = {str(s): s for s in self._symbols}

    def run(
        self,
        is_over: Callable[[], bool] = lambda: False,
        on_problem: Callable[[str], object] = lambda _: None,
    ) -> None:
        """Track until it is over; what prevents it is told once, and when it is over."""
        told = ""
        while not is_over():
            if self._reader.wait(0.1):
                self.step()
            if (problem := self.find_problem()) != told:
                told = problem
                on_problem(problem or "There are readings.")

    def find_problem(self) -> str:
        """Return why nothing can be tracked; empty if there are readings."""
        newest = self._reader.newest(ROBOT)
        if newest is None or time.monotonic() - newest.arrival > _SILENT:
            return "There are no readings: no world runs, or it is frozen."
        if decode(newest.note, RobotNote) is None:
            return "The world is of another version than this process: end it, and start it again."
        return ""

    def step(self) -> bool:
        """Publish the state of the newest readings; return False if there are none that are newer."""
        begin = time.perf_counter()
        newest = self._reader.newest(ROBOT)
        note = None if newest is None else decode(newest.note, RobotNote)
        if newest is None or note is None or newest.stamp <= self._stamp:
            return False
        self._follow()
        before, self._stamp = self._stamp, newest.stamp
        observation = self._observations.read(newest, note.touching, self._known)
        if observation.poses:
            frames = self.belief.model.frames
            poses = {name: pose for name, pose in observation.poses.items() if name in frames}
            observation = replace(observation, poses=poses)
        state = self.belief.update(observation, newest.stamp, self._read_commands(before, newest.stamp, note))
        self._ticks = note.ticks
        self._publish(state, newest.stamp, 1e3 * (time.perf_counter() - begin))
        return True

    def _read_commands(self, begin: float, end: float, robot: RobotNote) -> State | None:
        """Return the mean speeds over a time [s], and those planned for objects; None if nobody commands any.

        A world that was held up has left ticks out, and a command acts no longer than the world's time-out
        after the state that it is from.
        """
        newest = self._reader.newest(COMMANDS)
        note = None if newest is None else decode(newest.note, CommandNote)
        if newest is None or note is None or robot.stopped:
            return None
        moved = (robot.ticks - self._ticks) * TICK
        acted = newest.stamp + (robot.timeout if note.stamped else note.duration) - begin
        share = min(1.0, max(0.0, min(moved, acted) / (end - begin)))
        values = newest.named | note.planned
        return State({Symbol(*parse_symbol_name(name)): share * value for name, value in values.items()})

    def _publish(self, state: State, stamp: float, milliseconds: float) -> None:
        deviations = np.array([self.belief.deviation(s) for s in self._symbols])
        seen = {str(s): at for s, at in self.belief.seen.items()}
        lost = [str(s) for s, d in zip(self._symbols, deviations, strict=True) if not np.isfinite(d)]
        note = TrackerNote(deviations.tobytes(), seen, lost, milliseconds)
        self._publisher.put(state.vector(self._symbols), stamp, encode(note))

    def _follow(self) -> None:
        """Go on with the tracker of an edited model, once it is made."""
        if self._follower.version == self._version:
            return
        before = self.belief
        self.belief, self._version = self._follower.current
        self.belief.take_over(before)
        symbols = self._symbols
        self._list_symbols()
        if symbols != self._symbols:
            self._publisher.set_coordinates(self._symbols)

    def close(self) -> None:
        """End the stream."""
        self._publisher.close()
        self._reader.close()
        self._follower.close()
