"""CoACD in a separate process with limits on time and memory."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kineverse._extras import install_command
from kineverse.compilation.cache import UNFINISHED
from kineverse.errors import KineverseError, MissingDependencyError
from kineverse.geometry.mesh_files import Floats

from .mesh_cleanup import CleanMesh
from .result import DECOMPOSITIONS

PROGRAM = Path(__file__).with_name("_coacd_main.py")
_POLL = 0.05
_MAX_MESSAGE = 300
# Messages of Python, C++ and the dynamic loader about a lack of memory.
_MEMORY_ERRORS = (
    b"MemoryError",
    b"bad_alloc",
    b"annot allocate memory",
    b"failed to map segment",
    b"Resource temporarily unavailable",
)


class DecompositionError(KineverseError, RuntimeError):
    """Failed decomposition: CoACD crashed, ran out of time or memory, or returned impossible hulls."""


@dataclass(frozen=True, slots=True)
class ResourceLimits:
    """Limits on the resources for one mesh.

    Attributes
    ----------
    seconds
        Time [s].
    memory
        Address space [bytes]; not bounded on Windows, and not reliably on macOS.
    """

    seconds: float = 600.0
    memory: int = 4 * 2**30


def run_coacd(
    surface: CleanMesh, error: float, limits: ResourceLimits, stop: threading.Event | None = None
) -> list[Floats]:
    """Run CoACD in a separate process, and return the corners of its convex hulls, (n, 3) each [m]."""
    if importlib.util.find_spec("coacd") is None:
        raise MissingDependencyError(f"decomposing meshes needs CoACD: {install_command('decomposition')}")
    # In the cache, which removes what killed processes have left.
    place = DECOMPOSITIONS.folder.path
    with tempfile.TemporaryDirectory(prefix=UNFINISHED, dir=place, ignore_cleanup_errors=True) as folder:
        source, target, said = (Path(folder) / name for name in ("in.npz", "out.npz", "said.txt"))
        np.savez(source, vertices=surface.faces.vertices, faces=surface.faces.faces, parts=surface.parts)
        # -P keeps the program from importing its neighbours by accident.
        command = [sys.executable, "-P", str(PROGRAM), str(source), str(target), repr(error)]
        with said.open("wb") as errors:
            status = _run_process([*command, str(limits.memory)], errors.fileno(), limits, stop)
        if status == 0:
            return _read_hulls(target, surface)
        raise DecompositionError(_explain_failure(status, said.read_bytes()[-20_000:]))


def _run_process(
    command: list[str], errors: int, limits: ResourceLimits, stop: threading.Event | None
) -> int:
    # Threads hardly speed CoACD up, and several meshes are decomposed in parallel.
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    end = time.monotonic() + limits.seconds
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=errors, env=environment
    ) as process:
        try:
            while process.poll() is None:
                if stop is not None and stop.wait(_POLL):
                    raise DecompositionError("It was stopped.")
                if time.monotonic() > end:
                    raise DecompositionError(
                        f"CoACD did not end within {limits.seconds:g} s. Simplify the mesh, allow a larger "
                        "error, or more time."
                    )
                if stop is None:
                    time.sleep(_POLL)
        finally:
            process.kill()
        return process.wait()


def _read_hulls(target: Path, surface: CleanMesh) -> list[Floats]:
    try:
        with np.load(target, allow_pickle=False) as arrays:
            points, sizes = np.asarray(arrays["points"], dtype=float), np.asarray(arrays["sizes"])
        hulls = np.split(points, np.cumsum(sizes)[:-1])
    except Exception as error:
        raise DecompositionError("CoACD's answer cannot be read.") from error
    low, high = surface.faces.vertices.min(axis=0), surface.faces.vertices.max(axis=0)
    room = 0.1 * surface.size
    if not (np.isfinite(points).all() and (points > low - room).all() and (points < high + room).all()):
        raise DecompositionError("The hulls of CoACD are not where the mesh is.")
    return hulls


def _explain_failure(status: int, said: bytes) -> str:
    lines = said.decode(errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")[:_MAX_MESSAGE]
    if status < 0:
        try:
            how = f"was ended by {signal.Signals(-status).name}"
        except ValueError:
            how = f"was ended by signal {-status}"
    else:
        how = f"ended with status {status}"
    if any(sign in said for sign in _MEMORY_ERRORS):
        advice = (
            "It needs more memory than it may have: allow more, simplify the mesh, or allow a larger error."
        )
    elif "SIGKILL" in how:
        advice = "Systems without free memory do that: decompose fewer at a time, or simplify the mesh."
    else:
        advice = "Simplify or repair the mesh, or allow more memory."
    return f"CoACD {how}{': ' if last else ''}{last.rstrip('.')}. {advice}"
