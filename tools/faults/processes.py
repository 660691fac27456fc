"""Servers and clients as processes: they are told by lines of text, and tell by lines of JSON."""

from __future__ import annotations

import faulthandler
import importlib
import json
import multiprocessing
import os
import queue
import random
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.forkserver import ensure_running
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

PATIENCE = 60.0
"""Time after which a process that says nothing counts as a violation [s]."""

_UNKNOWN_STATUS = 255  # that multiprocessing gives if the process that forks others has ended
# Processes are forked from one that has imported what takes a second of CPU time, and does nothing else.
_context = multiprocessing.get_context("forkserver")
_context.set_forkserver_preload(["zenoh", "faults.messages", "faults.relayed", "kineverse.exchange.server"])


class Process:
    """Process of a module of this package; what it has told is kept, also after its end."""

    def __init__(self, module: str, *arguments: object) -> None:
        words = [*map(str, arguments)]
        self.what = f"{module} {' '.join(words)}"
        with patch.dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path)):
            ensure_running()
            stdin, stdout = os.pipe(), os.pipe()
            ends = Connection(stdin[0], writable=False), Connection(stdout[1], readable=False)
            self._stdin, self._stdout = (
                os.fdopen(stdin[1], "w", encoding="utf-8"),
                os.fdopen(stdout[0], encoding="utf-8"),
            )
            self._process = _context.Process(
                target=_run, args=(module, words, dict(os.environ), *ends), daemon=True
            )
            self._process.start()
        for end in ends:
            end.close()
        assert self._process.pid is not None
        self.id = self._process.pid
        self.told: list[dict[str, Any]] = []
        self._replies: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self._stdout:
            with suppress(ValueError):  # the last line of one that was killed
                told = json.loads(line)
                if "reply" in told:
                    self._replies.put(told)
                else:
                    self.told.append(told)
        self._replies.put(None)

    def wait_for_reply(self, timeout: float = PATIENCE) -> Any:
        """Return the next reply, the first of which says that the process is ready."""
        try:
            told = self._replies.get(timeout=timeout)
        except queue.Empty:
            raise AssertionError(f"{self.what}: no reply within {timeout:g} s") from None
        self.check()
        if told is None:
            raise AssertionError(f"{self.what}: has ended, {self._explain_end()}")
        return told["reply"]

    def _explain_end(self) -> str:
        """Return how the process has ended; what it has written to stderr was seen when it was written."""
        self._process.join()
        status = self._process.exitcode
        if status == _UNKNOWN_STATUS:
            return "and so has the process that it was forked from: perhaps both were killed"
        return (
            f"killed by {signal.Signals(-status).name}" if status and status < 0 else f"with status {status}"
        )

    def ask(self, *words: object, timeout: float = PATIENCE) -> Any:
        """Tell something and return the reply."""
        self.tell(*words)
        return self.wait_for_reply(timeout)

    def tell(self, *words: object) -> None:
        with suppress(BrokenPipeError):
            self._stdin.write(f"{' '.join(map(str, words))}\n")
            self._stdin.flush()

    def check(self) -> None:
        """Raise what the process has found wrong."""
        for told in [*self.told]:
            if "violation" in told:
                raise AssertionError(f"{self.what}: {told['violation']}")

    def kill(self) -> None:
        self._process.kill()
        self._end()

    def close(self) -> None:
        """Let the process end by itself."""
        self.tell("end")
        self._process.join(5)
        self.kill()

    def _end(self) -> None:
        self._process.join()
        self._reader.join()
        for stream in (self._stdin, self._stdout):
            with suppress(BrokenPipeError):
                stream.close()

    def freeze(self) -> None:
        os.kill(self.id, signal.SIGSTOP)

    def thaw(self) -> None:
        os.kill(self.id, signal.SIGCONT)


def _run(
    module: str, arguments: list[str], environment: dict[str, str], stdin: Connection, stdout: Connection
) -> None:
    os.environ.clear()
    os.environ.update(environment)
    faulthandler.enable()  # where it was, for one that is ended by a defect in native code
    random.seed()
    sys.argv = [module, *arguments]
    sys.stdin = os.fdopen(stdin.fileno(), encoding="utf-8", closefd=False)
    sys.stdout = os.fdopen(stdout.fileno(), "w", encoding="utf-8", closefd=False)
    importlib.import_module(f"faults.{module}").main()


def start(running: ExitStack, module: str, *arguments: object) -> Process:
    """Start a process, which is ended with others, and return when it is ready."""
    process = begin(running, module, *arguments)
    process.wait_for_reply()
    return process


def begin(running: ExitStack, module: str, *arguments: object) -> Process:
    """Start a process without waiting for it."""
    process = Process(module, *arguments)
    running.callback(process.kill)
    return process


@contextmanager
def folder() -> Iterator[Path]:
    """Temporary folder with one for sockets in it, for this process and those that it starts."""
    known = os.environ.get("KINEVERSE_RUNTIME_DIR")
    with TemporaryDirectory(prefix="kv-") as path:
        os.environ["KINEVERSE_RUNTIME_DIR"] = str(Path(path, "run"))
        try:
            yield Path(path)
        finally:
            if known is None:
                del os.environ["KINEVERSE_RUNTIME_DIR"]
            else:
                os.environ["KINEVERSE_RUNTIME_DIR"] = known


_telling = threading.Lock()


def tell(**told: Any) -> None:
    """Tell the process that has started this one."""
    line = f"{json.dumps(told)}\n"
    with _telling:
        sys.stdout.write(line)
        sys.stdout.flush()


def commands() -> Iterator[list[str]]:
    """Yield what this process is told, until it has to end."""
    for line in sys.stdin:
        words = line.split()
        if words == ["end"]:
            return
        yield words


def wait_until(is_so: Any, timeout: float, what: str) -> None:
    """Wait until something is so."""
    late = time.monotonic() + timeout
    while not is_so():
        if time.monotonic() > late:
            raise AssertionError(f"not within {timeout:g} s: {what}")
        time.sleep(0.01)
