"""Attempts of planners: what one found, and summaries over many problems."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from kineverse.lie import Array

from .result import Measurement

if TYPE_CHECKING:
    from kineverse.planning import Planner


@dataclass(frozen=True, slots=True)
class Attempt:
    """Result of a planner for one problem."""

    found: bool  # true if a path was found
    seconds: float  # time of the search, without anything that is done once for a robot [s]
    # time with the judgement of the path by a scene [s]; the same for planners that do not judge
    judged: float
    # configurations of the path, shape (N, n) [m], [rad]; empty without one
    points: Array = field(default_factory=lambda: np.empty((0, 0)))
    why: str = ""  # how the path was found, or why there is none


def attempt_with_kineverse(
    planner: Planner, start: Array, goals: Array, seconds: float, seed: int
) -> Attempt:
    """Return the attempt of our planner, whose obstacles are placed."""
    path = planner.plan(start, goals, seconds=seconds, seed=seed)
    return Attempt(path.found, path.search_seconds, path.seconds, path.points, path.why)


def attempt_first_path(planner: Planner, start: Array, goal: Array, seconds: float, seed: int) -> Attempt:
    """Return the attempt of our search alone: its path is neither shortened nor judged, as those of peers."""
    from kineverse.planning.search import RrtConnect

    # The goals of the planner: the given one where it is nearest, and full turns away from there.
    nearest = planner.space.equivalents(goal, start, most=1)
    planner.planning_scene.set_bounds(start, nearest)
    variants = planner.space.equivalents(nearest[0], start)
    starts, goals = (np.ascontiguousarray(Q, dtype=np.float32) for Q in (start[None], variants))
    begin = perf_counter()
    found = RrtConnect(planner.checker).solve(starts, goals, seconds, seed)
    spent = perf_counter() - begin
    return Attempt(found.found, spent, spent, found.points.astype(float))


@dataclass(frozen=True)
class AttemptSummary:
    """Times and success of a planner over problems."""

    name: str  # planner and problems
    attempts: Sequence[Attempt]

    @property
    def solved(self) -> float:
        """Share of attempts that found a path [%]."""
        return 100.0 * float(np.mean([attempt.found for attempt in self.attempts]))

    def times(self, judged: bool = False) -> Array:
        """Return the times of attempts that found a path [s]; one of ∞ if there are none."""
        times = [a.judged if judged else a.seconds for a in self.attempts if a.found]
        return np.array(times or [np.inf])

    @property
    def median(self) -> float:
        """Median time of what was solved [s]."""
        return float(np.median(self.times()))

    @property
    def mean(self) -> float:
        """Mean time of what was solved [s]."""
        return float(np.mean(self.times()))

    def percentile(self, share: float) -> float:
        """Return a percentile of the time of what was solved [s]."""
        return float(np.percentile(self.times(), share))

    def measurements(self, percentile: float = 95.0) -> Iterator[Measurement]:
        """Yield median, mean and percentile of times, the median with the judgement, and the share solved."""
        if any(attempt.found for attempt in self.attempts):
            times, judged = self.times(), self.times(judged=True)
            yield Measurement(f"{self.name}: median", "s", (self.median,))
            yield Measurement(f"{self.name}: mean", "s", (self.mean,))
            yield Measurement(f"{self.name}: p{percentile:g}", "s", (self.percentile(percentile),))
            if not np.array_equal(times, judged):
                yield Measurement(f"{self.name}: median, path judged", "s", (float(np.median(judged)),))
        yield Measurement(f"{self.name}: solved", "%", (self.solved,))
