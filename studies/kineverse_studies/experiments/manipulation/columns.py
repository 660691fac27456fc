"""Columns of the tables of trials: title, key in JSON data, and function of the trials of a row."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from .trials import FAILURES, StepTimeStatistics, Trial, count_objects

Cell = float | str


@dataclass(frozen=True)
class Column:
    """Column of a table."""

    key: str  # name in JSON data
    title: str  # title with the unit
    of: Callable[[Sequence[Trial]], Any]  # function from the trials of a row to the value
    digits: int = 3  # significant digits of numbers that are printed

    def cell(self, trials: Sequence[Trial]) -> str:
        """Return the printed value; empty for NaN."""
        value = self.of(trials)
        if isinstance(value, str):
            return value
        return "" if math.isnan(value) else f"{value:.{self.digits}g}" if value else "0"


def worst(key: str, scale: float = 1.0) -> Callable[[Sequence[Trial]], float]:
    """Return the function that finds the largest value of a measure, times a scale; NaN without any."""

    def largest(trials: Sequence[Trial]) -> float:
        found = (t.measures.get(key) for t in trials)
        numbers = [float(v) for v in found if v is not None and not math.isnan(v)]
        return scale * max(numbers, default=math.nan)

    return largest


def step_times(trials: Sequence[Trial]) -> StepTimeStatistics:
    """Return the statistics of all control steps of some trials [ms]."""
    return StepTimeStatistics.from_seconds(
        [t for trial in trials for t in trial.cpu], [t for trial in trials for t in trial.wall]
    )


def _failures(kind: str) -> Callable[[Sequence[Trial]], int]:
    return lambda trials: sum(t.failure == kind for t in trials)


def _deepest_pair(trials: Sequence[Trial]) -> str:
    deepest = max(trials, key=lambda t: t.measures.get("penetration") or 0.0)
    return (
        " and ".join(deepest.measures.get("penetrating", ())) if deepest.measures.get("penetration") else ""
    )


ROW = (
    Column("robot", "robot", lambda trials: trials[0].robot),
    Column("world", "world", lambda trials: trials[0].world),
    Column("noise", "noise", lambda trials: trials[0].noise or "none"),
    Column("dof", "DoF", lambda trials: trials[0].dof, 4),
)
"""Columns with which each table begins; their keys are attributes of trials, by which rows are grouped."""

SUCCESS = (
    Column("objects", "objects", lambda trials: count_objects(trials).objects, 6),
    Column("done", "done", lambda trials: count_objects(trials).done, 6),
    Column("excused", "out of reach", lambda trials: count_objects(trials).excused, 6),
    Column("rate", "of those in reach [%]", lambda trials: 100 * count_objects(trials).rate, 4),
    *(Column(kind, kind, _failures(kind), 6) for kind in FAILURES if kind),
)

TIMES = (
    Column("steps", "steps", lambda trials: step_times(trials).count, 9),
    Column("cpu_mean_ms", "CPU mean", lambda trials: step_times(trials).mean),
    Column("cpu_sd_ms", "sd", lambda trials: step_times(trials).deviation),
    Column("cpu_median_ms", "median", lambda trials: step_times(trials).median),
    Column("cpu_p99_ms", "p99", lambda trials: step_times(trials).p99),
    Column("cpu_worst_ms", "worst", lambda trials: step_times(trials).worst),
    Column("wall_mean_ms", "wall mean", lambda trials: step_times(trials).wall),
)

QUALITY = (
    Column("limit_violation", "limits violated", worst("limit_violation")),
    Column("grasp_error_mm", "grasp error [mm]", worst("grasp_error", 1e3)),
    Column("contact_losses", "contact losses", worst("contact_losses"), 6),
    Column("penetration_mm", "penetration [mm]", worst("penetration", 1e3)),
    Column("penetrating", "deepest pair", _deepest_pair),
    Column("jitter", "jitter", worst("jitter")),
    Column("peak_force", "force [N]", worst("peak_force")),
)
"""Largest values of single trials; penetration is that of the pairs that are not excepted."""

COLUMNS = (*ROW, *SUCCESS, *TIMES, *QUALITY)
"""Columns of JSON data."""
