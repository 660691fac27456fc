"""``ablations``: what augmented gradients are good for, in locks and in pushes.

A lock is no slope for a controller: only the trend of its condition leads to the bolts that open it. The
boxes are the lockbox of the thesis behind the 2020 paper, and random ones. Pushes use the trend of the
condition of a push to move a contact along the object.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kineverse.experiments.manipulation.robots import find_robots
from kineverse.experiments.manipulation.tables import make_failure_table, make_trial_numbers
from kineverse.experiments.manipulation.trial_pool import run_jobs
from kineverse.experiments.manipulation.trials import StepTimeStatistics, Trial
from kineverse.experiments.registry import Options, Progress
from kineverse.experiments.report import Figure, Report, ReportTable
from kineverse.experiments.table1_push import PushJob, run_push
from kineverse.experiments.table1_push.objects import OBJECTS, SHIPPED_KITCHEN

from .figure import FIGURE_SIZE, draw_boxes
from .locks import RULES, THESIS, UPPER, Rule, UnlockingRun, draw_box, unlock

OPTIONS = ("quick", "data", "seed", "count", "robot", "processes")

BOXES, QUICK_BOXES = 20, 3
PARTS = (10, 40)
MOST_STEPS = 1000
QUICK_OBJECTS = ("fridge door",)
_PUSH_LOGIC: dict[Rule, str | None] = {"and": "and", "product": "product", "none": None}


def run(progress: Progress, options: Options) -> Report:
    """Open boxes and push objects with each rule; ``quick`` takes few boxes, one robot and one object."""
    boxes = options.count or (QUICK_BOXES if options.quick else BOXES)
    thesis = {rule: unlock(THESIS, "a", UPPER, rule) for rule in RULES}
    runs = run_boxes(boxes, options.seed, progress)
    robots = find_robots(options.robot, options.data)
    if options.quick and not options.robot:
        robots = robots[:1]
    jobs = [
        PushJob(robot, SHIPPED_KITCHEN, None, thing, seed=options.seed, logic=_PUSH_LOGIC[rule])
        for rule in RULES
        for robot in robots
        for thing in (QUICK_OBJECTS if options.quick else OBJECTS)
    ]
    pushes = run_jobs(run_push, jobs, progress, "ablations", "push", options.processes)
    of_rule = len(jobs) // len(RULES)
    by_rule = {rule: pushes[k * of_rule : (k + 1) * of_rule] for k, rule in enumerate(RULES)}
    return make_ablation_report(thesis, runs, by_rule, options.seed)


def run_boxes(count: int, seed: int, progress: Progress) -> dict[tuple[Rule, int], list[UnlockingRun]]:
    """Return the openings of random boxes by rule and number of parts."""
    cases = [(rule, parts, seed + k) for rule in RULES for parts in PARTS for k in range(count)]
    found: dict[tuple[Rule, int], list[UnlockingRun]] = {}
    for rule, parts, number in progress(cases, "ablations", "box"):
        run_of = unlock(*draw_box(parts, number), rule, MOST_STEPS)
        found.setdefault((rule, parts), []).append(run_of)
    return found


def make_ablation_report(
    thesis: dict[Rule, UnlockingRun],
    boxes: dict[tuple[Rule, int], list[UnlockingRun]],
    pushes: dict[Rule, list[Trial]],
    seed: int,
) -> Report:
    """Return the report on locks and pushes."""
    tables = [_thesis_table(thesis), _box_table(boxes)]
    if any(pushes.values()):
        tables += [_push_table(pushes), make_failure_table([t for own in pushes.values() for t in own])]
    numbers = {
        "seed": seed,
        "thesis": {
            rule: {"done": one.done, "steps": one.steps, "order": list(one.order)}
            for rule, one in thesis.items()
        },
        "boxes": [
            {"rule": rule, "parts": parts, "opened": sum(r.done for r in own), "of": len(own)}
            for (rule, parts), own in boxes.items()
        ],
        "pushes": {rule: make_trial_numbers(own) for rule, own in pushes.items()},
    }
    return Report(
        "ablations",
        "With and without augmented gradients, and each rule of trends",
        tuple(table for table in tables if table.rows),
        numbers,
        Figure(lambda canvas: draw_boxes(canvas, boxes), FIGURE_SIZE),
    )


def _thesis_table(runs: dict[Rule, UnlockingRun]) -> ReportTable:
    rows = tuple(
        (
            RULES[rule],
            "yes" if one.done else "no",
            one.steps,
            ", ".join(one.order),
            f"{_microseconds(one.cpu):.3g}",
        )
        for rule, one in runs.items()
    )
    head = ("trends", "opened", "steps", "order of the bolts", "CPU of a step [µs]")
    return ReportTable("The lockbox of the thesis: f, e, d, then b and c, then a", head, rows)


def _box_table(runs: dict[tuple[Rule, int], list[UnlockingRun]]) -> ReportTable:
    rows: list[tuple[float | str, ...]] = []
    for (rule, parts), own in runs.items():
        steps = [r.steps for r in own if r.done]
        opened = f"{len(steps)} of {len(own)}"
        rows.append((RULES[rule], parts, opened, f"{np.median(steps):.0f}" if steps else ""))
    return ReportTable(
        f"Random boxes, at most {MOST_STEPS} steps", ("trends", "parts", "opened", "steps"), tuple(rows)
    )


def _push_table(pushes: dict[Rule, list[Trial]]) -> ReportTable:
    rows = tuple(
        (
            RULES[rule],
            f"{sum(t.done for t in own)} of {len(own)}",
            sum(t.done and not t.measures.get("placed", 0) for t in own),
            sum(int(t.measures.get("contact_losses", 0)) for t in own),
            f"{np.median([t.steps for t in own if t.done] or [0]):.0f}",
        )
        for rule, own in pushes.items()
    )
    head = ("trends", "shut", "from the papers' start", "contact losses", "steps")
    return ReportTable("Objects pushed shut", head, rows)


def _microseconds(cpu: Sequence[float]) -> float:
    return 1e3 * StepTimeStatistics.from_seconds(cpu).mean
