"""Diagnosis of steps without a command: constraints that conflict, values that are not finite."""

from __future__ import annotations

import math

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.compile.evaluator import Evaluator
from kineverse.errors import InfeasibleError, NotFiniteError
from kineverse.model.model_view import ModelView

from .command import Command, name_contact
from .contact_slots import ContactSlots
from .formulation import Formulation
from .infeasibility import Conflict, LeastViolation, find_irreducible_conflict, find_least_violation
from .velocity_program import VelocityProgram


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
        """Return the error that names the tasks and constraints with values that are not finite."""
        values = self._evaluator.input
        wrong = [str(s) for s, v in zip(self._program.inputs, values, strict=False) if not math.isfinite(v)]
        if wrong:
            return NotFiniteError(f"The state has no finite value for {', '.join(map(repr, wrong[:6]))}.")
        parts = self._formulation.parts
        symbols = self._program.function.inputs
        found = compile(list(parts.values()), symbols, tier="interpreter")(values)
        names = [name for name, part in zip(parts, found, strict=True) if not np.isfinite(part).all()]
        where = ", ".join(map(repr, names[:6])) or "the sum of the terms, which is too large"
        return NotFiniteError(
            f"A value or derivative is not finite at this state, in {where}: the state is a singularity of "
            "the expression, such as the end of a range where a speed becomes infinite. No command was made.",
            names,
        )

    def least_violation(self) -> LeastViolation:
        """Return the speeds that violate the rows least, within the model's limits of single speeds."""
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
        """Return the error with an irreducible conflict, and with the least-violating command."""
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
        found = []
        for row, low, high in zip(rows.rows, *ends(self._evaluator.input), strict=True):
            if len(row.weights) == 1:
                ((speed, weight),) = row.weights.items()
                if not weight.symbols:
                    below, above = sorted((low / float(weight), high / float(weight)))
                    found.append((row.name, column[speed], float(below), float(above)))
        return found

    def _find_conflict(self) -> tuple[Conflict, ...]:
        """Return an irreducible set of contradictory constraints; rows of one name are one member."""
        _, _, A, lower, upper, *_ = self._evaluator.outputs
        # Soft rows give way, so they take no part.
        soft = self._program.soft
        lower, upper = np.where(soft, -math.inf, lower), np.where(soft, math.inf, upper)
        simple = self._simple_rows()
        found: dict[str, tuple[float, float]] = {}
        for k, side in find_irreducible_conflict(A, lower, upper):
            if k < len(self._program.speeds):
                # Bounds of several constraints are merged: those count that are as tight.
                end = lower[k] if side < 0 else upper[k]
                names = [name for name, c, *ends in simple if c == k and ends[(side + 1) // 2] == end]
            else:
                names = list(self._names_of_row(k))
            for name in names:
                low, high = found.get(name, (-math.inf, math.inf))
                found[name] = (max(low, lower[k]), high) if side < 0 else (low, min(high, upper[k]))
        return tuple(Conflict(name, self._operations(name), *map(float, e)) for name, e in found.items())

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
