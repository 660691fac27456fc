"""Conflicts of bounds and points of least violation, against SciPy's linear programs (HiGHS)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from control_models import solve_by_osqp
from scipy.optimize import linprog

from kineverse.control.infeasibility import ConflictingBound, find_irreducible_conflict, find_least_violation

System = tuple[Any, Any, Any]


def feasible(A: Any, lower: Any, upper: Any) -> bool:
    n = A.shape[1]
    if (lower > upper).any():
        return False
    rows, right = np.concatenate([A, -A]), np.concatenate([upper[n:], -lower[n:]])
    finite, bounds = np.isfinite(right), np.stack([lower[:n], upper[:n]], axis=1)
    return bool(linprog(np.zeros(n), rows[finite], right[finite], bounds=bounds).status == 0)


def with_only(system: System, bounds: Iterable[ConflictingBound]) -> System:
    A, lower, upper = system
    low, high = np.full(len(lower), -np.inf), np.full(len(upper), np.inf)
    for bound in bounds:
        if bound.side < 0:
            low[bound.row] = lower[bound.row]
        else:
            high[bound.row] = upper[bound.row]
    return A, low, high


def is_irreducible(system: System, conflict: tuple[ConflictingBound, ...]) -> bool:
    without = [[other for other in conflict if other != bound] for bound in conflict]
    return not feasible(*with_only(system, conflict)) and all(
        feasible(*with_only(system, w)) for w in without
    )


def random_system(rng: np.random.Generator, n: int, m: int, density: float = 1.0) -> System:
    """Return ranges around values of one point, of which 30 % are moved away."""
    A, x = rng.normal(size=(m, n)) * (rng.random((m, n)) < density), rng.normal(size=n)
    values = np.concatenate([x, A @ x]) + 1.5 * rng.normal(size=n + m) * (rng.random(n + m) < 0.3)
    return A, values - rng.exponential(size=n + m), values + rng.exponential(size=n + m)


@pytest.mark.parametrize(
    ("n", "m", "density", "count"), [(3, 6, 1.0, 30), (8, 15, 0.3, 15), (60, 200, 0.2, 1)]
)
def test_no_member_of_a_conflict_can_be_left_out(n: int, m: int, density: float, count: int) -> None:
    rng, found = np.random.default_rng(n), 0
    for _ in range(count):
        system = random_system(rng, n, m, density)
        conflict = find_irreducible_conflict(*system)
        assert bool(conflict) != feasible(*system)
        if conflict:
            found += 1
            assert is_irreducible(system, conflict)
            assert len(conflict) <= n + 1
    assert found > count // 3


def test_members_of_degenerate_conflicts_are_needed() -> None:
    """Doubled rows, zero rows and equalities."""
    rng = np.random.default_rng(1)
    for _ in range(15):
        A, lower, upper = random_system(rng, 5, 6, 0.5)
        A, low, high = np.concatenate([A, A, np.zeros((2, 5)), -3.0 * A]), lower[5:], upper[5:]
        lower, upper = (
            np.concatenate([lower, low, [-1.0, 0.0], -3.0 * high]),
            np.concatenate([upper, high, [1.0, 0.0], -3.0 * low]),
        )
        lower[5:8] = upper[5:8]
        conflict = find_irreducible_conflict(A, lower, upper)
        assert bool(conflict) != feasible(A, lower, upper)
        assert not conflict or is_irreducible((A, lower, upper), conflict)


def test_a_conflict_among_many_rows_is_found() -> None:
    """``x + y >= 3`` with ``x, y <= 1``, beside 200 rows that nothing contradicts."""
    rng = np.random.default_rng(2)
    A, lower, upper = rng.normal(size=(200, 60)), np.full(260, -1e3), np.full(260, 1e3)
    A[77], lower[60 + 77], upper[[4, 9]] = 0.0, 3.0, 1.0
    A[77, [4, 9]] = 1.0
    assert find_irreducible_conflict(A, lower, upper) == ((4, 1), (9, 1), (137, -1))


def test_contradictory_bounds_and_zero_rows_are_conflicts_of_their_own() -> None:
    A, lower, upper = np.zeros((1, 2)), np.array([-1.0, 1.0, -1.0]), np.array([1.0, 0.0, 1.0])
    assert find_irreducible_conflict(A, lower, upper) == ((1, -1), (1, 1))
    lower[1], lower[2] = 0.0, 0.5
    assert find_irreducible_conflict(A, lower, upper) == ((2, -1),)
    lower[2] = -0.5
    assert find_irreducible_conflict(A, lower, upper) == ()
    no_rows = np.zeros((0, 1))
    assert find_irreducible_conflict(no_rows, np.array([0.0]), np.array([np.inf])) == ()
    assert find_irreducible_conflict(no_rows, np.array([2.0]), np.array([1.0])) == ((0, -1), (0, 1))


def test_units_of_rows_do_not_matter() -> None:
    """A row in micrometres conflicts as one in metres does."""
    for scale in (1e-6, 1e-3, 1.0, 1e3, 1e6):
        A = np.array([[1.0, 1.0], [scale, scale]])
        lower, upper = np.array([-9, -9, 0.3, -np.inf]), np.array([9, 9, np.inf, -0.3 * scale])
        conflict = find_irreducible_conflict(A, lower, upper)
        assert conflict == ((2, -1), (3, 1))


def test_the_least_violation_is_optimal() -> None:
    """As another solver finds it, and 0 where the rows are feasible."""
    pytest.importorskip("osqp")
    rng = np.random.default_rng(3)
    for index in range(5):
        A, lower, upper = random_system(rng, 4, 9)
        hard = np.arange(13) < 4
        best = find_least_violation(A, lower, upper, hard=hard)
        x, _ = solve_by_osqp((np.eye(4), np.zeros(4), A, lower, upper), ~hard, 1e6)
        values = np.concatenate([x, A @ x])
        cost = np.sum(np.maximum(np.maximum(lower - values, values - upper), 0.0) ** 2)
        assert abs(best.violations[:4]).max() < 1e-7
        assert np.sum(best.violations**2) == pytest.approx(cost, rel=1e-4, abs=1e-8)
        assert (np.sum(best.violations**2) < 1e-8) == feasible(A, lower, upper), index


def test_violations_have_signs_and_contradictory_bounds_share() -> None:
    A, lower, upper = np.ones((1, 1)), np.array([1.0, -np.inf]), np.array([np.inf, 0.0])
    best = find_least_violation(A, lower, upper, np.array([False, False]))
    np.testing.assert_allclose(best.x, [0.5], atol=1e-5)
    np.testing.assert_allclose(best.violations, [-0.5, 0.5], atol=1e-5)
    best = find_least_violation(A, lower, upper, np.array([True, False]))
    np.testing.assert_allclose(best.violations, [0.0, 1.0], atol=1e-5)
    best = find_least_violation(np.zeros((0, 1)), np.array([2.0]), np.array([1.0]), np.array([False]))
    np.testing.assert_allclose(best.x, [1.5], atol=1e-5)
    np.testing.assert_allclose(abs(best.violations), [0.5], atol=1e-5)


def test_hard_rows_that_contradict_each_other_are_violated_least() -> None:
    lower, upper = np.array([1.0, -np.inf, 7.0]), np.array([np.inf, 0.0, 7.0])
    best = find_least_violation(np.ones((2, 1)), lower, upper, np.array([True, True, False]))
    np.testing.assert_allclose(best.x, [0.5], atol=1e-2)


def test_the_point_is_close_to_zero() -> None:
    lower, upper, soft = np.array([1.0, -np.inf]), np.array([1.0, 3.0]), np.array([False, False])
    best = find_least_violation(np.zeros((0, 2)), lower, upper, soft)
    np.testing.assert_allclose(best.x, [1.0, 0.0], atol=1e-5)
    best = find_least_violation(np.zeros((0, 1)), np.array([-1.0]), np.array([1.0]), soft[:1])
    np.testing.assert_allclose(best.x, [0.0])
