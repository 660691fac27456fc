"""Report of the pushing experiment: tables, numbers and figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from kineverse.experiments.manipulation.tables import (
    make_failure_table,
    make_quality_table,
    make_success_table,
    make_trial_numbers,
)
from kineverse.experiments.manipulation.trials import StepTimeStatistics, Trial, as_json
from kineverse.experiments.report import Figure, Report, ReportTable

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

PUBLISHED = {
    "2022": {"hsr": (1.9, 0.02), "fetch": (2.3, 0.01), "pr2": (2.7, 0.02)},
    "2020": {"hsr": (2.2, 0.08), "fetch": (4.8, 0.09), "pr2": (3.2, 0.06)},
}
"""Mean time of a control step and its deviation over the objects, Table I of each paper [ms]."""

PENETRATION, LIMITS, LOSSES = 0.5, 1e-6, 1
"""Bars: deepest penetration [mm], largest violation of limits, and contact losses of one run."""


def make_push_report(trials: Sequence[Trial], seed: int) -> Report:
    """Return the report on pushes."""
    times = [_time_row(*group) for group in _groups(trials)]
    numbers = {
        "seed": seed,
        "times": [dict(zip(_KEYS, map(as_json, row), strict=True)) for row in times],
        **make_trial_numbers(trials),
    }
    tables = (
        make_success_table(trials, "Objects pushed shut"),
        _bar_table(trials),
        ReportTable(
            "Times of a control step, distance queries included [ms]",
            ("kitchen", "robot", "push", "CPU mean", "sd over objects", "p99", "worst", "in the paper"),
            tuple((*row[:3], *(f"{v:.3g}" for v in row[3:7]), _pair(row[7], row[8])) for row in times),
        ),
        make_quality_table(trials),
        make_failure_table(trials),
    )
    title = "Objects pushed shut with and without base placement (2020 and 2022 papers, Table I)"
    return Report(
        "table1-push",
        title,
        tuple(table for table in tables if table.rows),
        numbers,
        Figure(lambda canvas: _draw_commands(canvas, trials), FIGURE_SIZE),
    )


SHOWN = "fridge door"
"""Object of the figure: joint velocity commands, as in the 2020 paper, Fig. 7."""
FIGURE_SIZE = (12.0, 3.8)
_KEYS = (
    "kitchen",
    "robot",
    "push",
    "mean_ms",
    "sd_over_objects_ms",
    "p99_ms",
    "worst_ms",
    "published_mean_ms",
    "published_sd_ms",
)


def meets_bars(trial: Trial) -> bool:
    """Return whether a push was done within the bars."""
    m = trial.measures
    return bool(
        trial.done
        and m.get("contact_losses", 0) <= LOSSES
        and m.get("penetration", 0.0) <= PENETRATION
        and m.get("limits", 0.0) <= LIMITS
    )


def _bar_table(trials: Sequence[Trial]) -> ReportTable:
    rows: list[tuple[float | str, ...]] = []
    for kitchen, robot, push, own in _groups(trials):
        shut = [t for t in own if t.done]
        at_once = sum(t.measures.get("placed", 0) == 0 for t in shut)
        rows.append((kitchen, robot, push, len(own), len(shut), at_once, sum(map(meets_bars, own))))
    head = ("kitchen", "robot", "push", "objects", "shut", "from the papers' start", "within all bars")
    return ReportTable("Starts and bars", head, tuple(rows))


def _time_row(kitchen: str, robot: str, push: str, own: Sequence[Trial]) -> tuple[float | str, ...]:
    whole = StepTimeStatistics.from_seconds([t for trial in own for t in trial.cpu])
    # As in the papers, the deviation is that of the objects' means.
    means = [StepTimeStatistics.from_seconds(t.cpu).mean for t in own if t.cpu]
    spread = StepTimeStatistics.from_seconds([1e-3 * m for m in means]).deviation
    paper = next((values for name, values in PUBLISHED.items() if name in push), {})
    published = paper.get(robot.partition(" ")[0], (math.nan, math.nan))
    return kitchen, robot, push, whole.mean, spread, whole.p99, whole.worst, *published


def _groups(trials: Sequence[Trial]) -> list[tuple[str, str, str, list[Trial]]]:
    """Return the trials of each kitchen, robot and kind of push."""
    found: dict[tuple[str, str, str], list[Trial]] = {}
    for trial in trials:
        found.setdefault((trial.case, trial.robot, trial.skill), []).append(trial)
    return [(*key, own) for key, own in found.items()]


def _pair(mean: float | str, deviation: float | str) -> str:
    return "" if isinstance(mean, str) or math.isnan(mean) else f"{mean:g} / {deviation:g}"


def _draw_commands(canvas: Canvas, trials: Sequence[Trial]) -> None:
    """Draw the commanded speeds of each robot at one object of the first kitchen and period."""
    shown = {t.robot: t for t in reversed(trials) if t.series.get("time")}
    own = list(reversed(shown.values()))
    panels = np.atleast_1d(canvas.subplots(1, max(1, len(own)), sharey=True))
    for axes, trial in zip(panels, own, strict=False):
        for name, values in trial.series.items():
            if name != "time" and np.abs(values).max() > 1e-3:
                axes.plot(trial.series["time"], values, linewidth=0.9)
        axes.set_title(f"{trial.robot}, {trial.measures.get('thing', trial.what)}")
        axes.set_xlabel("time [s]")
    panels[0].set_ylabel("commanded speeds [rad/s], [m/s]")
