"""Fewer hulls: those within another are left out, and those that lose least by it are joined."""

from __future__ import annotations

import numpy as np

from kineverse.errors import ValueRejectedError
from kineverse.geometry.mesh_files import Floats

from .accuracy import Polytope, nearest

# A hull that stands out of another by less than this part of its size is inside of it.
_INSIDE = 1e-9


def polytopes(hulls: list[Floats], whole: Polytope) -> list[Polytope]:
    """Return the hulls of sets of points, without those that span nothing and those inside of another one.

    What stands out of the hull of the whole mesh is taken back onto it: where CoACD has wrapped a surface, it
    is a little larger all around.
    """
    found = []
    for points in hulls:
        try:
            found.append(Polytope.of(_within(points, whole)))
        except ValueRejectedError:  # A splinter: a cut has come upon a point or an edge.
            continue
    found.sort(key=lambda polytope: -polytope.volume)
    kept: list[Polytope] = []
    for polytope in found:
        room = _INSIDE * np.ptp(polytope.points, axis=0).max()
        if not any((larger.outside(polytope.points) <= room).all() for larger in kept):
            kept.append(polytope)
    return kept


def _within(points: Floats, whole: Polytope) -> Floats:
    points = points.copy()
    beyond = whole.outside(points) > 0.0
    points[beyond] = nearest(whole.engine, points[beyond])[1]
    return points


def at_most(hulls: list[Polytope], count: int) -> list[Polytope]:
    """Join hulls until there are at most so many: always the two whose common hull adds least volume."""
    hulls = list(hulls)
    joined = (
        {(i, j): _joined(hulls[i], hulls[j]) for j in range(len(hulls)) for i in range(j)}
        if len(hulls) > count
        else {}
    )
    alive = dict(enumerate(hulls))
    while len(alive) > count:
        (i, j), (_, one) = min(joined.items(), key=lambda item: (item[1][0], item[0]))
        new = max(alive) + 1
        del alive[i], alive[j]
        joined = {pair: value for pair, value in joined.items() if not {i, j} & set(pair)}
        joined |= {(k, new): _joined(other, one) for k, other in alive.items()}
        alive[new] = one
    return list(alive.values())


def _joined(one: Polytope, other: Polytope) -> tuple[float, Polytope]:
    """Return the volume that joining two hulls adds [m³], and what they become."""
    both = Polytope.of(np.concatenate([one.points, other.points]))
    return both.volume - one.volume - other.volume, both
