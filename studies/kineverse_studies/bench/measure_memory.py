"""``memory``: memory of a loaded robot in a fresh process, beyond that of the imports."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from kineverse.errors import KineverseError

from .harness import BenchmarkSettings, Contender, Contenders, run_program, time_contenders
from .measure_load import write_mujoco_file
from .result import BenchmarkResult, bound_median
from .workloads import BenchmarkRobot, find_benchmark_robot

LOADED, EVALUATED = "kineverse, loaded", "kineverse, pose and Jacobian compiled"


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure memory, each time in a fresh process."""
    if not os.path.exists("/proc/self/statm"):
        raise KineverseError("Benchmark 'memory' needs Linux, which reports the memory of a process.")
    robot = find_benchmark_robot(settings)
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        participants = Contenders(list(_ours(robot)))
        participants.add_peer("pinocchio", lambda: [_peer("pinocchio", str(robot.file), robot)])
        participants.add_peer(
            "mujoco", lambda: [_peer("mujoco", write_mujoco_file(robot, Path(folder)), robot)]
        )
        measured = time_contenders("memory", participants.contenders, settings.processes, settings.progress)
    return BenchmarkResult(
        name="memory",
        work=f"{robot}, in a fresh process, over what the imports take",
        measurements=tuple(measured.values()),
        comparisons=(bound_median(measured[LOADED], 60.0), bound_median(measured[EVALUATED], 60.0)),
        missing=tuple(participants.missing),
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
