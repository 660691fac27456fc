"""Supervisor of a live system: it starts its processes, watches them, and starts again what dies."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from kineverse.errors import KineverseError, OfflineError, UnknownNameError
from kineverse.exchange import LiveModel
from kineverse.exchange.address import SCHEME, list_servers
from kineverse.exchange.client import load_live
from kineverse.exchange.connection import Connection
from kineverse.exchange.state import StateReader
from kineverse.model.frame import WORLD as WORLD_FRAME

from .children import Child, stop_all
from .live_status import SOURCES
from .streams import (
    ACTIVITY,
    ROBOT,
    SUPERVISOR,
    ActivityNote,
    ProcessRow,
    RobotNote,
    SkillResult,
    SupervisorNote,
    ask,
    encode,
    read_note,
)

SERVE, WORLD, TRACK, LEARN, BEHAVE, VIEW = "serve", "world", "track", "learn", "behave", "view"
"""Names of processes, which are those of their commands."""
_STARTING = 30.0  # longest time until a process has said something [s]
_SERVING = 60.0  # longest time until the model server is there [s]
_PERIOD = 0.1  # time between two looks [s]
_TOLD = 0.5  # time between two notes on the processes [s]


@dataclass
class LiveStatus:
    """State of a live system."""

    rows: list[ProcessRow] = field(default_factory=list)
    robot: RobotNote | None = None
    activity: ActivityNote | None = None
    results: list[SkillResult] = field(default_factory=list)  # of all behaviours that ran
    steps: int = 0  # of control, in all
    late_steps: int = 0

    @property
    def restarts(self) -> dict[str, int]:
        """Number of times that each process was started again, of those that were."""
        return {row.name: row.restarts for row in self.rows if row.restarts}

    def list_results(self, what: str, skill: str) -> list[SkillResult]:
        """Return the results of a skill at an object."""
        return [one for one in self.results if (one.what, one.skill) == (what, skill)]


class Supervisor:
    """Processes of a live system around a model server, from the start of all to the end of all.

    The commands are words by the name of their process, in the order of their start, the server first.
    A folder keeps what they print. Those in ``ending`` may come to an end by themselves. ``prepare`` is run
    with a process before it is started again, and with the state of the system: it may change the words.
    """

    def __init__(
        self,
        name: str,
        commands: Mapping[str, Sequence[str]],
        folder: str | os.PathLike[str],
        *,
        ending: Sequence[str] = (),
        prepare: Callable[[Child, LiveStatus], object] = lambda *_: None,
    ) -> None:
        self._name = name
        self.children = {
            one: Child(one, words, folder, may_end=one in ending) for one, words in commands.items()
        }
        self.status = status = LiveStatus()
        for child in self.children.values():
            child.prepare = partial(prepare, child, status)
        self._live: LiveModel | None = None
        self._reader: StateReader | None = None
        self._publisher: Any = None
        self._told = -math.inf
        self._counted = (0, 0, 0)  # steps, late ones and results of the present behaviour that are in it

    @property
    def reader(self) -> StateReader:
        """Reader of all streams; OfflineError before the server is there."""
        if self._reader is None:
            raise OfflineError("The model server has not started yet.")
        return self._reader

    def start(self) -> None:
        """Start the server, wait for it, and start all others.

        A server that does not come up is a KineverseError, with what it says.
        """
        server, *others = self.children.values()
        server.start()
        until = time.monotonic() + _SERVING
        while self._name not in list_servers():
            if server.watch() or time.monotonic() > until:
                raise KineverseError(f"The model server does not start: {server.describe_end()}.")
            time.sleep(_PERIOD / 4)
        for child in others:
            child.start()
        while self._live is None:
            try:
                self._live = load_live(SCHEME + self._name, frames=[WORLD_FRAME], bodies=False)
            except (OfflineError, UnknownNameError):
                if server.watch() or time.monotonic() > until:
                    raise
                time.sleep(_PERIOD)
        self._reader = self._live.exchange.reader()
        self._publisher = self._live.exchange.publisher(SUPERVISOR, ())

    @property
    def connection(self) -> Connection:
        """Connection to the server; OfflineError before it is there."""
        if self._live is None:
            raise OfflineError("The model server has not started yet.")
        return self._live.exchange

    def look(self) -> LiveStatus:
        """Look at all processes, start again what has ended, and return how they are."""
        status = self.status
        for child in self.children.values():
            child.watch()
        now = time.monotonic()
        if now - self._told > _TOLD:
            self._told = now
            status.rows = [self._describe(child) for child in self.children.values()]
            self._tell(status.rows)
        self._read(status)
        return status

    def _describe(self, child: Child) -> ProcessRow:
        cpu, sources = child.measure_cpu(), SOURCES.get(child.name, ())
        if child.is_done:
            state = "ended"
        elif not child.pid:
            state = child.describe_end()
        elif child.is_frozen:
            state = "frozen"
        else:
            age = min((self._ages.get(source, math.inf) for source in sources), default=0.0)
            since = time.monotonic() - child.started
            state = "starting" if age > since and since < _STARTING else "running"
        return ProcessRow(child.name, child.pid, state, child.ends, cpu)

    @property
    def _ages(self) -> dict[str, float]:
        return {} if self._reader is None else self._reader.age

    @property
    def is_online(self) -> bool:
        """True if the model server answers."""
        return self._live is not None and self._live.exchange.is_online

    def _tell(self, rows: Sequence[ProcessRow]) -> None:
        if self._publisher is not None and not self._publisher.is_closed:
            self._publisher.put((), None, encode(SupervisorNote([*rows])))

    def _read(self, status: LiveStatus) -> None:
        reader = self.reader
        status.robot = read_note(reader, ROBOT, RobotNote)
        status.activity = note = read_note(reader, ACTIVITY, ActivityNote)
        if note is None:
            return
        steps, late, results = self._counted
        if note.steps < steps or note.done + note.failed < results:  # of another process
            steps = late = results = 0
        status.steps += note.steps - steps
        status.late_steps += note.late - late
        news = note.done + note.failed - results
        status.results += note.results[max(0, len(note.results) - news) :]
        self._counted = note.steps, note.late, note.done + note.failed

    def ask_world(self, do: str, **arguments: Any) -> str:
        """Ask the world for something that people do; return why it was refused, or an empty text."""
        try:
            ask(self.reader, ROBOT, do, 1.0, **arguments)
        except KineverseError as error:
            return str(error)
        return ""

    def run(self, on_look: Callable[[LiveStatus], bool]) -> None:
        """Look ten times a second until a function of the state returns True."""
        while not on_look(self.look()):
            time.sleep(_PERIOD)

    def close(self) -> None:
        """Stop all processes, the behaviour before the world and that before the server."""
        stop_all([*self.children.values()])
        if self._live is not None:
            self._live.close()
