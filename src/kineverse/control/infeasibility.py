"""Reasons of infeasibility, and the points that come closest to feasible ones.

The rows are those of a quadratic program, ``lower <= [x; A x] <= upper`` (:mod:`.quadratic_program`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kineverse.errors import InvalidValueError, ShapeError

from .qp_solver import Vector
from .quadratic_program import make_solver


class Conflict(NamedTuple):
    """One member of a set of contradictory constraints."""

    name: str  # name of the constraint
    operations: tuple[str, ...]  # operations of the model that wrote it
    lower: float  # bounds that take part; infinite where that side does not
    upper: float


class ConflictingBound(NamedTuple):
    """One bound of a conflict of rows."""

    row: int  # index of the row in [x; A x]
    side: int  # -1 for its lower bound, 1 for its upper one


class LeastViolation(NamedTuple):
    """The point that violates the soft rows least."""

    x: Vector  # point, of shape (n,)
    violations: Vector  # violations of [x
    hard_rows_hold: bool  # whether the hard rows are satisfied


def find_irreducible_conflict(
    A: ArrayLike, lower: ArrayLike, upper: ArrayLike
) -> tuple[ConflictingBound, ...]:
    """Find bounds that contradict each other, none of which can be left out.

    These are an irreducible infeasible subset: with all of its bounds there is no x, without any one of them
    there is. Violations y >= 0 at the point that violates ``G x <= h`` least certify by Farkas' lemma that
    there is none: ``G'y = 0`` and ``h'y < 0``. A certificate that no other one has part of is such a subset
    (Gleeson and Ryan 1990, "Identifying minimally infeasible subsystems of inequalities"). Where rounding
    blurs it, one bound after the other is left out instead (Chinneck and Dravnieks 1991, "Locating minimal
    infeasible constraint sets in linear programs"). A row with ``lower > upper`` comes first.
    """
    rows, low, high = _stacked(A, lower, upper)
    gap = low - high
    worst = int(np.argmax(gap))
    if gap[worst] > 0.0:
        return ConflictingBound(worst, -1), ConflictingBound(worst, 1)
    # One-sided rows g x <= h of length 1: first the upper bounds, then the lower ones.
    length = np.sqrt(np.einsum("ij,ij->i", rows, rows))
    unit = 1.0 / np.where(length > _SHORTEST, length, 1.0)
    g = np.concatenate([rows, -rows]) * np.tile(unit, 2)[:, None]
    h = np.concatenate([high, -low]) * np.tile(unit, 2)
    kept = np.flatnonzero(h < np.inf)
    violations = _violations(g[kept], h[kept])
    kept, violations = kept[violations > 0.0], violations[violations > 0.0]
    minimal, clear = _minimal_certificate(g[kept], h[kept], violations)
    if clear and _infeasible(g[kept[minimal]], h[kept[minimal]]):
        kept = kept[minimal]
    else:
        if not _infeasible(g[kept], h[kept]):
            kept = np.flatnonzero(h < np.inf)
            if not _infeasible(g, h):
                return ()
        for one in kept:
            rest = kept[kept != one]
            if _infeasible(g[rest], h[rest]):
                kept = rest
    count = len(rows)
    return tuple(
        ConflictingBound(int(i % count), 1 if i < count else -1)
        for i in sorted(kept, key=lambda i: (i % count, i < count))
    )


def find_least_violation(
    A: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    *,
    hard: ArrayLike | None = None,
    near: ArrayLike | None = None,
) -> LeastViolation:
    """Find the point whose violations have the smallest sum of squares, within the hard rows."""
    rows, low, high = _stacked(A, lower, upper)
    n = rows.shape[1]
    held = np.zeros(len(rows), bool) if hard is None else np.asarray(hard, bool)
    close = np.zeros(n) if near is None else np.ascontiguousarray(near, float)
    if held.shape != low.shape:
        raise ShapeError(
            f"hard has the shape {held.shape}, not {low.shape}: one entry per bound of [x; A x]."
        )
    if close.shape != (n,) or not np.isfinite(close).all():
        raise InvalidValueError(f"near is a point of shape ({n},) without NaN, not {close}.")
    crossed = np.flatnonzero(low > high)
    # Both bounds of a crossed row count, each as a row of its own.
    g = np.concatenate([rows, rows[crossed]])
    below, above = np.append(low, np.full(len(crossed), -np.inf)), np.append(high, high[crossed])
    above[crossed] = np.inf
    firm = np.append(held, held[crossed])
    x = _least_squares(g, below, above, ~firm, np.full(len(g), _WEIGHT), close)
    holds = x is not None
    if x is None:
        weight = np.where(firm, _WEIGHT * _HARD_WEIGHT, _WEIGHT)
        x = _least_squares(g, below, above, np.ones(len(g), bool), weight, close)
    if x is None:  # no soft problem is infeasible, so the numbers are out of reach for the solver
        x, holds = close, False
    values = rows @ x
    under, over = np.maximum(low - values, 0.0), np.maximum(values - high, 0.0)
    return LeastViolation(x, np.where(over >= under, over, -under), holds)


_WEIGHT = 1e6
"""The weight of squared violations beside the squared distance from the point to be near to."""
_HARD_WEIGHT = 1e4
_SHORTEST = 1e-12


def _stacked(A: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> tuple[Vector, Vector, Vector]:
    """Return the rows [I; A] and their bounds, checked."""
    a, low, high = (np.asarray(value, float) for value in (A, lower, upper))
    if a.ndim != 2 or a.shape[1] < 1 or low.shape != (sum(a.shape),) or high.shape != low.shape:
        raise ShapeError(
            f"A is of shape (m, n) and its bounds of shape (n + m,), "
            f"not {a.shape}, {low.shape} and {high.shape}."
        )
    if not np.isfinite(a).all() or np.isnan(low).any() or np.isnan(high).any():
        raise InvalidValueError("A is finite, and bounds are numbers or infinite: there is a NaN.")
    return np.concatenate([np.eye(a.shape[1]), a]), low, high


def _violations(g: Vector, h: Vector) -> Vector:
    """Return the violations of ``g x <= h`` at the point of least violation, 0 where they are rounding."""
    count, n = g.shape
    x = _least_squares(g, np.full(count, -np.inf), h, np.ones(count, bool), np.full(count, 1e8), np.zeros(n))
    if x is None:
        return np.ones(count)
    y = np.maximum(g @ x - h, 0.0)
    return np.where(y > 1e-9 * y.max(initial=0.0), y, 0.0)


def _minimal_certificate(g: Vector, h: Vector, y: Vector) -> tuple[NDArray[np.intp], bool]:
    """Reduce a certificate y > 0 of infeasible ``g x <= h`` to a vertex of ``{y >= 0, g'y = 0, h'y = -1}``."""
    alive = np.arange(len(y))
    if not len(y):
        return alive, False
    _, singular, basis = np.linalg.svd(g.T)
    rank = int(np.sum(singular > 1e-10 * max(1.0, singular.max(initial=0.0))))
    kernel = basis[rank:].T
    y = kernel @ (kernel.T @ y)
    slope = kernel.T @ h
    if len(slope) == 0 or not h @ y < 0.0:
        return alive, False
    # Certificates of the same h'y differ by these directions, along which rows leave one by one.
    moves = kernel @ np.linalg.svd(slope[None, :])[2][1:].T
    while moves.shape[1]:
        move = moves[:, 0] if moves[:, 0].max() >= -moves[:, 0].min() else -moves[:, 0]
        falling = np.flatnonzero(move > 1e-9 * move.max())
        leaving = falling[np.argmin(y[falling] / move[falling])]
        y = y - y[leaving] / move[leaving] * move
        column = int(np.argmax(np.abs(moves[leaving])))
        pivot = moves[:, column] / moves[leaving, column]
        moves = np.delete(moves - np.outer(pivot, moves[leaving]), column, axis=1)
        alive, y, moves = np.delete(alive, leaving), np.delete(y, leaving), np.delete(moves, leaving, axis=0)
    needed = y > 1e-7 * y.max(initial=0.0)
    return alive[needed], bool((np.abs(y[~needed]) < 1e-9 * y.max(initial=0.0)).all())


def _infeasible(g: Vector, h: Vector) -> bool:
    """Return whether no x satisfies ``g x <= h``."""
    if not len(g):
        return False
    n, none = g.shape[1], np.full(len(g), -np.inf)
    return _least_squares(g, none, h, np.zeros(len(g), bool), np.ones(len(g)), np.zeros(n)) is None


def _least_squares(
    g: Vector, lower: Vector, upper: Vector, soft: NDArray[np.bool_], weight: Vector, near: Vector
) -> Vector | None:
    """Return the point closest to another one, subject to rows, some of them soft."""
    count, n = g.shape
    free = np.zeros(n, bool)
    solver = make_solver(
        "daqp",
        n,
        count,
        soft=np.concatenate([free, soft]),
        soft_weight=np.concatenate([np.ones(n), weight]),
    )
    no_bound = np.full(n, np.inf)
    solution = solver.solve(
        np.eye(n),
        -near,
        np.ascontiguousarray(g),
        np.concatenate([-no_bound, lower]),
        np.concatenate([no_bound, upper]),
    )
    return solution.x if solution.status == "solved" else None
