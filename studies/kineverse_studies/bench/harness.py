"""Benchmark harness: settings, equality check, interleaved timing, installed peers, fresh processes.

Times drift by a factor of two on shared machines. Contenders are therefore compared within each round.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np

from kineverse._extras import install_studies
from kineverse._gc import no_collection
from kineverse.errors import KineverseError
from kineverse.lie import Array

from .result import Measurement

Progress: TypeAlias = Callable[[Iterable[Any], str, str], Iterable[Any]]


def _no_progress(items: Iterable[Any], what: str, unit: str) -> Iterable[Any]:
    return items


@dataclass(frozen=True, slots=True)
class BenchmarkSettings:
    """Settings of benchmarks: robot, number of rounds, size of workloads.

    Attributes
    ----------
    robot
        Name or file of the robot; an available PR2 if None, see :func:`.workloads.find_benchmark_robot`.
    frame
        Frame of the pose and Jacobian; a gripper if None.
    rounds
        Number of samples of each contender.
    processes
        Number of samples if each is taken in a fresh process.
    configurations
        Number of configurations of single calls in one sample.
    steps
        Largest number of states in distance queries.
    rows
        Number of configurations of a batch.
    operations
        Number of operations and constraints of large models.
    boxes
        Largest number of boxes around the arm.
    robots
        Robots that open a fridge.
    problems
        Largest number of problems of each published set of planning problems; None for all.
    queries
        Number of planning queries in kitchens.
    examples
        Examples of other libraries; all if empty.
    progress
        Progress reporter that wraps an iterable, such as :func:`kineverse.cli.output.show_progress`.
    """

    robot: str | None = None
    frame: str | None = None
    rounds: int = 25
    processes: int = 9
    configurations: int = 1000
    steps: int = 200
    rows: int = 100_000
    operations: int = 10_000
    boxes: int = 3000
    robots: Sequence[str] = ("pr2", "fetch", "hsr")
    problems: int | None = None
    queries: int = 1000
    examples: Sequence[str] = ()
    progress: Progress = _no_progress


QUICK = BenchmarkSettings(rounds=5, processes=3, steps=20, operations=1_000, problems=4, queries=60)
"""Settings for an order of magnitude."""


EQUALITY_TOLERANCE = 1e-9
"""Tolerance of poses and Jacobians [m], [rad]."""


class DisagreementError(KineverseError, ArithmeticError):
    """Disagreement of the results of contenders, whose times are then not comparable."""


def check_equal(
    what: str, results: Sequence[tuple[str, Sequence[Array]]], tolerance: float = EQUALITY_TOLERANCE
) -> None:
    """Compare the results of contenders with those of the first one."""
    (first, expected), *others = results
    if not all(np.isfinite(array).all() for array in expected):
        raise DisagreementError(f"Benchmark {what!r}: {first!r} computed what is not finite.")
    for name, found in others:
        shapes = [np.shape(array) for array in expected], [np.shape(array) for array in found]
        if shapes[0] != shapes[1]:
            raise DisagreementError(
                f"Benchmark {what!r}: {name!r} gave arrays of shapes {shapes[1]}, {first!r} {shapes[0]}."
            )
        for k, (ours, theirs) in enumerate(zip(expected, found, strict=True)):
            error = float(np.max(np.abs(np.asarray(theirs) - ours), initial=0.0))
            # The negation refuses NaN as well.
            if not error <= tolerance:
                raise DisagreementError(
                    f"Benchmark {what!r}: {name!r} and {first!r} differ by {error:.3g} in result {k}, "
                    f"more than {tolerance:g}. Their times cannot be compared."
                )


@dataclass(frozen=True, slots=True)
class Contender:
    """Library or implementation that is measured."""

    name: str  # library and method
    sample: Callable[[], float]  # does the work and returns its cost in ``unit``
    results: Callable[[], Sequence[Array]] | None = None
    unit: str = "s"  # ``s`` for times, else the unit of the count


def time_calls(
    run: Callable[..., object], count: int = 1, prepare: Callable[[], Any] | None = None
) -> Callable[[], float]:
    """Return a function that measures the time of ``run`` divided by ``count`` [s]."""

    def sample() -> float:
        arguments = () if prepare is None else (prepare(),)
        start = perf_counter()
        run(*arguments)
        return (perf_counter() - start) / count

    return sample


def time_contenders(
    what: str, contenders: Sequence[Contender], rounds: int, progress: Progress
) -> dict[str, Measurement]:
    """Check that contenders agree, then measure them interleaved; return measurements by name."""
    results = [(c.name, c.results()) for c in contenders if c.results is not None]
    if results:
        check_equal(what, results)
    samples: dict[str, list[float]] = {c.name: [] for c in contenders}
    for contender in contenders:
        contender.sample()
    for number in progress(range(rounds), what, "round"):
        # The order rotates, because the contender before may leave caches warm or the processor hot.
        first = number % len(contenders)
        for contender in (*contenders[first:], *contenders[:first]):
            # A garbage collection would count for the contender that happens to run.
            with no_collection():
                samples[contender.name].append(contender.sample())
    return {c.name: Measurement(c.name, c.unit, tuple(samples[c.name])) for c in contenders}


DISTRIBUTIONS: Mapping[str, str] = MappingProxyType(
    {"pinocchio": "pin", "pink": "pin-pink", "ripl_articulation": "ripl-articulation", "vamp": "vamp-planner"}
)
"""Distributions of modules with another name."""

BENCH_EXTRA = ("pinocchio", "mujoco", "pybullet", "pink", "mink", "ompl")
"""Modules that the extra ``bench`` installs."""


@dataclass(slots=True)
class Contenders:
    """Contenders of a benchmark, and missing peers."""

    contenders: list[Contender] = field(default_factory=list)  # contenders to measure
    missing: list[str] = field(default_factory=list)  # A line for each missing peer

    def add_peer(self, module: str, contenders: Callable[[], Iterable[Contender]]) -> None:
        """Add the contenders of a peer, or a line on the missing peer."""
        if has_peer(module):
            self.contenders += contenders()
        else:
            self.missing.append(install_advice(module))


def has_peer(module: str) -> bool:
    """Return whether a peer can be imported; silence its output."""
    try:
        with _silence_stderr() if module == "pybullet" else contextlib.nullcontext():
            peer = importlib.import_module(module)
    except ImportError:
        return False
    if module == "mujoco" and peer.get_mju_user_warning() is None:
        peer.set_mju_user_warning(_ignore_warning)
    return True


def _ignore_warning(warning: str) -> None:
    """Ignore a warning of MuJoCo, which by default is written to a file in the current folder."""


def install_advice(module: str) -> str:
    """Return a line on how to install a peer."""
    distribution = DISTRIBUTIONS.get(module, module)
    if module in BENCH_EXTRA:
        called = "" if distribution == module else f" (the package {distribution!r})"
        return f"{module} is not installed: {install_studies('peers')} brings it{called}"
    return f"{module} is not installed: it is the package {distribution!r}"


@contextlib.contextmanager
def _silence_stderr() -> Iterator[None]:
    """Redirect standard error of C code to the null device, because Bullet prints a greeting at import."""
    sys.stderr.flush()
    stderr, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(null)


FRESH_PROCESS = Path(__file__).with_name("fresh_process.py")


class ProgramError(KineverseError, RuntimeError):
    """Failure of a measurement in a fresh process."""


def run_program(name: str, *arguments: str, cache: str | None = None) -> dict[str, Any]:
    """Run a function of :mod:`.fresh_process` in a fresh process, and return its JSON object."""
    environment = dict(os.environ)
    if cache is not None:
        environment["KINEVERSE_CACHE_DIR"] = cache
    # -P keeps the file's folder off the import path.
    command = [sys.executable, "-P", str(FRESH_PROCESS), name, *arguments]
    done = subprocess.run(
        command, env=environment, capture_output=True, encoding="utf-8", errors="replace", check=False
    )
    try:
        output: dict[str, Any] = json.loads(done.stdout)
    except ValueError:
        last = (done.stderr.strip() or "it said nothing").splitlines()[-1]
        raise ProgramError(f"The program {name!r} ended with status {done.returncode}: {last}") from None
    return output
