"""Benchmark ``examples``: published examples of pink and mink, and ours in ``examples/``."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import kineverse
from kineverse._extras import checkout
from kineverse.errors import MissingDependencyError, UnknownNameError, suggest

from .control import ControllerLoop, TimedLoop, make_peer_loop
from .control_workloads import WORKLOADS, ControlLoop, reachable_targets
from .harness import Benchmark, BenchmarkResult, BenchmarkSettings


@dataclass(frozen=True)
class Example:
    library: str
    lines: int  # number of lines of the original, without imports, viewer, comments and empty lines
    task: str | None = None  # name of our task whose error counts; by default the first


EXAMPLES: Mapping[str, Example] = {
    "arm_ur5": Example("pink", 29),
    "arm_ur3_velocity_smoothing": Example("pink", 38),
    "flying_dual_arm_ur3": Example("pink", 96),
    "humanoid_g1_com": Example("pink", 57),
    "go2_squat": Example("pink", 73, "foot FL"),
    "inverse_kinematics_ur10": Example("pink", 50),
    "arm_panda_dof_freezing": Example("mink", 57),
    "humanoid_g1_teleop": Example("mink", 85, "left hand"),
    "biped_cassie": Example("mink", 50),
    "arm_hand_xarm": Example("mink", 98),
    "arm_ur5_wrist_cam_lookat": Example("mink", 58),
    "mobile_tiago": Example("mink", 80),
}
"""Examples by name, which is that of the workload and of the file."""
_STEPS = 10  # steps of a motion for each of the settings


def measure_examples(settings: BenchmarkSettings) -> BenchmarkResult:
    for name in settings.examples:
        if name not in EXAMPLES:
            raise UnknownNameError(f"There is no example {name!r}. {suggest(name, EXAMPLES, 'example')}")
    folder = find_examples(settings.folder)
    one = Benchmark("examples", settings)
    for name in settings.examples or EXAMPLES:
        library, workload = EXAMPLES[name].library, WORKLOADS[name]
        loops: dict[str, ControlLoop] = {f"{name}: kineverse": make_example_loop(name, folder)}
        if one.has(library):
            loops[f"{name}: {library}"] = make_peer_loop(library, name)
        steps = min(_STEPS * settings.steps, workload.steps)
        timed = [TimedLoop(label, loop, workload.period, steps) for label, loop in loops.items()]
        errors = [loop.mean_error(workload.steps) for loop in timed]
        one.time((loop.contender for loop in timed), what=name)
        one.add(*timed[0].solver_alone(), *(loop.p99() for loop in timed), *errors)
        one.speed(timed[0].name, f"{name}: {library}", at_least=1.0)
    return one.result(
        "published examples of pink and mink on the same robots and trajectories: CPU time from the "
        "state to the command; for a target in inverse_kinematics_ur10"
    )


def find_examples(folder: Path | None = None) -> Path:
    here = checkout(Path(kineverse.__file__))
    found = folder or (here and here / "examples")
    if found is None or not (found / "from_pink").is_dir():
        where = "they are in the repository of kineverse, and not installed" if found is None else found
        raise MissingDependencyError(
            f"There are no examples: {where}. Say where they are: --examples FOLDER."
        )
    return found


def load_example(name: str, folder: Path) -> ModuleType:
    file = folder / f"from_{EXAMPLES[name].library}" / f"{name}.py"
    specification = importlib.util.spec_from_file_location(f"example_{name}", file)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def make_example_loop(name: str, folder: Path | None = None) -> ControlLoop:
    module = load_example(name, find_examples(folder))
    if name == "inverse_kinematics_ur10":
        return TargetLoop(module, WORKLOADS[name].period)
    module.controller.wait()
    return ControllerLoop(module.controller, module.start, module.time, EXAMPLES[name].task)


class TargetLoop:
    """Inverse kinematics: a step is one target."""

    def __init__(self, module: ModuleType, period: float) -> None:
        self._solver, self._target, self._period = module.solver, module.target, period
        self._solver.wait()
        name = "inverse_kinematics_ur10"
        self._poses = reachable_targets(name, "wrist_3_link", WORKLOADS[name].steps)

    def reset(self) -> None:
        """Do nothing: each target starts anew."""

    def aim(self, time: float) -> None:
        self._values = self._target.values(self._poses[round(time / self._period) % len(self._poses)])

    def step(self) -> None:
        self._found = self._solver.solve(self._values)

    def advance(self) -> None:
        """Stay at the solution."""

    def error(self) -> float:
        return float(self._found.residuals["hand"])
