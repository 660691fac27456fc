"""Programs and functions that end in time, whatever they do."""

from __future__ import annotations

import multiprocessing
import os
import re
import resource
import signal
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
TOO_LONG = 124
CACHE = "KINEVERSE_CACHE_DIR"
"""Variable with the folder of compiled functions."""
_MODEL_VARIABLES = ("KINEVERSE_MODEL_PATH", "KINEVERSE_PACKAGE_PATH", "KINEVERSE_ROOT", "ROS_PACKAGE_PATH")


def import_path() -> list[str]:
    """Return the folders from which this checkout is imported, whatever is installed."""
    return [str(ROOT / name) for name in ("src", "studies") if (ROOT / name).is_dir()]


def environment(changes: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return an environment in which this checkout is imported, and only models that ship are found."""
    kept = {name: value for name, value in os.environ.items() if name not in _MODEL_VARIABLES}
    path = os.pathsep.join(import_path())
    quiet = {"OPENBLAS_NUM_THREADS": "1", "COLUMNS": "100", "NO_COLOR": "1", "PYTHONHASHSEED": "0"}
    return {**kept, **quiet, "PYTHONPATH": path, **(changes or {})}


@dataclass(frozen=True)
class Ended:
    """Status of a program, what it printed, and how long a core was busy with it [s]."""

    status: int
    out: str
    err: str
    seconds: float


def run(words: Sequence[str], seconds: int, cwd: Path, changes: Mapping[str, str] | None = None) -> Ended:
    """Run a program for some seconds of a core, or six times as many on the clock."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with subprocess.Popen(
        list(words),
        cwd=cwd,
        env=environment(changes),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="replace",
        start_new_session=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds)),
    ) as process:
        try:
            out, err = process.communicate(timeout=6 * seconds)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # with its children
            process.communicate()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    worked = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if process.returncode < 0:
        return Ended(TOO_LONG, "", f"ended after {seconds} s or by a signal", worked)
    return Ended(process.returncode, out, err, round(worked, 1))


def neutral(text: str, *folders: Path) -> str:
    """Return a text without the places of this checkout, of Python, and of some folders."""
    places = {str(folder): "TMP" for folder in folders}
    places |= {sysconfig.get_path("purelib"): "SITE", str(Path(sys.executable).parent): "BIN"}
    places |= {str(ROOT): "ROOT"}
    for place, name in places.items():
        text = text.replace(place, name)
    return re.sub(r" at 0x[0-9a-f]+", "", text)


def each(function: Callable[[Any], Any], items: Iterable[Any], seconds: float) -> Iterator[Any]:
    """Yield the results for some items, in another process; the text ``too long`` where one takes too long.

    What raises becomes the text of the exception.
    """
    context = multiprocessing.get_context("spawn")
    worker: Any = None
    for item in items:
        if worker is None:
            here, there = context.Pipe()
            worker = context.Process(target=_serve, args=(there, function), daemon=True)
            worker.start()
            there.close()
            here.recv()  # it has imported what it needs
        here.send(item)
        try:
            yield here.recv() if here.poll(seconds) else _end(worker, "too long")
        except EOFError:
            yield _end(worker, "the process ended")
        worker = worker if worker.is_alive() else None
    if worker is not None:
        here.close()
        worker.join(5)
        worker.kill()


def _end(worker: Any, reason: str) -> str:
    worker.kill()
    worker.join()
    return reason


def _serve(pipe: Connection, function: Callable[[Any], Any]) -> None:
    for name in _MODEL_VARIABLES:
        os.environ.pop(name, None)
    pipe.send("ready")
    while True:
        try:
            item = pipe.recv()
        except EOFError:
            return
        try:
            result = function(item)
        except Exception as error:  # a verdict as well
            result = f"{type(error).__name__}: {error}"
        pipe.send(result)
