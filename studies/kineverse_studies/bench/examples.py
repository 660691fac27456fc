"""Benchmark ``examples``: published examples of pink and mink, and ours in ``examples/``."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

import kineverse
from kineverse.errors import MissingDependencyError, UnknownNameError, suggest

from .control import ControllerLoop, TimedLoop
from .control_workloads import WORKLOADS, reachable_targets
from .harness import (
    BenchmarkResult,
    BenchmarkSettings,
    Comparison,
    Measurement,
    compare_speed,
    has_peer,
    install_advice,
    time_contenders,
)


@dataclass(frozen=True)
class Example:
    """Example of another library."""

    library: str
    lines: int  # number of lines of the original, without imports, viewer, comments and empty lines
    task: str | None = None  # name of our task whose error counts; by default the first


EXAMPLES: Mapping[str, Example] = MappingProxyType(
    {
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
)
"""Examples by name, which is that of the workload and of the file."""

_STEPS = 10  # steps of a motion for each of the settings
FOLDER = Path(kineverse.__file__).parents[2] / "examples"  # folder of the examples; only a checkout has it


def measure_examples(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure the steps of each example and of its original."""
    for name in settings.examples:
        if name not in EXAMPLES:
            raise UnknownNameError(f"There is no example {name!r}. {suggest(name, EXAMPLES, 'example')}")
    if not FOLDER.is_dir():
        raise MissingDependencyError(f"the examples are in the repository, not in the package ({FOLDER}).")
    measurements: list[Measurement] = []
    comparisons: list[Comparison] = []
    missing: list[str] = []
    for name in settings.examples or EXAMPLES:
        library = EXAMPLES[name].library
        steps = min(_STEPS * settings.steps, WORKLOADS[name].steps)
        loops = [_timed(f"{name}: kineverse", make_example_loop(name), name, steps)]
        if has_peer(library):
            loops.append(_timed(f"{name}: {library}", _peer_loop(name), name, steps))
        else:
            missing.append(install_advice(library))
        errors = [loop.mean_error(WORKLOADS[name].steps) for loop in loops]
        measured = time_contenders(
            name, [loop.contender for loop in loops], settings.rounds, settings.progress
        )
        measurements += measured.values()
        measurements += [*loops[0].solver_alone(), *(loop.p99() for loop in loops), *errors]
        comparisons.append(compare_speed(measured, loops[0].name, f"{name}: {library}", 1.0))
    return BenchmarkResult(
        name="examples",
        work=(
            "published examples of pink and mink on the same robots and trajectories: CPU time from the "
            "state to the command; for a target in inverse_kinematics_ur10"
        ),
        measurements=tuple(measurements),
        comparisons=tuple(comparisons),
        missing=tuple(dict.fromkeys(missing)),
    )


def _timed(label: str, loop: Any, name: str, steps: int) -> TimedLoop:
    return TimedLoop(label, loop, WORKLOADS[name].period, steps)


def load_example(name: str) -> ModuleType:
    """Return the example of this library, as a module that has not run."""
    file = FOLDER / f"from_{EXAMPLES[name].library}" / f"{name}.py"
    specification = importlib.util.spec_from_file_location(f"example_{name}", file)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def make_example_loop(name: str) -> Any:
    """Return the control loop of the example of this library, compiled."""
    module = load_example(name)
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


def _peer_loop(name: str) -> Any:
    if EXAMPLES[name].library == "pink":
        from .peers.pink import make_pink_loop

        return make_pink_loop(name)
    from .peers.mink import make_mink_loop

    return make_mink_loop(name)
