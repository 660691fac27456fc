"""Systematic search in a box whose locks are unknown: all parts are tried at all combinations of ends."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np

from kineverse.gallery.lockboxes import Lockbox

from .exhaustive_search import is_open

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
    """Return the fewest known moves to each combination that they lead to, nearest first."""
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
