"""Solution branches of a loop at one configuration, and their continuation along the inputs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .equations import CLOSURE_TOLERANCE, Array, Equations

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
        if (
            gap <= CLOSURE_TOLERANCE
            and upright is not None
            and not np.all(upright(np.concatenate([x, u])) > 0)
        ):
            gap = np.pi
        smallest = min(smallest, gap)
        if gap > CLOSURE_TOLERANCE:
            continue
        turns = np.where(angles, np.round((x - near) / (2 * np.pi)), 0.0)
        x = x - 2 * np.pi * turns
        if all(_distance(x, other, angles) > _SAME for other in found):
            found.append(x)
    found.sort(key=lambda x: (float(np.linalg.norm(x - near)), x.tolist()))
    return found, float(smallest)


def find_nearest_closed(equations: Equations, near: Array, u: Array) -> tuple[Array, float]:
    """Return a solution near a point, and what is left of the residual, looking further and further away.

    Where every coordinate is zero, all bars often lie in one line, and no direction leads downhill.
    """
    generator = np.random.default_rng(0)
    best, smallest = equations.close(near, u, 100)
    for scale in (0.03, 0.1, 0.3, 1.0, 3.0):
        for _ in range(8):
            if smallest < CLOSURE_TOLERANCE:
                return best, smallest
            x, gap = equations.close(near + scale * generator.uniform(-1, 1, len(near)), u, 100)
            if gap < smallest:
                best, smallest = x, gap
    return best, smallest


def _distance(a: Array, b: Array, angles: npt.NDArray[np.bool_]) -> float:
    d = a - b
    d = np.where(angles, (d + np.pi) % (2 * np.pi) - np.pi, d)
    return float(np.abs(d).max())


_SHORTEST = 1e-5
_FIRST = 1 / 16


@dataclass(frozen=True)
class ContinuationResult:
    """How far a solution could be followed.

    Attributes
    ----------
    solution
        The unknowns there.
    part
        The part of the way that was made, 1 for all of it.
    """

    solution: Array
    part: float


def continue_solution(equations: Equations, x: Array, start: Array, end: Array) -> ContinuationResult:
    """Follow a solution along a straight line of inputs.

    Each step predicts along the tangent and corrects; it counts if the correction is small beside the step,
    so that it cannot have fallen on another branch.
    """
    way = end - start
    done, step = 0.0, _FIRST
    _, by_x, by_u = equations(x, start)
    if not way.any():
        return ContinuationResult(x, 1.0)
    while done < 1.0:
        step = min(step, 1.0 - done)
        tangent = -np.linalg.lstsq(by_x, by_u @ way, rcond=1e-12)[0]
        predicted = x + step * tangent
        u = start + (done + step) * way
        found, gap = equations.close(predicted, u, 8)
        moved = float(np.linalg.norm(found - x))
        wrong = float(np.linalg.norm(found - predicted))
        if gap < CLOSURE_TOLERANCE and wrong <= 0.1 * max(moved, 1e-6) + 1e-9:
            x, done = found, done + step
            _, by_x, by_u = equations(x, u)
            step *= 2
        elif step > _SHORTEST:
            step /= 2
        elif gap < CLOSURE_TOLERANCE and wrong < 0.05:
            # Beside a singularity the tangent says little; steps this short cannot jump far.
            x, done = found, done + step
            _, by_x, by_u = equations(x, u)
        else:
            return ContinuationResult(x, done)
    return ContinuationResult(x, 1.0)
