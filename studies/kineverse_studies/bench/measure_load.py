"""``load``: time from a robot file to the first pose and Jacobian, in a fresh process after the import."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kineverse.lie import Array

from .harness import BenchmarkSettings, Contender, Contenders, run_program, time_contenders
from .result import BenchmarkResult, bound_median, compare_speed
from .workloads import BenchmarkRobot, find_benchmark_robot

COLD, CACHED = "kineverse, empty cache folder", "kineverse, cached"
AGAIN = "kineverse, again in the same process"
PINOCCHIO, MUJOCO = "pinocchio", "mujoco"


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure loading, each time in a fresh process."""
    robot = find_benchmark_robot(settings)
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        participants = Contenders(list(_ours(robot, Path(folder))))
        participants.add_peer("pinocchio", lambda: [_peer(robot, PINOCCHIO, str(robot.file))])
        participants.add_peer(
            "mujoco", lambda: [_peer(robot, MUJOCO, write_mujoco_file(robot, Path(folder)))]
        )
        measured = time_contenders("load", participants.contenders, settings.processes, settings.progress)
    return BenchmarkResult(
        name="load",
        work=f"{robot} to pose and Jacobian of {robot.frame}, in a fresh process, after the import",
        measurements=tuple(measured.values()),
        comparisons=(
            bound_median(measured[COLD], 0.020),
            bound_median(measured[CACHED], 0.005),
            bound_median(measured[AGAIN], 0.005),
            *(compare_speed(measured, ours, peer) for ours in (COLD, CACHED) for peer in (PINOCCHIO, MUJOCO)),
        ),
        missing=tuple(participants.missing),
    )


def _ours(robot: BenchmarkRobot, folder: Path) -> Iterator[Contender]:
    program, arguments = "load_with_kineverse", (str(robot.file), robot.frame)
    full = folder / "full"
    full.mkdir(mode=0o700)

    def cold() -> dict[str, Any]:
        with tempfile.TemporaryDirectory(dir=folder) as empty:
            return run_program(program, *arguments, cache=empty)

    def cached() -> dict[str, Any]:
        return run_program(program, *arguments, cache=str(full))

    def filled() -> dict[str, Any]:
        return run_program(program, *arguments, "wait", cache=str(full))

    yield Contender(COLD, lambda: float(cold()["first"]), _results(robot, cold))
    yield Contender(CACHED, lambda: float(cached()["first"]), _results(robot, filled))
    yield Contender(AGAIN, lambda: float(cached()["again"]))


def _peer(robot: BenchmarkRobot, name: str, file: str) -> Contender:
    def load() -> dict[str, Any]:
        return run_program(f"load_with_{name}", file, robot.frame)

    return Contender(name, lambda: float(load()["first"]), _results(robot, load))


def write_mujoco_file(robot: BenchmarkRobot, folder: Path) -> str:
    """Write the robot's file for MuJoCo to a folder, and return its path."""
    from .peers.mujoco_kinematics import make_robot_mjcf

    file = folder / "for_mujoco.urdf"
    file.write_text(make_robot_mjcf(robot), encoding="utf-8")
    return str(file)


def _results(robot: BenchmarkRobot, load: Callable[[], dict[str, Any]]) -> Callable[[], Sequence[Array]]:
    """Return a function that gives pose and Jacobian, with columns in the order of the chain."""

    def results() -> list[Array]:
        output = load()
        columns = [output["columns"][symbol.path] for symbol in robot.chain]
        return [np.array(output["pose"]), np.array(columns).T]

    return results
