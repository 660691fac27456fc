"""The QP solver of control loops."""

from __future__ import annotations

from typing import Any

import numpy as np

from .qp_solver import QpSolution, QpSolver, Vector, import_solver


class DaqpSolver(QpSolver):
    """The dual active-set solver DAQP (Arnström, Bemporad, Axehill 2022), started from the last active set.

    Its tolerance of violations is 1e-9, in the units of the rows.
    """

    def _prepare(self) -> None:
        self._daqp = import_solver("daqp", "control")
        self._model: Any = None
        self._warm = False

    def reset(self) -> None:  # noqa: D102
        self._warm = False

    def _solve(self, H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> QpSolution:
        if self._warm:
            # A bound of the last active set that is infinite now gives wrong solutions, reported as solved.
            low, high = self._bound_by(_INFINITY)
            # The solver keeps these arrays, and the active set of the last solve.
            model = self._model
            if model.update(H, f, A if self.m else None, high, low) == 0:
                x, _, flag, info = model.solve()
                if (flag == 1 or flag == 2) and self._satisfies(x):
                    return QpSolution(x, info["lam"], info["iterations"], "solved")
        self._warm = False
        status = self._unsolvable(H, f, A, lower, upper)
        if status is not None:
            return self._nothing(status)
        return self._solve_anew(H, f, A, lower, upper)

    def _solve_anew(self, H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> QpSolution:
        one = np.ones(self.n + self.m)
        usual = _SOFT_SETTINGS if self._any_soft else _SETTINGS
        flags: set[int] = set()
        # Where equalities are nearly dependent, it succeeds after it has eliminated them.
        for settings in (usual, _REDUCED_SETTINGS):
            flag, x, multipliers, iterations = self._start(H, f, A, lower, upper, one, settings)
            if flag >= 1 and self._satisfies(x):
                self._warm = settings is usual
                return QpSolution(x, multipliers, iterations, "solved")
            flags.add(flag)
        # Its tolerances are absolute: data of many decades are scaled to unknowns and rows of length 1.
        unit = 1.0 / np.sqrt(H.diagonal())
        rows = A * unit
        length = np.sqrt(np.einsum("ij,ij->i", rows, rows))
        scale = np.concatenate([1.0 / unit, 1.0 / np.where(length > 0.0, length, 1.0)])
        scaled = np.ascontiguousarray(H * np.outer(unit, unit)), f * unit, rows * scale[self.n :, None]
        for settings in _SCALED_SETTINGS:
            flag, x, multipliers, iterations = self._start(
                *scaled, lower * scale, upper * scale, scale, settings
            )
            x = x * unit
            if flag >= 1 and self._satisfies(x):
                return QpSolution(x, multipliers * scale, iterations, "solved")
            flags.add(flag)
            if flags <= _INFEASIBLE:
                break
        return self._nothing("infeasible" if flags & _INFEASIBLE else "failed", iterations)

    def _start(
        self,
        H: Vector,
        f: Vector,
        A: Vector,
        lower: Vector,
        upper: Vector,
        scale: Vector,
        settings: dict[str, float],
    ) -> tuple[int, Vector, Vector, int]:
        """Solve a problem from scratch, whose entries of [x; A x] are multiples of the user's."""
        model = self._model = self._daqp.Model()
        model.settings = settings
        sense = np.where(self.soft, _SOFT, 0).astype(np.intc)
        if settings is _REDUCED_SETTINGS:
            sense[(lower == upper) & ~self.soft] = _EQUALITY
        flag, _ = model.setup(H, f, A, upper, lower, sense)
        if flag < 0:
            return flag, np.zeros(self.n), np.zeros(self.n + self.m), 0
        if self._any_soft:
            reciprocal, linear = scale**2 / self._weight, self._linear / scale
            model.soft_weights(reciprocal, reciprocal, linear, linear)
        x, _, flag, info = model.solve()
        return flag, x, info["lam"], info["iterations"]


_SOFT, _EQUALITY = 8, 5
_INFINITY = 1e8
"""Bounds beyond are none in warm starts: far from all speeds and lengths, but near enough for doubles."""
_INFEASIBLE = {-1, -6}
_SETTINGS = {"primal_tol": 1e-9}
_REDUCED_SETTINGS = {"primal_tol": 1e-9, "eq_reduction": 1}
_SOFT_SETTINGS = {"primal_tol": 1e-9, "sing_tol": 1e-13}
"""Pivots of soft rows are as small as the reciprocals of their weights."""
_SCALED_SETTINGS = ({"primal_tol": 1e-9, "sing_tol": 1e-13}, {"primal_tol": 1e-6, "sing_tol": 1e-13})
"""Rows that are nearly parallel are told apart; a larger tolerance prevents cycles."""
