"""The QP solver against the conditions of Karush, Kuhn and Tucker, against OSQP, and against SciPy."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.optimize
from control_models import solve_by_osqp

from kineverse.control import qp
from kineverse.control.qp import QpSolution, QpSolver
from kineverse.errors import InvalidValueError, MissingDependencyError, ShapeError

Problem = tuple[Any, Any, Any, Any, Any]
N, M = 7, 10


def random_problem(
    rng: np.random.Generator, n: int = N, m: int = M, equalities: int = 0, decades: float = 0.0
) -> Problem:
    """Return a feasible problem; the diagonal of H spans twice the decades, up and down."""
    J, unit = rng.normal(size=(n // 2, n)), 10 ** rng.uniform(-decades, decades, n)
    H = (J.T @ J + 0.01 * np.eye(n)) * np.outer(unit, unit)
    f, A, inside = 3.0 * rng.normal(size=n) * unit, rng.normal(size=(m, n)), rng.normal(size=n)
    values = np.concatenate([inside, A @ inside])
    lower, upper = values - rng.exponential(size=n + m), values + rng.exponential(size=n + m)
    lower[rng.random(n + m) < 0.2] = -np.inf
    upper[rng.random(n + m) < 0.2] = np.inf
    fixed = rng.choice(n + m, equalities, replace=False)
    lower[fixed] = upper[fixed] = values[fixed]
    return H, f, A, lower, upper


def optimality(problem: Problem, solution: QpSolution) -> float:
    """Return the largest violation of the conditions of optimality, relative to f and to the multipliers."""
    H, f, A, lower, upper = problem
    x, multipliers = solution.x, solution.multipliers
    values = np.concatenate([x, A @ x])
    stationary = H @ x + f + multipliers[: len(x)] + A.T @ multipliers[len(x) :]
    gap = np.where(multipliers == 0, 0.0, np.where(multipliers > 0, upper - values, values - lower))
    slack = gap * multipliers / (1 + abs(multipliers).max())
    outside = np.maximum(np.maximum(lower - values, values - upper), 0.0)
    return float(max(abs(stationary).max() / (1 + abs(f).max()), outside.max(), abs(slack).max()))


@pytest.mark.parametrize("equalities", [0, 3, N])
def test_solutions_are_optimal(equalities: int) -> None:
    """Also when started from the solution of another problem, whose bounds may have been finite."""
    rng, solver = np.random.default_rng(equalities), QpSolver(N, M)
    for _ in range(100):
        problem = random_problem(rng, equalities=equalities)
        solution = solver.solve(*problem)
        assert solution.status == "solved"
        assert optimality(problem, solution) < 1e-6


def test_bounds_that_become_infinite_do_no_harm() -> None:
    """A warm start of daqp itself returns wrong solutions as solved when bounds that were active vanish."""
    rng = np.random.default_rng(4)
    for n, m in ((2, 0), (4, 1), (6, 3)):
        solver = QpSolver(n, m)
        for _ in range(400):
            problem = random_problem(rng, n, m)
            solution = solver.solve(*problem)
            assert solution.status == "solved"
            assert optimality(problem, solution) < 1e-6


@pytest.mark.parametrize("softened", [False, True])
def test_solutions_agree_with_those_of_osqp(softened: bool) -> None:
    """Of hard rows; and of rows with penalties, which are unknowns of their own in OSQP."""
    pytest.importorskip("osqp")
    rng = np.random.default_rng(12)
    soft = rng.random(N + M) < 0.5 if softened else np.zeros(N + M, bool)
    solver = QpSolver(N, M, soft=soft, soft_weight=10.0)
    for index in range(6):
        H, f, A, lower, upper = random_problem(rng, equalities=0 if softened else index % 3)
        lower[soft] += 1.0
        upper[soft] += 1.0
        x, multipliers = solve_by_osqp((H, f, A, lower, upper), soft, 10.0)
        solution = solver.solve(H, f, A, lower, upper)
        np.testing.assert_allclose(solution.x, x, atol=1e-5)
        np.testing.assert_allclose(solution.multipliers, multipliers, atol=1e-4)


def test_least_squares_within_bounds_are_as_scipy_solves_them() -> None:
    rng, solver = np.random.default_rng(6), QpSolver(N, 0)
    for _ in range(5):
        J, r = rng.normal(size=(9, N)), rng.normal(size=9)
        bounds = np.full(N, -0.1), np.full(N, 0.2)
        oracle = scipy.optimize.lsq_linear(J, r, bounds, tol=1e-14)
        x = solver.solve(np.ascontiguousarray(J.T @ J), -J.T @ r, np.zeros((0, N)), *bounds).x
        np.testing.assert_allclose(x, oracle.x, atol=1e-6)


def test_daqp_solves_over_many_decades() -> None:
    """Weights that span 1e8 and more cost accuracy, not the solution."""
    for decades in (1.0, 2.0, 3.0):
        rng, solver = np.random.default_rng(7), QpSolver(13, 22)
        for index in range(60):
            problem = random_problem(rng, 13, 22, 4 * (index % 2), decades)
            solution = solver.solve(*problem)
            assert solution.status == "solved"
            assert optimality(problem, solution) < 1e-6


def test_rows_of_few_micrometres_are_kept() -> None:
    """A row is not dropped because its entries are small beside the weights."""
    for size in (1e-2, 1e-4, 1e-6):
        solver = QpSolver(2, 1)
        H, f, A = np.eye(2) * 1e8, np.array([-1e8, -1e8]), np.array([[size, size]])
        solution = solver.solve(H, f, A, np.full(3, -np.inf), np.array([np.inf, np.inf, size]))
        assert solution.status == "solved"
        np.testing.assert_allclose(solution.x, [0.5, 0.5], atol=1e-6 if size > 1e-5 else 2e-2)


def test_zero_rows_and_doubled_rows_change_nothing() -> None:
    rng = np.random.default_rng(8)
    few, many = QpSolver(N, M), QpSolver(N, 2 * M + 2)
    for index in range(5):
        H, f, A, lower, upper = random_problem(rng, equalities=2 * (index % 2))
        more = np.concatenate([A, np.zeros((2, N)), A])
        low = np.concatenate([lower, [0.0, -1.0], lower[N:]])
        high = np.concatenate([upper, [0.0, np.inf], upper[N:]])
        first, second = few.solve(H, f, A, lower, upper), many.solve(H, f, more, low, high)
        assert first.status == second.status == "solved"
        np.testing.assert_allclose(second.x, first.x, atol=1e-6)


def test_infeasible_problems_are_told_and_do_no_harm() -> None:
    rng, solver = np.random.default_rng(9), QpSolver(N, M)
    for index in range(4):
        good = random_problem(rng)
        H, f, A, lower, upper = random_problem(rng)
        if index == 0:
            lower[2], upper[2] = 1.0, 0.0
        elif index == 1:
            A[1], lower[N : N + 2], upper[N : N + 2] = A[0], [1.0, -2.0], [2.0, -1.0]
        elif index == 2:
            A[3], lower[N + 3], upper[N + 3] = 0.0, 1.0, 2.0
        else:
            A[3], A[4] = A[5] + A[6], A[5] - 2 * A[6]
            lower[N + 3 : N + 7] = upper[N + 3 : N + 7] = [1.0, 1.0, 1.0, 1.0]
        bad = solver.solve(H, f, A, lower, upper)
        assert bad.status == "infeasible"
        assert not bad.x.any()
        assert not bad.multipliers.any()
        solution = solver.solve(*good)
        assert solution.status == "solved"
        assert optimality(good, solution) < 1e-6


@pytest.mark.parametrize("part", range(5))
def test_no_nan_counts_as_solved(part: int) -> None:
    rng, solver = np.random.default_rng(10 + part), QpSolver(N, M)
    for index in range(12):
        problem = random_problem(rng, equalities=index % 3)
        solver.solve(*problem)
        where = rng.integers(problem[part].size)
        kept = problem[part].flat[where]
        problem[part].flat[where] = np.nan
        for solve in (solver.solve, QpSolver(N, M).solve):
            broken = solve(*problem)
            assert broken.status == "failed"
            assert not broken.x.any()
            assert not broken.multipliers.any()
        problem[part].flat[where] = kept
        solution = solver.solve(*problem)
        assert solution.status == "solved"
        assert optimality(problem, solution) < 1e-6


def test_infinite_costs_and_indefinite_ones_fail() -> None:
    H, f, A, lower, upper = random_problem(np.random.default_rng(11))
    solver = QpSolver(N, M)
    assert solver.solve(H, np.full(N, np.inf), A, lower, upper).status == "failed"
    assert solver.solve(-H, f, A, lower, upper).status == "failed"


def test_soft_rows_give_way_by_their_weights() -> None:
    """Of ``x <= 0`` and ``x >= 1`` at weights 1 and 3 the optimum is 3/4; hard bounds hold."""
    solver = QpSolver(1, 2, soft=np.array([False, True, True]), soft_weight=[1.0, 1.0, 3.0])
    H, f, A = np.array([[1e-7]]), np.zeros(1), np.ones((2, 1))
    low, high = np.array([-np.inf, -np.inf, 1.0]), np.array([np.inf, 0.0, np.inf])
    solution = solver.solve(H, f, A, low, high)
    assert solution.x[0] == pytest.approx(0.75, abs=1e-6)
    np.testing.assert_allclose(solution.multipliers, [0.0, 0.75, -0.75], atol=1e-6)
    high[0] = 0.5
    assert solver.solve(H, f, A, low, high).x[0] == pytest.approx(0.5, abs=1e-6)
    low[0], high[0] = 2.0, 1.0
    assert solver.solve(H, f, A, low, high).status == "infeasible"


def test_arrays_are_read_in_place() -> None:
    rng, solver = np.random.default_rng(13), QpSolver(N, M)
    arrays = random_problem(rng)
    for _ in range(5):
        problem = random_problem(rng)
        for array, new in zip(arrays, problem, strict=True):
            array[:] = new
        assert optimality(problem, solver.solve(*arrays)) < 1e-6


def test_bad_input_is_told() -> None:
    H, f, A, lower, upper = random_problem(np.random.default_rng(14))
    solver = QpSolver(N, M)
    with pytest.raises(ShapeError, match=r"A has the shape \(9, 7\), not \(10, 7\)"):
        solver.solve(H, f, A[1:], lower, upper)
    with pytest.raises(InvalidValueError, match="A is read in place"):
        solver.solve(H, f, np.asfortranarray(A), lower, upper)
    with pytest.raises(InvalidValueError, match="f is read in place"):
        solver.solve(H, f.astype(np.float32), A, lower, upper)
    with pytest.raises(ShapeError, match="soft has the shape"):
        QpSolver(N, M, soft=[True])
    with pytest.raises(InvalidValueError, match="weights"):
        QpSolver(N, M, soft_weight=0.0)
    with pytest.raises(InvalidValueError, match="unknowns"):
        QpSolver(0, M)


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "daqp", None)
    with pytest.raises(MissingDependencyError, match=r"need daqp.*install"):
        QpSolver(N, M)


@pytest.mark.compiler
def test_solutions_are_checked_in_c_as_in_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Violations on both sides of the tolerance, soft entries, and what is not finite."""
    assert qp._library.prepare(wait=True)
    rng, answers = np.random.default_rng(0), []
    soft = np.zeros(N + M, bool)
    soft[[1, N + 2]] = True
    for case in range(200):
        H, f, A, lower, upper = problem = random_problem(rng, equalities=2)
        x = QpSolver(N, M).solve(*problem).x
        place, size = rng.integers(N + M), 10.0 ** rng.uniform(-10, -6)
        lower[place] = np.concatenate([x, A @ x])[place] + size
        upper[place] = max(upper[place], lower[place])
        if case % 10 == 0:
            [x, A, lower, upper][rng.integers(4)].flat[place % N] = [np.nan, np.inf, -np.inf][case // 10 % 3]
        found = []
        for library in (qp._library, SimpleNamespace(code=None, prepare=lambda: None)):
            monkeypatch.setattr(qp, "_library", library)
            solver = QpSolver(N, M, soft=soft if case % 2 else None)
            solver._bind(H, f, A, lower, upper)
            with np.errstate(all="ignore"):
                satisfied = solver._satisfies(x)
            low, high = (bounds.copy() for bounds in solver._bound_by(0.5))
            found.append((satisfied, low, high))
        monkeypatch.undo()
        assert found[0][0] == found[1][0]
        np.testing.assert_array_equal(found[0][1], np.maximum(lower, -0.5))
        np.testing.assert_array_equal(found[1][1], found[0][1])
        np.testing.assert_array_equal(found[0][2], np.minimum(upper, 0.5))
        np.testing.assert_array_equal(found[1][2], found[0][2])
        answers.append(satisfied)
    assert 20 < sum(answers) < 180
