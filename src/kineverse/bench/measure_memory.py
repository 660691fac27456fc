"""``memory``: what a loaded robot takes in a fresh process, over what the imports take."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from kineverse.errors import KineverseError

from .measure_load import _for_mujoco
from .peers import Field
from .processes import run_program
from .result import Result, at_most
from .robot import Robot, find_robot
from .settings import Settings
from .timing import Contender, race

LOADED, EVALUATED = "kineverse, loaded", "kineverse, pose and Jacobian compiled"


def measure(settings: Settings) -> Result:
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
        field = Field(list(_ours(robot)))
        field.admit("pinocchio", lambda: [_peer("pinocchio", str(robot.file), robot)])
        field.admit("mujoco", lambda: [_peer("mujoco", _for_mujoco(robot, Path(folder)), robot)])
        measured = race("memory", field.contenders, settings.processes, settings.progress)
    return Result(
        name="memory",
        work=f"{robot}, in a fresh process, over what the imports take",
        measurements=tuple(measured.values()),
        comparisons=(at_most(measured[LOADED], 60.0), at_most(measured[EVALUATED], 60.0)),
        missing=tuple(field.missing),
    )


def _ours(robot: Robot) -> Iterator[Contender]:
    for name, key in ((LOADED, "loaded"), (EVALUATED, "evaluated")):

        def sample(key: str = key) -> float:
            return float(run_program("memory_of_robot", "kineverse", str(robot.file), robot.frame)[key])

        yield Contender(name, sample, unit="MB")


def _peer(library: str, file: str, robot: Robot) -> Contender:
    def sample() -> float:
        return float(run_program("memory_of_robot", library, file, robot.frame)["loaded"])

    return Contender(f"{library}, loaded", sample, unit="MB")
