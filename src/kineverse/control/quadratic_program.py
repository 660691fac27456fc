"""Quadratic programs: several solvers behind one interface.

The problem is to minimise ``1/2 x'Hx + f'x`` subject to ``lower <= [x; A x] <= upper``. The first n entries
of the bounds are those of x itself, the other m those of the rows of A. A bound may be infinite, and rows
whose bounds are equal are equalities.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import ModuleType
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kineverse._extras import install_command
from kineverse.errors import InvalidValueError, MissingDependencyError, ShapeError, UnknownNameError, suggest

Vector = NDArray[np.float64]
Status = Literal["solved", "infeasible", "failed"]

SOFT_WEIGHT = 1e6
"""The default weight of the squared violation of a soft row."""


class QpSolution(NamedTuple):
    """The outcome of a quadratic program.

    Attributes
    ----------
    x
        The minimiser, of shape (n,); zeros unless solved.
    multipliers
        The multipliers of ``[x; A x]``, of shape (n + m,), with ``H x + f + [I; A]' multipliers = 0``:
        negative at a lower bound, positive at an upper one; zeros unless solved.
    iterations
        The number of iterations.
    status
        "solved"; "infeasible" (no x satisfies all hard rows, or a lower bound is above its upper one);
        "failed" (the data are not finite, H is not positive definite, or the solver did not converge).
    """

    x: Vector
    multipliers: Vector
    iterations: int
    status: Status


class QpSolver(ABC):
    """A solver of quadratic programs of one size, started from its last solution.

    Parameters
    ----------
    n
        The number of unknowns, at least 1.
    m
        The number of rows of A, 0 or more.
    soft
        The soft entries of ``[x; A x]``: a mask of shape (n + m,), or None. A violation s of a soft entry
        costs ``soft_linear s + 1/2 soft_weight s^2``.
    soft_weight
        The weight of the squared violation, above 0: a number or one per entry.
    soft_linear
        The weight of the violation itself, at least 0: a number or one per entry. Above the multiplier of
        the row it makes the penalty exact: a row that can be satisfied is.

    Raises
    ------
    InvalidValueError, ShapeError
        For sizes, masks or weights outside of these.
    """

    def __init__(
        self,
        n: int,
        m: int,
        soft: ArrayLike | None = None,
        soft_weight: ArrayLike = SOFT_WEIGHT,
        soft_linear: ArrayLike = 0.0,
    ) -> None:
        if n < 1 or m < 0:
            raise InvalidValueError(
                f"A quadratic program has n >= 1 unknowns and m >= 0 rows, not {n} and {m}."
            )
        self.n, self.m = n, m
        self.soft = np.zeros(n + m, bool) if soft is None else np.array(soft, bool)
        if self.soft.shape != (n + m,):
            raise ShapeError(
                f"soft has the shape {self.soft.shape}, not ({n + m},): one entry per bound of [x; A x]."
            )
        self._weight = np.broadcast_to(np.asarray(soft_weight, float), n + m).copy()
        self._linear = np.broadcast_to(np.asarray(soft_linear, float), n + m).copy()
        if not (np.isfinite(self._weight) & (self._weight > 0)).all():
            raise InvalidValueError("The weights of soft rows are finite and above 0.")
        if not (np.isfinite(self._linear) & (self._linear >= 0)).all():
            raise InvalidValueError("The linear weights of soft rows are finite and at least 0.")
        self._bound: tuple[object, ...] = (None,) * 5
        self._flat = (np.zeros(0), np.zeros(0), np.zeros(0))
        self._ordered = np.zeros(n + m, bool)

    def solve(self, H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> QpSolution:
        """Minimise ``1/2 x'Hx + f'x`` subject to ``lower <= [x; A x] <= upper``.

        The arrays are read in place: rewrite the same ones for each solve, since other ones are checked anew.
        The solution's arrays are its own.

        Parameters
        ----------
        H
            Positive definite and symmetric, of shape (n, n).
        f
            Of shape (n,).
        A
            Of shape (m, n).
        lower, upper
            Of shape (n + m,); infinite where there is no bound, equal for an equality.

        Raises
        ------
        ShapeError, InvalidValueError
            For arrays of another shape, or that are not C-contiguous doubles. Numbers raise nothing, see
            :class:`QpSolution`.
        """
        h0, f0, a0, l0, u0 = self._bound
        if H is not h0 or f is not f0 or A is not a0 or lower is not l0 or upper is not u0:
            self._bind(H, f, A, lower, upper)
        h, g, a = self._flat
        # Squares tell all that is not finite (NaN included) in one sum, the cheapest way from Python.
        square = h.dot(h) + g.dot(g) + a.dot(a)
        if square - square != 0.0:
            return self._nothing("failed")
        np.less_equal(lower, upper, self._ordered)
        if np.count_nonzero(self._ordered) != self._ordered.size:
            return self._nothing("failed" if np.isnan(lower).any() or np.isnan(upper).any() else "infeasible")
        return self._solve(H, f, A, lower, upper)

    @abstractmethod
    def reset(self) -> None:
        """Forget the last solution, so that the next solve starts from scratch."""

    @abstractmethod
    def _solve(self, H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> QpSolution:
        """Solve a problem with finite data and ordered bounds; what counts as solved is finite."""

    def _nothing(self, status: Status, iterations: int = 0) -> QpSolution:
        return QpSolution(np.zeros(self.n), np.zeros(self.n + self.m), iterations, status)

    def _bind(self, H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> None:
        n, m = self.n, self.m
        for name, array, shape in (
            ("H", H, (n, n)),
            ("f", f, (n,)),
            ("A", A, (m, n)),
            ("lower", lower, (n + m,)),
            ("upper", upper, (n + m,)),
        ):
            if not isinstance(array, np.ndarray) or array.dtype != np.float64 or not array.flags.c_contiguous:
                raise InvalidValueError(
                    f"{name} is read in place, so it is a C-contiguous array of doubles: "
                    f"numpy.ascontiguousarray({name}, float)."
                )
            if array.shape != shape:
                raise ShapeError(f"{name} has the shape {array.shape}, not {shape} (n = {n}, m = {m}).")
        self._bound = (H, f, A, lower, upper)
        self._flat = (H.reshape(-1), f, A.reshape(-1))


def make_solver(
    name: str,
    n: int,
    m: int,
    *,
    soft: ArrayLike | None = None,
    soft_weight: ArrayLike = SOFT_WEIGHT,
    soft_linear: ArrayLike = 0.0,
) -> QpSolver:
    """Make a solver of quadratic programs with n unknowns and m rows.

    Parameters
    ----------
    name
        "daqp" (dual active set, for loops), "proxqp" (augmented Lagrangian; or "proxsuite") or "osqp"
        (operator splitting).
    n, m, soft, soft_weight, soft_linear
        See :class:`QpSolver`.

    Raises
    ------
    UnknownNameError
        For another name.
    MissingDependencyError
        If the library is not installed.
    """
    if name not in SOLVERS:
        raise UnknownNameError(f"There is no QP solver {name!r}. {suggest(name, SOLVERS, 'solver')}")
    return SOLVERS[name](n, m, soft, soft_weight, soft_linear)


class DaqpSolver(QpSolver):
    """The dual active-set solver DAQP (Arnström, Bemporad, Axehill 2022), started from the last active set.

    Its tolerance of violations is 1e-9, in the units of the rows.
    """

    def __init__(
        self,
        n: int,
        m: int,
        soft: ArrayLike | None = None,
        soft_weight: ArrayLike = SOFT_WEIGHT,
        soft_linear: ArrayLike = 0.0,
    ) -> None:
        super().__init__(n, m, soft, soft_weight, soft_linear)
        self._daqp = _library("daqp", "control")
        self._sense = np.where(self.soft, _DAQP_SOFT, 0).astype(np.intc)
        self._model: Any = None
        self._update: Callable[..., int]
        self._run: Callable[[], tuple[Vector, float, int, dict[str, Any]]]
        self._warm = False

    def reset(self) -> None:  # noqa: D102
        self._warm = False

    def _solve(self, H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> QpSolution:
        if self._warm:
            # The solver keeps these arrays, and the active set of the last solve unless senses are given.
            if self._update(H, f, A if self.m else None, upper, lower) == 0:
                x, _, flag, info = self._run()
                if (flag == 1 or flag == 2) and x.dot(x) < np.inf:
                    return QpSolution(x, info["lam"], info["iterations"], "solved")
            # It fails, or returns NaN as solved, if bounds of the last active set are infinite now.
            self._warm = False
        flag, iterations = self._start(H, f, A, lower, upper), 0
        if flag >= 0:
            x, _, flag, info = self._run()
            iterations = info["iterations"]
            if (flag == 1 or flag == 2) and x.dot(x) < np.inf:
                self._warm = True
                return QpSolution(x, info["lam"], iterations, "solved")
        return self._nothing(_DAQP_STATUS.get(flag, "failed"), iterations)

    def _start(self, H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> int:
        if self._model is not None:
            flag: int = self._update(H, f, A if self.m else None, upper, lower, self._sense)
            return flag
        model = self._daqp.Model()
        model.settings = _DAQP_SETTINGS
        flag, _ = model.setup(H, f, A, upper, lower, self._sense)
        if flag >= 0:
            if self.soft.any():
                rho, w = 1.0 / self._weight, self._linear
                model.soft_weights(rho, rho, w, w)
            self._model, self._update, self._run = model, model.update, model.solve
        return flag


class _SlackSolver(QpSolver):
    """A solver that knows no soft rows: their violations are unknowns of their own.

    The unknowns are ``[x; above; below]``, the rows ``[[x; A x] - above + below; above; below]``.
    """

    def __init__(
        self,
        n: int,
        m: int,
        soft: ArrayLike | None = None,
        soft_weight: ArrayLike = SOFT_WEIGHT,
        soft_linear: ArrayLike = 0.0,
    ) -> None:
        super().__init__(n, m, soft, soft_weight, soft_linear)
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
        n, entries = self.n, self.n + self.m
        self._H[:n, :n], self._f[:n], self._C[n:entries, :n] = H, f, A
        self._lower[:entries], self._upper[:entries] = lower, upper
        x, multipliers, iterations, status = self._solve_hard()
        if status == "solved" and not x.dot(x) < np.inf:
            status = "failed"
        if status != "solved":
            self.reset()
            return self._nothing(status, iterations)
        return QpSolution(x[:n].copy(), multipliers[:entries].copy(), iterations, status)

    @abstractmethod
    def _solve_hard(self) -> tuple[Vector, Vector, int, Status]:
        """Return the unknowns, multipliers, iterations and status of the problem with slacks."""


class ProxqpSolver(_SlackSolver):
    """The proximal augmented Lagrangian solver ProxQP (Bambade et al. 2022), dense."""

    _qp: Any = None

    def reset(self) -> None:  # noqa: D102
        self._qp = None

    def _solve_hard(self) -> tuple[Vector, Vector, int, Status]:
        library = _library("proxsuite", "bench").proxqp
        lower, upper = np.maximum(self._lower, -_PROXQP_INFINITY), np.minimum(self._upper, _PROXQP_INFINITY)
        data = (self._H, self._f, None, None, self._C, lower, upper)
        if self._qp is None:
            self._qp = library.dense.QP(len(self._f), 0, len(lower))
            self._qp.settings.eps_abs, self._qp.settings.eps_rel = _TOLERANCE, 0.0
            self._qp.settings.eps_primal_inf = _TOLERANCE
            self._qp.settings.initial_guess = library.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
            self._qp.init(*data)
        else:
            self._qp.update(*data, update_preconditioner=True)
        self._qp.solve()
        result, known = self._qp.results, library
        status: Status = "failed"
        if result.info.status == known.PROXQP_SOLVED:
            status = "solved"
        elif result.info.status == known.PROXQP_PRIMAL_INFEASIBLE:
            status = "infeasible"
        return np.asarray(result.x), np.asarray(result.z), result.info.iter, status


class OsqpSolver(_SlackSolver):
    """The operator splitting solver OSQP (Stellato et al. 2020), with polishing."""

    _qp: Any = None

    def reset(self) -> None:  # noqa: D102
        self._qp = None

    def _solve_hard(self) -> tuple[Vector, Vector, int, Status]:
        library, sparse = _library("osqp", "bench"), _library("scipy.sparse", "bench")
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
        result = self._qp.solve()
        status: Status = "failed"
        if result.info.status_val == library.SolverStatus.OSQP_SOLVED:
            status = "solved"
        elif result.info.status_val == library.SolverStatus.OSQP_PRIMAL_INFEASIBLE:
            status = "infeasible"
        return result.x, result.y, result.info.iter, status


SOLVERS: dict[str, type[QpSolver]] = {
    "daqp": DaqpSolver,
    "proxqp": ProxqpSolver,
    "proxsuite": ProxqpSolver,
    "osqp": OsqpSolver,
}
"""The solvers by name."""

_TOLERANCE = 1e-9
_PROXQP_INFINITY = 1e20
_DAQP_SOFT = 8
_DAQP_SETTINGS = {"primal_tol": 1e-9}
_DAQP_STATUS: dict[int, Status] = {-1: "infeasible", -6: "infeasible"}
_OSQP_SETTINGS = {
    "verbose": False,
    "eps_abs": 1e-9,
    "eps_rel": 1e-9,
    "max_iter": 100_000,
    "polishing": True,
    "eps_prim_inf": 1e-7,
}


def _library(name: str, extra: str) -> ModuleType:
    """Import the library of a solver."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingDependencyError(
            f"This QP solver needs {name.partition('.')[0]}: {install_command(extra)}"
        ) from error
