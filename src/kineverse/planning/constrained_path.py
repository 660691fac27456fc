"""Paths on a manifold: shortened, and polished in double precision."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from kineverse.lie import Array

from .manifold import EXACT, Manifold
from .obstacles import Floats32
from .search import RrtConnect

DEVIATION = 5e-6
"""Largest residual half way between two points of a polished path [m], [rad]."""
_LEVELS = 6
_PATIENCE = 12
"""Number of tries in a row that may bring nothing."""
_MOST_POINTS = 4000


def shorten_on_manifold(
    search: RrtConnect, points: Floats32, seconds: float, seed: int, rounds: int
) -> Floats32:
    """Return a shorter path: points of it are joined by ways on the manifold.

    Parameters
    ----------
    search
        Search on the manifold.
    points
        Points (N, n) of the path.
    seconds
        Largest time [s].
    seed
        Seed of the choice of points.
    rounds
        Number of tries.
    """
    generator = np.random.default_rng(seed)
    begin = perf_counter()
    failures = 0
    for k in range(rounds):
        if len(points) < 4 or failures > _PATIENCE or perf_counter() - begin > seconds:
            break
        # The whole way first: a path that a straight way replaces needs no other tries.
        i, j = (0, len(points) - 1) if k == 0 else sorted(generator.integers(0, len(points), 2).tolist())
        if j < i + 3:
            continue
        length = float(np.linalg.norm(np.diff(points[i : j + 1], axis=0), axis=1).sum())
        if np.linalg.norm(points[j] - points[i]) > 0.98 * length:
            continue
        way = search.walk(points[i], points[j])
        failures += 1
        if way is None:
            continue
        shortcut = np.vstack([points[i : i + 1], way])
        if np.linalg.norm(np.diff(shortcut, axis=0), axis=1).sum() < 0.98 * length:
            points = np.ascontiguousarray(np.vstack([points[: i + 1], way, points[j + 1 :]]))
            failures = 0
    return points


def polish(manifold: Manifold, points: Array) -> Array | None:
    """Return points in double precision on the manifold, so dense that lines between them keep to it.

    Half way between two of them the residual is at most :data:`DEVIATION`. None if a point does not arrive
    within limits.
    """
    exact, residuals = manifold.polish(points)
    for _ in range(_LEVELS):
        if not (residuals <= EXACT).all():
            return None
        middle = (exact[:-1] + exact[1:]) / 2
        off = np.flatnonzero(manifold.residuals(middle) > DEVIATION)
        if not len(off) or len(exact) > _MOST_POINTS:
            break
        added, more = manifold.polish(middle[off])
        exact = np.insert(exact, off + 1, added, axis=0)
        residuals = np.insert(residuals, off + 1, more)
    return exact
