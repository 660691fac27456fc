"""Report of the opening experiment: tables, numbers and figure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.experiments.manipulation.tables import (
    Rows,
    make_failure_table,
    make_quality_table,
    make_success_table,
    make_time_table,
    make_trial_numbers,
)
from kineverse.experiments.manipulation.trials import StepTimeStatistics, Trial, as_json
from kineverse.experiments.report import Figure, Report, ReportTable

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
    rows = [_program_row(robot, program, own) for (robot, program), own in _groups(alone)]
    numbers = {
        "seed": seed,
        "starts": starts,
        "programs": [dict(zip(_KEYS, map(as_json, row), strict=True)) for row in rows],
        "skill": make_trial_numbers(skill),
    }
    tables: tuple[ReportTable, ...] = (
        _program_table(rows),
        _object_table(alone),
        make_success_table(skill, "Skill: opened and closed in the kinematic world"),
        make_time_table(skill),
        make_quality_table(skill),
        make_failure_table(skill),
    )
    tables = tuple(table for table in tables if table.rows)
    title = f"Grasped opening of three objects, {starts} starts each (2022 paper, Table I, IV-C1)"
    return Report("table1-open", title, tables, numbers, Figure(lambda c: _draw(c, alone), FIGURE_SIZE))


_KEYS = (
    "robot",
    "program",
    "opened",
    "runs",
    "solve_mean_ms",
    "solve_sd_ms",
    "published_mean_ms",
    "published_sd_ms",
    "cpu_mean_ms",
    "cpu_p99_ms",
    "cpu_worst_ms",
    "programs_a_step",
    "grasp_error_mm",
    "limits",
)


def _program_row(robot: str, program: str, own: Sequence[Trial]) -> tuple[float | str, ...]:
    solve = StepTimeStatistics.from_seconds([t for trial in own for t in trial.series["solve"]])
    cpu = StepTimeStatistics.from_seconds([t for trial in own for t in trial.cpu])
    steps = sum(t.steps for t in own)
    # The papers' figures are about two programs a step.
    published = PUBLISHED.get(robot.partition(" ")[0], (math.nan,) * 2)
    return (
        robot,
        program,
        sum(t.done for t in own),
        len(own),
        solve.mean,
        solve.deviation,
        *(published if program == LeaderFollower.name else (math.nan,) * 2),
        cpu.mean,
        cpu.p99,
        cpu.worst,
        sum(t.measures["programs"] for t in own) / steps if steps else math.nan,
        max((t.measures["grasp_error"] for t in own if t.done), default=math.nan),
        max((t.measures["limits"] for t in own), default=math.nan),
    )


def _program_table(rows: Iterable[tuple[float | str, ...]]) -> ReportTable:
    shown: Rows = tuple(
        (
            row[0],
            row[1],
            f"{row[2]} of {row[3]}",
            *(f"{_pair(row[k], row[k + 1])}" for k in (4, 6)),
            *(f"{value:.3g}" for value in row[8:]),
        )
        for row in rows
    )
    head = (
        "robot", "program", "opened", "solver, mean/sd [ms]", "in the paper", "CPU mean [ms]", "p99", "worst",
        "programs a step", "grasp error [mm]", "limits",
    )  # fmt: skip
    return ReportTable(
        "Programs alone: the solver's calls of a control step, and the whole step", head, shown
    )


def _object_table(trials: Sequence[Trial]) -> ReportTable:
    objects = list(dict.fromkeys(t.case for t in trials))
    rows: list[tuple[float | str, ...]] = []
    for (robot, program), own in _groups(trials):
        cells = []
        for name in objects:
            runs = [t for t in own if t.case == name]
            steps = [t.steps for t in runs if t.done]
            mean = f", {np.mean(steps):.0f} steps" if steps else ""
            cells.append(f"{sum(t.done for t in runs)} of {len(runs)}{mean}")
        rows.append((robot, program, *cells))
    return ReportTable("Opened with the handle in the hand", ("robot", "program", *objects), tuple(rows))


def _groups(trials: Sequence[Trial]) -> list[tuple[tuple[str, str], list[Trial]]]:
    """Return the trials of each robot and program."""
    found: dict[tuple[str, str], list[Trial]] = {}
    for trial in trials:
        found.setdefault((trial.robot, trial.skill), []).append(trial)
    return list(found.items())


def _pair(mean: Any, deviation: Any) -> str:
    return "" if math.isnan(mean) else f"{mean:.3g} / {deviation:.2g}"


def _draw(canvas: Canvas, trials: Sequence[Trial]) -> None:
    """Draw the solver's times of a control step, by robot and program."""
    axes = canvas.add_subplot()
    groups = _groups(trials)
    times = [[1e3 * t for trial in own for t in trial.series["solve"]] or [math.nan] for _, own in groups]
    axes.boxplot(times, whis=(1, 99), showfliers=False, orientation="horizontal")
    axes.set_yticks(range(1, len(groups) + 1), [f"{robot}, {program}" for (robot, program), _ in groups])
    axes.set_xscale("log")
    axes.set_xlabel("solver's calls of a control step [ms], 1st to 99th percentile")
