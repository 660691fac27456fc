"""Quadratic programs: several solvers behind one interface.

The problem is to minimise ``1/2 x'Hx + f'x`` subject to ``lower <= [x; A x] <= upper``. The first n entries
of the bounds are those of x itself, the other m those of the rows of A. A bound may be infinite, and rows
whose bounds are equal are equalities.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
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
        self._hard = None if not self.soft.any() else (~self.soft).astype(float)
        self._values, self._violations = np.zeros(n + m), np.zeros(n + m)
        self._x, self._rows = self._values[:n], self._values[n:]

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
        h, g, a, low, high = self._bound
        if H is not h or f is not g or A is not a or lower is not low or upper is not high:
            self._bind(H, f, A, lower, upper)
        return self._solve(H, f, A, lower, upper)

    @abstractmethod
    def reset(self) -> None:
        """Forget the last solution, so that the next solve starts from scratch."""

    @abstractmethod
    def _solve(self, H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> QpSolution:
        """Solve a problem with arrays of the right shapes and any numbers."""

    def _satisfies(self, x: Vector, A: Vector, lower: Vector, upper: Vector) -> bool:
        """Return whether x satisfies the hard rows; any NaN, in the data or in x, makes that False."""
        values, violations = self._values, self._violations
        self._x[:] = x
        A.dot(x, self._rows)
        size = values.dot(values)
        if not size < np.inf:
            return False
        np.maximum(values, lower, out=violations)
        np.minimum(violations, upper, out=violations)
        np.subtract(values, violations, out=violations)
        if self._hard is not None:
            # A NaN is a NaN also in a soft row.
            np.multiply(violations, self._hard, out=violations)
        return bool(violations.dot(violations) <= _FEASIBLE * (1.0 + size))

    @staticmethod
    def _unsolvable(H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> Status | None:
        """Return the status of a problem that no solver needs to see; None for any other."""
        if not all(np.isfinite(array).all() for array in (H, f, A)):
            return "failed"
        if np.isnan(lower).any() or np.isnan(upper).any() or (H.diagonal() <= 0.0).any():
            return "failed"
        return None if (lower <= upper).all() else "infeasible"

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
        self._model: Any = None
        self._warm = False

    def reset(self) -> None:  # noqa: D102
        self._warm = False

    def _solve(self, H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> QpSolution:
        if self._warm:
            # The solver keeps these arrays, and the active set of the last solve.
            model = self._model
            if model.update(H, f, A if self.m else None, upper, lower) == 0:
                x, _, flag, info = model.solve()
                if (flag == 1 or flag == 2) and self._satisfies(x, A, lower, upper):
                    return QpSolution(x, info["lam"], info["iterations"], "solved")
        # It may have failed, or returned NaN as solved: so it does if bounds of the last active set are
        # infinite now.
        self._warm = False
        status = self._unsolvable(H, f, A, lower, upper)
        if status is not None:
            return self._nothing(status)
        return self._solve_anew(H, f, A, lower, upper)

    def _solve_anew(self, H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> QpSolution:
        flag, x, multipliers, iterations = self._start(
            H, f, A, lower, upper, np.ones(self.n + self.m), _DAQP_SETTINGS
        )
        if flag >= 1 and self._satisfies(x, A, lower, upper):
            self._warm = True
            return QpSolution(x, multipliers, iterations, "solved")
        # Its tolerances are absolute: data of many decades are scaled to unknowns and rows of length 1.
        unit = 1.0 / np.sqrt(H.diagonal())
        rows = A * unit
        length = np.sqrt(np.einsum("ij,ij->i", rows, rows))
        scale = np.concatenate([1.0 / unit, 1.0 / np.where(length > 0.0, length, 1.0)])
        flag, x, multipliers, iterations = self._start(
            np.ascontiguousarray(H * np.outer(unit, unit)),
            f * unit,
            rows * scale[self.n :, None],
            lower * scale,
            upper * scale,
            scale,
            _DAQP_SCALED_SETTINGS,
        )
        x = x * unit
        if flag >= 1 and self._satisfies(x, A, lower, upper):
            return QpSolution(x, multipliers * scale, iterations, "solved")
        return self._nothing("infeasible" if flag in _DAQP_INFEASIBLE else "failed", iterations)

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
        sense = np.where(self.soft, _DAQP_SOFT, 0).astype(np.intc)
        flag, _ = model.setup(H, f, A, upper, lower, sense)
        if flag < 0:
            return flag, np.zeros(self.n), np.zeros(self.n + self.m), 0
        if self._hard is not None:
            reciprocal, linear = scale**2 / self._weight, self._linear / scale
            model.soft_weights(reciprocal, reciprocal, linear, linear)
        x, _, flag, info = model.solve()
        return flag, x, info["lam"], info["iterations"]


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
        unsolvable = self._unsolvable(H, f, A, lower, upper)
        if unsolvable is not None:
            return self._nothing(unsolvable)
        n, entries = self.n, self.n + self.m
        self._H[:n, :n], self._f[:n], self._C[n:entries, :n] = H, f, A
        self._lower[:entries], self._upper[:entries] = lower, upper
        x, multipliers, iterations, status = self._solve_hard()
        if status == "solved" and not self._satisfies(x[:n], A, lower, upper):
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
        library = _library("proxsuite", "bench").proxqp
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
        result = self._qp.solve(raise_error=False)
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

_FEASIBLE = 1e-8**2
_PROXQP_INFINITY = 1e20
_DAQP_SOFT = 8
_DAQP_SETTINGS = {"primal_tol": 1e-9}
_DAQP_SCALED_SETTINGS = {"primal_tol": 1e-9, "sing_tol": 1e-13}
"""Rows that are nearly parallel are told apart, at the price of a less stable factorisation."""
_DAQP_INFEASIBLE = (-1, -6)
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


def _library(name: str, extra: str) -> ModuleType:
    """Import the library of a solver."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingDependencyError(
            f"This QP solver needs {name.partition('.')[0]}: {install_command(extra)}"
        ) from error
