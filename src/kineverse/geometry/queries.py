"""Questions about distances of bodies: lower bounds settle what they can, coal the rest."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np

from kineverse.errors import ValueRejectedError

from .mirror import Mirror
from .narrow import ACCURACY, Witness
from .results import Closest
from .sweep_native import sweep_library
from .table import Indices

Choice = Callable[[str, str], bool]


def pair(mirror: Mirror, a: str, b: str) -> Closest:
    """Return how near two bodies are, whatever the rules say."""
    one, other = mirror.number(a), mirror.number(b)
    if one == other:
        raise ValueRejectedError(f"'{a}' is asked for its distance to itself.")
    members, others = mirror.members[one], mirror.members[other]
    mirror.ready((*members, *others))
    nearest = _Nearest(mirror, math.inf)
    if len(members) == len(others) == 1:
        nearest.take(min(members[0], others[0]), max(members[0], others[0]))
    else:
        left, right = np.repeat(members, len(others)), np.tile(others, len(members))
        _take_in_order(nearest, np.minimum(left, right), np.maximum(left, right))
    (found,) = nearest.results()
    return found if found.a == a else found.swapped()


def within(mirror: Mirror, radius: float, choice: Choice | None = None) -> list[Closest]:
    """Return the pairs of bodies within a radius [m], nearest first; only those of ``choice`` if given."""
    _check_radius(radius)
    mirror.ready()
    nearest = _Nearest(mirror, radius)
    for i, j, low in _candidates(mirror, radius, choice):
        nearest.take(i, j, low)
    return nearest.results()


def first(mirror: Mirror, margin: float, choice: Choice | None = None) -> Closest | None:
    """Return the first pair found within a margin [m], in the order of the pieces; None if there is none."""
    _check_radius(margin)
    mirror.ready()
    for i, j, _ in sorted(_candidates(mirror, margin, choice)):
        nearest = _Nearest(mirror, margin)
        nearest.take(i, j)
        if found := nearest.results():
            return found[0]
    return None


def around(mirror: Mirror, body: str, radius: float) -> list[Closest]:
    """Return how near the others are to one body, nearest first."""
    _check_radius(radius)
    one = mirror.number(body)
    mirror.ready()
    table = mirror.table
    others = np.flatnonzero(table.allowed[one][table.body] == 1).astype(np.int32)
    members = np.array(mirror.members[one], dtype=np.int32)
    left, right = np.repeat(members, len(others)), np.tile(others, len(members))
    nearest = _Nearest(mirror, radius)
    _take_in_order(nearest, np.minimum(left, right), np.maximum(left, right), radius)
    return [found if found.a == body else found.swapped() for found in nearest.results()]


def _candidates(mirror: Mirror, radius: float, choice: Choice | None) -> Iterable[tuple[int, int, float]]:
    pairs, lows = sweep_library.near(mirror.table, radius + ACCURACY)
    listed = zip(*pairs.T.tolist(), lows.tolist(), strict=True) if len(lows) else ()
    if choice is None:
        return listed
    body, names = mirror.table.body.tolist(), mirror.bodies
    return [c for c in listed if choice(names[body[c[0]]], names[body[c[1]]])]


def _take_in_order(nearest: _Nearest, ones: Indices, others: Indices, radius: float = math.inf) -> None:
    """Measure pairs of pieces, those first that may be nearest."""
    lows = nearest.mirror.table.lower_bounds(ones, others)
    order = np.argsort(lows, kind="stable")
    order = order[lows[order] <= radius + ACCURACY]
    for i, j, low in zip(ones[order].tolist(), others[order].tolist(), lows[order].tolist(), strict=True):
        nearest.take(i, j, low)


class _Nearest:
    """The nearest pieces of each pair of bodies, within a radius [m]."""

    def __init__(self, mirror: Mirror, radius: float) -> None:
        self.mirror = mirror
        self._radius = radius
        self._body = mirror.table.body.tolist()
        self._found: dict[tuple[int, int], tuple[float, int, int, Witness]] = {}

    def take(self, i: int, j: int, low: float = -math.inf) -> None:
        """Measure two pieces, i < j, unless their bodies are nearer than a lower bound of their distance."""
        key = self._body[i], self._body[j]
        known = self._found.get(key) or self._found.get(key[::-1])
        # Within the accuracy a pair that comes later may still be the nearest.
        if known is not None and low > known[0] + ACCURACY:
            return
        distance, witness = self.mirror.measured(i, j, self._radius)
        if witness is not None and (known is None or (distance, i, j) < known[:3]):
            self._found.pop(key[::-1], None)
            self._found[key] = distance, i, j, witness

    def results(self) -> list[Closest]:
        """Return them, nearest first, then by the order of the bodies."""
        names, pieces = self.mirror.bodies, self.mirror.pieces
        found = []
        for (one, other), (distance, i, j, (point_a, point_b, normal)) in self._found.items():
            if distance > self._radius:
                continue
            answer = Closest(
                names[one],
                names[other],
                distance,
                point_a,
                point_b,
                normal,
                pieces[i].number,
                pieces[j].number,
            )
            order = (distance, min(one, other), max(one, other))
            found.append((order, answer if one < other else answer.swapped()))
        found.sort(key=lambda item: item[0])
        return [answer for _, answer in found]


def _check_radius(radius: float) -> None:
    if not radius >= 0.0:
        raise ValueRejectedError(f"A radius is a distance from 0 on [m], not {radius!r}.")
