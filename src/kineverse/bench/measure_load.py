"""``load``: a robot's file to its first pose and Jacobian, in a fresh process, after the import."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .agreement import Array
from .peers import Field
from .processes import run_program
from .result import Result, at_most, faster
from .robot import Robot, find_robot
from .settings import Settings
from .timing import Contender, race

COLD, CACHED = "kineverse, empty cache folder", "kineverse, cached"
AGAIN = "kineverse, again in the same process"
PINOCCHIO, MUJOCO = "pinocchio", "mujoco"


def measure(settings: Settings) -> Result:
    """Measure loading, every time in a new process."""
    robot = find_robot(settings)
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        field = Field(list(_ours(robot, Path(folder))))
        field.admit("pinocchio", lambda: [_peer(robot, PINOCCHIO, str(robot.file))])
        field.admit("mujoco", lambda: [_peer(robot, MUJOCO, _for_mujoco(robot, Path(folder)))])
        measured = race("load", field.contenders, settings.processes, settings.progress)
    return Result(
        name="load",
        work=f"{robot} to pose and Jacobian of {robot.frame}, in a fresh process, after the import",
        measurements=tuple(measured.values()),
        comparisons=(
            at_most(measured[COLD], 0.020),
            at_most(measured[CACHED], 0.005),
            at_most(measured[AGAIN], 0.005),
            *(faster(measured, ours, peer) for ours in (COLD, CACHED) for peer in (PINOCCHIO, MUJOCO)),
        ),
        missing=tuple(field.missing),
    )


def _ours(robot: Robot, folder: Path) -> Iterator[Contender]:
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


def _peer(robot: Robot, name: str, file: str) -> Contender:
    def load() -> dict[str, Any]:
        return run_program(f"load_with_{name}", file, robot.frame)

    return Contender(name, lambda: float(load()["first"]), _results(robot, load))


def _for_mujoco(robot: Robot, folder: Path) -> str:
    from .mujoco_robot import mujoco_text

    file = folder / "for_mujoco.urdf"
    file.write_text(mujoco_text(robot), encoding="utf-8")
    return str(file)


def _results(robot: Robot, load: Callable[[], dict[str, Any]]) -> Callable[[], Sequence[Array]]:
    """Return what gives pose and Jacobian, with columns in the order of the chain."""

    def results() -> list[Array]:
        said = load()
        columns = [said["columns"][symbol.path] for symbol in robot.chain]
        return [np.array(said["pose"]), np.array(columns).T]

    return results
