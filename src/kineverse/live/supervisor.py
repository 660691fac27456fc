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
from .streams import (
    ACTIVITY,
    LEARNER,
    ROBOT,
    SUPERVISOR,
    TRACKER,
    ActivityNote,
    ProcessRow,
    RobotNote,
    SkillResult,
    SupervisorNote,
    ask,
    encode,
    read_note,
)

SERVER, WORLD, TRACK, BEHAVE, PAGE = "server", "world", "tracker", "behaviour", "page"
SOURCES: Mapping[str, str] = {WORLD: ROBOT, TRACK: TRACKER, BEHAVE: ACTIVITY, "learner": LEARNER}
"""Stream of each process, whose age tells whether it goes on."""
_SILENT = 2.0  # age of the last word of a process from which on it counts as frozen [s]
_STARTING = 30.0  # longest time until a process has said something [s]
_SERVING = 60.0  # longest time until the model server is there [s]
_PERIOD = 0.1  # time between two looks [s]
_TOLD = 0.5  # time between two notes on the processes [s]


@dataclass
class LiveRow:
    """Process of a live system, as a table shows it."""

    name: str
    pid: int
    state: str  # running, starting, frozen, or how it has ended
    age: float  # time since its last word [s]; NaN without a stream
    cpu: float  # share of a core; NaN where the system does not tell
    restarts: int


@dataclass
class LiveStatus:
    """State of a live system."""

    rows: list[LiveRow] = field(default_factory=list)
    robot: RobotNote | None = None
    activity: ActivityNote | None = None
    results: dict[tuple[str, str], SkillResult] = field(default_factory=dict)  # by object and skill
    steps: int = 0  # of control, in all
    late_steps: int = 0

    @property
    def restarts(self) -> int:
        """Number of starts of processes that had ended, in all."""
        return sum(row.restarts for row in self.rows)


class Supervisor:
    """Processes of a live system around a model server, from the start of all to the end of all.

    Parameters
    ----------
    name
        Name of the model server.
    commands
        Words of each command by the name of its process, in the order of their start; the server is first.
    folder
        Folder of the run, for what is kept and printed.
    ending
        Names of processes that may come to an end by themselves.
    prepare
        Is called with a process before it is started again, and with the state of the system: it may change
        the words of its command.

    Attributes
    ----------
    status
        The present state.
    children
        The processes, by name.

    Raises
    ------
    GivenUpError
        By :meth:`look`, once a process ends again and again.
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
        self._counted = (0, 0)  # steps of the present behaviour that are in the status

    @property
    def reader(self) -> StateReader:
        """Reader of all streams; OfflineError before the server is there."""
        if self._reader is None:
            raise OfflineError("The model server has not started yet.")
        return self._reader

    def start(self) -> None:
        """Start the server, wait for it, and start all others.

        Raises
        ------
        KineverseError
            If the server does not come up, with what it says.
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

    def _describe(self, child: Child) -> LiveRow:
        cpu, source = child.measure_cpu(), SOURCES.get(child.name)
        age = math.nan if source is None else self.reader.age.get(source, math.inf)
        if child.is_done:
            state = "has ended"
        elif not child.pid:
            state = child.describe_end()
        elif child.is_frozen:
            state = "frozen"
        else:
            since = time.monotonic() - child.started
            silent = not math.isnan(age) and age > min(_SILENT, since)
            fresh = since < _STARTING and (math.isnan(age) or age > since)
            state = "running" if not silent else "starting" if fresh else "silent"
        return LiveRow(child.name, child.pid, state, age, cpu, child.ends)

    def _tell(self, rows: Sequence[LiveRow]) -> None:
        if self._publisher is not None and not self._publisher.is_closed:
            note = SupervisorNote([ProcessRow(r.name, r.pid, r.state, r.restarts, r.cpu) for r in rows])
            self._publisher.put((), None, encode(note))

    def _read(self, status: LiveStatus) -> None:
        reader = self.reader
        status.robot = read_note(reader, ROBOT, RobotNote)
        status.activity = note = read_note(reader, ACTIVITY, ActivityNote)
        if note is None:
            return
        steps, late = self._counted
        if note.steps < steps:  # of another process
            steps = late = 0
        status.steps += note.steps - steps
        status.late_steps += note.late - late
        self._counted = note.steps, note.late
        for one in note.results:
            status.results[one.what, one.skill] = one

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
