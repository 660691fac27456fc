"""Benchmarks in fresh processes: ``load``, ``import`` and ``memory``."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from kineverse.errors import KineverseError
from kineverse.lie import Array

from .harness import Benchmark, BenchmarkResult, BenchmarkSettings, Contender, run_program
from .workloads import BenchmarkRobot, find_benchmark_robot

COLD, CACHED = "kineverse, empty cache folder", "kineverse, cached"
AGAIN = "kineverse, again in the same process"
CORE, MOST_PACKAGES = "kineverse-articulation", 14
LOADED, EVALUATED = "kineverse, loaded", "kineverse, pose and Jacobian compiled"


def measure_load(settings: BenchmarkSettings) -> BenchmarkResult:
    robot, one = find_benchmark_robot(settings), Benchmark("load", settings)
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        peers = [_load_with_peer(robot, *peer) for peer in _peer_files(one, robot, Path(folder))]
        one.time([*_load(robot, Path(folder)), *peers], settings.processes)
    one.bound(0.020, COLD)
    one.bound(0.005, CACHED, AGAIN)
    one.speed((COLD, CACHED), "pinocchio", "mujoco")
    return one.result(f"{robot} to pose and Jacobian of {robot.frame}, in a fresh process, after the import")


def _peer_files(one: Benchmark, robot: BenchmarkRobot, folder: Path) -> Iterator[tuple[str, str]]:
    if one.has("pinocchio"):
        yield "pinocchio", str(robot.file)
    if one.has("mujoco"):
        from .peers.mujoco import make_robot_mjcf

        file = folder / "for_mujoco.urdf"
        file.write_text(make_robot_mjcf(robot), encoding="utf-8")
        yield "mujoco", str(file)


def _load(robot: BenchmarkRobot, folder: Path) -> Iterator[Contender]:
    full = folder / "full"
    full.mkdir(mode=0o700)

    def load(cache: Path | str, *options: str) -> dict[str, Any]:
        return run_program("load_with_kineverse", str(robot.file), robot.frame, *options, cache=str(cache))

    def cold() -> dict[str, Any]:
        with tempfile.TemporaryDirectory(dir=folder) as empty:
            return load(empty)

    yield Contender(COLD, lambda: float(cold()["first"]), _results(robot, cold))
    yield Contender(CACHED, lambda: float(load(full)["first"]), _results(robot, lambda: load(full, "wait")))
    yield Contender(AGAIN, lambda: float(load(full)["again"]))


def _load_with_peer(robot: BenchmarkRobot, name: str, file: str) -> Contender:
    def load() -> dict[str, Any]:
        return run_program(f"load_with_{name}", file, robot.frame)

    return Contender(name, lambda: float(load()["first"]), _results(robot, load))


def _results(robot: BenchmarkRobot, load: Callable[[], dict[str, Any]]) -> Callable[[], Sequence[Array]]:
    """Return a function that gives pose and Jacobian, with columns in the order of the chain."""

    def results() -> list[Array]:
        output = load()
        columns = [output["columns"][symbol.path] for symbol in robot.chain]
        return [np.array(output["pose"]), np.array(columns).T]

    return results


def measure_import(settings: BenchmarkSettings) -> BenchmarkResult:
    one = Benchmark("import", settings)
    peers = ("casadi", "pinocchio", "mujoco")
    one.time(map(_import, ["kineverse", *filter(one.has, peers)]), settings.processes)
    one.bound(0.5, "import kineverse")
    one.speed("import kineverse", *(f"import {peer}" for peer in peers))
    if one.has("packaging"):
        for name in (CORE, "pin", "mujoco"):
            with suppress(metadata.PackageNotFoundError):
                one.note(f"packages for {name}", "packages", len(find_requirements(name)))
        one.bound(MOST_PACKAGES, f"packages for {CORE}")
    return one.result(
        "the import, in a fresh process; and the packages that pip installs for it, itself included"
    )


def _import(module: str) -> Contender:
    return Contender(f"import {module}", lambda: float(run_program("import_time", module)["seconds"]))


def find_requirements(distribution: str) -> set[str]:
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


def measure_memory(settings: BenchmarkSettings) -> BenchmarkResult:
    if not os.path.exists("/proc/self/statm"):
        raise KineverseError("Benchmark 'memory' needs Linux, which reports the memory of a process.")
    robot, one = find_benchmark_robot(settings), Benchmark("memory", settings)

    def contender(name: str, library: str, file: str, key: str = "loaded") -> Contender:
        def sample() -> float:
            return float(run_program("memory_of_robot", library, file, robot.frame)[key])

        return Contender(name, sample, unit="MB")

    file = str(robot.file)
    ours = contender(LOADED, "kineverse", file), contender(EVALUATED, "kineverse", file, "evaluated")
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        files = _peer_files(one, robot, Path(folder))
        one.time(
            [*ours, *(contender(f"{peer}, loaded", peer, own) for peer, own in files)], settings.processes
        )
    one.bound(60.0, LOADED, EVALUATED)
    return one.result(f"{robot}, in a fresh process, over what the imports take")
