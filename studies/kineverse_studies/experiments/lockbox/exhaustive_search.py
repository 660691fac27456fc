"""Exhaustive search on the data of a lockbox, without its model and without the planner's code."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

from kineverse.gallery.lockboxes import Lockbox, Slider


def can_be_opened(box: Lockbox) -> bool:
    """Return whether a box can be opened, by search over all positions between the thresholds."""
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
    """Return a position between each two thresholds of a part, and its limits."""
    conditions = (c for part in box.parts.values() for group in part.groups for c in group)
    cuts = sorted({c.threshold for c in conditions if c.part == name})
    return [0.0, *((a + b) / 2 for a, b in pairwise(cuts)), box.parts[name].upper]


def is_open(state: Mapping[str, float], part: Slider) -> bool:
    """Return whether the lock of a part is open where the parts are."""
    return all(any((state[c.part] > c.threshold) == c.beyond for c in group) for group in part.groups)
