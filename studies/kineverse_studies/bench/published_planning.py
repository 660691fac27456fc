"""Planners on published problems: times and success beside VAMP, measured here or published."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from kineverse.planning import Planner

from .harness import Progress, has_peer
from .planning_attempts import Attempt, AttemptSummary, attempt_first_path, attempt_with_kineverse
from .planning_problems import ProblemSet, PublishedProblem, load_problem_sets
from .result import Bar, Comparison

OURS, SEARCH, VAMP = "kineverse", "kineverse, first path", "vamp"
"""Contenders: our planner, which shortens, certifies and judges; its search alone, as VAMP's clock; VAMP."""

SECONDS = 1.0
"""Largest time of our search for one problem [s]."""

SLOWER, FEWER = 2.0, -3.0
"""Targets: largest ratio of times, and least difference of the shares solved [%]."""


@dataclass(frozen=True)
class PublishedFigures:
    """Figures of VAMP 0.6.4 for these problems, measured on another machine (AVX2, one core, gcc 12)."""

    median: float  # times of what was solved, five trials each; of two runs the faster [s]
    mean: float
    solved: float  # share of attempts that found a path [%]


FIGURES: Mapping[str, PublishedFigures] = MappingProxyType(
    {
        "panda": PublishedFigures(56e-6, 146e-6, 100.0),
        # 5 of the 280 problems are invalid, and 41 of the other 1375 attempts failed.
        "fetch": PublishedFigures(683e-6, 4.009e-3, 100.0 * 1334 / 1400),
    }
)
"""Figures of VAMP by robot."""


def run_published_problems(
    robot: str, most: int | None, seeds: int, progress: Progress
) -> dict[str, AttemptSummary]:
    """Return the attempts of each planner at the problems of a robot.

    All planners attempt a problem before the next one, because times drift.
    """
    attempts: dict[str, list[Attempt]] = {}
    for problems in progress([*load_problem_sets(robot, most)], f"planning, {robot}", "set"):
        planners = dict(_planners(problems))
        for name, (place, plan) in planners.items():
            place(problems.problems[0])
            plan(problems.problems[0], seeds)  # not counted
            attempts.setdefault(name, [])
        for problem in problems.problems:
            for place, _ in planners.values():
                place(problem)
            for seed in range(seeds):
                for name, (_, plan) in planners.items():
                    attempts[name].append(plan(problem, seed))
    return {name: AttemptSummary(f"{name}, {robot}", found) for name, found in attempts.items()}


Place = Callable[[PublishedProblem], object]
Plan = Callable[[PublishedProblem, int], Attempt]


def _planners(problems: ProblemSet) -> Iterator[tuple[str, tuple[Place, Plan]]]:
    planner = Planner(problems.model, move=problems.symbols)

    def plan(problem: PublishedProblem, seed: int) -> Attempt:
        return attempt_with_kineverse(planner, problem.start, problem.goal, SECONDS, seed)

    def search(problem: PublishedProblem, seed: int) -> Attempt:
        return attempt_first_path(planner, problem.start, problem.goal, SECONDS, seed)

    yield OURS, (lambda problem: planner.place(problem.state), plan)
    yield SEARCH, (lambda problem: None, search)
    if has_peer(VAMP):
        module: Any = importlib.import_module(f"{__package__}.peers.vamp_rrt_connect")
        peer = module.VampRrtConnect(problems.robot)
        yield VAMP, (peer.place, peer.plan)


def compare_with_vamp(robot: str, summaries: Mapping[str, AttemptSummary]) -> Iterator[Comparison]:
    """Yield how our times and success compare with VAMP's: measured here, else the published figures.

    Times with a target are those to the first path, as VAMP's are; the share is of paths that were judged.
    """
    ours, whole = summaries[SEARCH], summaries[OURS]
    theirs: AttemptSummary | PublishedFigures = summaries.get(VAMP, FIGURES[robot])
    source = "vamp" if VAMP in summaries else "vamp (published, another machine)"
    bar = Bar(SLOWER, at_least=False)
    yield Comparison(f"{ours.name}: median, of {source}", ours.median / theirs.median, "x", bar)
    yield Comparison(f"{ours.name}: mean, of {source}", ours.mean / theirs.mean, "x", bar)
    yield Comparison(f"{whole.name}: median, of {source}", whole.median / theirs.median, "x")
    more = whole.solved - theirs.solved
    yield Comparison(f"{whole.name}: solved more than {source}", more, "%", Bar(FEWER, at_least=True))
