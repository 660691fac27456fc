"""Boxes whose locks are unknown: numbers of tries by hypotheses, and by systematic and exhaustive search."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np

from kineverse.gallery.lockboxes import (
    THESIS,
    Lockbox,
    Slider,
    draw_lockbox,
    make_lockbox_model,
    remove_locks,
)
from kineverse.manipulation import explore_locks
from kineverse_studies.experiments.report import ReportTable


def can_be_opened(box: Lockbox) -> bool:
    places = {name: _places(box, name) for name in box.parts}
    names = list(places)
    start = (0,) * len(names)
    seen, waiting = {start}, [start]
    while waiting:
        here = waiting.pop()
        state = {name: places[name][k] for name, k in zip(names, here, strict=True)}
        if all(state[name] == value for name, value in box.goal.items()):
            return True
        for n, name in enumerate(names):
            part = box.parts[name]
            free = is_open(state, part)
            for way in (1, -1):
                after = (*here[:n], here[n] + way, *here[n + 1 :])
                inside = 0 <= after[n] < len(places[name])
                if inside and (free or (way < 0 and part.blocks == "forward")) and after not in seen:
                    seen.add(after)
                    waiting.append(after)
    return False


def _places(box: Lockbox, name: str) -> list[float]:
    conditions = (c for part in box.parts.values() for group in part.groups for c in group)
    cuts = sorted({c.threshold for c in conditions if c.part == name})
    return [0.0, *((a + b) / 2 for a, b in pairwise(cuts)), box.parts[name].upper]


def is_open(state: Mapping[str, float], part: Slider) -> bool:
    return all(any((state[c.part] > c.threshold) == c.beyond for c in group) for group in part.groups)


Order: TypeAlias = Literal["depth", "breadth"]
Combination: TypeAlias = tuple[bool, ...]


class LockboxTrials:
    """Box whose parts are moved from end to end, and the number of tries."""

    def __init__(self, box: Lockbox) -> None:
        self.box, self.tries = box, 0
        self.positions = dict.fromkeys(box.parts, 0.0)

    def move(self, name: str, target: float) -> float:
        """Try to move a part to a position, and return where it is."""
        part, here = self.box.parts[name], self.positions[name]
        self.tries += 1
        if is_open(self.positions, part) or (target < here and part.blocks == "forward"):
            self.positions[name] = target
        return self.positions[name]


def count_systematic_tries(box: Lockbox, order: Order = "depth", most: int = 100_000) -> int | None:
    """Return the number of tries until a box is open, None if it is not after the largest number.

    At each combination of ends, the parts are tried in the order of the box. Depth first, the search goes
    on from the nearest combination where something is left to try, which is the new one; breadth first from
    the one that was found first. The ways there consist of known moves, and count as tries.
    """
    trials, names = LockboxTrials(box), list(box.parts)
    uppers = [box.parts[name].upper for name in names]
    here: Combination = (False,) * len(names)
    # For each combination the parts that are still to be tried, and those that moved.
    untried = {here: list(range(len(names)))}
    moves: dict[Combination, list[int]] = {here: []}
    while trials.tries < most:
        if all(trials.positions[name] == value for name, value in box.goal.items()):
            return trials.tries
        ways = _find_ways(here, moves)
        # Combinations are in the order in which they were found, ways in that of their length.
        found = next(
            (one for one in (ways if order == "depth" else untried) if untried[one] and one in ways), None
        )
        if found is None:
            return None
        for k in ways[found]:
            trials.move(names[k], 0.0 if here[k] else uppers[k])
            here = _flip(here, k)
        k = untried[here].pop(0)
        target = 0.0 if here[k] else uppers[k]
        if trials.move(names[k], target) == target:
            moves[here].append(k)
            here = _flip(here, k)
            if here not in untried:
                untried[here], moves[here] = list(range(len(names))), []
    return None


def _flip(combination: Combination, k: int) -> Combination:
    return (*combination[:k], not combination[k], *combination[k + 1 :])


def _find_ways(start: Combination, moves: dict[Combination, list[int]]) -> dict[Combination, list[int]]:
    ways: dict[Combination, list[int]] = {start: []}
    waiting = deque([start])
    while waiting:
        here = waiting.popleft()
        for k in moves[here]:
            there = _flip(here, k)
            if there not in ways:
                ways[there] = [*ways[here], k]
                waiting.append(there)
    return ways


def permute_parts(box: Lockbox, seed: int) -> Lockbox:
    """Return a box whose parts have changed their names, and with them their order."""
    names = list(box.parts)
    renamed = dict(zip(names, np.random.default_rng(seed).permutation(names).tolist(), strict=True))
    parts = {
        renamed[name]: replace(
            part,
            groups=tuple(tuple(c._replace(part=renamed[c.part]) for c in group) for group in part.groups),
        )
        for name, part in box.parts.items()
    }
    return Lockbox(
        {name: parts[name] for name in names}, {renamed[name]: value for name, value in box.goal.items()}
    )


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
    rows: list[tuple[float | str, ...]] = []
    for kind, name in UNKNOWN_KINDS.items():
        own = [r for r in results if r.job.kind == kind]
        tries = [r.tries for r in own if r.tries is not None]
        most = max(tries, default="")
        systematic = _mean([r.depth for r in own]), _mean([r.breadth for r in own])
        rows.append((name, f"{len(tries)} of {len(own)}", _mean(tries), most, *systematic))
    head = ("boxes", "opened", "tries (mean)", "(most)", "systematic, depth first", "breadth first")
    return ReportTable(f"Unknown locks, {_PARTS} parts", head, tuple(rows))


def _mean(tries: Sequence[int | None]) -> str:
    found = [n for n in tries if n is not None]
    return f"{np.mean(found):.1f}" if found else ""
