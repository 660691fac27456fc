"""Benchmarks by name."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType

from kineverse.compile.toolchain import toolchain
from kineverse.errors import CompileError, MissingDependencyError, UnknownNameError, suggest

from .harness import BenchmarkSettings
from .result import BenchmarkResult

BENCHMARKS: Mapping[str, str] = MappingProxyType(
    {
        "load": "a robot's file to its first pose and Jacobian, in a fresh process",
        "call": "pose and Jacobian of one frame at one configuration",
        "frames": "the poses of all frames at one configuration",
        "batch": "pose and Jacobian at 100 000 configurations",
        "loop": "a closed loop and its derivative at one configuration",
        "motion": "coordinates after a step, and constraints: a robot in a kitchen, as a control loop asks",
        "geometry": "what is near, and how near: an arm among boxes, a robot in a kitchen",
        "inverse_kinematics": "joint positions for poses of five arms, with restarts",
        "tracking": "a kitchen's coordinates from noisy poses of its doors and drawers",
        "identification": "the joint between two parts, from twenty poses of both and from one more",
        "control": "a controller's step, a robot that opens a fridge; beside pink and mink",
        "planning": "paths without collisions: published problems, robots in kitchens, held doors",
        "examples": "published examples of pink and mink, beside the same ones of this library",
        "import": "importing the library, and how many packages that takes",
        "memory": "the memory of a loaded robot",
        "document": "a robot in a kitchen, written down and read again; models of up to a million nodes",
        "edit": "models of 10 000 operations, and a robot with one joint replaced",
    }
)
"""Benchmarks in the order of running; each name belongs to the module ``measure_NAME``."""


def select_benchmarks(names: Sequence[str]) -> list[str]:
    """Return the names of the benchmarks to run, each once and in their order; all if none is named."""
    for name in names:
        if name not in BENCHMARKS:
            raise UnknownNameError(
                f"There is no benchmark {name!r}. {suggest(name, BENCHMARKS, 'benchmark')} "
                "'kineverse bench --list' says what each measures."
            )
    return [name for name in BENCHMARKS if name in names or not names]


def run_benchmarks(
    names: Sequence[str] = (), settings: BenchmarkSettings | None = None
) -> Iterator[BenchmarkResult]:
    """Run benchmarks, and yield each result.

    The result of a benchmark whose extra is not installed, or for which there is no C compiler, has only a
    line that names it.

    Parameters
    ----------
    names
        Names of benchmarks; all if empty.
    settings
        Settings; the defaults if None.

    Raises
    ------
    UnknownNameError
        If there is no such benchmark, before any is run.
    DisagreementError
        If the results of contenders differ.
    """
    for name in select_benchmarks(names):
        # Imported here, because a benchmark imports its peers.
        module = importlib.import_module(f"{__package__}.measure_{name}")
        try:
            result: BenchmarkResult = module.measure(settings or BenchmarkSettings())
        except (MissingDependencyError, CompileError) as error:
            if isinstance(error, CompileError) and toolchain() is not None:
                raise
            result = BenchmarkResult(name, BENCHMARKS[name], (), (), (f"{name} is left out: {error}",))
        yield result
