"""Quadratic programs: several solvers behind one interface.

The problem is to minimise ``1/2 x'Hx + f'x`` subject to ``lower <= [x; A x] <= upper``. The first n entries
of the bounds are those of x itself, the other m those of the rows of A. A bound may be infinite, and rows
whose bounds are equal are equalities.
"""

from __future__ import annotations

from numpy.typing import ArrayLike

from kineverse.errors import UnknownNameError, suggest

from .qp import SOFT_WEIGHT, DaqpSolver, QpSolution, QpSolver
from .slack_solvers import OsqpSolver, ProxqpSolver

__all__ = ["SOFT_WEIGHT", "SOLVERS", "QpSolution", "QpSolver", "make_solver"]


def make_solver(
    name: str,
    n: int,
    m: int,
    *,
    soft: ArrayLike | None = None,
    soft_weight: ArrayLike = SOFT_WEIGHT,
    soft_linear: ArrayLike = 0.0,
) -> QpSolver:
    """Make a solver of quadratic programs with n unknowns and m rows."""
    if name not in SOLVERS:
        raise UnknownNameError(f"There is no QP solver {name!r}. {suggest(name, SOLVERS, 'solver')}")
    return SOLVERS[name](n, m, soft, soft_weight, soft_linear)


SOLVERS: dict[str, type[QpSolver]] = {
    "daqp": DaqpSolver,
    "proxqp": ProxqpSolver,
    "proxsuite": ProxqpSolver,
    "osqp": OsqpSolver,
}
"""The solvers by name."""
