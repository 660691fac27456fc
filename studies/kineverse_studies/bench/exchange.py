"""Benchmark ``exchange``: a model server and its clients, each in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from multiprocessing import get_context
from multiprocessing.managers import BaseManager
from operator import sub
from signal import SIGCONT, SIGKILL, SIGSTOP
from statistics import median
from time import perf_counter
from typing import TypeVar

from . import exchange_programs as programs
from .harness import Benchmark, BenchmarkResult, BenchmarkSettings, Contender
from .workloads import find_benchmark_robot

WHOLE, TO_HOOK, BY_RELAY = "with the user's code", "to the hook", "by the relay"
EDITS = {
    "datum": ("datum", 1.2e-3),
    "frame": ("constant frame", 1.2e-3),
    "joint": ("joint with limits", 1.6e-3),
}
"""Kinds of edits: name, and the bar of the time that one takes longer than by the relay [s]."""
STREAMS = (
    ("frame", 1, "a frame", 200e-6),
    ("joint", 1, "a joint", 350e-6),
    ("frame", 20, "a frame of 20", 90e-6),
)
"""Streamed edits: kind and number of their operations, name, and bar of the server's CPU time for one [s]."""
ENDING = """
import time, kineverse as kv
model = kv.load("live:bench")
model.listen(print)
print(time.perf_counter())
"""

Started = TypeVar("Started", bound=programs.Remote)
_EDITS, _STREAMED, _LARGE_EDITS = 20, 200, 60
_RATE, _SECONDS = 20_000.0, 0.5  # of vectors
_CROWD = 200
_FEW, _SIZE = 10, 20  # objects of the small model, coordinates of an object


class Processes(BaseManager):
    """Process with a program."""


for _program in programs.Remote.__subclasses__():
    Processes.register(_program.__name__, _program)


class ProcessGroup:
    """Folder of sockets and of a store, with processes that end with it."""

    def __init__(self) -> None:
        self._opened, self._started = (
            ExitStack(),
            list[programs.Remote](),
        )  # which end with their last proxies
        # The path of a socket has to be short.
        self.folder = self._opened.enter_context(tempfile.TemporaryDirectory(prefix="kv-"))
        self.environment = "KINEVERSE_RUNTIME_DIR", self.folder

    def __enter__(self) -> ProcessGroup:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def start(self, program: type[Started], *arguments: object) -> Started:
        """Return an object whose methods are called in a process of its own."""
        process = Processes(ctx=get_context("spawn"))
        process.start(programs.begin, self.environment)
        self._opened.callback(process.shutdown)
        found: Started = getattr(process, program.__name__)(*arguments)
        self._started.append(found)
        return found

    def stop(self, *programs: programs.Remote) -> None:
        for program in programs:
            os.kill(program.pid(), SIGKILL)

    def serve(self, joints: int = 0, *models: str) -> programs.ServerProgram:
        return self.start(programs.ServerProgram, f"{self.folder}/bench.db", joints, *models)


def measure_exchange(settings: BenchmarkSettings) -> BenchmarkResult:
    one = Benchmark("exchange", settings)
    for measure in (_edits, _faults, _state, _joining, _restoring, _growth):
        with ProcessGroup() as scene:
            measure(one, scene)
    return one.result(
        "a model server and its clients, each a process: an edit until a subscriber's hook is called, beside "
        "a server that only publishes the same bytes; state; joining; faults; models of many objects"
    )


def _time(one: Benchmark, samples: dict[str, tuple[Callable[[], float], float]]) -> None:
    """Measure some processes, each with its bar."""
    one.time([Contender(name, sample) for name, (sample, _) in samples.items()], one.settings.processes)
    for name, (_, limit) in samples.items():
        one.bound(limit, name)


def _edits(one: Benchmark, scene: ProcessGroup) -> None:
    """Measure the time to a subscriber beside the relay, and the CPU time of the server."""
    place = f"unixsock-stream/{scene.folder}/relay.sock"
    server, _ = scene.serve(), scene.start(programs.EchoServer, place)
    editor, follower = scene.start(programs.Editor, place), scene.start(programs.Subscriber, place)

    def edit(since: int, kind: str) -> float:
        return median(_delays(editor, follower, kind, _EDITS, since=since))

    def relay(kind: str) -> float:
        starts = editor.relay(kind, _EDITS)
        return median(end - start for start, end in zip(starts, follower.relayed(_EDITS), strict=True))

    def stream(kind: str, size: int) -> float:
        before = server.times()[1]
        editor.stream(kind, _STREAMED // size, size)
        return float(server.times()[1] - before) / _STREAMED

    ways = (partial(edit, 1), WHOLE), (partial(edit, 2), TO_HOOK), (relay, BY_RELAY)
    one.time(
        Contender(f"{name}, {how}", partial(sample, kind))
        for kind, (name, _) in EDITS.items()
        for sample, how in ways
    )
    for name, limit in EDITS.values():
        ours, theirs = (one.measured[f"{name}, {how}"].samples for how in (TO_HOOK, BY_RELAY))
        longer = one.note(f"{name}, longer than {BY_RELAY}", "s", median(map(sub, ours, theirs)))
        one.bound(limit, longer.name)
    for kind, size, name, limit in STREAMS:
        _time(one, {f"server's CPU time, {name}": (partial(stream, kind, size), limit)})


def _delays(
    editor: programs.Editor,
    follower: programs.Subscriber,
    kind: str,
    count: int,
    pause: float = programs.PAUSE,
    since: int = 1,
) -> list[float]:
    """Return the times to the hook, since the edits began (1) or were asked for (2)."""
    made = editor.edit(kind, count, pause)
    heard = follower.heard([version for version, *_ in made])
    return [end - times[since] for end, times in zip(heard, made, strict=True)]


def _faults(one: Benchmark, scene: ProcessGroup) -> None:
    """Measure subscribers that are frozen or many, the end of a script, and a server that is killed."""
    server, editor = scene.serve(), scene.start(programs.Editor)
    follower, frozen = (scene.start(programs.Subscriber) for _ in range(2))
    editor.edit("frame", 1)
    process = frozen.pid()
    os.kill(process, SIGSTOP)
    slowest = max(_delays(editor, follower, "large", _LARGE_EDITS, 0.0))
    one.bound(0.15, one.note("longest time to a hook beside a frozen subscriber", "s", slowest).name)
    os.kill(process, SIGCONT)
    crowd = scene.start(programs.Crowd, _CROWD, "edited/")
    served = crowd.got([version for version, *_ in editor.edit("frame", _EDITS)])
    got = one.note("subscribers of a part, all in order", "subscribers", served)
    one.compare(got.name, served, got.unit, _CROWD, at_least=True)
    scene.stop(crowd, follower, frozen)
    environment = dict([*os.environ.items(), scene.environment])

    def end_script() -> float:
        said = subprocess.check_output([sys.executable, "-c", ENDING], env=environment)
        return perf_counter() - float(said)

    def restart() -> float:
        nonlocal server
        start = perf_counter()
        scene.stop(server)
        server = scene.serve()
        return editor.edit("frame", 1)[0][3] - start

    script, killed = "end of a script that closes nothing", "server killed, until an edit is acknowledged"
    _time(one, {script: (end_script, 1.0), killed: (restart, 2.0)})


def _state(one: Benchmark, scene: ProcessGroup) -> None:
    source = scene.start(programs.SourceProgram)
    readers = [scene.start(programs.Reader, source.endpoint()) for _ in range(2)]
    while not all(reader.take(1)[0] for reader in readers):
        source.send(1, _RATE)
    known = [reader.take(0)[0] for reader in readers]
    number, sent = round(_RATE * _SECONDS), 0
    rates, delays = [], []
    for _ in range(one.settings.processes):
        rates.append(source.send(number, _RATE))
        sent += number
        taken = [reader.take(sent + before) for reader, before in zip(readers, known, strict=True)]
        delays.append(max(delay for _, delay in taken))
    lost = max(sent + before - come for (come, _), before in zip(taken, known, strict=True))
    one.bound(0.5e-3, one.note("20 values, to two readers", "s", *delays).name)
    one.bound(0.0, one.note("20 values, vectors lost", "vectors", lost).name)
    reached = one.note("20 values, vectors sent", "vectors/s", *rates)
    one.compare(reached.name, reached.median, reached.unit, 0.99 * _RATE, at_least=True)


def _joining(one: Benchmark, scene: ProcessGroup) -> None:
    robot = find_benchmark_robot(one.settings)
    scene.serve(0, str(robot.file), "kitchen")
    editor, joiner = scene.start(programs.Editor), scene.start(programs.Editor)

    def join(*frames: str) -> float:
        with ThreadPoolExecutor() as beside:
            beside.submit(editor.edit, "frame", _EDITS)
            return joiner.join(*frames)

    whole, part = "robot and kitchen joined, under edits", "part of an arm joined, under edits"
    _time(one, {whole: (join, 0.2), part: (partial(join, robot.frame), 0.05)})


def _restoring(one: Benchmark, scene: ProcessGroup) -> None:
    scene.stop(scene.serve(one.settings.operations))

    def restore() -> float:
        server = scene.serve()
        seconds, _ = server.times()
        scene.stop(server)
        return seconds

    _time(one, {"large store served": (restore, 2.0)})


def _growth(one: Benchmark, small: ProcessGroup) -> None:
    """Compare edits of a model of many objects with those of few."""
    many = max(one.settings.operations // 10, 2 * _FEW)
    times: dict[str, list[float]] = {}
    with ProcessGroup() as large:
        scenes = {_FEW: small, many: large}
        for objects, scene in scenes.items():
            scene.serve(_SIZE * objects)
        editors = {objects: scene.start(programs.Editor) for objects, scene in scenes.items()}
        for _ in range(one.settings.processes * _EDITS):
            for objects, editor in editors.items():
                for what, kind in (("append", "joint"), ("replace", "replace"), ("remove", "remove")):
                    ((_, start, _, end),) = editor.edit(kind, 1)
                    times.setdefault(f"{what} a joint, {objects:,} objects", []).append(end - start)
    for name, seconds in times.items():
        one.note(name, "s", median(seconds))
    names = [*times]
    for few, name in zip(names[:3], names[3:], strict=True):
        ratio = one.measured[name].median / one.measured[few].median
        one.compare(f"{name}, beside {_FEW}", ratio, "x", 2.0)
