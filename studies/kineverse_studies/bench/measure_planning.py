"""``planning``: arms among boxes, robots in kitchens, held doors; beside VAMP and OMPL."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from statistics import median

from kineverse.errors import UnknownNameError

from .harness import (
    BenchmarkSettings,
    Contender,
    has_peer,
    install_advice,
    run_program,
    time_contenders,
)
from .held_planning import MOTIONS, run_held_motion
from .kitchen_planning import run_kitchen_queries, time_fridge_problems
from .kitchen_queries import find_missing
from .planning_problems import ROBOTS
from .published_planning import SECONDS, compare_with_vamp, run_published_problems
from .result import BenchmarkResult, Comparison, Measurement, bound_median

PEERS = ("ompl", "vamp")

PARTS = ("published", "fridge", "kitchens", "held", "build")
"""Parts of the benchmark."""

SEEDS = 5
"""Number of attempts at each published problem."""

BUILT = ("pr2", "pr2 (shipped)")
"""Robots whose planner is built in a fresh process, in the shipped kitchen: the first that is there."""

_AGAIN = 5
"""Number of times that it is built from the cache, of which the median counts."""

FIRST, AGAIN = "planner from its file, spheres and compiling", "planner from the cache"


def measure(settings: BenchmarkSettings, parts: Sequence[str] = PARTS) -> BenchmarkResult:
    """Measure times of searches, and the shares of problems that are solved."""
    measured: list[Measurement] = []
    compared: list[Comparison] = []
    missing = [install_advice(peer) for peer in PEERS if not has_peer(peer)]
    if "published" in parts:
        for robot in ROBOTS:
            try:
                summaries = run_published_problems(robot, settings.problems, SEEDS, settings.progress)
            except UnknownNameError:
                missing.append(
                    f"the problems of {robot} are not on the model path: planning_problems/{robot}"
                )
                continue
            for summary in summaries.values():
                measured += summary.measurements()
            compared += compare_with_vamp(robot, summaries)
    if "fridge" in parts:
        times, ratios = time_fridge_problems(settings.processes, settings.progress)
        measured += times
        compared += ratios
    if "kitchens" in parts and settings.queries:
        kitchens = run_kitchen_queries(settings.queries, settings.progress)
        measured += kitchens.measurements()
        compared += kitchens.comparisons()
        missing += kitchens.missing
    if "held" in parts:
        for name in MOTIONS:
            held = run_held_motion(name, settings.rounds, settings.progress)
            measured += held.measurements()
            if not held.attempts:
                missing.append(f"{name}: no grasps without collisions at {held.tried} places of the base")
            compared += held.comparisons()
    if "build" in parts:
        robot = next(robot for robot in BUILT if find_missing(robot, "kitchen (shipped)") is None)
        built = time_contenders("planning, build", _fresh_builds(robot), 1, settings.progress)
        measured += built.values()
        bounds = ((FIRST, 30.0), (AGAIN, 0.3))
        compared += [bound_median(built[f"{robot}: {name}"], seconds) for name, seconds in bounds]
    return BenchmarkResult(
        name="planning",
        work=(
            f"paths without collisions: published problems of Panda and Fetch, {SEEDS} attempts each with at "
            f"most {SECONDS:g} s; three problems at an open fridge; {settings.queries} queries between "
            "handles of kitchens, whose paths the scene checks 20 times finer; a fridge and a drawer that "
            "are held; times of the search, with the judgement by the scene where that is said"
        ),
        measurements=tuple(measured),
        comparisons=tuple(compared),
        missing=tuple(dict.fromkeys(missing)),
    )


def _fresh_builds(robot: str) -> list[Contender]:
    """Return the build of a planner in a fresh process with an empty cache, and again from that cache."""
    found: dict[str, float] = {}

    def build() -> float:
        with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as empty:
            found["first"] = run_program("build_planner", robot, cache=empty)["seconds"]
            again = [run_program("build_planner", robot, cache=empty)["seconds"] for _ in range(_AGAIN)]
            found["again"] = median(again)
        return found["first"]

    return [Contender(f"{robot}: {FIRST}", build), Contender(f"{robot}: {AGAIN}", lambda: found["again"])]
