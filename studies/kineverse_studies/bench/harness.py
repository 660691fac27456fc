"""Benchmark harness: settings, equality check, interleaved timing, installed peers, fresh processes.

Times drift by a factor of two on shared machines. Contenders are therefore compared within each round.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import platform
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from time import perf_counter
from typing import Any, Literal, TypeAlias

import numpy as np

from kineverse import position, rotation_z
from kineverse._extras import STUDIES, install_distribution
from kineverse._runtime import no_collection
from kineverse._version import __version__
from kineverse.compilation import CompilerInformation, compile, compiler_information
from kineverse.compilation.call_extension import call_extension
from kineverse.compilation.toolchain import toolchain
from kineverse.errors import CompileError, KineverseError, MissingDependencyError, UnknownNameError, suggest
from kineverse.lie import Array

Progress: TypeAlias = Callable[[Iterable[Any], str, str], Iterable[Any]]


def _no_progress(items: Iterable[Any], what: str, unit: str) -> Iterable[Any]:
    return items


@dataclass(frozen=True, slots=True)
class BenchmarkSettings:
    """Settings of benchmarks: robot, number of rounds, size of workloads."""

    robot: str | None = None  # name or file of the robot; an available PR2 if None
    frame: str | None = None  # frame of the pose and Jacobian; a gripper if None
    rounds: int = 25  # number of samples of each contender
    processes: int = 9  # number of samples if each is taken in a fresh process
    configurations: int = 1000  # number of configurations of single calls in one sample
    steps: int = 200  # largest number of states in distance queries
    rows: int = 100_000  # number of configurations of a batch
    operations: int = 10_000  # number of operations and constraints of large models
    boxes: int = 3000  # largest number of boxes around the arm
    robots: Sequence[str] = ("pr2", "fetch", "hsr")  # robots that open a fridge
    problems: int | None = None  # largest number of problems of each published set; None for all
    queries: int = 1000  # number of planning queries in kitchens
    examples: Sequence[str] = ()  # examples of other libraries; all if empty
    folder: Path | None = None  # folder of our examples; None for that of the checkout
    progress: Progress = _no_progress  # such as kineverse.cli.output.show_progress


QUICK = BenchmarkSettings(rounds=5, processes=3, steps=20, operations=1_000, problems=4, queries=60)
EQUALITY_TOLERANCE = 1e-9  # tolerance of poses and Jacobians [m], [rad]


class DisagreementError(KineverseError, ArithmeticError):
    """Disagreement of the results of contenders, whose times are then not comparable."""


def check_equal(
    what: str, results: Sequence[tuple[str, Sequence[Array]]], tolerance: float = EQUALITY_TOLERANCE
) -> None:
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


class Benchmark:
    """Measurements and comparisons of a benchmark, as they are made, and lines on what is missing."""

    def __init__(self, name: str, settings: BenchmarkSettings) -> None:
        self.name, self.settings = name, settings
        self.measured: dict[str, Measurement] = {}
        self.comparisons: list[Comparison] = []
        self.missing: list[str] = []

    def peers(self, function: str, modules: Iterable[str], *arguments: object) -> Iterator[Contender]:
        """Yield what a function of modules in :mod:`.peers` makes; note modules that are not installed."""
        for module in modules:
            if self.has(module):
                make = getattr(importlib.import_module(f"{__package__}.peers.{module}"), function)
                yield from make(*arguments)

    def has(self, module: str) -> bool:
        """Return whether a peer is installed, and note it otherwise."""
        found = has_peer(module)
        self.missing += [] if found else [install_advice(module)]
        return found

    def time(self, contenders: Iterable[Contender], rounds: int | None = None, what: str = "") -> None:
        """Measure contenders, interleaved, for the rounds of the settings if no number is given."""
        rounds = self.settings.rounds if rounds is None else rounds
        self.measured |= time_contenders(what or self.name, [*contenders], rounds, self.settings.progress)

    def add(self, *measurements: Measurement) -> None:
        self.measured |= {one.name: one for one in measurements}

    def note(self, name: str, unit: str, *samples: float) -> Measurement:
        self.measured[name] = Measurement(name, unit, tuple(map(float, samples)))
        return self.measured[name]

    def speed(
        self,
        ours: str | Iterable[str],
        *theirs: str,
        at_least: float | None = None,
        at_most: float | None = None,
    ) -> None:
        """Compare contenders with peers, see :func:`compare_speed`."""
        for one in (ours,) if isinstance(ours, str) else ours:
            self.comparisons += [
                compare_speed(self.measured, one, peer, at_least, at_most) for peer in theirs
            ]

    def bound(self, limit: float, *names: str) -> None:
        self.comparisons += [bound_median(self.measured[name], limit) for name in names]

    def compare(
        self, name: str, value: float | None, unit: str, limit: float, at_least: bool = False
    ) -> None:
        self.comparisons.append(Comparison(name, value, unit, Bar(limit, at_least)))

    def result(self, work: str) -> BenchmarkResult:
        measurements, missing = tuple(self.measured.values()), tuple(dict.fromkeys(self.missing))
        return BenchmarkResult(self.name, work, measurements, tuple(self.comparisons), missing)


DISTRIBUTIONS: Mapping[str, str] = {
    "pinocchio": "pin",
    "pink": "pin-pink",
    "ripl_articulation": "ripl-articulation",
    "vamp": "vamp-planner",
}
"""Distributions of modules with another name."""
PEERS_EXTRA = ("pinocchio", "mujoco", "pybullet", "pink", "mink", "ompl", "jaxadi")
"""Modules that the extra ``peers`` installs."""


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
    distribution = DISTRIBUTIONS.get(module, module)
    if module in PEERS_EXTRA:
        called = "" if distribution == module else f" (the package {distribution!r})"
        return f"{module} is not installed: {install_distribution(STUDIES, 'peers')} brings it{called}"
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


Status: TypeAlias = Literal["met", "missed", "missing", "no bar"]


@dataclass(frozen=True, slots=True)
class Measurement:
    name: str  # contender
    unit: str  # ``s`` for times, else the unit of the count
    samples: tuple[float, ...]  # a number for each round; a single one if it does not vary

    @property
    def median(self) -> float:
        return statistics.median(self.samples)

    @property
    def best(self) -> float:
        return min(self.samples)


@dataclass(frozen=True, slots=True)
class Bar:
    """Target of a figure: at least, or at most, the limit."""

    limit: float
    at_least: bool

    def met_by(self, value: float) -> bool:
        return value >= self.limit if self.at_least else value <= self.limit

    def __str__(self) -> str:
        return f"{'>=' if self.at_least else '<='} {self.limit:g}"


@dataclass(frozen=True, slots=True)
class Comparison:
    name: str
    value: float | None  # None if a peer is missing
    unit: str  # ``x`` for ratios, else as in measurements
    bar: Bar | None = None  # target in the same unit; None if there is none
    ours: str = ""  # contenders of a ratio of speeds; empty for other figures
    theirs: str = ""

    @property
    def status(self) -> Status:
        """Status of the figure: target met or missed, peer missing, or no target."""
        if self.value is None:
            return "missing"
        if self.bar is None:
            return "no bar"
        return "met" if self.bar.met_by(self.value) else "missed"


@dataclass(frozen=True, slots=True)
class BenchmarkResult:
    name: str
    work: str
    measurements: tuple[Measurement, ...]  # of all contenders
    comparisons: tuple[Comparison, ...]  # figures computed from them
    missing: tuple[str, ...] = ()  # a line for each missing peer, with advice


def compare_speed(
    measured: Mapping[str, Measurement],
    ours: str,
    theirs: str,
    at_least: float | None = None,
    at_most: float | None = None,
) -> Comparison:
    """Return the median over the rounds of the ratio of speeds: slowdowns of the machine affect both."""
    bar = None if at_least is None else Bar(at_least, at_least=True)
    bar = bar if at_most is None else Bar(at_most, at_least=False)
    name = f"{ours}, beside {theirs}"
    if theirs not in measured:
        return Comparison(name, None, "x", bar, ours, theirs)
    pairs = zip(measured[theirs].samples, measured[ours].samples, strict=True)
    ratio = statistics.median(their / our for their, our in pairs)
    return Comparison(name, ratio, "x", bar, ours, theirs)


def bound_median(measurement: Measurement, limit: float) -> Comparison:
    return Comparison(measurement.name, measurement.median, measurement.unit, Bar(limit, at_least=False))


BENCHMARKS: Mapping[str, str] = {
    "load": "a robot's file to its first pose and Jacobian, in a fresh process",
    "call": "pose and Jacobian of one frame at one configuration",
    "frames": "the poses of all frames at one configuration",
    "batch": "pose and Jacobian at 100 000 configurations",
    "learning": "pose and Jacobian at 4096 configurations in JAX and PyTorch, beside jaxadi",
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
    "exchange": "a model shared by processes: edits, state, joining, restoring, faults",
}
"""Benchmarks in the order of running; each is a function ``measure_NAME`` of a module of this package."""
_MODULES = {
    "kinematics": ("call", "frames", "batch", "loop"),
    "processes": ("load", "import", "memory"),
    "models": ("motion", "document", "edit"),
    "estimation": ("tracking", "identification"),
}


def select_benchmarks(names: Sequence[str]) -> list[str]:
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
        place = next((module for module, own in _MODULES.items() if name in own), name)
        measure = getattr(importlib.import_module(f"{__package__}.{place}"), f"measure_{name}")
        try:
            result: BenchmarkResult = measure(settings or BenchmarkSettings())
        except (MissingDependencyError, CompileError) as error:
            if isinstance(error, CompileError) and toolchain() is not None:
                raise
            result = BenchmarkResult(name, BENCHMARKS[name], (), (), (f"{name} is left out: {error}",))
        yield result


VERSIONS = "casadi numpy pin mujoco coal pybullet daqp pin-pink mink qpsolvers ompl jax jaxadi torch".split()  # noqa: SIM905


@dataclass(frozen=True, slots=True)
class Machine:
    tier: str
    compiler: CompilerInformation  # C compiler, with the vector unit and the number of cores
    processor: str  # names of processor, operating system and Python implementation, with versions
    system: str
    python: str
    versions: dict[str, str | None]


def describe_machine() -> Machine:
    return Machine(
        tier=_evaluation_tier(),
        compiler=compiler_information(),
        processor=_processor(),
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
        python=f"{platform.python_implementation()} {platform.python_version()}",
        versions={"kineverse": __version__, **{name: _version(name) for name in VERSIONS}},
    )


def _evaluation_tier() -> str:
    function = compile(rotation_z(position("angle")), wait=True)
    return "c extension" if function.tier == "c" and call_extension.module is not None else function.tier


def _processor() -> str:
    if sys.platform == "linux":
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [line.partition(":")[2].strip() for line in file if line.startswith("model name")]
        if names:
            return names[0]
    return platform.processor() or platform.machine()


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None
