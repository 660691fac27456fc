"""Outside of their bounds rows on positions still leave a way for all rows at once, and it leads inside.

The oracle is a linear program over the rows' numbers; how far bounds are and how speeds change them is computed
from the constraints themselves, not from the rows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_models import constrained
from scipy.optimize import linprog

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.model.velocity_constraints.velocity_rows import VelocityRows

q = [kv.position(f"q{i}") for i in range(4)]
v = [s.derivative() for s in q]
acc = [s.derivative() for s in v]
p = kv.parameter("p", 0.0)
Triples = dict[str, tuple[Any, Any, Any]]
Numbers = tuple[np.ndarray, np.ndarray, np.ndarray]


def numbers(rows: VelocityRows, at: Mapping[kv.Symbol, float]) -> Numbers:
    parts = (rows.matrix, rows.lower, rows.upper)
    matrix, lower, upper = (part({s: at[s] for s in part.symbols}) for part in parts)
    assert not np.isnan(np.hstack([matrix.ravel(), lower, upper])).any()
    return matrix, lower, upper


def best(wish: np.ndarray, matrix: np.ndarray, lower: np.ndarray, upper: np.ndarray, far: float = 1e7) -> Any:
    """Return the speeds, of ``far`` at most, that get most of a wish; fail if the rows contradict each other."""
    both, ends = np.vstack([matrix, -matrix]), np.hstack([upper, -lower])
    keep = np.isfinite(ends)
    found = linprog(-wish, both[keep], ends[keep], bounds=[(-far, far)] * len(wish), method="highs")
    assert found.status == 0, (found.message, matrix, lower, upper)
    return found.x


def row(rows: VelocityRows, name: str, at: Mapping[kv.Symbol, float]) -> tuple[list[float], float, float]:
    matrix, lower, upper = numbers(rows, at)
    (k,) = (i for i, n in enumerate(rows.names) if n == name)
    return matrix[k].tolist(), float(lower[k]), float(upper[k])


# -- any model, anywhere -----------------------------------------------------------------------------------------


def some_limits_of_speeds(rng: np.random.Generator) -> Triples:
    """Single, one-sided, locked, summed, scaled, depending on positions, of norms; all allow to stand still."""
    triples: Triples = {}
    for k in range(4):
        if rng.random() < 0.7:
            low, high = -rng.choice([0.5, 2, math.inf], p=[0.5, 0.4, 0.1]), rng.choice([0.3, 1, 5])
            free = (q[(k + 1) % 4] > 0) if rng.random() < 0.2 else 1.0
            triples[f"speed {k}"] = (low if math.isinf(low) else low * free, v[k], high * free)
        if rng.random() < 0.25:
            triples[f"brake {k}"] = (-rng.uniform(0.1, 3), acc[k], rng.uniform(0.1, 3))
    for k in range(rng.integers(0, 3)):
        i, j = rng.permutation(4)[:2]
        x, y = rng.normal(size=2)
        forms = [
            x * v[i] + y * v[j],
            v[i] - v[j],
            (1 + q[j] ** 2) * v[i],
            np.sin(q[i]) * v[j] + x * v[i],
            v[i] * q[j],
        ]
        expression = forms[rng.integers(len(forms))]
        high = rng.choice([0.0, 0.2, 1.0], p=[0.1, 0.5, 0.4])
        triples[f"sum {k}"] = (-rng.choice([0.1, 1, math.inf]), expression, high)
    for k in range(rng.integers(0, 2)):
        i, j, m = rng.permutation(4)[:3]
        forms = [
            kv.norm(kv.array([v[i], v[j]])),
            0.5 * kv.norm(kv.array([2 * v[i], v[j] - v[m]])),
            np.hypot(v[i], np.cos(q[m]) * v[j] + np.sin(q[m]) * v[i]),
            kv.norm(kv.array([q[m] * v[i]])),
        ]
        triples[f"norm {k}"] = (-math.inf, forms[rng.integers(len(forms))], rng.uniform(0, 1))
    return triples


def some_limits_of_positions(rng: np.random.Generator) -> Triples:
    """On single coordinates, sums, products, distances, between bounds that move; also with no room inside."""
    triples: Triples = {}
    for k in range(rng.integers(1, 6)):
        i, j, m = rng.permutation(4)[:3]
        forms = [
            q[i],
            -2 * q[i],
            q[i] + rng.choice([0.1, -1, 3]) * q[j],
            q[i] * q[j],
            np.sin(q[i]) * q[j] - q[m],
            kv.norm(kv.array([q[i], q[j]])),
            q[0] + q[1] - q[2] + q[3],
        ]
        low, width = rng.normal(), rng.choice([0, 0.01, 1, math.inf])
        bounds: tuple[Any, Any] = (low, low + width)
        if rng.random() < 0.3:
            bounds = [(q[m], q[m] + width), (-math.inf, q[m]), (q[m] - 1, q[j] + p), (p, p + 1)][
                rng.integers(4)
            ]
        if math.isinf(float(width)) and any(isinstance(b, kv.Expression) for b in bounds):
            bounds = (q[m], math.inf)
        triples[f"position {k}"] = (bounds[0], forms[rng.integers(len(forms))], bounds[1])
    return triples


def somewhere(rng: np.random.Generator) -> dict[kv.Symbol, float]:
    values = [rng.choice([0.0, rng.normal(), 10 * rng.normal(), rng.integers(-1, 2)]) for _ in q]
    return {**dict(zip(q, map(float, values), strict=True)), p: 0.0}


def sides(model: kv.Model, rows: VelocityRows, at: Mapping[kv.Symbol, float]) -> Sequence[tuple[float, Any]]:
    """Return for each bound on positions its distance, negative outside, and the distance's change with speeds."""
    found = []
    for constraint in model.constraints.values():
        if constraint.order:
            continue
        for distance in (constraint.upper - constraint.expression, constraint.expression - constraint.lower):
            slopes = distance.gradient(heuristic=False)
            change = [
                slopes[s]({x: at[x] for x in slopes[s].symbols}) if s in slopes else 0 for s in rows.speeds
            ]
            far = float(distance({x: at[x] for x in distance.symbols}))
            if math.isfinite(far) and np.any(change):
                found.append((far, np.array(change, dtype=float)))
    return found


@settings(max_examples=attempts(25))
@given(seed=st.integers(0, 2**32), dt=st.sampled_from([0.01, 0.1, 1]), share=st.sampled_from([1, 0.2]))
def test_all_rows_together_can_be_obeyed_from_anywhere(seed: int, dt: float, share: float) -> None:
    rng = np.random.default_rng(seed)
    model = constrained({**some_limits_of_speeds(rng), **some_limits_of_positions(rng)})
    chosen = [v[i] for i in sorted(rng.permutation(4)[:3])] if rng.random() < 0.3 else None
    rows = model.velocity_rows(dt, speeds=chosen, gain=share / dt)
    assert not any("affine" in reason for _, reason in rows.skipped), rows.skipped
    if not rows.names:
        return
    for _ in range(4):
        at = somewhere(rng)
        obeyed = best(rng.normal(size=len(rows.speeds)), *numbers(rows, at))
        for distance, change in sides(model, rows, at):
            size = 1e-6 * (1 + np.abs(change).max())
            if distance >= 0:  # a step does not cross it
                assert change @ obeyed * dt >= -distance - size
            else:  # and nothing leads further out
                assert change @ obeyed >= -size


# -- as fast as limits allow -------------------------------------------------------------------------------------


@settings(max_examples=attempts(15))
@given(seed=st.integers(0, 2**32), far=st.floats(0.001, 100))
def test_a_bound_alone_asks_for_all_that_single_limits_give(seed: int, far: float) -> None:
    """The linear program that goes inside as fast as it can is no faster."""
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=4) * rng.choice([0.0, 1.0], 4)
    expression = sum((w * x for w, x in zip(weights, q, strict=True)), 3 * q[0] * q[1])
    limits: Triples = {f"speed {k}": (-rng.uniform(0, 1), v[k], rng.uniform(0, 1)) for k in range(4)}
    at = somewhere(rng)
    value = float(expression({x: at[x] for x in expression.symbols}))
    rows = constrained({**limits, "n": (-math.inf, expression, value - far)}).velocity_rows(0.1)
    weights, _, upper = row(rows, "n", at)
    free = constrained({**limits, "n": (-1e9, expression, 1e9)}).velocity_rows(0.1)
    fastest = best(-np.array(weights), *numbers(free, at))
    assert upper == pytest.approx(max(-far / 0.1, weights @ fastest), rel=1e-6, abs=1e-4)


def test_bounds_that_agree_are_all_asked_for_at_full_speed() -> None:
    speeds: Triples = {f"speed {k}": (-k - 1, v[k], k + 1) for k in range(4)}
    rows = constrained(
        {**speeds, "0": (0, q[0], 1), "1": (0, q[1], 1), "sum": (-math.inf, q[0] + q[1] - q[2], 1)}
    ).velocity_rows(0.01)
    at = {q[0]: 50.0, q[1]: 50.0, q[2]: 0.0}
    assert [row(rows, name, at)[2] for name in ("0", "1", "sum")] == [-1, -2, -6]


def test_a_speed_without_room_recovers_only_with_the_help_of_others() -> None:
    speeds: Triples = {f"speed {k}": (-1, v[k], 1) for k in range(2)}
    rows = constrained(
        {**speeds, "sum": (2, q[0] + q[1], math.inf), "difference": (0, q[0] - q[1], 1)}
    ).velocity_rows(0.1)
    for here in (0.0, 0.01, 0.5):  # q0 makes room for q1
        assert row(rows, "sum", {q[0]: here, q[1]: 0.0})[1] == pytest.approx(2)
    helped = constrained({**speeds, "up": (2, q[0], 9), "difference": (-math.inf, q[0] - q[1], 0)})
    at = {q[0]: 0.0, q[1]: 0.0}
    assert row(helped.velocity_rows(0.1), "up", at)[1] == 1  # q1, which is about something else, goes along
    alone = helped.velocity_rows(0.1, speeds=[v[0]])
    assert row(alone, "up", at)[1] == 0
    assert row(alone, "up", at | {q[1]: 0.05})[1] == pytest.approx(0.5)


def test_a_speed_requested_in_both_directions_is_zero() -> None:
    speeds: Triples = {f"speed {k}": (-1, v[k], 1) for k in range(2)}
    pulled = constrained({**speeds, "up": (2, q[0], 9), "down": (-9, q[0] - q[1], 1)}).velocity_rows(0.1)
    at = {q[0]: 1.0, q[1]: -9.0}
    assert row(pulled, "up", at)[1] <= 1
    assert row(pulled, "down", at)[2] < 0


# -- what limits are made of -------------------------------------------------------------------------------------


@pytest.mark.parametrize("turned", [1, -1])
def test_the_way_back_leaves_room_to_brake_before_the_other_bound(turned: int) -> None:
    brake: Triples = {"brake": (-1, acc[0], 1)}
    narrow = constrained({**brake, "range": (0, turned * q[0], 0.01), "speed": (-2, v[0], 2)})
    braked = 0.01 - math.sqrt(0.01**2 + 2 * 0.02)  # from 0.02 to 0
    _, lower, upper = row(narrow.velocity_rows(0.01), "range", {q[0]: 0.02 * turned})
    assert (lower, upper) == pytest.approx((braked, braked))
    wide = constrained({**brake, "range": (0, turned * q[0], 1)})
    _, lower, upper = row(wide.velocity_rows(0.01), "range", {q[0]: 2.0 * turned})
    braked = 0.01 - math.sqrt(0.01**2 + 2 * 2)
    assert (lower, upper) == pytest.approx((braked, braked))


LIMITED_BY: dict[str, tuple[Triples, float]] = {
    "a sum with a speed without limits": ({"one": (-1, v[0], 1), "sum": (-1, v[0] + v[1], 1)}, -1),
    "a coefficient of another position": ({"one": (-1, (1 + q[0] ** 2) * v[1], 1)}, -0.2),
    "a quotient": ({"one": (-1, v[1] / q[1], 1)}, -10),
    "a scaled norm": ({"one": (0, 2 * kv.norm(kv.array([v[1], v[0]])), 1)}, -math.cos(math.pi / 16) / 2),
    "a norm of scaled speeds": (
        {"one": (0, kv.norm(kv.array([2 * v[1], v[0]])), 1)},
        -math.cos(math.pi / 16) / 2,
    ),
    "hypot": ({"one": (0, np.hypot(v[0], 4 * v[1]) / 2, 1)}, -math.cos(math.pi / 16) / 2),
    "a norm that turns": (
        {"one": (0, kv.norm(kv.array([np.cos(q[0]) * v[1], np.sin(q[0]) * v[1], v[0]])), 2)},
        -2 * math.cos(math.pi / 16) ** 2,
    ),
    "a norm with an offset": ({"one": (0, kv.norm(kv.array([v[1] + 0.5])), 1)}, -0.5),
}


@pytest.mark.parametrize("name", LIMITED_BY)
def test_every_kind_of_speed_limit_clips_the_way_back(name: str) -> None:
    triples, expected = LIMITED_BY[name]
    rows = constrained({**triples, "range": (0, q[1], 1)}).velocity_rows(0.01)
    assert not rows.skipped
    at = {q[0]: 2.0, q[1]: 10.0}
    assert row(rows, "range", at)[2] == pytest.approx(expected)
    best(np.ones(len(rows.speeds)), *numbers(rows, at))


@pytest.mark.parametrize("factor", [0.25, 2.0])
def test_a_factor_before_a_norm_scales_its_limit(factor: float) -> None:
    plain, both = kv.norm(kv.array([v[0], v[1]])), np.hypot(v[0], v[1])
    expected = constrained({"n": (0, plain, 1 / factor)}).velocity_rows(0.1)
    for expression in (factor * plain, plain / (1 / factor), factor * both):
        rows = constrained({"n": (0, expression, 1)}).velocity_rows(0.1)
        np.testing.assert_allclose(rows.matrix({}), expected.matrix({}))
        np.testing.assert_allclose(rows.upper({}), expected.upper({}))


@pytest.mark.parametrize(
    "expression", [kv.norm(kv.array([v[0], v[1]])) * q[2], -kv.norm(kv.array([v[0], v[1]]))]
)
def test_other_factors_make_no_rows(expression: kv.Expression) -> None:
    rows = constrained({"n": (-1, expression, 1)}).velocity_rows(0.1)
    assert dict(rows.skipped) == {"n": "it is neither affine in the speeds nor a norm of speeds"}


@pytest.mark.parametrize("expression", [q[0] * q[1], kv.norm(kv.array([q[0], q[1]])), q[0] ** 3])
def test_a_row_with_vanishing_gradient_demands_nothing(expression: kv.Expression) -> None:
    """The gradient vanishes at the origin, outside of the bounds, and no speed has a limit."""
    rows = constrained({"n": (1, expression, 2)}).velocity_rows(0.01)
    weights, lower, _ = row(rows, "n", {q[0]: 0.0, q[1]: 0.0})
    assert not any(weights)
    assert lower <= 0
    near = {q[0]: 1e-3, q[1]: 1e-3}
    if expression != q[0] ** 3:
        assert row(rows, "n", near)[1] > 90


@pytest.mark.parametrize("braked", [False, True])
@pytest.mark.parametrize("expression", [q[0], np.log(q[0]), np.log(q[0]) + q[1]])
def test_a_distance_that_is_no_number_is_none_in_the_rows(expression: kv.Expression, braked: bool) -> None:
    """And takes no other row with it."""
    speeds: Triples = {f"speed {k}": (-1, v[k], 1) for k in range(2)}
    brakes: Triples = {f"brake {k}": (-1, acc[k], 1) for k in range(2)} if braked else {}
    rows = constrained({**speeds, **brakes, "n": (0, expression, 1), "1": (0, q[1], 1)}).velocity_rows(0.1)
    bounds = kv.compile([rows.lower, rows.upper], q[:2], tier="interpreter")
    lower, upper = bounds([math.nan if expression == q[0] else -1.0, 5.0])
    n, other = rows.names.index("n"), rows.names.index("1")
    assert math.isnan(lower[n])
    assert math.isnan(upper[n])
    # Who is in both is not counted on.
    assert upper[other] == (-1 if q[1] not in expression.symbols else 0)
    assert lower[other] <= upper[other]


def test_limits_that_forbid_to_stand_still_are_kept_as_they_are() -> None:
    rows = constrained({"belt": (0.1, v[0], 0.3), "range": (-1, q[0], 1)}).velocity_rows(0.1)
    assert row(rows, "belt", {q[0]: 5.0})[1:] == (0.1, 0.3)
    assert row(rows, "range", {q[0]: -5.0})[1] == 0.3  # its way is the way back


# -- which speeds are columns ------------------------------------------------------------------------------------


def test_a_speed_without_a_column_is_zero() -> None:
    speeds: Triples = {"0": (-1, v[0], 1), "1": (-10, v[1], 10)}
    at = {q[0]: 5.0, q[1]: 0.0}
    for triple in ((0, q[0] + q[1], 1), (-math.inf, q[0], q[1])):
        model = constrained({**speeds, "range": triple, "brake": (-1, acc[0], 1)})
        rows = model.velocity_rows(0.1, speeds=[v[0]])
        assert row(rows, "range", at)[2] == -1
        # It alone has to brake.
        inside = {q[0]: 0.0, q[1]: 0.5}
        braked = math.sqrt(0.01 + 2 * 0.5) - 0.1
        assert row(rows, "range", inside)[2] == pytest.approx(braked)


def test_a_subject_brings_the_speed_limits_of_all_that_may_move() -> None:
    model = constrained(
        {
            "bound": (-math.inf, q[0], q[1]),
            "0": (-1, v[0], 1),
            "1": (-0.1, v[1], 0.1),
            "1 and 2": (-1, v[1] + v[2], 1),
            "2": (-3, v[2], 3),
            "2's range": (-3, q[2], 3),
            "3": (-3, v[3], 3),
            "brake": (-1, acc[1], 1),
        }
    )
    rows = model.velocity_rows(0.1, subject=q[0])
    assert sorted(rows.names) == ["0", "1", "1 and 2", "2", "bound"]
    assert rows.speeds == (v[0], v[1], v[2])
    at = dict.fromkeys(q, 0.0) | {q[0]: 5.0}
    assert row(rows, "bound", at)[2] == pytest.approx(-1.1)
    assert model.velocity_rows(0.1, subject=q[0], speeds=[v[0]]).names == ("0", "bound")
    with model.edit() as edit:
        edit.constrain("brake 0", -2, acc[0], 2)
    rows = model.velocity_rows(0.1, subject=q[0])
    assert row(rows, "bound", at | {q[0]: -1.0})[2] == pytest.approx(math.sqrt(0.09 + 6) - 0.3)


def test_a_subject_adds_the_speed_limits_of_driven_coordinates() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="base", parent="world", child="base", radius=0.1, track=0.5
            )
        )
        edit.constrain("follow", -math.inf, q[0], kv.position("base/x"))
        edit.constrain("along", -0.2, kv.velocity("base/y"), 0.2)
    rows = model.velocity_rows(0.1, subject=q[0])
    assert set(rows.names) == {"follow", "along"}
    assert [str(s) for s in rows.speeds] == [
        "base/left_wheel:velocity",
        "base/right_wheel:velocity",
        "q0:velocity",
    ]
