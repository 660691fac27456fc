"""Configurations that meet holds and goals: projections of random ones, all lanes at once."""

from __future__ import annotations

import numpy as np

from kineverse.compile.build_queue import working_seconds
from kineverse.lie import Array

from .checker import CollisionChecker
from .connection import unique_rows
from .manifold import EXACT, Manifold

_BATCH = 2048
MOST_BATCHES = 1_000_000
"""Number of batches of a search that only its time ends."""
_IDLE = 8
"""Number of batches without anything new after which there is nothing more to find."""
_APART = 0.05
"""Least distance of two solutions that count as different [rad], [m]."""


def find_solutions(
    checker: CollisionChecker,
    manifold: Manifold,
    near: Array,
    count: int,
    seconds: float,
    seed: int,
    batches: int = MOST_BATCHES,
) -> Array:
    """Return different configurations (K, n) on a manifold, free of collisions, at most some number of them."""
    generator = np.random.default_rng(seed)
    begin = working_seconds()
    lower, upper = checker.lower.astype(float), checker.upper.astype(float)
    found, idle = np.zeros((0, len(near))), 0
    for k in range(batches):
        if k == 0:
            tries = near + generator.standard_normal((_BATCH, len(near))) * (upper - lower) / 8
            tries[0] = near
        else:
            tries = generator.uniform(lower, upper, (_BATCH, len(near)))
        rows = np.ascontiguousarray(np.clip(tries, lower, upper), dtype=np.float32)
        rows = np.ascontiguousarray(rows[manifold.project(rows)])
        rows, before = rows[checker.valid(rows)], len(found)
        if len(rows):
            exact, residuals = manifold.polish(rows[: 4 * count].astype(float))
            inside = (exact >= lower - 1e-9).all(axis=1) & (exact <= upper + 1e-9).all(axis=1)
            exact = exact[inside & (residuals <= EXACT)]
            # Polishing moves them a little.
            free = checker.valid(np.ascontiguousarray(np.clip(exact, lower, upper), dtype=np.float32))
            found = np.vstack([found, exact[free]])
            found = found[unique_rows(found, _APART)]
        idle = 0 if len(found) > before else idle + 1
        if len(found) >= count or (len(found) and idle >= _IDLE) or working_seconds() - begin > seconds:
            break
    return found[np.argsort(np.linalg.norm(found - near, axis=1), kind="stable")][:count]
