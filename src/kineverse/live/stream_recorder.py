"""Recorder of a live system: what its streams say, in a file that plays in the browser."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from kineverse._runtime import Closing
from kineverse.errors import KineverseError
from kineverse.exchange import Connection
from kineverse.exchange.state import Newest
from kineverse.model.model_view import ModelView
from kineverse.worlds.recorder import Recorder

from .streams import (
    ACTIVITY,
    COMMANDS,
    ROBOT,
    TRACKER,
    TRUTH,
    ActivityNote,
    ObservationReader,
    RobotNote,
    decode,
)

_LOG = logging.getLogger(__name__)
_PERIOD = 1.0 / 30.0  # time between two looks [s]


class StreamRecorder(Closing):
    """Thread that writes the newest of all streams to an MCAP file, until it is closed.

    It begins with the first word of the world, whose time is 0 in the file. Values of coordinates that an
    edit brings meanwhile are left out: the file has the model of its beginning. Errors are those of
    :class:`.Recorder`.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        connection: Connection,
        model: ModelView,
        about: Mapping[str, str] | None = None,
    ) -> None:
        self._recorder = Recorder(path, model, about)
        self._known = {str(s): s for s in model.symbols}
        self._reader = connection.reader()
        self._observations = ObservationReader(self._reader)
        self._stamps: dict[str, float] = {}
        self._origin: float | None = None
        self._told = 0  # results that were written
        self._phase: str | None = None
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name="recorder")
        self._thread.start()

    def close(self) -> None:
        """Finish the file."""
        self._is_over.set()
        self._thread.join()
        self._reader.close()
        self._recorder.close()

    def _run(self) -> None:
        while not self._is_over.wait(_PERIOD):
            try:
                self.look()
            except KineverseError as error:  # such as of a full disk
                _LOG.warning("Nothing more is recorded: %s", error)
                return

    def look(self) -> None:
        """Write what is new."""
        robot = self._read(ROBOT)
        if self._origin is None:
            if robot is None:
                return
            self._origin = robot.stamp
        if (truth := self._read(TRUTH)) is not None:
            self._recorder.write_state(self._time(truth), self._select(truth))
        if (belief := self._read(TRACKER)) is not None:
            self._recorder.write_belief(self._time(belief), self._select(belief))
        if (commands := self._read(COMMANDS)) is not None:
            self._recorder.write_command(self._time(commands), self._select(commands))
        if robot is not None:
            self._write_readings(robot)
            self._write_activity(self._time(robot))

    def _read(self, source: str) -> Newest | None:
        """Return the newest vector of a source if it is newer than the one before."""
        newest = self._reader.newest(source)
        if newest is None or newest.stamp <= self._stamps.get(source, -np.inf):
            return None
        self._stamps[source] = newest.stamp
        return newest

    def _time(self, newest: Newest) -> float:
        assert self._origin is not None
        return max(0.0, newest.stamp - self._origin)

    def _select(self, newest: Newest) -> dict[str, float]:
        return {name: value for name, value in newest.named.items() if name.partition(":")[0] in self._known}

    def _write_readings(self, robot: Newest) -> None:
        note, time = decode(robot.note, RobotNote), self._time(robot)
        observation = self._observations.read(robot, () if note is None else note.touching, self._known)
        self._recorder.write_observation(time, replace(observation, stamp=time))

    def _write_activity(self, time: float) -> None:
        newest = self._reader.newest(ACTIVITY)
        note = None if newest is None else decode(newest.note, ActivityNote)
        if note is None:
            return
        phase = ": ".join(filter(None, [note.doing, note.phase or note.why]))
        if phase != self._phase:
            self._phase = phase
            self._recorder.write_phase(time, phase)
        if note.vectors:
            self._recorder.write_vectors(time, note.read_vectors())
        if (number := note.done + note.failed) > self._told:
            self._told = number
            self._recorder.write_outcome({"done": not note.failed, "reason": note.last})
