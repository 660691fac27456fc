"""Benchmark ``planning``: arms among boxes, robots in kitchens, held doors; with VAMP and OMPL."""

from __future__ import annotations

import importlib
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from statistics import median
from typing import Any

import numpy as np

from kineverse.errors import UnknownNameError
from kineverse.geometry import Scene
from kineverse.planning import Planner

from .harness import (
    Bar,
    Benchmark,
    BenchmarkResult,
    BenchmarkSettings,
    Comparison,
    Contender,
    Measurement,
    Progress,
    bound_median,
    has_peer,
    install_advice,
    run_program,
)
from .held_planning import MOTIONS, run_held_motion
from .kitchen_queries import ARMS, KITCHENS, KitchenArm, PlanningQuery, find_missing, make_kitchen_arm
from .planning_problems import (
    ROBOTS,
    Attempt,
    AttemptSummary,
    ConfigurationCheck,
    ProblemSet,
    PublishedProblem,
    attempt_first_path,
    attempt_with_kineverse,
    load_problem_sets,
)

OURS, SEARCH, VAMP = "kineverse", "kineverse, first path", "vamp"
"""Contenders: our planner, which shortens, certifies and judges; its search alone, as VAMP's clock; VAMP."""
PUBLISHED_SECONDS = 1.0  # largest time of our search for one problem [s]
SLOWER, FEWER = 2.0, -3.0  # targets: largest ratio of times, and least difference of the shares solved [%]


@dataclass(frozen=True)
class PublishedFigures:
    """Figures of VAMP 0.6.4 for these problems, measured on another machine (AVX2, one core, gcc 12)."""

    median: float  # times of what was solved, five trials each; of two runs the faster [s]
    mean: float
    solved: float  # share of attempts that found a path [%]


FIGURES: Mapping[str, PublishedFigures] = {
    "panda": PublishedFigures(56e-6, 146e-6, 100.0),
    # 5 of the 280 problems are invalid, and 41 of the other 1375 attempts failed.
    "fetch": PublishedFigures(683e-6, 4.009e-3, 100.0 * 1334 / 1400),
}
"""Figures of VAMP by robot."""


def run_published_problems(
    robot: str, most: int | None, seeds: int, progress: Progress
) -> dict[str, AttemptSummary]:
    """Return the attempts of each planner; all attempt a problem in turn, because times drift."""
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
        return attempt_with_kineverse(planner, problem.start, problem.goal, PUBLISHED_SECONDS, seed)

    def search(problem: PublishedProblem, seed: int) -> Attempt:
        return attempt_first_path(planner, problem.start, problem.goal, PUBLISHED_SECONDS, seed)

    yield OURS, (lambda problem: planner.place(problem.state), plan)
    yield SEARCH, (lambda problem: None, search)
    if has_peer(VAMP):
        module: Any = importlib.import_module(f"{__package__}.peers.vamp")
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


OMPL = "ompl with a scene"
KITCHEN_SECONDS = 10.0  # largest time of a search for one query [s]
SAMPLED = 50  # one of so many queries is also attempted by OMPL if ours is solved
FRIDGE = ("fetch (shipped)", "kitchen (shipped)")  # robot and kitchen of the problems at the fridge
PROBLEMS = {"easy": 15, "middle": 12, "hard": 18}
"""Numbers of the queries at the open fridge by the time that OMPL takes for them."""
LEAST_SOLVED, MEDIAN, P99, FASTER = 98.0, 2e-3, 0.2, 100.0
"""Targets: share of solvable queries that are solved [%], times [s], and how many times as fast as OMPL."""


@dataclass
class KitchenResults:
    ours: dict[str, list[Attempt]] = field(default_factory=dict)  # our attempts by robot and kitchen
    solvable: int = 0  # number of queries that we or OMPL solve
    sampled: list[tuple[Attempt, Attempt]] = field(default_factory=list)
    unsolved: int = 0  # number of queries that neither solves; None without OMPL
    checked: int = 0  # number of our paths that the scene checked, and of those with a contact
    contacts: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)  # A line for each robot, kitchen or peer that is missing

    @property
    def summary(self) -> AttemptSummary:
        return AttemptSummary(f"{OURS}, kitchens", [a for found in self.ours.values() for a in found])

    def measurements(self) -> Iterator[Measurement]:
        """Yield the times of all queries and of each robot and kitchen, shares, and checked paths."""
        yield from self.summary.measurements(percentile=99.0)
        for name, attempts in self.ours.items():
            yield from AttemptSummary(f"{OURS}, {name}", attempts).measurements(percentile=99.0)
        if self.sampled:
            ompl = AttemptSummary(f"{OMPL}, kitchens, 1 of {SAMPLED}", [theirs for _, theirs in self.sampled])
            yield from ompl.measurements(percentile=99.0)
        count = len(self.summary.attempts)
        yield Measurement("kitchens: solved by none", "%", (100.0 * self.unsolved / count,))
        yield Measurement("kitchens: paths checked by the scene", "paths", (float(self.checked),))

    def comparisons(self) -> Iterator[Comparison]:
        summary = self.summary
        if self.solvable:
            solved = sum(a.found for a in summary.attempts)
            share = 100.0 * solved / self.solvable
            name = f"{summary.name}: solved of what somebody solves"
            yield Comparison(name, share, "%", Bar(LEAST_SOLVED, at_least=True))
            median = Measurement(f"{summary.name}: median", "s", (summary.median,))
            yield bound_median(median, MEDIAN)
            yield bound_median(Measurement(f"{summary.name}: p99", "s", (summary.percentile(99.0),)), P99)
        contacts = Measurement("kitchens: paths with contacts", "paths", (float(len(self.contacts)),))
        yield bound_median(contacts, 0.0)


def run_kitchen_queries(
    queries: int, progress: Progress, pairs: Sequence[tuple[str, str]] | None = None, seed: int = 0
) -> KitchenResults:
    """Return attempts at queries, shared by robots and kitchens; every path is checked by the scene."""
    results = KitchenResults()
    wanted = [(robot, kitchen) for kitchen in KITCHENS for robot in ARMS] if pairs is None else [*pairs]
    absent = {pair: find_missing(*pair) for pair in wanted}
    results.missing += dict.fromkeys(line for line in absent.values() if line is not None)
    present = [pair for pair in wanted if absent[pair] is None]
    counts = [len(part) for part in np.array_split(np.arange(queries), max(len(present), 1))]
    for (robot, kitchen), count in zip(progress(present, "planning", "kitchen"), counts, strict=False):
        if count:
            _run_pair(make_kitchen_arm(robot, kitchen), count, seed, results)
    return results


def _run_pair(arm: KitchenArm, count: int, seed: int, results: KitchenResults) -> None:
    planner, scene = Planner(arm.model, move=arm.symbols), Scene(arm.model)
    attempts = results.ours.setdefault(arm.name, [])
    for number, query in enumerate(arm.queries(count, seed)):
        check = ConfigurationCheck(scene, arm.symbols, query.state)
        planner.place(query.state)
        if number == 0:
            planner.plan(query.start, query.goal, seconds=KITCHEN_SECONDS, seed=1)  # not counted
        ours = attempt_with_kineverse(planner, query.start, query.goal, KITCHEN_SECONDS, seed=number)
        attempts.append(ours)
        solved = ours.found
        if (not ours.found or number % SAMPLED == 0) and has_peer("ompl"):
            theirs = _make_ompl(arm, check).plan(query.start, query.goal, KITCHEN_SECONDS, number)
            solved |= theirs.found
            if ours.found:
                results.sampled.append((ours, theirs))
        results.solvable += solved
        results.unsolved += not solved
        if ours.found:
            results.checked += 1
            if check.count_contacts(ours.points):
                results.contacts.append(f"{arm.name}, query {number}")


def _make_ompl(arm: KitchenArm, check: ConfigurationCheck) -> Any:
    module = importlib.import_module(f"{__package__}.peers.ompl")
    return module.OmplRrtConnect(check, *arm.limits)


def time_fridge_problems(one: Benchmark, rounds: int) -> None:
    """Measure the problems at the open fridge, in turns with OMPL where it is installed.

    Each round has another seed. A search that fails counts with the largest time that it may take. The target
    is about the first path. For the whole plan there is none, as OMPL neither shortens nor judges.
    """
    arm = make_kitchen_arm(*FRIDGE)
    queries = [*arm.fridge_queries(1 + max(PROBLEMS.values()))]
    planner, scene = Planner(arm.model, move=arm.symbols), Scene(arm.model)

    def search(query: PlanningQuery, attempt: Callable[..., Attempt], seed: int) -> Attempt:
        planner.place(query.state)
        return attempt(planner, query.start, query.goal, KITCHEN_SECONDS, seed)

    contenders: list[Contender] = []
    attempts: dict[str, list[Attempt]] = {}
    for name, number in PROBLEMS.items():
        query = queries[number]
        searches: dict[str, Callable[[int], Attempt]] = {
            f"{OURS}, {name}": partial(search, query, attempt_first_path),
            f"{OURS}, {name}, whole plan": partial(search, query, attempt_with_kineverse),
        }
        if has_peer("ompl"):
            peer = _make_ompl(arm, ConfigurationCheck(scene, arm.symbols, query.state))
            searches[f"{OMPL}, {name}"] = partial(peer.plan, query.start, query.goal, KITCHEN_SECONDS)
        for contender, plan in searches.items():
            contenders.append(Contender(contender, _with_seeds(plan, attempts.setdefault(contender, []))))
    one.time(contenders, rounds, "planning, fridge")
    for name in PROBLEMS:
        ours, theirs, whole = f"{OURS}, {name}", f"{OMPL}, {name}", f"{OURS}, {name}, whole plan"
        one.note(whole, "s", *(a.judged if a.found else KITCHEN_SECONDS for a in attempts[whole][-rounds:]))
        one.speed(ours, theirs, at_least=FASTER)
        one.speed(whole, theirs)


def _with_seeds(plan: Callable[[int], Attempt], attempts: list[Attempt]) -> Callable[[], float]:
    """Return a sample of the time of a search, with the next seed at each call; attempts are collected."""

    def sample() -> float:
        attempts.append(plan(len(attempts)))
        return attempts[-1].seconds if attempts[-1].found else KITCHEN_SECONDS

    return sample


PARTS = ("published", "fridge", "kitchens", "held", "build")  # parts of the benchmark
SEEDS = 5  # number of attempts at each published problem
BUILT = ("pr2", "pr2 (shipped)")
"""Robots whose planner is built in a fresh process, in the shipped kitchen: the first that is there."""
_AGAIN = 5  # number of times that it is built from the cache, of which the median counts
FIRST, AGAIN = "planner from its file, spheres and compiling", "planner from the cache"


def measure_planning(settings: BenchmarkSettings, parts: Sequence[str] = PARTS) -> BenchmarkResult:
    one = Benchmark("planning", settings)
    one.missing += [install_advice(peer) for peer in ("ompl", "vamp") if not has_peer(peer)]
    for robot in ROBOTS if "published" in parts else ():
        try:
            summaries = run_published_problems(robot, settings.problems, SEEDS, settings.progress)
        except UnknownNameError:
            one.missing.append(
                f"the problems of {robot} are not on the model path: planning_problems/{robot}"
            )
            continue
        one.add(*(m for summary in summaries.values() for m in summary.measurements()))
        one.comparisons += compare_with_vamp(robot, summaries)
    if "fridge" in parts:
        time_fridge_problems(one, settings.processes)
    if "kitchens" in parts and settings.queries:
        kitchens = run_kitchen_queries(settings.queries, settings.progress)
        one.add(*kitchens.measurements())
        one.comparisons += kitchens.comparisons()
        one.missing += kitchens.missing
    for name in MOTIONS if "held" in parts else ():
        held = run_held_motion(name, settings.rounds, settings.progress)
        one.add(*held.measurements())
        if not held.attempts:
            one.missing.append(f"{name}: no grasps without collisions at {held.tried} places of the base")
        one.comparisons += held.comparisons()
    if "build" in parts:
        robot = next(robot for robot in BUILT if find_missing(robot, "kitchen (shipped)") is None)
        one.time(_fresh_builds(robot), 1, "planning, build")
        one.bound(30.0, f"{robot}: {FIRST}")
        one.bound(0.3, f"{robot}: {AGAIN}")
    return one.result(
        f"paths without collisions: published problems of Panda and Fetch, {SEEDS} attempts each with at "
        f"most {PUBLISHED_SECONDS:g} s; three problems at an open fridge; {settings.queries} queries between "
        "handles of kitchens, whose paths the scene checks 20 times finer; a fridge and a drawer that "
        "are held; times of the search, with the judgement by the scene where that is said"
    )


def _fresh_builds(robot: str) -> list[Contender]:
    found: dict[str, float] = {}

    def build() -> float:
        with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as empty:
            found["first"] = run_program("build_planner", robot, cache=empty)["seconds"]
            again = [run_program("build_planner", robot, cache=empty)["seconds"] for _ in range(_AGAIN)]
            found["again"] = median(again)
        return found["first"]

    return [Contender(f"{robot}: {FIRST}", build), Contender(f"{robot}: {AGAIN}", lambda: found["again"])]
