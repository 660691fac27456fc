"""Report of the pushing experiment: tables, numbers and figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from kineverse.view.plots import Figure
from kineverse.worlds.run_metrics import CONTACT_GAP
from kineverse_studies.experiments.manipulation.columns import ROW, TIMES, Column, step_times
from kineverse_studies.experiments.manipulation.tables import (
    make_group_table,
    make_trial_numbers,
    make_trial_tables,
)
from kineverse_studies.experiments.manipulation.trials import StepTimeStatistics, Trial, as_json, group_trials
from kineverse_studies.experiments.report import Report

from .figures import FILMED, make_push_pictures

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

PUBLISHED = {
    "2022": {"hsr": (1.9, 0.02), "fetch": (2.3, 0.01), "pr2": (2.7, 0.02)},
    "2020": {"hsr": (2.2, 0.08), "fetch": (4.8, 0.09), "pr2": (3.2, 0.06)},
}
"""Mean time of a control step and its deviation over the objects, Table I of each paper [ms]."""

PENETRATION, LIMITS, LOSSES = 5e-4, 1e-6, 1
"""Bars: deepest penetration [m], largest violation of limits, and contact losses of one run."""


def make_push_report(trials: Sequence[Trial], seed: int) -> Report:
    """Return the report on pushes."""
    by = ("case", "skill")
    groups = group_trials(trials, *by, *(c.key for c in ROW)).values()
    columns = (*ROW[:3], *OBJECT_COLUMNS, *PAPER_COLUMNS)
    own = [dict(zip(by, (own[0].case, own[0].skill), strict=True)) for own in groups]
    numbers = {
        "seed": seed,
        "pushes": [
            one | {c.key: as_json(c.of(group)) for c in columns}
            for one, group in zip(own, groups, strict=True)
        ],
        **make_trial_numbers(trials),
    }
    more = (
        make_group_table("Starts and bars", trials, (*ROW[:3], *OBJECT_COLUMNS), by),
        make_group_table("Control steps beside the papers [ms]", trials, (*ROW[:3], *PAPER_COLUMNS), by),
    )
    return Report(
        "table1-push",
        "Objects pushed shut with and without base placement (2020 and 2022 papers, Table I)",
        make_trial_tables(trials, "Objects pushed shut", more),
        numbers,
        Figure(lambda canvas: _draw_commands(canvas, trials), FIGURE_SIZE),
        make_push_pictures(trials),
    )


FIGURE_SIZE = (13.0, 4.2)
_NAMED = 6
"""Number of the fastest joints that have their names in the figure."""


def meets_bars(trial: Trial) -> bool:
    """Return whether a push was done within the bars."""
    m = trial.measures
    return bool(
        trial.done
        and m.get("contact_losses", 0) <= LOSSES
        and m.get("penetration", 0.0) <= PENETRATION
        and m.get("limit_violation", 0.0) <= LIMITS
    )


OBJECT_COLUMNS = (
    Column("objects", "objects", len, 6),
    Column("done", "shut", lambda trials: sum(t.done for t in trials), 6),
    Column(
        "at_once",
        "from the papers' start",
        lambda trials: sum(t.done and t.measures.get("placed", 0) == 0 for t in trials),
        6,
    ),
    Column("within_bars", "within all bars", lambda trials: sum(map(meets_bars, trials)), 6),
)


def _spread(trials: Sequence[Trial]) -> float:
    """Return the deviation of the objects' means [ms], as in the papers."""
    means = [1e-3 * StepTimeStatistics.from_seconds(t.cpu).mean for t in trials if t.cpu]
    return StepTimeStatistics.from_seconds(means).deviation


def _published(trials: Sequence[Trial], entry: int) -> float:
    paper = next((values for name, values in PUBLISHED.items() if name in trials[0].skill), {})
    return paper.get(trials[0].robot.partition(" ")[0], (math.nan, math.nan))[entry]


PAPER_COLUMNS = (
    TIMES[1],
    Column("sd_over_objects_ms", "sd over objects", _spread),
    Column("published_mean_ms", "paper mean", lambda trials: _published(trials, 0)),
    Column("published_sd_ms", "sd over objects", lambda trials: _published(trials, 1)),
    Column("cpu_worst_ms", "worst", lambda trials: step_times(trials).worst),
)


def _draw_commands(canvas: Canvas, trials: Sequence[Trial]) -> None:
    """Draw the commanded speeds of each robot at the first filmed object (2020 paper, Fig. 7)."""
    shown = [t for t in trials if t.series.get("time") and t.measures["thing"] == FILMED[0]]
    own = list({t.robot: t for t in reversed(shown)}.values())[::-1]
    panels = np.atleast_1d(canvas.subplots(1, max(1, len(own))))
    for axes, trial in zip(panels, own, strict=False):
        time = np.asarray(trial.series["time"])
        speeds = {name: np.asarray(v) for name, v in trial.series.items() if name != "time"}
        fastest = sorted(speeds, key=lambda name: -float(np.abs(speeds[name]).max(initial=0.0)))
        for name in reversed(fastest):
            label = name.partition("/")[2].removesuffix(":velocity")
            style = {"label": label} if name in fastest[:_NAMED] else {"color": "0.75"}
            axes.plot(time, speeds[name], linewidth=0.9, **style)
        gaps = ((m.time, np.linalg.norm(m.vectors["r - p"][1])) for m in trial.film if m.vectors)
        touches = (at for at, gap in gaps if gap < CONTACT_GAP)
        if (touch := next(touches, None)) is not None:
            axes.axvline(touch, color="0.5", linewidth=0.8, linestyle=":")
        axes.legend(fontsize="x-small", frameon=False)
        axes.set_title(f"{trial.robot}, {trial.measures['thing']} (dotted: first contact)", fontsize="medium")
        axes.set_xlabel("time [s]")
    panels[0].set_ylabel("commanded speeds [rad/s], [m/s]")
