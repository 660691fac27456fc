"""``lockbox``: boxes of the thesis behind the 2020 paper, random ones, the Chinese rings, unknown locks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Literal, TypeAlias

import numpy as np

from kineverse.gallery.lockboxes import (
    THESIS,
    Lockbox,
    draw_lockbox,
    draw_tangled_lockbox,
    make_lockbox_model,
    make_rings,
    remove_locks,
)
from kineverse.manipulation import PartMover, Session, execute_unlocking, explore_locks
from kineverse.reasoning import interlocks, plan_unlocking, plan_violations
from kineverse.view.plots import Figure
from kineverse.worlds import MechanismWorld, Recorder
from kineverse_studies.experiments.execution import run_jobs
from kineverse_studies.experiments.manipulation.skills import make_record_folder
from kineverse_studies.experiments.registry import Options, Progress
from kineverse_studies.experiments.report import Report, ReportTable, make_table

from . import unknown_locks
from .unlocking_runs import (
    FIGURE_SIZE,
    LOCK_RULES,
    Rule,
    UnlockingRun,
    draw_boxes,
    make_thesis_table,
    run_unlocking,
)

_DT = 0.05


def record_thesis_box(folder: Path) -> None:
    make_record_folder(folder)
    with _start(folder, "trends") as (_, recorder):
        run = run_unlocking(THESIS, recorder=recorder)
        recorder.write_outcome({"done": run.done, "reason": f"{run.steps} steps"})
    with _start(folder, "plan") as (world, recorder):
        session = Session(world, dt=_DT, on_step=recorder)
        recorder.write_outcome(execute_unlocking(session, THESIS.goal).as_data())
    with _start(folder, "unknown-locks") as (world, recorder):
        model = make_lockbox_model(remove_locks(THESIS), None)
        mover = PartMover(model.snapshot(), Session(world, dt=_DT, on_step=recorder))
        done = explore_locks(model, THESIS.goal, mover.move)
        recorder.write_outcome({"done": done.done, "reason": f"{len(done.tries)} tries"})


@contextmanager
def _start(folder: Path, name: str) -> Iterator[tuple[MechanismWorld, Recorder]]:
    world = MechanismWorld(make_lockbox_model(THESIS, None))
    about = {"box": "thesis", "by": name}
    with Recorder(folder / f"thesis-{name}.mcap", world.model, about, world=world) as recorder:
        yield world, recorder


OPTIONS = ("quick", "seed", "count", "processes", "record")
COUNT, QUICK_COUNT = 1000, 4
"""Number of random boxes without negations; half as many have some, a tenth is for each ablation."""
NEGATED = 0.25
_STEPS_A_PART = 40
_LARGEST, _LARGEST_NEGATED = 100, 40
_ABLATED = (10, 40)
_SMALL = 7  # largest number of parts of boxes on which plans are compared with exhaustive search
Kind: TypeAlias = Literal["monotone", "negated", "tangled", "rings"]
KINDS: dict[Kind, str] = {
    "monotone": "& and |",
    "negated": "&, | and ~",
    "tangled": "any conditions",
    "rings": "Chinese rings",
}


@dataclass(frozen=True, slots=True)
class ExplorerJob:
    parts: int
    seed: int
    negated: float
    rule: Rule


@dataclass(frozen=True, slots=True)
class ExplorerResult:
    """Opening of a random box; ``solvable`` is False if a plan refutes it, and None if none decides it."""

    job: ExplorerJob
    run: UnlockingRun
    solvable: bool | None


@dataclass(frozen=True, slots=True)
class PlannerJob:
    kind: Kind
    parts: int
    seed: int


@dataclass(frozen=True, slots=True)
class PlannerResult:
    job: PlannerJob
    verdict: str  # verdict, and number of moves
    moves: int
    wrong: bool  # true if the constraints contradict the plan, or exhaustive search the verdict
    reading: float  # CPU times of reading the interlocks and of planning [s]
    planning: float


def run(progress: Progress, options: Options) -> Report:
    """Open boxes by trends and plan their opening; ``quick`` takes few and small boxes."""
    count = options.count or (QUICK_COUNT if options.quick else COUNT)
    if options.record is not None:
        record_thesis_box(options.record)
    thesis = {rule: run_unlocking(THESIS, rule) for rule in LOCK_RULES}
    explorer_jobs = list_explorer_jobs(count, options.seed, options.quick)
    planner_jobs = list_planner_jobs(count, options.seed, options.quick)
    explored = run_jobs(run_explorer, explorer_jobs, progress, "lockbox", "box", options)
    planned = run_jobs(run_planner, planner_jobs, progress, "lockbox", "plan", options)
    unknown_jobs = unknown_locks.list_unknown_jobs(count, options.seed)
    unknown = run_jobs(unknown_locks.run_unknown, unknown_jobs, progress, "lockbox", "exploration", options)
    return make_lockbox_report(thesis, explored, planned, unknown, options.seed)


def list_explorer_jobs(count: int, seed: int, quick: bool) -> list[ExplorerJob]:
    """Return the random boxes for each rule; the numbers of parts are spread over their range."""
    largest, largest_negated = (15, 10) if quick else (_LARGEST, _LARGEST_NEGATED)
    jobs = [ExplorerJob(_spread(k, largest), seed + k, 0.0, "and") for k in range(count)]
    half = range(math.ceil(count / 2))
    jobs += [ExplorerJob(_spread(k, largest_negated), seed + k, NEGATED, "and") for k in half]
    for rule in LOCK_RULES:
        for parts in _ABLATED[: 1 if quick else None]:
            share = NEGATED if rule == "undemanded" else 0.0
            jobs += [ExplorerJob(parts, seed + k, share, rule) for k in range(math.ceil(count / 10))]
    return jobs


def list_planner_jobs(count: int, seed: int, quick: bool) -> list[PlannerJob]:
    jobs = [PlannerJob("monotone", 10 if quick else 50, seed + k) for k in range(math.ceil(count / 10))]
    jobs += [PlannerJob("negated", 10 if quick else 30, seed + k) for k in range(math.ceil(count / 2))]
    small = range(count if quick else 10 * count)
    jobs += [PlannerJob("tangled", 2 + k % (_SMALL - 1), seed + k) for k in small]
    return jobs + [PlannerJob("rings", n, 0) for n in range(1, 6 if quick else 13)]


def _spread(k: int, largest: int) -> int:
    return 5 + 37 * k % (largest - 4)


def run_explorer(job: ExplorerJob) -> list[ExplorerResult]:
    box = draw_lockbox(job.parts, job.seed, negated=job.negated)
    found = run_unlocking(box, job.rule, 400 + _STEPS_A_PART * job.parts)
    solvable: bool | None = True
    if job.negated and not found.done:
        verdict = plan_unlocking(make_lockbox_model(box, None), box.goal).verdict
        solvable = {"found": True, "refuted": False}.get(verdict)
    return [ExplorerResult(job, found, solvable)]


def run_planner(job: PlannerJob) -> list[PlannerResult]:
    box = _draw(job)
    model = make_lockbox_model(box, None)
    begin = process_time()
    found = interlocks(model)
    read = process_time()
    plan = plan_unlocking(model, box.goal, found=found)
    end = process_time()
    wrong = bool(plan_violations(model, plan))
    if job.kind == "tangled":
        wrong = wrong or (plan.verdict == "found") != unknown_locks.can_be_opened(box)
    if job.kind == "rings":
        wrong = wrong or len(plan.steps) != (2 ** (job.parts + 1) - 1) // 3
    return [PlannerResult(job, plan.verdict, len(plan.steps), wrong, read - begin, end - read)]


def _draw(job: PlannerJob) -> Lockbox:
    if job.kind == "rings":
        return make_rings(job.parts)
    if job.kind == "tangled":
        return draw_tangled_lockbox(job.parts, job.seed)
    return draw_lockbox(job.parts, job.seed, negated=NEGATED if job.kind == "negated" else 0.0)


def make_lockbox_report(
    thesis: dict[Rule, UnlockingRun],
    explored: Sequence[ExplorerResult],
    planned: Sequence[PlannerResult],
    unknown: Sequence[unknown_locks.UnknownLockResult],
    seed: int,
) -> Report:
    groups: dict[tuple[Rule, bool], list[ExplorerResult]] = {}
    for one in explored:
        groups.setdefault((one.job.rule, bool(one.job.negated)), []).append(one)
    plans = {kind: [p for p in planned if p.job.kind == kind] for kind in KINDS}
    ablated: dict[tuple[Rule, int], list[UnlockingRun]] = {}
    for one in explored:
        if one.job.parts in _ABLATED:
            ablated.setdefault((one.job.rule, one.job.parts), []).append(one.run)
    numbers = {
        "seed": seed,
        "thesis": {rule: one.as_data() for rule, one in thesis.items()},
        "explorer": [
            {
                "rule": rule,
                "negated": negated,
                "opened": sum(r.run.done for r in own),
                "of": sum(r.solvable is True for r in own),
                "failed": [(r.job.parts, r.job.seed) for r in own if r.solvable and not r.run.done],
            }
            for (rule, negated), own in groups.items()
        ],
        "planner": [
            {
                "boxes": kind,
                "number": len(own),
                **{v: sum(p.verdict == v for p in own) for v in ("found", "refuted", "undecided")},
                "wrong": [(p.job.parts, p.job.seed) for p in own if p.wrong],
                "planning_s": [p.planning for p in own],
            }
            for kind, own in plans.items()
        ],
        "unknown locks": [
            {
                "boxes": r.job.kind,
                "seed": r.job.seed,
                **{k: getattr(r, k) for k in ("tries", "depth", "breadth")},
            }
            for r in unknown
        ],
    }
    return Report(
        "lockbox",
        "Lockboxes opened by trends, plans of their opening, and unknown locks",
        (
            make_thesis_table("The lockbox of the thesis", "order of the parts", thesis),
            make_explorer_table(groups),
            make_planner_table(plans),
            unknown_locks.make_unknown_table(unknown),
        ),
        numbers,
        Figure(lambda canvas: draw_boxes(canvas, ablated), FIGURE_SIZE),
    )


def make_explorer_table(groups: dict[tuple[Rule, bool], list[ExplorerResult]]) -> ReportTable:
    """Return the table of boxes that a controller opens, by rule of trends and whether locks are negated."""
    rows: list[tuple[float | str, ...]] = []
    for (rule, negated), own in groups.items():
        solvable = [r for r in own if r.solvable]
        steps = [r.run.steps for r in solvable if r.run.done]
        cpu = [1e6 * t for r in solvable for t in r.run.cpu]
        parts, opened = _format_parts(r.job.parts for r in own), f"{len(steps)} of {len(solvable)}"
        medians = (f"{np.median(values):.0f}" if values else "" for values in (steps, cpu))
        rows.append((LOCK_RULES[rule], "&, |, ~" if negated else "&, |", parts, opened, *medians))
    head = ("trends", "locks", "parts", "opened", "steps (median)", "CPU of a step [µs]")
    return ReportTable("Random boxes that can be opened", head, tuple(rows))


def _format_parts(parts: Iterable[int]) -> str:
    numbers = sorted(parts)
    return str(numbers[0]) if numbers[0] == numbers[-1] else f"{numbers[0]} to {numbers[-1]}"


def make_planner_table(plans: dict[Kind, list[PlannerResult]]) -> ReportTable:
    def times(own: list[PlannerResult]) -> list[float]:
        return [1e3 * p.planning for p in own]

    return make_table(
        "Plans, checked by constraints and exhaustive search",
        plans.items(),
        {
            "boxes": lambda pair: KINDS[pair[0]],
            "parts": lambda pair: _format_parts(p.job.parts for p in pair[1]),
            "found": lambda pair: sum(p.verdict == "found" for p in pair[1]),
            "refuted": lambda pair: sum(p.verdict == "refuted" for p in pair[1]),
            "undecided": lambda pair: sum(p.verdict == "undecided" for p in pair[1]),
            "wrong": lambda pair: sum(p.wrong for p in pair[1]),
            "moves (most)": lambda pair: max(p.moves for p in pair[1]),
            "planning [ms]": lambda pair: f"{np.median(times(pair[1])):.3g}",
            "(longest)": lambda pair: f"{max(times(pair[1])):.3g}",
            "reading locks [ms]": lambda pair: f"{np.median([1e3 * p.reading for p in pair[1]]):.3g}",
        },
    )
