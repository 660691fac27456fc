"""Rigid bodies: parts that never move against each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from kineverse.model.frame import WORLD

from .fit import SURE
from .pairs import Pair
from .rigid import Array, inverse
from .spanning import path, spanning_tree
from .tracks import Track


@dataclass(frozen=True)
class RigidBody:
    """Parts that do not move against each other.

    Attributes
    ----------
    parts
        The first stands for all of them in edges.
    places
        Their poses in the first, (4, 4), by name.
    probability
        That they are one.
    """

    parts: tuple[str, ...]
    places: Mapping[str, Array]
    probability: float = 1.0

    def __str__(self) -> str:
        words = " = ".join(self.parts)
        return words if self.probability >= SURE else f"{words} ({self.probability:.0%})"


def rigid_bodies(seen: Mapping[str, Track], pairs: Mapping[frozenset[str], Pair]) -> tuple[RigidBody, ...]:
    """Return rigid bodies: parts join while more speaks for it than against it over all pairs."""
    group: dict[str, tuple[str, ...]] = {name: (name,) for name in seen}
    surest = dict.fromkeys(seen, 1.0)
    for joined in sorted(pairs.values(), key=lambda p: -p.rigid):
        a, b = group[joined.parent], group[joined.child]
        if a == b or joined.rigid <= 0.0:
            continue
        across = [pairs[frozenset((x, y))] for x in a for y in b if frozenset((x, y)) in pairs]
        odds = sum(p.rigid for p in across)
        if odds <= 0.0:
            continue
        least = min(joined.found["rigid"].probability, surest[a[0]], surest[b[0]])
        for name in (*a, *b):
            group[name], surest[name] = (*a, *b), least
    result = []
    for parts in dict.fromkeys(group.values()):
        # What was seen most often stands for all, unless it is a point, and the world before everything.
        often = {p: (p == WORLD, not seen[p].is_point, int(seen[p].seen.sum())) for p in parts}
        ordered = sorted(parts, key=lambda p: (*(-n for n in often[p]), list(seen).index(p)))
        places = _places(ordered, pairs, {p for p in parts if seen[p].is_point})
        result.append(RigidBody(tuple(ordered), places, surest[parts[0]]))
    return tuple(result)


def _places(parts: list[str], pairs: Mapping[frozenset[str], Pair], points: set[str]) -> dict[str, Array]:
    """Return the poses of parts in the first, along the pairs that are surest to be rigid."""
    places = {parts[0]: np.eye(4)}
    rigid = {c: p.rigid for c, p in pairs.items() if c <= set(parts)}
    tree = spanning_tree(parts, rigid, points)
    for part in parts[1:]:
        place = np.eye(4)
        for a, b in pairwise(path(tree, parts[0], part)):
            known = pairs[frozenset((a, b))]
            reference = np.asarray(known.found["rigid"].parameters["reference"])
            place = place @ (reference if known.parent == a else inverse(reference))
        places[part] = place
    return places
