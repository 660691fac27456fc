"""Quadratic programs of control loops: minimise ``1/2 x'Hx + f'x`` subject to ``lower <= [x; A x] <= upper``.

The first n entries of the bounds are those of x itself, the other m those of the rows of A. A bound may be
infinite, and rows whose bounds are equal are equalities.
"""

from __future__ import annotations

import ctypes
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kineverse._extras import install_command
from kineverse.compilation.c_library import SourceLibrary, struct_fields
from kineverse.errors import InvalidValueError, MissingDependencyError, ShapeError

Vector = NDArray[np.float64]
Status = Literal["solved", "infeasible", "failed"]

SOFT_WEIGHT = 1e6  # default weight of the squared violation of a soft row
_FEASIBLE = 1e-8**2  # largest squared violation of the hard rows, relative to 1 plus the square of [x; A x]
_SOFT, _EQUALITY = 8, 5
_INFINITY = 1e8
"""Bounds beyond are none in warm starts: far from all speeds and lengths, but near enough for doubles."""
_INFEASIBLE = {-1, -6}
_SETTINGS = {"primal_tol": 1e-9}
_REDUCED_SETTINGS = {"primal_tol": 1e-9, "eq_reduction": 1}
_SOFT_SETTINGS = {"primal_tol": 1e-9, "sing_tol": 1e-13}
"""Pivots of soft rows are as small as the reciprocals of their weights."""
_SCALED_SETTINGS = ({"primal_tol": 1e-9, "sing_tol": 1e-13}, {"primal_tol": 1e-6, "sing_tol": 1e-13})
"""Nearly parallel rows are distinguished; a larger tolerance prevents cycles."""


class QpSolution(NamedTuple):
    """Outcome of a quadratic program.

    The multipliers satisfy ``H x + f + [I; A]' multipliers = 0``: negative at a lower bound, positive at an
    upper one. The status is "infeasible" if no x satisfies all hard rows, and "failed" if the data are not
    finite, H is not positive definite, or the solver did not converge; x and multipliers are zeros then.
    """

    x: Vector  # (n,)
    multipliers: Vector  # (n + m,), of [x; A x]
    iterations: int
    status: Status


class _Rows(ctypes.Structure):
    _fields_ = struct_fields("i n m; p A lower upper hard values low high")


def _declare(code: Any) -> None:
    code.violation.argtypes, code.violation.restype = (ctypes.c_void_p,), ctypes.c_double
    code.bound.argtypes, code.bound.restype = (ctypes.c_void_p, ctypes.c_double), None


_library = SourceLibrary("qp.c", _declare)


class QpSolver:
    """Dual active-set solver DAQP (Arnström, Bemporad, Axehill 2022), started from the last active set.

    Its tolerance of violations is 1e-9, in the units of the rows. A violation s of a soft entry of [x; A x]
    costs ``1/2 soft_weight s^2``.
    """

    def __init__(
        self, n: int, m: int, *, soft: ArrayLike | None = None, soft_weight: ArrayLike = SOFT_WEIGHT
    ) -> None:
        if n < 1 or m < 0:
            raise InvalidValueError(f"A quadratic program has unknowns, n >= 1, and m >= 0, not {n}, {m}.")
        self.n, self.m = n, m
        self.soft = np.zeros(n + m, bool) if soft is None else np.array(soft, bool)
        if self.soft.shape != (n + m,):
            raise ShapeError(f"soft has the shape {self.soft.shape}, not ({n + m},), as for [x; A x].")
        self._weight = np.broadcast_to(np.asarray(soft_weight, float), n + m).copy()
        if not (np.isfinite(self._weight) & (self._weight > 0)).all():
            raise InvalidValueError("The weights of soft rows are finite and above 0.")
        self._bound: tuple[Any, ...] = (None,) * 5
        self._hard, self._any_soft = (~self.soft).astype(float), bool(self.soft.any())
        self._values, self._low, self._high = np.zeros((3, n + m))
        self._x = self._values[:n]
        self._entries = _Rows(n, m)
        arrays = {"hard": self._hard, "values": self._values, "low": self._low, "high": self._high}
        for name, array in arrays.items():
            setattr(self._entries, name, array.ctypes.data)
        self._address = ctypes.addressof(self._entries)
        _library.prepare()
        try:
            import daqp
        except ImportError as error:
            command = install_command("control")
            raise MissingDependencyError(f"Quadratic programs need daqp: {command}") from error
        self._daqp: Any = daqp
        self._model: Any = None
        self._warm = False

    def reset(self) -> None:
        """Forget the last solution, so that the next solve starts from scratch."""
        self._warm = False

    def solve(self, H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> QpSolution:
        """Minimise ``1/2 x'Hx + f'x`` subject to ``lower <= [x; A x] <= upper``.

        H is (n, n), f (n,), A (m, n), and the bounds are (n + m,). The arrays are read in place: rewrite the
        same ones for each solve, since other ones are checked again.
        """
        h, g, a, low, high = self._bound
        if H is not h or f is not g or A is not a or lower is not low or upper is not high:
            self._bind(H, f, A, lower, upper)
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
        return self._solve_cold(H, f, A, lower, upper)

    def _solve_cold(self, H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> QpSolution:
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
            bounds = lower * scale, upper * scale
            flag, x, multipliers, iterations = self._start(*scaled, *bounds, scale, settings)
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
            reciprocal, linear = scale**2 / self._weight, np.zeros_like(scale)
            model.soft_weights(reciprocal, reciprocal, linear, linear)
        x, _, flag, info = model.solve()
        return flag, x, info["lam"], info["iterations"]

    def _satisfies(self, x: Vector) -> bool:
        """Return whether x satisfies the problem's hard rows; any NaN, there or in x, makes that False."""
        self._x[:] = x
        code = _library.code
        if code is not None:
            return bool(code.violation(self._address) <= _FEASIBLE)
        values, (_, _, A, lower, upper) = self._values, self._bound
        A.dot(x, values[self.n :])
        size = values.dot(values)
        if not size < np.inf:
            return False
        violations = self._hard * np.maximum(np.maximum(values - upper, lower - values), 0.0)
        return bool(violations.dot(violations) <= _FEASIBLE * (1.0 + size))

    def _bound_by(self, limit: float) -> tuple[Vector, Vector]:
        """Return the problem's bounds within a limit, in arrays that the next call overwrites."""
        code, (*_, lower, upper) = _library.code, self._bound
        if code is not None:
            code.bound(self._address, limit)
        else:
            np.maximum(lower, -limit, out=self._low)
            np.minimum(upper, limit, out=self._high)
        return self._low, self._high

    @staticmethod
    def _unsolvable(H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> Status | None:
        """Return the status of a problem that no solver needs to see; None for any other."""
        if not all(np.isfinite(array).all() for array in (H, f, A)):
            return "failed"
        if np.isnan(lower).any() or np.isnan(upper).any() or (H.diagonal() <= 0.0).any():
            return "failed"
        ordered = (lower <= upper) & (lower < np.inf) & (upper > -np.inf)
        return None if ordered.all() else "infeasible"

    def _nothing(self, status: Status, iterations: int = 0) -> QpSolution:
        return QpSolution(np.zeros(self.n), np.zeros(self.n + self.m), iterations, status)

    def _bind(self, H: Vector, f: Vector, A: Vector, lower: Vector, upper: Vector) -> None:
        n, m = self.n, self.m
        arrays = {"H": H, "f": f, "A": A, "lower": lower, "upper": upper}
        shapes = (n, n), (n,), (m, n), (n + m,), (n + m,)
        for (name, array), shape in zip(arrays.items(), shapes, strict=True):
            if not isinstance(array, np.ndarray) or array.dtype != np.float64 or not array.flags.c_contiguous:
                raise InvalidValueError(
                    f"{name} is read in place, so it is a C-contiguous array of doubles: "
                    f"numpy.ascontiguousarray({name}, float)."
                )
            if array.shape != shape:
                raise ShapeError(f"{name} has the shape {array.shape}, not {shape} (n = {n}, m = {m}).")
        self._bound = (H, f, A, lower, upper)
        for name, array in (("A", A), ("lower", lower), ("upper", upper)):
            setattr(self._entries, name, array.ctypes.data)
