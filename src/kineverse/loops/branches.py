"""All the ways in which a loop closes at one configuration of its inputs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from .equations import CLOSED, Array, Equations

_TRIES = 60
_SAME = 1e-4


def find_branches(
    equations: Equations,
    near: Array,
    u: Array,
    angles: npt.NDArray[np.bool_],
    reach: Array,
    upright: Callable[[Array], Array] | None = None,
) -> tuple[list[Array], float]:
    """Return the solutions that were found, the nearest first, and the smallest gap of all attempts.

    Parameters
    ----------
    equations
        The loop.
    near
        Where to look first; solutions are sorted by their distance from it.
    u
        The inputs.
    angles
        Which unknowns are angles; solutions that differ by whole turns are one, the nearest to ``near``.
    reach
        How far from ``near`` to look, for each unknown.
    upright
        Numbers at unknowns and inputs that are positive in a solution that counts; elsewhere the ends are
        half a turn apart.
    """
    # The same attempts in every process: which branch is which has to be the same everywhere.
    generator = np.random.default_rng(0)
    starts = [near, *(near + generator.uniform(-1, 1, (_TRIES, len(near))) * reach)]
    found: list[Array] = []
    smallest = np.inf
    for start in starts:
        x, gap = equations.close(start, u, 60)
        if gap <= CLOSED and upright is not None and not np.all(upright(np.concatenate([x, u])) > 0):
            gap = np.pi
        smallest = min(smallest, gap)
        if gap > CLOSED:
            continue
        turns = np.where(angles, np.round((x - near) / (2 * np.pi)), 0.0)
        x = x - 2 * np.pi * turns
        if all(_distance(x, other, angles) > _SAME for other in found):
            found.append(x)
    found.sort(key=lambda x: (float(np.linalg.norm(x - near)), x.tolist()))
    return found, float(smallest)


def nearest_closed(equations: Equations, near: Array, u: Array) -> tuple[Array, float]:
    """Return a solution near a point, and what is left of the residual, looking further and further away.

    Where every coordinate is zero, all bars often lie in one line, and no direction leads downhill.
    """
    generator = np.random.default_rng(0)
    best, smallest = equations.close(near, u, 100)
    for scale in (0.03, 0.1, 0.3, 1.0, 3.0):
        for _ in range(8):
            if smallest < CLOSED:
                return best, smallest
            x, gap = equations.close(near + scale * generator.uniform(-1, 1, len(near)), u, 100)
            if gap < smallest:
                best, smallest = x, gap
    return best, smallest


def _distance(a: Array, b: Array, angles: npt.NDArray[np.bool_]) -> float:
    d = a - b
    d = np.where(angles, (d + np.pi) % (2 * np.pi) - np.pi, d)
    return float(np.abs(d).max())
