"""``ablations``: what augmented gradients are good for, in locks and in pushes.

A lock is no slope for a controller: only the trend of its condition leads to the bolts that open it. The
boxes are the lockbox of the thesis behind the 2020 paper, and random ones. Pushes use the trend of the
condition of a push to move a contact along the object.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kineverse.gallery.lockboxes import THESIS, draw_lockbox
from kineverse.view.plots import Figure

from .execution import run_jobs
from .lockbox.unlocking_runs import (
    FIGURE_SIZE,
    RULES,
    Rule,
    UnlockingRun,
    draw_boxes,
    make_thesis_table,
    run_unlocking,
)
from .manipulation import trials as trial_runner
from .manipulation.skills import SettingOptions, find_robots, make_settings
from .registry import Options, Progress
from .report import Report, ReportTable
from .table1_push import OBJECT_COLUMNS, OBJECTS, SHIPPED_KITCHEN, PushJob, run_push

OPTIONS = ("quick", "data", "seed", "count", "robot", "processes", *SettingOptions)
BOXES, QUICK_BOXES = 20, 3
PARTS = (10, 40)
MOST_STEPS = 1000
QUICK_OBJECTS = ("fridge door",)
_PUSH_LOGIC: dict[Rule, str | None] = {"and": "and", "product": "product", "none": None}


def run(progress: Progress, options: Options) -> Report:
    """Open boxes and push objects with each rule; ``quick`` takes few boxes, one robot and one object."""
    settings = make_settings(options)
    robots = find_robots(options.robot, options.data)
    boxes = options.count or (QUICK_BOXES if options.quick else BOXES)
    thesis = {rule: run_unlocking(THESIS, rule) for rule in RULES}
    runs = run_boxes(boxes, options.seed, progress)
    if options.quick and not options.robot:
        robots = robots[:1]
    jobs = [
        PushJob(
            robot, SHIPPED_KITCHEN, None, thing, setting=setting, seed=options.seed, logic=_PUSH_LOGIC[rule]
        )
        for rule in RULES
        for setting in settings
        for robot in robots
        for thing in (QUICK_OBJECTS if options.quick else OBJECTS)
    ]
    pushes = run_jobs(run_push, jobs, progress, "ablations", "push", options)
    of_rule = len(jobs) // len(RULES)
    by_rule = {
        rule: [replace(trial, skill=name) for trial in pushes[k * of_rule : (k + 1) * of_rule]]
        for k, (rule, name) in enumerate(RULES.items())
    }
    return make_ablation_report(thesis, runs, by_rule, options.seed)


def run_boxes(count: int, seed: int, progress: Progress) -> dict[tuple[Rule, int], list[UnlockingRun]]:
    cases = [(rule, parts, seed + k) for rule in RULES for parts in PARTS for k in range(count)]
    found: dict[tuple[Rule, int], list[UnlockingRun]] = {}
    for rule, parts, number in progress(cases, "ablations", "box"):
        run_of = run_unlocking(draw_lockbox(parts, number), rule, MOST_STEPS)
        found.setdefault((rule, parts), []).append(run_of)
    return found


def make_ablation_report(
    thesis: dict[Rule, UnlockingRun],
    boxes: dict[tuple[Rule, int], list[UnlockingRun]],
    pushes: dict[Rule, list[trial_runner.Trial]],
    seed: int,
) -> Report:
    tables = [_thesis_table(thesis), _box_table(boxes)]
    trials = [t for own in pushes.values() for t in own]
    tables += [
        trial_runner.make_group_table(
            "Objects pushed shut (times of a control step in ms)", trials, PUSH_COLUMNS, ("skill",)
        ),
        trial_runner.make_exception_table(trials),
        trial_runner.make_failure_table(trials),
    ]
    numbers = {
        "seed": seed,
        "thesis": {rule: one.as_data() for rule, one in thesis.items()},
        "boxes": [
            {"rule": rule, "parts": parts, "opened": sum(r.done for r in own), "of": len(own)}
            for (rule, parts), own in boxes.items()
        ],
        "pushes": {rule: trial_runner.make_trial_numbers(own) for rule, own in pushes.items()},
    }
    return Report(
        "ablations",
        "With and without augmented gradients, and each rule of trends",
        tuple(table for table in tables if table.rows),
        numbers,
        Figure(lambda canvas: draw_boxes(canvas, boxes), FIGURE_SIZE),
    )


def _thesis_table(runs: dict[Rule, UnlockingRun]) -> ReportTable:
    title = "The lockbox of the thesis: f, e, d, then b and c, then a"
    table = make_thesis_table(title, "order of the bolts", runs)
    cpu = (f"{1e3 * trial_runner.StepTimeStatistics.from_seconds(one.cpu).mean:.3g}" for one in runs.values())
    rows = tuple((*row, cell) for row, cell in zip(table.rows, cpu, strict=True))
    return ReportTable(title, (*table.head, "CPU of a step [µs]"), rows)


def _box_table(runs: dict[tuple[Rule, int], list[UnlockingRun]]) -> ReportTable:
    rows: list[tuple[float | str, ...]] = []
    for (rule, parts), own in runs.items():
        steps = [r.steps for r in own if r.done]
        opened = f"{len(steps)} of {len(own)}"
        rows.append((RULES[rule], parts, opened, f"{np.median(steps):.0f}" if steps else ""))
    return ReportTable(
        f"Random boxes, at most {MOST_STEPS} steps", ("trends", "parts", "opened", "steps"), tuple(rows)
    )


def _median_steps(trials: Sequence[trial_runner.Trial]) -> float:
    steps = [t.steps for t in trials if t.done]
    return float(np.median(steps)) if steps else math.nan


PUSH_COLUMNS = (
    *trial_runner.ROW,
    *OBJECT_COLUMNS[:3],
    trial_runner.Column("steps", "steps (median)", _median_steps, 6),
    *trial_runner.TIMES[1:],
    *trial_runner.QUALITY,
)
