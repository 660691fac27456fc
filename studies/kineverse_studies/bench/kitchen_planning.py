"""Planners in kitchens: random queries between handles, and three problems at an open fridge beside OMPL."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from kineverse.geometry import Scene
from kineverse.planning import Planner

from .configuration_check import ConfigurationCheck
from .harness import Contender, Progress, has_peer, time_contenders
from .kitchen_queries import ARMS, KITCHENS, KitchenArm, PlanningQuery, find_missing, make_kitchen_arm
from .planning_attempts import Attempt, AttemptSummary, attempt_first_path, attempt_with_kineverse
from .result import Bar, Comparison, Measurement, bound_median, compare_speed

OURS, OMPL = "kineverse", "ompl with a scene"

SECONDS = 10.0
"""Largest time of a search for one query [s]."""

SAMPLED = 50
"""One of so many queries is also attempted by OMPL if ours is solved."""

FRIDGE = ("fetch (shipped)", "kitchen (shipped)")
"""Robot and kitchen of the problems at the fridge."""

PROBLEMS = {"easy": 15, "middle": 12, "hard": 18}
"""Numbers of the queries at the open fridge by the time that OMPL takes for them."""

LEAST_SOLVED, MEDIAN, P99, FASTER = 98.0, 2e-3, 0.2, 100.0
"""Targets: share of solvable queries that are solved [%], times [s], and how many times as fast as OMPL."""


@dataclass
class KitchenResults:
    """Attempts at queries in kitchens."""

    ours: dict[str, list[Attempt]] = field(default_factory=dict)  # our attempts by robot and kitchen
    solvable: int = 0  # number of queries that we or OMPL solve
    sampled: list[tuple[Attempt, Attempt]] = field(default_factory=list)
    unsolved: int = 0  # number of queries that neither solves; None without OMPL
    checked: int = 0  # number of our paths that the scene checked, and of those with a contact
    contacts: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)  # A line for each robot, kitchen or peer that is missing

    @property
    def summary(self) -> AttemptSummary:
        """All of our attempts."""
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
        """Yield the figures with targets."""
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
            planner.plan(query.start, query.goal, seconds=SECONDS, seed=1)  # not counted
        ours = attempt_with_kineverse(planner, query.start, query.goal, SECONDS, seed=number)
        attempts.append(ours)
        solved = ours.found
        if (not ours.found or number % SAMPLED == 0) and has_peer("ompl"):
            theirs = _make_ompl(arm, check).plan(query.start, query.goal, SECONDS, number)
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
    module = importlib.import_module(f"{__package__}.peers.ompl_rrt_connect")
    return module.OmplRrtConnect(check, *arm.limits)


def fridge_queries() -> tuple[KitchenArm, dict[str, PlanningQuery]]:
    """Return the arm at the open fridge, and the problems there by name."""
    arm = make_kitchen_arm(*FRIDGE)
    queries = [*arm.fridge_queries(1 + max(PROBLEMS.values()))]
    return arm, {name: queries[number] for name, number in PROBLEMS.items()}


def time_fridge_problems(rounds: int, progress: Progress) -> tuple[list[Measurement], list[Comparison]]:
    """Return the times of the problems at the open fridge, in turns with OMPL where it is installed.

    Each round has another seed. A search that fails counts with the largest time that it may take. The target
    is about the first path. For the whole plan there is none, as OMPL neither shortens nor judges.
    """
    arm, queries = fridge_queries()
    planner, scene = Planner(arm.model, move=arm.symbols), Scene(arm.model)
    contenders: list[Contender] = []
    attempts: dict[str, list[Attempt]] = {}
    for name, query in queries.items():
        searches = {
            f"{OURS}, {name}": partial(_search_at_fridge, planner, query),
            f"{OURS}, {name}, whole plan": partial(_plan_at_fridge, planner, query),
        }
        if has_peer("ompl"):
            peer = _make_ompl(arm, ConfigurationCheck(scene, arm.symbols, query.state))
            searches[f"{OMPL}, {name}"] = partial(peer.plan, query.start, query.goal, SECONDS)
        for contender, plan in searches.items():
            contenders.append(Contender(contender, _with_seeds(plan, attempts.setdefault(contender, []))))
    measured = time_contenders("planning, fridge", contenders, rounds, progress)
    compared = []
    for name in queries:
        ours, theirs, whole = f"{OURS}, {name}", f"{OMPL}, {name}", f"{OURS}, {name}, whole plan"
        samples = tuple(a.judged if a.found else SECONDS for a in attempts[whole][-rounds:])
        measured[whole] = Measurement(whole, "s", samples)
        compared.append(compare_speed(measured, ours, theirs, at_least=FASTER))
        compared.append(compare_speed(measured, whole, theirs))
    return [*measured.values()], compared


def _search_at_fridge(planner: Planner, query: PlanningQuery, seed: int) -> Attempt:
    planner.place(query.state)
    return attempt_first_path(planner, query.start, query.goal, SECONDS, seed)


def _plan_at_fridge(planner: Planner, query: PlanningQuery, seed: int) -> Attempt:
    planner.place(query.state)
    return attempt_with_kineverse(planner, query.start, query.goal, SECONDS, seed)


def _with_seeds(plan: Callable[[int], Attempt], attempts: list[Attempt]) -> Callable[[], float]:
    """Return a sample of the time of a search, with the next seed at each call; attempts are collected."""

    def sample() -> float:
        attempts.append(plan(len(attempts)))
        return attempts[-1].seconds if attempts[-1].found else SECONDS

    return sample
