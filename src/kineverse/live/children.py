"""Child processes of a supervisor: commands that are watched, are started again, and die with it."""

from __future__ import annotations

import ctypes
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from kineverse.errors import KineverseError

_PAUSE, _MOST_PAUSE = 0.5, 8.0  # first and longest time until what has ended is started again [s]
_MOST_ENDS, _SHORT = 5, 20.0
"""Number of ends in a row, each within a time of its start [s], after which a process is given up."""
_STOPPING = 3.0  # longest time that a process is given to end [s]
_DEATH_SIGNAL: Final = 1  # of Linux: PR_SET_PDEATHSIG
_WATCHING = 0.5  # time between two looks at the parent where no signal tells of its end [s]
_LAST = 2000  # last bytes of a log in which its last line is looked for

# In the child, before anything else is imported, so that it cannot outlive its parent.
_START = (
    "import sys; from kineverse.live.children import follow_parent; follow_parent(int(sys.argv.pop(1))); "
    "from kineverse.cli.command_line import main; sys.exit(main())"
)


class GivenUpError(KineverseError):
    """A process ends again and again."""


def follow_parent(parent: int) -> None:
    """Have the system kill this process, however it is, when its parent of that number has ended."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None, use_errno=True).prctl(_DEATH_SIGNAL, signal.SIGKILL)
    else:
        threading.Thread(target=_watch_parent, args=(parent,), daemon=True).start()
    if os.getppid() != parent:
        os._exit(1)


def _watch_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_WATCHING)
    os._exit(1)


class Child:
    """Command of Kineverse in a process of its own.

    It is started by the thread of a supervisor that lives as long as that: on Linux a child dies with the
    thread that has started it. What it prints goes to a file of the folder. With ``may_end`` it may come to
    an end by itself, with exit status 0 or 1; any other end is unwanted.
    """

    def __init__(
        self, name: str, words: Sequence[str], folder: str | os.PathLike[str], *, may_end: bool = False
    ) -> None:
        self.name, self.words = name, list(words)  # in tables; after ``kineverse``, at the next start
        self.log = Path(folder) / f"{name}.log"
        self.status: int | None = None  # exit status of the last end
        self.ends, self.is_done = 0, False  # number of unwanted ends; whether it has ended by itself
        self._may_end, self._failures = may_end, 0
        self._process: subprocess.Popen[bytes] | None = None
        self._due = 0.0  # when it is started again
        self.started = -math.inf
        self.prepare: Callable[[], object] = lambda: None  # is called before it is started again
        self._cpu = _Usage(0)

    @property
    def pid(self) -> int:
        """Number of the process; 0 while there is none."""
        return 0 if self._process is None else self._process.pid

    @property
    def is_frozen(self) -> bool:
        """True if the system says that it is stopped."""
        return self._cpu.state in ("T", "t")

    def start(self) -> None:
        """Start it."""
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _START, str(os.getpid()), *self.words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,  # Ctrl-C is for the supervisor
            )
        self.started, self._cpu = time.monotonic(), _Usage(self._process.pid)

    def watch(self) -> bool:
        """Notice an end, and start it again after a pause; return True if it was started.

        One that has ended too often is a GivenUpError, with the last line that it printed.
        """
        now = time.monotonic()
        if self._process is not None:
            status = self._process.poll()
            if status is None:
                return False
            self._process, self.status = None, status
            if self._may_end and status in (0, 1):
                self.is_done = True
                return False
            self.ends += 1
            # Of those only that have hardly lived, however long a start takes on a machine that is busy.
            self._failures = self._failures + 1 if now - self.started < _SHORT else 1
            if self._failures >= _MOST_ENDS:
                raise GivenUpError(
                    f"'{self.name}' has ended {self._failures} times within {_SHORT:g} s of its start: "
                    f"{self.describe_end()}."
                )
            self._due = now + min(_PAUSE * 2.0 ** (self._failures - 1), _MOST_PAUSE)
        if self.is_done or now < self._due:
            return False
        self.prepare()
        self.start()
        return True

    def describe_end(self) -> str:
        """Return how it has ended the last time, without a final dot; empty if it has not."""
        if self.status is None:
            return ""
        if self.status < 0:
            return f"killed by {signal.Signals(-self.status).name}"
        said = self.read_last_line().removeprefix("kineverse: ").removesuffix(".")
        return said or f"exit status {self.status}"

    def read_last_line(self) -> str:
        """Return the last line that it printed; empty without any."""
        try:
            data = self.log.read_bytes()[-_LAST:]
        except OSError:
            return ""
        lines = [line.strip() for line in data.decode(errors="replace").splitlines() if line.strip()]
        return lines[-1] if lines else ""

    def measure_cpu(self) -> float:
        """Return the share of a core since the last call; NaN where the system does not tell."""
        return self._cpu.measure()

    def kill(self) -> None:
        """Kill it as the system does; it is started again."""
        if self._process is not None and self._process.poll() is None:
            self._process.kill()

    def end(self) -> None:
        """Tell it to end, also one that is frozen, and do not wait."""
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGCONT)

    def wait(self, until: float) -> None:
        """Wait for its end until a time of the clock that only counts [s], and kill it then."""
        if self._process is None:
            return
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(max(0.0, until - time.monotonic()))
        self.kill()
        self.status = self._process.wait()
        self._process = None


def stop_all(children: Sequence[Child]) -> None:
    """End some processes, the last one first, and kill those that do not end."""
    for child in reversed(children):
        child.end()
    until = time.monotonic() + _STOPPING
    for child in children:
        child.wait(until)


class _Usage:
    """CPU time and state of a process, as Linux tells them."""

    def __init__(self, pid: int) -> None:
        self._path = Path(f"/proc/{pid}/stat")
        self.state = ""
        self._seconds, self._time = math.nan, time.monotonic()
        self.measure()

    def measure(self) -> float:
        """Read both, and return the share of a core since the last time."""
        try:
            words = self._path.read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
            seconds = (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
        except (OSError, ValueError, IndexError, AttributeError):
            self.state = ""
            return math.nan
        now, self.state = time.monotonic(), words[0]
        share = (seconds - self._seconds) / max(now - self._time, 1e-3)
        self._seconds, self._time = seconds, now
        return share
