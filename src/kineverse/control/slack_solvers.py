"""QP solvers without soft rows of their own."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from .qp import QpSolution, QpSolver, Status, Vector, import_solver


class _SlackSolver(QpSolver):
    """A solver that knows no soft rows: their violations are unknowns of their own.

    The unknowns are ``[x; above; below]``, the rows ``[[x; A x] - above + below; above; below]``.
    """

    def _prepare(self) -> None:
        n, m = self.n, self.m
        rows = np.flatnonzero(self.soft)
        k, size = len(rows), n + 2 * len(rows)
        self._H = np.diag(np.concatenate([np.ones(n), np.tile(self._weight[rows], 2)]))
        self._f = np.concatenate([np.zeros(n), np.tile(self._linear[rows], 2)])
        self._C = np.zeros((n + m + 2 * k, size))
        self._C[:n, :n] = np.eye(n)
        self._C[rows, n + np.arange(k)] = -1.0
        self._C[rows, n + k + np.arange(k)] = 1.0
        self._C[n + m :, n:] = np.eye(2 * k)
        self._lower, self._upper = np.zeros(n + m + 2 * k), np.full(n + m + 2 * k, np.inf)

    def _solve(self, H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> QpSolution:
        unsolvable = self._unsolvable(H, f, A, lower, upper)
        if unsolvable is not None:
            return self._nothing(unsolvable)
        n, entries = self.n, self.n + self.m
        self._H[:n, :n], self._f[:n], self._C[n:entries, :n] = H, f, A
        self._lower[:entries], self._upper[:entries] = lower, upper
        x, multipliers, iterations, status = self._solve_hard()
        if status == "solved" and not self._satisfies(x[:n]):
            status = "failed"
        if status != "solved":
            self.reset()
            return self._nothing(status, iterations)
        # They are tiny, not zero, where there is no bound.
        least, most = np.where(np.isinf(lower), 0.0, -np.inf), np.where(np.isinf(upper), 0.0, np.inf)
        return QpSolution(x[:n].copy(), np.clip(multipliers[:entries], least, most), iterations, status)

    @abstractmethod
    def _solve_hard(self) -> tuple[Vector, Vector, int, Status]:
        """Return the unknowns, multipliers, iterations and status of the problem with slacks."""


class ProxqpSolver(_SlackSolver):
    """The proximal augmented Lagrangian solver ProxQP (Bambade et al. 2022), dense.

    It starts from its last solution while the same rows are equalities, and the same have bounds. It may say
    "failed" of an infeasible problem.
    """

    _qp: Any = None
    _kinds = b""

    def reset(self) -> None:  # noqa: D102
        self._qp = None

    def _solve_hard(self) -> tuple[Vector, Vector, int, Status]:
        library = import_solver("proxsuite", "bench").proxqp
        lower, upper = np.maximum(self._lower, -_PROXQP_INFINITY), np.minimum(self._upper, _PROXQP_INFINITY)
        equal = lower == upper
        between = ~equal & (np.isfinite(self._lower) | np.isfinite(self._upper))
        data = (
            self._H,
            self._f,
            self._C[equal],
            lower[equal],
            self._C[between],
            lower[between],
            upper[between],
        )
        warm = self._qp is not None and self._kinds == equal.tobytes() + between.tobytes()
        if warm:
            self._qp.update(*data, update_preconditioner=True)
            self._qp.solve()
        if not warm or self._qp.results.info.status != library.PROXQP_SOLVED:
            self._qp = library.dense.QP(len(self._f), np.count_nonzero(equal), np.count_nonzero(between))
            self._kinds = equal.tobytes() + between.tobytes()
            for key, value in _PROXQP_SETTINGS.items():
                setattr(self._qp.settings, key, value)
            self._qp.settings.initial_guess = library.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
            self._qp.init(*data)
            self._qp.solve()
        result = self._qp.results
        status: Status = "failed"
        if result.info.status == library.PROXQP_SOLVED:
            status = "solved"
        elif result.info.status == library.PROXQP_PRIMAL_INFEASIBLE:
            status = "infeasible"
        multipliers = np.zeros(len(lower))
        multipliers[equal], multipliers[between] = result.y, result.z
        return np.asarray(result.x), multipliers, result.info.iter, status


class OsqpSolver(_SlackSolver):
    """The operator splitting solver OSQP (Stellato et al. 2020), with polishing."""

    _qp: Any = None

    def reset(self) -> None:  # noqa: D102
        self._qp = None

    def _solve_hard(self) -> tuple[Vector, Vector, int, Status]:
        library, sparse = import_solver("osqp", "bench"), import_solver("scipy.sparse", "bench")
        columns, rows = np.tril_indices(len(self._f))  # of the upper triangle, by columns
        quadratic, linear = self._H[rows, columns], np.ascontiguousarray(self._C.T)
        if self._qp is None:
            # All entries are stored, since other ones may be zero in the next problem.
            size, height = len(self._f), len(self._lower)
            starts = np.concatenate([[0], np.cumsum(np.arange(1, size + 1))])
            P = sparse.csc_matrix((quadratic, rows, starts), shape=(size, size))
            indices = np.tile(np.arange(height), size)
            C = sparse.csc_matrix(
                (linear.ravel(), indices, height * np.arange(size + 1)), shape=(height, size)
            )
            self._qp = library.OSQP()
            self._qp.setup(P, self._f, C, self._lower, self._upper, **_OSQP_SETTINGS)
        else:
            self._qp.update(q=self._f, l=self._lower, u=self._upper, Px=quadratic, Ax=linear.ravel())
        result = self._qp.solve(raise_error=False)
        status: Status = "failed"
        if result.info.status_val == library.SolverStatus.OSQP_SOLVED:
            status = "solved"
        elif result.info.status_val == library.SolverStatus.OSQP_PRIMAL_INFEASIBLE:
            status = "infeasible"
        return result.x, result.y, result.info.iter, status


_PROXQP_INFINITY = 1e20
_PROXQP_SETTINGS = {
    "eps_abs": 1e-9,
    "eps_rel": 0.0,
    "eps_primal_inf": 1e-9,
    "check_duality_gap": True,
    "eps_duality_gap_abs": 1e-8,
    "eps_duality_gap_rel": 0.0,
    "max_iter": 300,
}
_OSQP_SETTINGS = {
    "verbose": False,
    "eps_abs": 1e-9,
    "eps_rel": 1e-9,
    "max_iter": 100_000,
    "polishing": True,
    "eps_prim_inf": 1e-7,
}
