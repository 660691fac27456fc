"""Rows of the limits, locks and closures of objects in the speeds of a step, see :mod:`.object_motion`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.compile import compile  # noqa: A004
from kineverse.expressions.expression import array
from kineverse.lie import Array
from kineverse.model.constraint import Constraint
from kineverse.model.model_view import ModelView
from kineverse.model.projection import is_equality
from kineverse.model.velocity_rows import Recovery, VelocityRows, velocity_rows
from kineverse.symbols import Symbol

_EXACT = 1e-6
"""Excess of a limit that is a matter of rounding, and is taken back."""

_HARMLESS = ("nothing that moves changes it", "it has no bounds")
_STEP = Symbol("world/step", 0, "parameter", 0.01)

Rows: TypeAlias = tuple[Array, Array, Array, Array]
"""Matrix (m, n), lower and upper bounds, and signed excess of position constraints, (m,) each."""


class ObjectLimits:
    """Limits of objects as rows ``lower <= A v <= upper`` in their speeds over a step.

    A limit of a position that is exceeded at first moves nothing by itself. What a motion exceeds it by is
    taken back by the next one: :meth:`begin`, then :meth:`position_rows` where the motion leads, then
    :meth:`finish`. Limits of accelerations are no rows.
    """

    def __init__(
        self,
        model: ModelView,
        speeds: Sequence[Symbol],
        is_robot: Callable[[str], bool],
        leave_out: Collection[str] = (),
    ) -> None:
        # Those of the robot alone have no entries in the columns, and are no rows.
        kept = {n: c for n, c in model.constraints.items() if n not in leave_out}
        closures = {n: c for n, c in kept.items() if is_equality(c)}
        limits = {n: c for n, c in kept.items() if c.order == 0 and n not in closures}
        rates = {n: c for n, c in kept.items() if c.order == 1}
        # A closure has to close.
        sets: list[tuple[Mapping[str, Constraint], Recovery]] = [
            (closures, "required"), (limits, "allowed"), (rates, "allowed")
        ]  # fmt: skip
        rows = [
            velocity_rows(these, _STEP, rates=model.rates, speeds=speeds, recovery=recovery)
            for these, recovery in sets
        ]
        skipped = [(n, "accelerations are not limited") for n, c in kept.items() if c.order > 1]
        skipped += [pair for each in rows for pair in each.skipped if pair[1] not in _HARMLESS]
        others = {n for n, c in kept.items() if not all(is_robot(s.path) for s in c.symbols)}
        self.skipped = tuple(pair for pair in skipped if pair[0] in others)
        place = {s: k for k, s in enumerate(model.symbols)}
        self._positions, self._rates = (
            _CompiledRows(parts, len(speeds), place) for parts in (rows[:2], rows[2:])
        )
        self._linked = _link_columns(len(speeds), (self._positions.pattern, self._rates.pattern))
        self._found: dict[bytes, tuple[npt.NDArray[np.intp], ...]] = {}
        self.reset()

    def find_linked(self, moved: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.intp], ...]:
        """Return the indices of speeds that share rows with some, directly or by others, and of these rows."""
        key = moved.tobytes()
        if key not in self._found:
            linked = moved | self._linked[moved].any(axis=0)
            patterns = (self._positions.pattern, self._rates.pattern)
            rows = [np.flatnonzero(pattern[:, linked].any(axis=1)) for pattern in patterns]
            self._found[key] = np.flatnonzero(linked), *rows
        return self._found[key]

    def link(self, moved: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Return the flags of speeds that share rows with flagged ones, and of these."""
        return moved | np.asarray(self._linked[moved].any(axis=0))

    def reset(self) -> None:
        """Forget what the last motion exceeded."""
        self._exceeded = np.zeros((2, len(self._positions.pattern)))

    def begin(self, q: Array, h: float) -> Rows:
        """Begin a motion at values of the model's symbols, and return the rows of speeds for h [s]."""
        below, above = self._exceeded
        excess = self._positions.evaluate(q, h)[3]
        self._excess = np.minimum(excess + below, 0.0) + np.maximum(excess - above, 0.0)
        self._excess[np.abs(self._excess) < _EXACT] = 0.0
        return self._rates.evaluate(q, h)

    def position_rows(self, q: Array, h: float, v: Array) -> tuple[Rows, float]:
        """Return the rows of positions where speeds v led, and the squares of the growth of excesses."""
        matrix, lower, upper, excess = self._positions.evaluate(q, h)
        below, above = _growth(self._excess, excess)
        shift = matrix @ v
        rows = matrix, lower + below / h + shift, upper - above / h + shift, excess
        return rows, float(below @ below + above @ above)

    def finish(self, q: Array, h: float) -> None:
        """End a motion, and remember what it exceeds."""
        self._exceeded = np.array(_growth(self._excess, self._positions.evaluate(q, h)[3]))


class _CompiledRows:
    """Rows as a function of the model's symbols and the time of a step."""

    def __init__(
        self,
        parts: Sequence[VelocityRows],
        count: int,
        place: Mapping[Symbol, int],
    ) -> None:
        rows = [row for part in parts for row in part.rows]
        columns = parts[0].speeds
        self.pattern = np.array([[s in row.weights for s in columns] for row in rows], dtype=bool)
        self.pattern = self.pattern.reshape(len(rows), count)
        self._values: Rows = np.zeros((0, count)), np.zeros(0), np.zeros(0), np.zeros(0)
        self._evaluator: Any = None
        if not rows:
            return
        matrix = array([row.weights.get(s, 0.0) for row in rows for s in columns])
        ends = [array([getattr(row, end) for row in rows]) for end in ("lower", "upper", "violation")]
        function = compile([matrix.reshape(len(rows), count), *ends])
        self._step = np.array([s == _STEP for s in function.inputs], dtype=bool)
        self._source = np.array([place[s] for s in function.inputs if s != _STEP], dtype=np.intp)
        self._evaluator = function.bind()

    def evaluate(self, q: Array, h: float) -> Rows:
        """Return the rows at values of the model's symbols for a step of h [s]."""
        if self._evaluator is None:
            return self._values
        self._evaluator.input[~self._step] = q[self._source]
        self._evaluator.input[self._step] = h
        self._evaluator()
        matrix, lower, upper, excess = (out.copy() for out in self._evaluator.outputs)
        return matrix, lower, upper, excess


def _growth(before: Array, now: Array) -> tuple[Array, Array]:
    """Return the growth of signed excesses below lower and above upper bounds, (m,) each."""
    below = np.minimum(before, 0.0) - np.minimum(now, 0.0)
    above = np.maximum(now, 0.0) - np.maximum(before, 0.0)
    return np.maximum(below, 0.0), np.maximum(above, 0.0)


def _link_columns(count: int, patterns: Sequence[npt.NDArray[np.bool_]]) -> npt.NDArray[np.bool_]:
    """Return (n, n) flags of columns that share a row, directly or by others."""
    linked = np.eye(count, dtype=bool)
    for pattern in patterns:
        for row in pattern:
            linked[np.ix_(row, row)] = True
    for k in range(count):  # transitive closure (Warshall)
        linked |= np.outer(linked[:, k], linked[k])
    return linked
