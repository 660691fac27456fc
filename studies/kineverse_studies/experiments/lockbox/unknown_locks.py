"""Boxes whose locks are unknown: numbers of tries by hypotheses, and by systematic search."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from kineverse.gallery.lockboxes import THESIS, Lockbox, draw_lockbox, make_lockbox_model, remove_locks
from kineverse.manipulation import explore_locks
from kineverse_studies.experiments.report import ReportTable

from .exhaustive_search import can_be_opened
from .systematic_search import LockboxTrials, count_systematic_tries, permute_parts

_PARTS = 6
_NEGATED = 0.25
_MOST = 500

UnknownKind: TypeAlias = Literal["published", "thesis", "monotone", "negated"]
UNKNOWN_KINDS: dict[UnknownKind, str] = {
    "published": "thesis, parts a to f",
    "thesis": "thesis, parts in any order",
    "monotone": "& and |",
    "negated": "&, | and ~",
}


@dataclass(frozen=True, slots=True)
class UnknownLockJob:
    """Box whose locks are unknown."""

    kind: UnknownKind
    seed: int


@dataclass(frozen=True, slots=True)
class UnknownLockResult:
    """Numbers of tries until a box is open, None if it is not: by hypotheses, depth first, breadth first."""

    job: UnknownLockJob
    tries: int | None
    depth: int | None
    breadth: int | None


def list_unknown_jobs(count: int, seed: int) -> list[UnknownLockJob]:
    """Return the boxes to explore, a tenth of the boxes without negations for each kind."""
    return [UnknownLockJob(kind, seed + k) for kind in UNKNOWN_KINDS for k in range(math.ceil(count / 10))]


def run_unknown(job: UnknownLockJob) -> list[UnknownLockResult]:
    """Open one box whose locks are unknown; a box that cannot be opened has no result."""
    box = _draw_unknown(job)
    if not can_be_opened(box):
        return []
    model, trials = make_lockbox_model(remove_locks(box), None), LockboxTrials(box)
    done = explore_locks(model, box.goal, lambda s, x: trials.move(str(s), x), most=_MOST, seed=job.seed)
    depth, breadth = count_systematic_tries(box), count_systematic_tries(box, "breadth")
    return [UnknownLockResult(job, trials.tries if done else None, depth, breadth)]


def _draw_unknown(job: UnknownLockJob) -> Lockbox:
    if job.kind == "published":
        return THESIS
    if job.kind == "thesis":
        return permute_parts(THESIS, job.seed)
    negated = _NEGATED if job.kind == "negated" else 0.0
    return permute_parts(draw_lockbox(_PARTS, job.seed, negated=negated), job.seed)


def make_unknown_table(results: Sequence[UnknownLockResult]) -> ReportTable:
    """Return the table of the mean numbers of tries."""
    rows: list[tuple[float | str, ...]] = []
    for kind, name in UNKNOWN_KINDS.items():
        own = [r for r in results if r.job.kind == kind]
        tries = [r.tries for r in own if r.tries is not None]
        rows.append(
            (
                name,
                f"{len(tries)} of {len(own)}",
                _mean(tries),
                max(tries, default=""),
                _mean([r.depth for r in own]),
                _mean([r.breadth for r in own]),
            )
        )
    head = ("boxes", "opened", "tries (mean)", "(most)", "systematic, depth first", "breadth first")
    return ReportTable(f"Unknown locks, {_PARTS} parts", head, tuple(rows))


def list_unknown_numbers(results: Sequence[UnknownLockResult]) -> list[dict[str, Any]]:
    """Return the results as data for JSON."""
    return [
        {"boxes": r.job.kind, "seed": r.job.seed, "tries": r.tries, "depth": r.depth, "breadth": r.breadth}
        for r in results
    ]


def _mean(tries: Sequence[int | None]) -> str:
    found = [n for n in tries if n is not None]
    return f"{np.mean(found):.1f}" if found else ""
