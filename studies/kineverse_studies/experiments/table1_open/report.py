"""Report of the opening experiment: tables, numbers and figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.view.plots import Figure
from kineverse_studies.experiments.manipulation.columns import ROW, TIMES, Column, step_times, worst
from kineverse_studies.experiments.manipulation.tables import make_trial_numbers, make_trial_tables
from kineverse_studies.experiments.manipulation.trials import StepTimeStatistics, Trial, as_json, group_trials
from kineverse_studies.experiments.report import Report, ReportTable

from .figures import make_opening_pictures
from .programs import LeaderFollower, OneProgram

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

PUBLISHED = {"hsr": (3.3, 2.2), "fetch": (1.2, 0.5), "pr2": (2.8, 1.6)}
"""Mean and deviation of the solver's time of a control step in the 2022 paper, Table I [ms]."""
PROGRAMS = (LeaderFollower.name, OneProgram.name)
FIGURE_SIZE = (9.0, 4.0)


def make_opening_report(trials: Sequence[Trial], starts: int, seed: int) -> Report:
    """Return the report on the trials of programs and of the skill."""
    alone = [t for t in trials if t.skill in PROGRAMS]
    skill = [t for t in trials if t.skill not in PROGRAMS]
    groups = list(group_trials(alone, "robot", "skill").values())
    rows = tuple(tuple(column.cell(own) for column in PROGRAM_COLUMNS) for own in groups)
    title = "Programs alone: the solver's calls of a control step, and the whole step [ms]"
    numbers = {
        "seed": seed,
        "starts": starts,
        "programs": [{c.key: as_json(c.of(own)) for c in PROGRAM_COLUMNS} for own in groups],
        "skill": make_trial_numbers(skill),
    }
    tables = (
        ReportTable(title, tuple(c.title for c in PROGRAM_COLUMNS), rows),
        _object_table(groups),
        *make_trial_tables(skill, "Skill: opened and closed"),
    )
    title = f"Grasped opening of three objects, {starts} starts each (2022 paper, Table I, IV-C1)"
    figure = Figure(lambda canvas: _draw(canvas, groups), FIGURE_SIZE)
    return Report("table1-open", title, tables, numbers, figure, make_opening_pictures(skill))


def _solver_times(trials: Sequence[Trial]) -> StepTimeStatistics:
    return StepTimeStatistics.from_seconds([t for trial in trials for t in trial.series["solve"]])


def _published(trials: Sequence[Trial], entry: int) -> float:
    """Return a figure of the paper, which is about two programs a step; NaN for another program."""
    known = PUBLISHED.get(trials[0].robot.partition(" ")[0])
    return math.nan if known is None or trials[0].skill != LeaderFollower.name else known[entry]


def _programs_a_step(trials: Sequence[Trial]) -> float:
    steps = sum(t.steps for t in trials)
    return sum(t.measures["programs"] for t in trials) / steps if steps else math.nan


PROGRAM_COLUMNS = (
    ROW[0],
    Column("program", "program", lambda trials: trials[0].skill),
    ROW[3],
    Column("opened", "opened", lambda trials: sum(t.done for t in trials), 6),
    Column("runs", "of", len, 6),
    Column("solve_mean_ms", "solver mean (wall)", lambda trials: _solver_times(trials).mean),
    Column("solve_sd_ms", "sd", lambda trials: _solver_times(trials).deviation),
    Column("published_mean_ms", "paper mean", lambda trials: _published(trials, 0)),
    Column("published_sd_ms", "sd", lambda trials: _published(trials, 1)),
    *(column for column in TIMES if column.key in ("cpu_mean_ms", "cpu_p99_ms", "cpu_worst_ms")),
    Column("rate_hz", "slowest [Hz]", lambda trials: 1e3 / step_times(trials).worst),
    Column("programs_a_step", "programs a step", _programs_a_step),
    Column("grasp_error_mm", "grasp error [mm]", lambda trials: worst("grasp_error", 1e3)(_done(trials))),
    Column("limit_violation", "limits violated", worst("limit_violation")),
)
"""Columns of the programs alone; the grasp error is that of the runs that opened the object."""


def _done(trials: Sequence[Trial]) -> list[Trial]:
    return [t for t in trials if t.done]


def _object_table(groups: Sequence[Sequence[Trial]]) -> ReportTable:
    objects = list(dict.fromkeys(t.case for own in groups for t in own))
    rows: list[tuple[float | str, ...]] = []
    for own in groups:
        cells = []
        for name in objects:
            runs = [t for t in own if t.case == name]
            steps = [t.steps for t in runs if t.done]
            mean = f", {np.mean(steps):.0f} steps" if steps else ""
            cells.append(f"{sum(t.done for t in runs)} of {len(runs)}{mean}")
        rows.append((own[0].robot, own[0].skill, *cells))
    return ReportTable("Opened with the handle in the hand", ("robot", "program", *objects), tuple(rows))


def _draw(canvas: Canvas, groups: Sequence[Sequence[Trial]]) -> None:
    """Draw the solver's times of a control step, by robot and program."""
    axes = canvas.add_subplot()
    times: list[Any] = [
        [1e3 * t for trial in own for t in trial.series["solve"]] or [math.nan] for own in groups
    ]
    axes.boxplot(times, whis=(1, 99), showfliers=False, orientation="horizontal")
    axes.set_yticks(range(1, len(groups) + 1), [f"{own[0].robot}, {own[0].skill}" for own in groups])
    axes.set_xscale("log")
    axes.set_xlabel("solver's calls of a control step [ms], 1st to 99th percentile")
