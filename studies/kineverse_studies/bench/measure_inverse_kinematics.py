"""``inverse_kinematics``: poses that five arms can reach, with restarts, beside pink, mink and pinocchio."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from time import thread_time_ns

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.control import Goal, InverseKinematics, Target, same_pose
from kineverse.errors import MissingDependencyError, UnknownNameError
from kineverse.lie import Array

from .harness import BenchmarkSettings, has_peer, install_advice
from .reaching import (
    ANGLE_TOLERANCE,
    ARMS,
    BUDGET,
    POSITION_TOLERANCE,
    STARTS,
    ReachingProblem,
    Search,
    make_reaching_problem,
    searches,
)
from .result import Bar, BenchmarkResult, Comparison, Measurement, compare_speed

OURS, SAME_STARTS = "kineverse", "kineverse, starts of the peers"
PEERS = {
    "pink": ("pink", "pink_reaching", "PinkReaching"),
    "mink": ("mink", "mink_reaching", "MinkReaching"),
    "pinocchio's example": ("pink", "pink_reaching", "PinocchioReaching"),
}
"""Peers by name: package, module and class; the example's loop is in the module of pink."""

LEAST_SOLVED = 99.0
"""Target share of solved poses [%]."""

_MORE = 10
"""Number of our targets per configuration, and of configurations per target of a peer."""


@dataclass(frozen=True)
class ArmSearches:
    """Searches of one contender for the targets of one arm."""

    arm: str
    contender: str
    searches: tuple[Search, ...]

    @property
    def name(self) -> str:
        """Name of the measurement of times."""
        return f"{self.contender}, {self.arm}"

    @property
    def solved(self) -> float:
        """Share of the targets that are solved within the budget [%]."""
        return 100.0 * float(np.mean([s.solved for s in self.searches]))

    def times(self, rounds: int) -> Measurement:
        """Return the mean CPU time of a target in each of some groups of targets."""
        groups = np.array_split([s.seconds for s in self.searches], rounds)
        return Measurement(self.name, "s", tuple(float(group.mean()) for group in groups))


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure CPU times from pose to joint positions, without building; and the share of solved poses."""
    missing = [install_advice(package) for package in ("pink", "mink") if not has_peer(package)]
    results: dict[tuple[str, str], ArmSearches] = {}
    count = max(_MORE * settings.configurations, settings.rounds)
    few = max(settings.configurations // _MORE, settings.rounds)
    for arm in settings.progress(tuple(ARMS), "inverse_kinematics", "arm"):
        try:
            problem = make_reaching_problem(arm, count, starts=1)
            peer_problem = make_reaching_problem(arm, few)
        except UnknownNameError:
            missing.append(f"the arm {arm} is not among the models")
            continue
        results[arm, OURS] = ArmSearches(arm, OURS, tuple(search_with_kineverse(problem)))
        runs = {SAME_STARTS: search_from_same_starts(peer_problem)}
        runs |= {peer: run(peer_problem) for peer, run in _peers()}
        # All search for one target before the next one, because times drift.
        interleaved = zip(*zip(*runs.values(), strict=True), strict=True)
        for contender, found in zip(runs, interleaved, strict=True):
            results[arm, contender] = ArmSearches(arm, contender, found)
    if not results:
        raise MissingDependencyError(f"no arm is among the models. {install_advice('pinocchio')}")
    times = {r.name: r.times(settings.rounds) for r in results.values()}
    shares = [Measurement(f"{r.name}, solved", "%", (r.solved,)) for r in results.values()]
    return BenchmarkResult(
        name="inverse_kinematics",
        work=(
            f"{count} poses of uniform states, solved to {1e3 * POSITION_TOLERANCE:g} mm and "
            f"{1e3 * ANGLE_TOLERANCE:g} mrad within limits, with at most {STARTS} starts and "
            f"{1e3 * BUDGET:g} ms of CPU time; {few} of them in turns with the peers, from the same "
            "starts; mean time of a pose"
        ),
        measurements=(*times.values(), *shares),
        comparisons=tuple(_compare(results, times)),
        missing=tuple(missing),
    )


class _Reaching:
    """Our solver for a problem; what counts as solved is checked by forward kinematics."""

    def __init__(self, problem: ReachingProblem) -> None:
        pose = problem.model.fk(problem.frame)
        self._problem, self._target = problem, Target("target", problem.targets[0])
        self._solver = InverseKinematics(problem.model, [Goal(same_pose(self._target.expression, pose))])
        self._solver.wait()
        self._forward = compile(pose, problem.joints)

    def search(self, index: int, start: Array, starts: int) -> Search:
        """Solve one target from a start, and from random ones."""
        problem, wanted = self._problem, self._problem.targets[index]
        values = dict(zip(problem.joints, start.tolist(), strict=True)) | self._target.values(wanted)
        begin = thread_time_ns()
        result = self._solver.solve(values, starts=starts)
        seconds = (thread_time_ns() - begin) * 1e-9
        q = result.best.vector(problem.joints)
        solved = seconds <= BUDGET and problem.within_limits(q)
        solved = solved and _agree(np.asarray(self._forward(q)), wanted)
        return Search(solved, result.starts, result.iterations, seconds)


def search_with_kineverse(problem: ReachingProblem) -> Iterator[Search]:
    """Yield our search for each target, from the first start and random ones of our own."""
    solver = _Reaching(problem)
    for index, starts in enumerate(problem.starts):
        yield solver.search(index, starts[0], STARTS)


def search_from_same_starts(problem: ReachingProblem) -> Iterator[Search]:
    """Yield our search for each target, from the starts of the problem, one after the other."""
    solver = _Reaching(problem)
    for index, starts in enumerate(problem.starts):
        used, iterations, seconds, solved = 0, 0, 0.0, False
        for start in starts:
            found = solver.search(index, start, 1)
            used, iterations, seconds = used + 1, iterations + found.iterations, seconds + found.seconds
            solved = found.solved and seconds <= BUDGET
            if solved or seconds > BUDGET:
                break
        yield Search(solved, used, iterations, seconds)


def _agree(found: Array, wanted: Array) -> bool:
    cosine = 0.5 * (np.trace(found[:3, :3].T @ wanted[:3, :3]) - 1.0)
    sine = 0.5 * np.linalg.norm(found[:3, :3] @ wanted[:3, :3].T - wanted[:3, :3] @ found[:3, :3].T) / 2**0.5
    near = np.linalg.norm(found[:3, 3] - wanted[:3, 3]) <= POSITION_TOLERANCE
    return bool(near and np.arctan2(sine, cosine) <= ANGLE_TOLERANCE)


def _peers() -> Iterator[tuple[str, Callable[[ReachingProblem], Iterator[Search]]]]:
    for name, (package, module, kind) in PEERS.items():
        if has_peer(package):
            make = getattr(importlib.import_module(f"{__package__}.peers.{module}"), kind)
            yield name, partial(_search_with, make)


def _search_with(make: Callable[[ReachingProblem], object], problem: ReachingProblem) -> Iterator[Search]:
    return searches(make(problem), problem)  # type: ignore[arg-type]


def _compare(
    results: dict[tuple[str, str], ArmSearches], times: dict[str, Measurement]
) -> Iterator[Comparison]:
    for (arm, contender), result in results.items():
        if contender == OURS:
            yield Comparison(f"{result.name}, solved", result.solved, "%", Bar(LEAST_SOLVED, at_least=True))
        if contender != SAME_STARTS:
            continue
        for peer in PEERS:
            name = f"{peer}, {arm}"
            yield compare_speed(times, result.name, name, at_least=1.0)
            other = results.get((arm, peer))
            more = None if other is None else result.solved - other.solved
            yield Comparison(f"{result.name}, solved more than {name}", more, "%", Bar(0.0, at_least=True))
