"""``memory``: memory of a loaded robot in a fresh process, without that of the imports."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from kineverse.errors import KineverseError

from .harness import BenchmarkSettings, Contender, Contenders, run_program, time_contenders
from .measure_load import _for_mujoco
from .result import BenchmarkResult, bound_median
from .workloads import BenchmarkRobot, find_robot

LOADED, EVALUATED = "kineverse, loaded", "kineverse, pose and Jacobian compiled"


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure memory, every time in a new process.

    Raises
    ------
    KineverseError
        Where the system does not say how much memory a process has.
    """
    if not os.path.exists("/proc/self/statm"):
        raise KineverseError("Benchmark 'memory' needs Linux, where processes are told how much they use.")
    robot = find_robot(settings)
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        field = Contenders(list(_ours(robot)))
        field.admit("pinocchio", lambda: [_peer("pinocchio", str(robot.file), robot)])
        field.admit("mujoco", lambda: [_peer("mujoco", _for_mujoco(robot, Path(folder)), robot)])
        measured = time_contenders("memory", field.contenders, settings.processes, settings.progress)
    return BenchmarkResult(
        name="memory",
        work=f"{robot}, in a fresh process, over what the imports take",
        measurements=tuple(measured.values()),
        comparisons=(bound_median(measured[LOADED], 60.0), bound_median(measured[EVALUATED], 60.0)),
        missing=tuple(field.missing),
    )


def _ours(robot: BenchmarkRobot) -> Iterator[Contender]:
    for name, key in ((LOADED, "loaded"), (EVALUATED, "evaluated")):

        def sample(key: str = key) -> float:
            return float(run_program("memory_of_robot", "kineverse", str(robot.file), robot.frame)[key])

        yield Contender(name, sample, unit="MB")


def _peer(library: str, file: str, robot: BenchmarkRobot) -> Contender:
    def sample() -> float:
        return float(run_program("memory_of_robot", library, file, robot.frame)["loaded"])

    return Contender(f"{library}, loaded", sample, unit="MB")
