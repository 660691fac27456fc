"""Benchmark ``exchange``: a model server and its clients, each in a process of its own."""

from __future__ import annotations

import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from time import perf_counter
from typing import Any

from .harness import Benchmark, BenchmarkResult, BenchmarkSettings, Contender, ProgramError
from .workloads import find_benchmark_robot

KINDS = {"datum": 1.2e-3, "constant frame": 1.2e-3, "joint with limits": 1.6e-3}
"""Edits, with the bars of the time that they take longer than the relay [s]."""
CPU = {"a frame": (1, 200e-6), "a joint": (1, 350e-6), "a frame in edits of 20": (20, 90e-6)}
"""Streamed edits, with the number of operations in each and the bar of the server's CPU time for one [s]."""
FEW, SIZE = 10, 20  # objects of the small model, coordinates of an object
_EDITS = 20  # in a sample
_STREAMED = 200
_RATE, _SECONDS = 20_000.0, 0.5  # of vectors
_CROWD = 200
_LARGE_EDITS = 60  # what a subscriber does not read has to fill its socket

FROZEN, CROWD = (
    "longest time to a hook beside a frozen subscriber",
    "subscribers of a part, all edits in order",
)
SCRIPT, KILLED = "end of a script that closes nothing", "server killed, until the next edit is acknowledged"
STATE, STATE_RATE, STATE_LOST = (
    f"20 values, {what}" for what in ("to a reader", "vectors sent", "vectors lost")
)
WHOLE, PART = "robot and kitchen joined, under edits", "part of an arm joined, under edits"
RESTORE = "large store served"


class Process:
    """Object of :mod:`.exchange_programs` in a process of its own."""

    def __init__(self, program: str, *arguments: object, folder: str, **options: object) -> None:
        code = (
            "import json, sys; from kineverse_studies.bench import exchange_programs as programs; "
            "name, arguments, options = json.loads(sys.argv[1]); "
            "programs.run(getattr(programs, name)(*arguments, **options))"
        )
        self.name = program
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", code, json.dumps([program, arguments, options])],
            env={**os.environ, "KINEVERSE_RUNTIME_DIR": folder},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def begin(self, method: str, *arguments: object) -> None:
        """Call a method; its result is for :meth:`end`."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{json.dumps([method, *arguments])}\n")
        self._process.stdin.flush()

    def end(self) -> Any:
        """Return the result of the method that was called, or None once the process is ready."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise ProgramError(f"The program {self.name!r} ended with status {self._process.wait()}.")
        return json.loads(line)

    def __call__(self, method: str, *arguments: object) -> Any:
        self.begin(method, *arguments)
        return self.end()

    def signal(self, number: int) -> None:
        """Send a signal to the process."""
        self._process.send_signal(number)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()


class Scene:
    """Folder with sockets and stores, and processes that end with it."""

    def __init__(self, folder: str, opened: ExitStack) -> None:
        self.folder, self._opened = folder, opened
        self.relay = f"unixsock-stream/{folder}/relay.sock"

    def start(self, *program: Any, **options: object) -> Process:
        """Start a process, and return it when it is ready."""
        process = Process(*program, folder=self.folder, **options)
        self._opened.callback(process.close)
        process.end()
        return process

    def run_script(self, code: str) -> tuple[str, float]:
        """Run a script, and return its output and when it ended."""
        environment = {**os.environ, "KINEVERSE_RUNTIME_DIR": self.folder}
        done = subprocess.run(
            [sys.executable, "-P", "-c", code], env=environment, stdout=subprocess.PIPE, text=True, check=True
        )
        return done.stdout, perf_counter()

    def serve(self, *models: str, **options: object) -> Process:
        """Start a server of models, or of a number of joints."""
        return self.start("Server", f"{self.folder}/bench.db", *models, **options)


@contextmanager
def make_scene() -> Iterator[Scene]:
    # A socket's path has to be short.
    with tempfile.TemporaryDirectory(prefix="kv-") as folder, ExitStack() as opened:
        yield Scene(folder, opened)


def measure_exchange(settings: BenchmarkSettings) -> BenchmarkResult:
    one = Benchmark("exchange", settings)
    for measure in (
        _measure_edits,
        _measure_faults,
        _measure_state,
        _measure_joining,
        _measure_restoring,
        _measure_growth,
    ):
        measure(one)
    return one.result(
        "a model server and its clients, each a process: an edit until a subscriber's hook is called, beside "
        "a server that only publishes the same bytes; PR2 and kitchen joined; state; faults"
    )


def _measure_edits(one: Benchmark) -> None:
    """Measure the time to a subscriber beside the relay, and the CPU time of the server."""
    with make_scene() as scene:
        server, _ = scene.serve(), scene.start("Relay", scene.relay)
        editor, follower = scene.start("Editor", scene.relay), scene.start("Follower", scene.relay)

        def edit(kind: str) -> float:
            return statistics.median(_delays(editor, follower, kind, _EDITS))

        def relay(kind: str) -> float:
            starts = editor("relay", kind, _EDITS)
            return _median_difference(follower("relayed", _EDITS), starts)

        def cpu(kind: str, size: int) -> float:
            before = server("cpu_time")
            editor("stream", kind, _STREAMED // size, size)
            return (server("cpu_time") - before) / (_STREAMED // size * size)

        contenders = []
        for name in KINDS:
            kind = name.split()[0].replace("constant", "frame")
            contenders += [
                Contender(f"{name}, to the hook", lambda kind=kind: edit(kind)),
                Contender(f"{name}, by the relay", lambda kind=kind: relay(kind)),
            ]
        one.time(contenders, what="exchange, edits")
        for name, (size, limit) in CPU.items():
            kind = "joint" if "joint" in name else "frame"
            label = f"server's CPU time, {name}"
            one.time(
                [Contender(label, lambda kind=kind, size=size: cpu(kind, size))],
                one.settings.processes,
                "exchange, CPU",
            )
            one.bound(limit, label)
    for name, limit in KINDS.items():
        ours, theirs = (one.measured[f"{name}, {how}"].median for how in ("to the hook", "by the relay"))
        one.compare(f"{name}, to the hook, longer than by the relay", ours - theirs, "s", limit)


def _delays(editor: Process, follower: Process, kind: str, *how: float) -> list[float]:
    made = editor("edit", kind, *how)
    heard = follower("heard", [version for version, _ in made])
    return [end - start for end, (_, start) in zip(heard, made, strict=True)]


def _median_difference(ends: Sequence[float], starts: Sequence[float]) -> float:
    return statistics.median(end - start for end, start in zip(ends, starts, strict=True))


def _measure_faults(one: Benchmark) -> None:
    """Measure a server that is killed, subscribers that are many or frozen, and the end of a script."""
    settings = one.settings
    with make_scene() as scene:
        server, _ = scene.serve(), scene.start("Relay", scene.relay)
        editor = scene.start("Editor")
        follower, frozen = (scene.start("Follower", scene.relay) for _ in range(2))
        editor("edit", "frame", 1)

        frozen.signal(signal.SIGSTOP)
        delays = _delays(editor, follower, "large", _LARGE_EDITS, 0.0)
        one.note(FROZEN, "s", max(delays))
        frozen.signal(signal.SIGCONT)

        crowd = scene.start("Crowd", _CROWD, "edited/")
        versions = [version for version, _ in editor("edit", "frame", _EDITS)]
        one.note(CROWD, "subscribers", crowd("in_order", versions))
        crowd.close()

        def end_script() -> float:
            line, end = scene.run_script(
                "import kineverse as kv, time\nmodel = kv.load('live:bench')\n"
                "model.listen(print)\nprint(time.perf_counter())"
            )
            return end - float(line)

        def restart() -> float:
            nonlocal server
            server.signal(signal.SIGKILL)
            start = perf_counter()
            server.close()
            server = scene.serve()
            return editor("edit_again") - start

        one.time(
            [Contender(SCRIPT, end_script), Contender(KILLED, restart)],
            settings.processes,
            "exchange, faults",
        )
    one.bound(0.15, FROZEN)
    one.compare(CROWD, one.measured[CROWD].median, "subscribers", _CROWD, at_least=True)
    one.bound(1.0, SCRIPT)
    one.bound(2.0, KILLED)


def _measure_state(one: Benchmark) -> None:
    with make_scene() as scene:
        source = scene.start("Source")
        readers = [scene.start("Reader", source("endpoint")) for _ in range(2)]
        lost: list[int] = []
        rates: list[float] = []
        number = round(_RATE * _SECONDS)
        source("send", 1, _RATE)  # by which the connections are known
        sent = 1

        def send() -> float:
            nonlocal sent
            rates.append(source("send", number, _RATE))
            sent += number
            taken = [reader("taken", sent) for reader in readers]
            lost.append(max(missing for missing, _ in taken))
            return max(delay for _, delay in taken)

        one.time([Contender(STATE, send)], one.settings.processes, "exchange, state")
    one.note(STATE_RATE, "1/s", min(rates))
    one.note(STATE_LOST, "vectors", lost[-1])
    one.bound(0.5e-3, STATE)
    one.compare(STATE_RATE, min(rates), "1/s", 0.99 * _RATE, at_least=True)
    one.bound(0, STATE_LOST)


def _measure_joining(one: Benchmark) -> None:
    robot = find_benchmark_robot(one.settings)
    with make_scene() as scene:
        scene.serve(str(robot.file), "kitchen")
        editor, joiner = scene.start("Editor"), scene.start("Joiner")
        arm = joiner("frame", robot.frame)

        def join(frame: str | None) -> float:
            editor.begin("keep_editing", 0.3)
            seconds = float(joiner("join", frame))
            editor.end()
            return seconds

        contenders = [Contender(WHOLE, lambda: join(None)), Contender(PART, lambda: join(arm))]
        one.time(contenders, what="exchange, joining")
    one.bound(0.2, WHOLE)
    one.bound(0.05, PART)


def _measure_restoring(one: Benchmark) -> None:
    with make_scene() as scene:
        scene.serve(joints=one.settings.operations).close()

        def restore() -> float:
            server = scene.serve()
            seconds = float(server("start_time"))
            server.close()
            return seconds

        one.time([Contender(RESTORE, restore)], one.settings.processes, "exchange, restoring")
    one.bound(2.0, RESTORE)


def _measure_growth(one: Benchmark) -> None:
    """Compare edits of a large model with those of a small one."""
    sizes = FEW, max(one.settings.operations // 10, FEW)
    with ExitStack() as scenes:
        editors = []
        for objects in sizes:
            scene = scenes.enter_context(make_scene())
            scene.serve(joints=SIZE * objects)
            editors.append(scene.start("Editor"))
        times: dict[str, list[float]] = {}
        for _ in range(one.settings.processes):
            for objects, editor in zip(sizes, editors, strict=True):
                for what, seconds in editor("touch", _EDITS).items():
                    times.setdefault(f"{what} a joint among {objects:,} objects", []).append(seconds)
    for name, seconds in times.items():
        one.note(name, "s", *seconds)
    names = list(times)
    for small, large in zip(names[:3], names[3:], strict=True):
        ratio = one.measured[large].median / one.measured[small].median
        one.compare(f"{large}, beside {FEW}", ratio, "x", 2.0)
