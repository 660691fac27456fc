"""Compilation of the hand-written C into the cache of the tests, on two cores.

Otherwise every worker compiles all of it, and meanwhile computes the same in numpy, which takes five times as long.
"""

from __future__ import annotations

import subprocess
import sys

# They take about the same time.
PROGRAMS = (
    "from kineverse.control.contact_constraints import row_library\n"
    "from kineverse.geometry.bindings import collision_library\n"
    "from kineverse.planning.bindings import planning_functions\n"
    "row_library.prepare(wait=True)\n"
    "collision_library.prepare(wait=True)\n"
    "planning_functions()\n",
    "import numpy as np, kineverse as kv\n"
    "from kineverse.estimation.identification.native import library\n"
    "from kineverse.estimation.tracking.native import native_library\n"
    "library.prepare(wait=True)\n"
    "native_library.prepare(wait=True)\n"
    "kv.compile(np.sin(kv.position('a')) ** 2, wait=True)\n",
)


def compile_native_libraries() -> None:
    """Compile all libraries; where that fails, the tests find it out."""
    commands = [[sys.executable, "-c", program] for program in PROGRAMS]
    running = [subprocess.Popen(command, stderr=subprocess.DEVNULL) for command in commands]
    for process in running:
        process.wait()
