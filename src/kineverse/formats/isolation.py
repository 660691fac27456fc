"""Calls of a function in a process of its own, which bound its time and memory and survive its crash.

It is for code of others that a file controls: plugins of MuJoCo, and the expressions of xacro.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from tempfile import TemporaryDirectory
from typing import Any

from kineverse._runtime import limit_resources
from kineverse.errors import KineverseError

CPU_SECONDS = 20  # largest CPU time of a call [s]. A large robot takes xacro about 2 s
MEMORY = 4 << 30  # largest address space of a call [bytes]
_WAIT_SECONDS = 15 * CPU_SECONDS  # longest wait for a call, on a machine that is busy otherwise [s]

_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Libraries of linear algebra reserve memory for each thread, which counts as used."""

_CHILD = (
    "import json, sys; job = json.load(sys.stdin.buffer); sys.path[:] = job['path']; "
    "from kineverse.formats.isolation import answer; answer(job)"
)


class IsolatedCallError(KineverseError):
    """Failure of an isolated call: a crash, or more time or memory than it may take."""


def call_isolated(module: str, function: str, *arguments: Any) -> Any:
    """Call a function in a process of its own and return its result."""
    job = {"path": sys.path, "module": module, "function": function, "arguments": arguments}
    with TemporaryDirectory(prefix="kineverse-") as folder:  # MuJoCo writes a log where it runs
        try:
            done = subprocess.run(
                [sys.executable, "-I", "-X", "utf8", "-c", _CHILD],
                input=json.dumps(job).encode(),
                capture_output=True,
                cwd=folder,
                env={**os.environ, **_ONE_THREAD},
                timeout=_WAIT_SECONDS,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise IsolatedCallError(f"it takes more than {_WAIT_SECONDS} s") from None
        except OSError as error:
            raise IsolatedCallError(f"no process can be started for it: {error}") from None
    if done.returncode:
        reason = f"signal {-done.returncode}" if done.returncode < 0 else f"status {done.returncode}"
        raise IsolatedCallError(
            f"its process ended with {reason}; it may take {CPU_SECONDS} s and {MEMORY >> 30} GiB"
        )
    return json.loads(done.stdout)


def answer(job: dict[str, Any]) -> None:
    """Call the function of a job within the limits, and print the result."""
    limit_resources(MEMORY, CPU_SECONDS)
    output, sys.stdout = sys.stdout, sys.stderr  # what the function itself prints is no result
    function = getattr(importlib.import_module(job["module"]), job["function"])
    json.dump(function(*job["arguments"]), output)
    output.flush()
