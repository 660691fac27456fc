"""Following one solution of a loop while its inputs move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .equations import CLOSED, Array, Equations

_SHORTEST = 1e-5
_FIRST = 1 / 16


@dataclass(frozen=True)
class Reached:
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


def follow(equations: Equations, x: Array, start: Array, end: Array) -> Reached:
    """Follow a solution along a straight line of inputs.

    Each step predicts along the tangent and corrects; it counts if the correction is small beside the step,
    so that it cannot have fallen on another branch.
    """
    way = end - start
    done, step = 0.0, _FIRST
    _, by_x, by_u = equations(x, start)
    if not way.any():
        return Reached(x, 1.0)
    while done < 1.0:
        step = min(step, 1.0 - done)
        tangent = -np.linalg.lstsq(by_x, by_u @ way, rcond=1e-12)[0]
        predicted = x + step * tangent
        u = start + (done + step) * way
        found, gap = equations.close(predicted, u, 8)
        moved = float(np.linalg.norm(found - x))
        wrong = float(np.linalg.norm(found - predicted))
        if gap < CLOSED and wrong <= 0.1 * max(moved, 1e-6) + 1e-9:
            x, done = found, done + step
            _, by_x, by_u = equations(x, u)
            step *= 2
        elif step > _SHORTEST:
            step /= 2
        elif gap < CLOSED and wrong < 0.05:
            # Beside a singularity the tangent says little; steps this short cannot jump far.
            x, done = found, done + step
            _, by_x, by_u = equations(x, u)
        else:
            return Reached(x, done)
    return Reached(x, 1.0)
