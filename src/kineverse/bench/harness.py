"""Benchmark harness: settings, equality check, interleaved timing, installed peers, fresh processes.

Times drift by a factor of two on machines that others use as well, so what counts is how contenders do beside
each other, round by round.
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

from kineverse._extras import install_command
from kineverse._gc import no_collection
from kineverse.errors import KineverseError
from kineverse.lie import Array

from .result import Measurement

Progress: TypeAlias = Callable[[Iterable[Any], str, str], Iterable[Any]]


def _no_progress(items: Iterable[Any], what: str, unit: str) -> Iterable[Any]:
    return items


@dataclass(frozen=True, slots=True)
class BenchmarkSettings:
    """Amount of measurement, and the robot.

    Attributes
    ----------
    robot
        The name or file of the robot; a PR2 that is found here if None, see :func:`.workloads.find_robot`.
    frame
        The frame whose pose and Jacobian are computed; a gripper if None.
    rounds
        Number of turns of each contender.
    processes
        The same where every turn is a fresh process.
    configurations
        How many configurations single calls go through in one turn.
    steps
        Through how many states, at most, things move among others.
    rows
        How many configurations a batch has.
    operations
        How many operations and constraints the large models have.
    boxes
        Among how many boxes, at most, an arm is moved.
    progress
        Wraps what is worked on, like :func:`kineverse.cli.output.show_progress`.
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
    progress: Progress = _no_progress


QUICK = BenchmarkSettings(rounds=5, processes=3, steps=20, operations=1_000)
"""Enough to see an order of magnitude."""


EQUALITY_TOLERANCE = 1e-9
"""Tolerance of the comparison of poses and Jacobians [m], [rad]."""


class DisagreementError(KineverseError, ArithmeticError):
    """Disagreement of contenders, which makes their times meaningless."""


def check_equal(
    what: str, results: Sequence[tuple[str, Sequence[Array]]], tolerance: float = EQUALITY_TOLERANCE
) -> None:
    """Compare the arrays that contenders computed with those of the first one.

    Parameters
    ----------
    what
        The benchmark, for the message.
    results
        Names, each with arrays.
    tolerance
        How far their numbers may be apart.

    Raises
    ------
    DisagreementError
        If an array has another shape, or numbers that are further off or not finite.
    """
    (first, wanted), *others = results
    if not all(np.isfinite(array).all() for array in wanted):
        raise DisagreementError(f"Benchmark {what!r}: {first!r} computed what is not finite.")
    for name, found in others:
        shapes = [np.shape(array) for array in wanted], [np.shape(array) for array in found]
        if shapes[0] != shapes[1]:
            raise DisagreementError(
                f"Benchmark {what!r}: {name!r} gave arrays of shapes {shapes[1]}, {first!r} {shapes[0]}."
            )
        for k, (ours, theirs) in enumerate(zip(wanted, found, strict=True)):
            error = float(np.max(np.abs(np.asarray(theirs) - ours), initial=0.0))
            # Written so that NaN is refused as well.
            if not error <= tolerance:
                raise DisagreementError(
                    f"Benchmark {what!r}: {name!r} and {first!r} differ by {error:.3g} in result {k}, "
                    f"more than {tolerance:g}. Their times cannot be compared."
                )


@dataclass(frozen=True, slots=True)
class Contender:
    """Library or implementation that does the work.

    Attributes
    ----------
    name
        Library and method.
    sample
        Does the work and returns its cost, in ``unit``.
    results
        Returns the arrays that the work gives, which must be equal to those of the others; None if there is
        nothing to compare.
    unit
        ``s`` for times, or the unit of the count.
    """

    name: str
    sample: Callable[[], float]
    results: Callable[[], Sequence[Array]] | None = None
    unit: str = "s"


def time_calls(
    run: Callable[..., object], count: int = 1, prepare: Callable[[], Any] | None = None
) -> Callable[[], float]:
    """Return a sample: the time [s] that each of ``count`` pieces of work takes in ``run``.

    Parameters
    ----------
    run
        Does all of them.
    count
        Their number.
    prepare
        Called before, outside of the time; ``run`` is given what it returns.
    """

    def sample() -> float:
        arguments = () if prepare is None else (prepare(),)
        start = perf_counter()
        run(*arguments)
        return (perf_counter() - start) / count

    return sample


def time_contenders(
    what: str, contenders: Sequence[Contender], rounds: int, progress: Progress
) -> dict[str, Measurement]:
    """Check that contenders compute the same, then measure them in turns; return measurements by name.

    Parameters
    ----------
    what
        The benchmark.
    contenders
        The participants.
    rounds
        Number of turns of each contender, after one that is not counted.
    progress
        See :class:`.harness.BenchmarkSettings`.

    Raises
    ------
    DisagreementError
        If they do not compute the same.
    """
    results = [(c.name, c.results()) for c in contenders if c.results is not None]
    if results:
        check_equal(what, results)
    samples: dict[str, list[float]] = {c.name: [] for c in contenders}
    for contender in contenders:
        contender.sample()
    for number in progress(range(rounds), what, "round"):
        # The order changes: a neighbour may leave caches warm or the processor hot.
        first = number % len(contenders)
        for contender in (*contenders[first:], *contenders[:first]):
            # The collector would charge all garbage to the contender that happens to run.
            with no_collection():
                samples[contender.name].append(contender.sample())
    return {c.name: Measurement(c.name, c.unit, tuple(samples[c.name])) for c in contenders}


DISTRIBUTIONS: Mapping[str, str] = MappingProxyType(
    {"pinocchio": "pin", "ripl_articulation": "ripl-articulation"}
)
"""Distribution of a module with another name."""

IN_THE_EXTRA = ("pinocchio", "mujoco", "pybullet")
"""The modules that the extra ``bench`` brings."""


@dataclass(slots=True)
class Contenders:
    """Contenders of a race, and missing peers.

    Attributes
    ----------
    contenders
        The participants.
    missing
        A line for each other one.
    """

    contenders: list[Contender] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def admit(self, module: str, contenders: Callable[[], Iterable[Contender]]) -> None:
        """Add the contenders of a peer, or the line that says that it is missing."""
        if has_peer(module):
            self.contenders += contenders()
        else:
            self.missing.append(install_advice(module))


def has_peer(module: str) -> bool:
    """Return whether a peer can be imported."""
    try:
        with _silence_stderr() if module == "pybullet" else contextlib.nullcontext():
            peer = importlib.import_module(module)
    except ImportError:
        return False
    if module == "mujoco" and peer.get_mju_user_warning() is None:
        peer.set_mju_user_warning(_ignore_warning)
    return True


def _ignore_warning(warning: str) -> None:
    """Take a warning of MuJoCo, which would leave it in a file in the current folder."""


def install_advice(module: str) -> str:
    """Return the advice to install a peer."""
    distribution = DISTRIBUTIONS.get(module, module)
    if module in IN_THE_EXTRA:
        called = "" if distribution == module else f" (the package {distribution!r})"
        return f"{module} is not installed: {install_command('bench')} brings it{called}"
    return f"{module} is not installed: it is the package {distribution!r}"


@contextlib.contextmanager
def _silence_stderr() -> Iterator[None]:
    """Keep what C code prints off standard error: Bullet prints a greeting at import."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


FRESH_PROCESS = Path(__file__).with_name("fresh_process.py")


class ProgramError(KineverseError, RuntimeError):
    """Failure of a measurement in a process of its own."""


def run_program(name: str, *arguments: str, cache: str | None = None) -> dict[str, Any]:
    """Run a function of :mod:`.fresh_process` in a process of its own; return its JSON.

    Parameters
    ----------
    name
        Of the function.
    arguments
        Its arguments.
    cache
        Folder of the cache of compiled code; the usual one if None.

    Raises
    ------
    ProgramError
        If it fails, with its last line.
    """
    environment = dict(os.environ)
    if cache is not None:
        environment["KINEVERSE_CACHE_DIR"] = cache
    # With -P the file's neighbours cannot be imported by accident.
    command = [sys.executable, "-P", str(FRESH_PROCESS), name, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    try:
        said: dict[str, Any] = json.loads(done.stdout)
    except ValueError:
        last = (done.stderr.strip() or "it said nothing").splitlines()[-1]
        raise ProgramError(f"The program {name!r} ended with status {done.returncode}: {last}") from None
    return said
