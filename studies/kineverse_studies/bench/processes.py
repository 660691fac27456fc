"""Benchmarks in fresh processes: ``load``, ``import`` and ``memory``."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from kineverse.errors import KineverseError
from kineverse.lie import Array

from .harness import (
    Bar,
    BenchmarkResult,
    BenchmarkSettings,
    Comparison,
    Contender,
    Contenders,
    Measurement,
    bound_median,
    compare_speed,
    has_peer,
    install_advice,
    run_program,
    time_contenders,
)
from .workloads import BenchmarkRobot, find_benchmark_robot

COLD, CACHED = "kineverse, empty cache folder", "kineverse, cached"
AGAIN = "kineverse, again in the same process"
PINOCCHIO, MUJOCO = "pinocchio", "mujoco"


def measure_load(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure loading, each time in a fresh process."""
    robot = find_benchmark_robot(settings)
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        participants = Contenders(list(_load_with_kineverse(robot, Path(folder))))
        participants.add_peer("pinocchio", lambda: [_load_with_peer(robot, PINOCCHIO, str(robot.file))])
        participants.add_peer(
            "mujoco", lambda: [_load_with_peer(robot, MUJOCO, write_mujoco_file(robot, Path(folder)))]
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


def _load_with_kineverse(robot: BenchmarkRobot, folder: Path) -> Iterator[Contender]:
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


def _load_with_peer(robot: BenchmarkRobot, name: str, file: str) -> Contender:
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


KINEVERSE = "import kineverse"
PEERS = ("casadi", "pinocchio", "mujoco")
CORE, MOST_PACKAGES = "kineverse-articulation", 14


def measure_import(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure imports, and count packages."""
    participants = Contenders([_import("kineverse")])
    for peer in PEERS:
        participants.add_peer(peer, lambda peer=peer: [_import(peer)])  # type: ignore[misc]
    measured = time_contenders("import", participants.contenders, settings.processes, settings.progress)
    comparisons = [bound_median(measured[KINEVERSE], 0.5)]
    comparisons += [compare_speed(measured, KINEVERSE, f"import {peer}") for peer in PEERS]
    packages = []
    if has_peer("packaging"):
        packages = list(_packages())
        bar = Bar(MOST_PACKAGES, at_least=False)
        comparisons.append(Comparison(packages[0].name, packages[0].median, "packages", bar))
    else:
        participants.missing.append(install_advice("packaging"))
    return BenchmarkResult(
        name="import",
        work="the import, in a fresh process; and the packages that pip installs for it, itself included",
        measurements=(*measured.values(), *packages),
        comparisons=tuple(comparisons),
        missing=tuple(participants.missing),
    )


def _import(module: str) -> Contender:
    return Contender(f"import {module}", lambda: float(run_program("import_time", module)["seconds"]))


def _packages() -> Iterator[Measurement]:
    for distribution in (CORE, "pin", "mujoco"):
        try:
            count = len(find_requirements(distribution))
        except metadata.PackageNotFoundError:
            continue
        yield Measurement(f"packages for {distribution}", "packages", (float(count),))


def find_requirements(distribution: str) -> set[str]:
    """Return a distribution and all that it requires here, without extras."""
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    names: set[str] = set()
    pending = [Requirement(distribution)]
    while pending:
        required = pending.pop()
        name = canonicalize_name(required.name)
        if name in names:
            continue
        names.add(name)
        extras = required.extras or {""}
        for text in metadata.requires(name) or ():
            requirement = Requirement(text)
            marker = requirement.marker
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in extras):
                pending.append(requirement)
    return names


LOADED, EVALUATED = "kineverse, loaded", "kineverse, pose and Jacobian compiled"


def measure_memory(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure memory, each time in a fresh process."""
    if not os.path.exists("/proc/self/statm"):
        raise KineverseError("Benchmark 'memory' needs Linux, which reports the memory of a process.")
    robot = find_benchmark_robot(settings)
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        participants = Contenders(list(_memory_with_kineverse(robot)))
        participants.add_peer("pinocchio", lambda: [_memory_with_peer("pinocchio", str(robot.file), robot)])
        participants.add_peer(
            "mujoco", lambda: [_memory_with_peer("mujoco", write_mujoco_file(robot, Path(folder)), robot)]
        )
        measured = time_contenders("memory", participants.contenders, settings.processes, settings.progress)
    return BenchmarkResult(
        name="memory",
        work=f"{robot}, in a fresh process, over what the imports take",
        measurements=tuple(measured.values()),
        comparisons=(bound_median(measured[LOADED], 60.0), bound_median(measured[EVALUATED], 60.0)),
        missing=tuple(participants.missing),
    )


def _memory_with_kineverse(robot: BenchmarkRobot) -> Iterator[Contender]:
    for name, key in ((LOADED, "loaded"), (EVALUATED, "evaluated")):

        def sample(key: str = key) -> float:
            return float(run_program("memory_of_robot", "kineverse", str(robot.file), robot.frame)[key])

        yield Contender(name, sample, unit="MB")


def _memory_with_peer(library: str, file: str, robot: BenchmarkRobot) -> Contender:
    def sample() -> float:
        return float(run_program("memory_of_robot", library, file, robot.frame)["loaded"])

    return Contender(f"{library}, loaded", sample, unit="MB")
