"""Reasons for steps without a command: conflicting constraints, values that are not finite.

The rows are those of a quadratic program, ``lower <= [x; A x] <= upper`` (:mod:`.qp`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kineverse.compilation import compile
from kineverse.compilation.evaluator import Evaluator
from kineverse.errors import InfeasibleError, InvalidValueError, NotFiniteError, ShapeError
from kineverse.model.model_view import ModelView

from .command import Command, name_contact
from .formulation import Formulation
from .qp import QpSolver, Vector
from .velocity_program import VelocityProgram

if TYPE_CHECKING:
    from .contact_constraints import ContactSlots

_WEIGHT = 1e6  # weight of squared violations, relative to the squared distance from the point to be near to
_HARD_WEIGHT = 1e4
_SHORTEST = 1e-12


class Conflict(NamedTuple):
    """Member of a set of contradictory constraints."""

    name: str
    operations: tuple[str, ...]  # of the model, which wrote the constraint
    lower: float  # bounds that take part; infinite where that side does not
    upper: float


class ConflictingBound(NamedTuple):
    """Bound in a conflict of rows."""

    row: int  # index of the row in [x; A x]
    side: int  # -1 for its lower bound, 1 for its upper one


class LeastViolation(NamedTuple):
    """Point that violates the soft rows least.

    If the hard rows contradict each other, they are violated little, and the soft ones count for nothing.
    """

    x: Vector  # (n,)
    violations: Vector  # (n + m,), of [x; A x]: negative below the lower bound, positive above the upper one
    hard_rows_hold: bool


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
    """Find the point whose violations have the smallest sum of squares, within the hard rows.

    ``hard`` is a mask (n + m,); of the points that violate equally, the nearest to ``near`` (n,) is taken.
    """
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
    """Reduce a certificate y > 0 of ``g x <= h`` to a vertex of ``{y >= 0, g'y = 0, h'y = -1}``."""
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
    solver = QpSolver(
        n, count, soft=np.concatenate([free, soft]), soft_weight=np.concatenate([np.ones(n), weight])
    )
    no_bound = np.full(n, np.inf)
    low, high = np.concatenate([-no_bound, lower]), np.concatenate([no_bound, upper])
    solution = solver.solve(np.eye(n), -near, np.ascontiguousarray(g), low, high)
    return solution.x if solution.status == "solved" else None


class Diagnosis:
    """Reasons why the last evaluation of a program has no solution."""

    def __init__(
        self,
        model: ModelView,
        formulation: Formulation,
        program: VelocityProgram,
        evaluator: Evaluator,
        contacts: ContactSlots | None,
    ) -> None:
        self._model, self._formulation, self._program = model, formulation, program
        self._evaluator, self._contacts = evaluator, contacts

    def not_finite(self) -> NotFiniteError:
        """Name the tasks and constraints with values that are not finite."""
        values = self._evaluator.input
        wrong = [str(s) for s, v in zip(self._program.inputs, values, strict=False) if not math.isfinite(v)]
        if wrong:
            return NotFiniteError(f"The state has no finite value for {', '.join(map(repr, wrong[:6]))}.")
        parts = self._formulation.parts
        symbols = self._program.function.inputs
        result = compile(list(parts.values()), symbols, tier="interpreter")(values)
        names = [name for name, part in zip(parts, result, strict=True) if not np.isfinite(part).all()]
        where = ", ".join(map(repr, names[:6])) or "the sum of the terms, which is too large"
        return NotFiniteError(
            f"A value or derivative is not finite at this state, in {where}: the state is a singularity of "
            "the expression, such as the end of a range where a speed becomes infinite. No command was made.",
            names,
        )

    def least_violation(self) -> LeastViolation:
        """Find the speeds that violate the rows least, within the model's limits of single speeds."""
        _, _, A, lower, upper, *_ = self._evaluator.outputs
        n, width = len(self._program.speeds), A.shape[1]
        # Keeps on single speeds become rows, which may give way.
        low, high, keeps = lower.copy(), upper.copy(), []
        low[:n], high[:n] = -math.inf, math.inf
        for name, k, below, above in self._simple_rows():
            if name in self._formulation.keeps:
                keeps.append((np.eye(width)[k], below, above))
            else:
                low[k], high[k] = max(low[k], below), min(high[k], above)
        hard = np.zeros(len(lower) + len(keeps), dtype=bool)
        hard[:width] = True
        return find_least_violation(
            np.vstack([A, *(row for row, _, _ in keeps)]),
            np.append(low, [below for _, below, _ in keeps]),
            np.append(high, [above for _, _, above in keeps]),
            hard=hard,
        )

    def infeasible(self, command: Command) -> InfeasibleError:
        """Name an irreducible conflict; the error has the least-violating command."""
        conflict = self._find_conflict()
        listed = "; ".join(map(_describe_conflict, conflict))
        return InfeasibleError(
            f"No command satisfies all hard rows. These contradict each other: {listed}. "
            "error.command is the least-violating one.",
            conflict,
            command,
        )

    def _simple_rows(self) -> list[tuple[str, int, float, float]]:
        """Return name, column, lower and upper bound of each constraint on a single speed at this state."""
        rows = self._formulation.rows
        column = {s: k for k, s in enumerate(self._program.speeds)}
        ends = compile([rows.lower, rows.upper], self._program.function.inputs, tier="interpreter")
        result = []
        for row, low, high in zip(rows.rows, *ends(self._evaluator.input), strict=True):
            if len(row.weights) == 1:
                ((speed, weight),) = row.weights.items()
                if not weight.symbols:
                    below, above = sorted((low / float(weight), high / float(weight)))
                    result.append((row.name, column[speed], float(below), float(above)))
        return result

    def _find_conflict(self) -> tuple[Conflict, ...]:
        """Return an irreducible set of contradictory constraints; rows of one name are one member."""
        _, _, A, lower, upper, *_ = self._evaluator.outputs
        # Soft rows give way, so they take no part.
        soft = self._program.soft
        lower, upper = np.where(soft, -math.inf, lower), np.where(soft, math.inf, upper)
        simple = self._simple_rows()
        result: dict[str, tuple[float, float]] = {}
        for k, side in find_irreducible_conflict(A, lower, upper):
            if k < len(self._program.speeds):
                # Bounds of several constraints are merged: those count that are as tight.
                end = lower[k] if side < 0 else upper[k]
                names = [name for name, c, *ends in simple if c == k and ends[(side + 1) // 2] == end]
            else:
                names = list(self._names_of_row(k))
            for name in names:
                low, high = result.get(name, (-math.inf, math.inf))
                result[name] = (max(low, lower[k]), high) if side < 0 else (low, min(high, upper[k]))
        return tuple(Conflict(name, self._operations(name), *map(float, e)) for name, e in result.items())

    def _names_of_row(self, index: int) -> tuple[str, ...]:
        names = self._program.names
        if index < len(names) or self._contacts is None:
            return names[index]
        return (name_contact(self._contacts.found[index - len(names)]),)

    def _operations(self, name: str) -> tuple[str, ...]:
        history = getattr(self._model, "history", None)
        return () if history is None else tuple(history.writers(f"constraints/{name}"))


def _describe_conflict(conflict: Conflict) -> str:
    name, operations, lower, upper = conflict
    low, high = ("" if math.isinf(e) else f"{e:g}" for e in (lower, upper))
    ends = " <= ".join(part for part in (low, f"'{name}'", high) if part)
    return ends + (f" (written by {', '.join(map(repr, operations))})" if operations else "")
