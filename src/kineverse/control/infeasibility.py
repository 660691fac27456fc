"""Reasons for steps without a command: conflicting constraints, values that are not finite.

The rows are those of a quadratic program, ``lower <= [x; A x] <= upper`` (:mod:`.qp`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kineverse.compilation import compile
from kineverse.compilation.evaluator import Evaluator
from kineverse.errors import InfeasibleError, NotFiniteError
from kineverse.model.model_view import ModelView

from .command import Command, name_contact
from .formulation import Formulation
from .qp import QpSolver, Vector
from .velocity_program import VelocityProgram

if TYPE_CHECKING:
    from .contact_constraints import ContactSlots

_WEIGHT = 1e6  # weight of squared violations, relative to the squared length of the point
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


def find_irreducible_conflict(A: Vector, lower: Vector, upper: Vector) -> tuple[ConflictingBound, ...]:
    """Find bounds that contradict each other, none of which can be left out.

    These are an irreducible infeasible subset: with all of its bounds there is no x, without any one of them
    there is. Violations y >= 0 at the point that violates ``G x <= h`` least certify by Farkas' lemma that
    there is none: ``G'y = 0`` and ``h'y < 0``. Of their bounds, one after the other is left out if the rest
    still contradict each other (Chinneck and Dravnieks 1991, "Locating minimal infeasible constraint sets in
    linear programs"). A row with ``lower > upper`` comes first.
    """
    rows = np.concatenate([np.eye(A.shape[1]), A])
    gap = lower - upper
    worst = int(np.argmax(gap))
    if gap[worst] > 0.0:
        return ConflictingBound(worst, -1), ConflictingBound(worst, 1)
    # One-sided rows g x <= h of length 1: first the upper bounds, then the lower ones.
    length = np.sqrt(np.einsum("ij,ij->i", rows, rows))
    unit = 1.0 / np.where(length > _SHORTEST, length, 1.0)
    g = np.concatenate([rows, -rows]) * np.tile(unit, 2)[:, None]
    h = np.concatenate([upper, -lower]) * np.tile(unit, 2)
    bounded = np.flatnonzero(h < np.inf)
    kept = bounded[_violations(g[bounded], h[bounded]) > 0.0]
    if not _infeasible(g[kept], h[kept]):
        kept = bounded
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


def find_least_violation(A: Vector, lower: Vector, upper: Vector, hard: NDArray[np.bool_]) -> LeastViolation:
    """Find the point whose violations have the smallest sum of squares, within the hard rows.

    ``hard`` is a mask (n + m,); of the points that violate equally, the nearest to 0 is taken.
    """
    rows = np.concatenate([np.eye(A.shape[1]), A])
    crossed = np.flatnonzero(lower > upper)
    # Both bounds of a crossed row count, each as a row of its own.
    g = np.concatenate([rows, rows[crossed]])
    below, above = np.append(lower, np.full(len(crossed), -np.inf)), np.append(upper, upper[crossed])
    above[crossed] = np.inf
    firm = np.append(hard, hard[crossed])
    x = _least_squares(g, below, above, ~firm, np.full(len(g), _WEIGHT))
    if x is None:
        weight = np.where(firm, _WEIGHT * _HARD_WEIGHT, _WEIGHT)
        x = _least_squares(g, below, above, np.ones(len(g), bool), weight)
    if x is None:  # no soft problem is infeasible, so the numbers are out of reach for the solver
        x = np.zeros(A.shape[1])
    values = rows @ x
    under, over = np.maximum(lower - values, 0.0), np.maximum(values - upper, 0.0)
    return LeastViolation(x, np.where(over >= under, over, -under))


def _violations(g: Vector, h: Vector) -> Vector:
    """Return the violations of ``g x <= h`` at the point of least violation, 0 where they are rounding."""
    count = len(g)
    x = _least_squares(g, np.full(count, -np.inf), h, np.ones(count, bool), np.full(count, 1e8))
    if x is None:
        return np.ones(count)
    y = np.maximum(g @ x - h, 0.0)
    return np.where(y > 1e-9 * y.max(initial=0.0), y, 0.0)


def _infeasible(g: Vector, h: Vector) -> bool:
    if not len(g):
        return False
    none = np.full(len(g), -np.inf)
    return _least_squares(g, none, h, np.zeros(len(g), bool), np.ones(len(g))) is None


def _least_squares(
    g: Vector, lower: Vector, upper: Vector, soft: NDArray[np.bool_], weight: Vector
) -> Vector | None:
    """Return the point closest to 0, subject to rows, some of them soft."""
    count, n = g.shape
    may_give_way, weights = np.concatenate([np.zeros(n, bool), soft]), np.concatenate([np.ones(n), weight])
    solver = QpSolver(n, count, soft=may_give_way, soft_weight=weights)
    no_bound = np.full(n, np.inf)
    low, high = np.concatenate([-no_bound, lower]), np.concatenate([no_bound, upper])
    solution = solver.solve(np.eye(n), np.zeros(n), np.ascontiguousarray(g), low, high)
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
            hard,
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
                row = k - len(self._program.names)
                names = [*self._program.names[k]] if row < 0 else [self._name_contact(row)]
            for name in names:
                low, high = result.get(name, (-math.inf, math.inf))
                result[name] = (max(low, lower[k]), high) if side < 0 else (low, min(high, upper[k]))
        return tuple(Conflict(name, self._operations(name), *map(float, e)) for name, e in result.items())

    def _name_contact(self, index: int) -> str:
        assert self._contacts is not None
        return name_contact(self._contacts.found[index])

    def _operations(self, name: str) -> tuple[str, ...]:
        history = getattr(self._model, "history", None)
        return () if history is None else tuple(history.writers(f"constraints/{name}"))


def _describe_conflict(conflict: Conflict) -> str:
    name, operations, lower, upper = conflict
    low, high = ("" if math.isinf(e) else f"{e:g}" for e in (lower, upper))
    ends = " <= ".join(part for part in (low, f"'{name}'", high) if part)
    return ends + (f" (written by {', '.join(map(repr, operations))})" if operations else "")
