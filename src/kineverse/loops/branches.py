"""Solution branches of a loop at one configuration, and their continuation along the inputs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.lie import Array

from .equations import CLOSURE_TOLERANCE, Equations, least_squares

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
    """Search solutions from several starts; return them, the nearest first, and the smallest residual.

    Of those that are equally near, the one with the largest first unknown that differs comes first.
    """
    # Equal starts in every process, so that branches have equal numbers everywhere.
    generator = np.random.default_rng(0)
    starts = [near, *(near + generator.uniform(-1, 1, (_TRIES, len(near))) * reach)]
    result: list[Array] = []
    smallest = np.inf
    for start in starts:
        x, gap = equations.close(start, u, 60)
        if gap <= CLOSURE_TOLERANCE and upright is not None:
            gap = gap if np.all(upright(np.concatenate([x, u])) > 0) else np.pi
        smallest = min(smallest, gap)
        if gap > CLOSURE_TOLERANCE:
            continue
        turns = np.where(angles, np.round((x - near) / (2 * np.pi)), 0.0)
        x = x - 2 * np.pi * turns
        if all(_distance(x, other, angles) > _SAME for other in result):
            result.append(x)
    if result:
        # Mirror images are equally near, and rounding, which processors do differently, must not number them.
        keys = [np.linalg.norm(np.array(result) - near, axis=1), *-np.array(result).T]
        order = np.lexsort([_rank_distinct(key) for key in reversed(keys)])
        result = [result[k] for k in order]
    return result, float(smallest)


def _rank_distinct(values: Array) -> npt.NDArray[np.intp]:
    """Return the ranks of values (n,), equal ones for those that differ by no more than rounding."""
    order = np.argsort(values)
    ranks = np.empty(len(values), dtype=np.intp)
    ranks[order] = np.concatenate([[0], np.cumsum(np.diff(values[order]) > _SAME)])
    return ranks


def find_nearest_closed(equations: Equations, near: Array, u: Array) -> tuple[Array, float]:
    """Return a solution near a point and its residual, from starts at growing distance.

    At zero coordinates the bars are often collinear, and the residual has no descent direction.
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
FIRST_STEP = 1 / 16  # first step of a continuation, as a fraction of the line
_LITTLE = 0.5  # relative change of ∂r/∂x over a whole line up to which its end is on the same branch


@dataclass(frozen=True)
class ContinuationResult:
    """Result of a continuation."""

    solution: Array  # unknowns at the last point
    part: float  # completed fraction of the path


def continue_solution(
    equations: Equations, x: Array, start: Array, end: Array, first_step: float = FIRST_STEP
) -> ContinuationResult:
    """Continue a solution along a straight line of inputs.

    Each step has a predictor along the tangent and a Newton corrector. It is accepted if the correction is
    small relative to the step, so that it stays on the branch. Where two branches come close to each other,
    the other one lies along the tangent, so that a whole line is accepted only if ∂r/∂x changes little.
    """
    direction = end - start
    done, step = 0.0, first_step
    _, by_x, by_u = equations(x, start)
    if not direction.any():
        return ContinuationResult(x, 1.0)
    while done < 1.0:
        step = min(step, 1.0 - done)
        tangent = -least_squares(by_x, by_u @ direction)
        predicted = x + step * tangent
        u = start + (done + step) * direction
        result, gap = equations.close(predicted, u, 8)
        moved = float(np.linalg.norm(result - x))
        wrong = float(np.linalg.norm(result - predicted))
        near = gap < CLOSURE_TOLERANCE and wrong <= 0.1 * max(moved, 1e-6) + 1e-9
        # Near a singularity the tangent is unreliable, but such short steps stay on the branch.
        if near or (step <= _SHORTEST and gap < CLOSURE_TOLERANCE and wrong < 0.05):
            _, next_by_x, next_by_u = equations(result, u)
            # Below a norm of 1, nothing between the two is singular.
            change = least_squares(by_x, next_by_x - by_x) if step == 1.0 else np.zeros(1)
            if np.linalg.norm(change) > _LITTLE:
                step = FIRST_STEP
                continue
            x, done, by_x, by_u = result, done + step, next_by_x, next_by_u
            step *= 2 if near else 1
        elif step > _SHORTEST:
            step /= 2
        else:
            return ContinuationResult(x, done)
    return ContinuationResult(x, 1.0)
