"""Rows in speeds keep a system that obeys them within its constraints, lead back, and can always be obeyed.

A controller is anything that picks speeds obeying the rows. Here it is a linear program with a random or a
hostile wish, so it goes to the corners of what rows allow; infeasible rows end the test.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from random_models import constrained, random_speeds, random_state, random_tree
from scipy.optimize import linprog
from scipy.spatial import HalfspaceIntersection

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.errors import InvalidValueError
from kineverse.model.velocity_constraints.velocity_rows import VelocityRows

a, b, c = (kv.position(n) for n in "abc")
va, vb, vc = (s.derivative() for s in (a, b, c))
DT = 0.1
Triples = Mapping[str, tuple[Any, Any, Any]]


def rows_of(triples: Triples, dt: float = DT, **options: Any) -> VelocityRows:
    return constrained(triples).velocity_rows(dt, **options)


class Controlled:
    """Coordinates that follow their speeds, and a controller that obeys the rows of a model."""

    def __init__(self, model: kv.Model, dt: float = DT, gain: float | None = None) -> None:
        self.dt, self.rows = dt, model.velocity_rows(dt, gain=gain)
        self.symbols = model.symbols
        parts = [self.rows.matrix, self.rows.lower, self.rows.upper]
        self._numbers = kv.compile(parts, self.symbols, tier="interpreter")

    def program(self, q: np.ndarray, wish: np.ndarray) -> np.ndarray:
        """Return the speeds that get most of a wish; fail if the rows contradict each other."""
        matrix, lower, upper = self._numbers(q)
        assert not np.isnan(np.hstack([matrix.ravel(), lower, upper])).any()
        both = np.vstack([matrix, -matrix]), np.hstack([upper, -lower])
        keep, free = np.isfinite(both[1]), [(-1e3, 1e3)] * len(wish)
        found = linprog(-wish, both[0][keep], both[1][keep], bounds=free, method="highs")
        assert found.status == 0, (found.message, q, matrix, lower, upper)
        return np.asarray(found.x)

    def step(self, q: np.ndarray, wish: np.ndarray) -> np.ndarray:
        moved = q.copy()
        at = [self.symbols.index(s.position) for s in self.rows.speeds]
        moved[at] += self.dt * self.program(q, wish)
        return moved


def excess(model: kv.Model, q: np.ndarray) -> float:
    """Return by how much the worst constraint on positions is violated."""
    found = model.violations(dict(zip(model.symbols, q, strict=True)), tolerance=1e-9)
    return max((v.excess for v in found), default=0.0)


# -- positions: inside stays inside ----------------------------------------------------------------------------

JOINTS: Triples = {
    "a": (-1, a, 2),
    "a speed": (-0.5, va, 1),
    "b": (-0.3, b, 0.4),
    "b speed": (-3, vb, 2),
    "sum": (-0.9, a + 2 * b, 1.5),
    "one side": (-math.inf, c - a, 0.5),
    "c speed": (-1, vc, 1),
}


@settings(max_examples=attempts(6))
@given(seed=st.integers(0, 10**6), dt=st.floats(0.01, 1), share=st.floats(0.05, 1))
def test_velocity_rows_keep_a_feasible_state_feasible(seed: int, dt: float, share: float) -> None:
    rng, model = np.random.default_rng(seed), constrained(JOINTS)
    system, q = Controlled(model, dt, gain=share / dt), np.zeros(3)
    for _ in range(25):
        q = system.step(q, rng.normal(size=3))
        assert excess(model, q) == 0


def test_the_bound_is_reached() -> None:
    """Rows that allowed nothing would keep everything inside as well."""
    system, q = Controlled(constrained(JOINTS)), np.zeros(3)
    for _ in range(60):
        q = system.step(q, np.array([1.0, 0, 0]))
    assert q[0] == pytest.approx(2)


@settings(max_examples=attempts(6))
@given(seed=st.integers(0, 10**6), share=st.floats(0.2, 1))
def test_bounds_that_move_are_kept_while_they_move(seed: int, share: float) -> None:
    """c is between two bounds that other joints move, and these may not catch it either."""
    rng = np.random.default_rng(seed)
    triples = {
        "between": (a - 1, c, b + 1),
        **{f"{s} speed": (-1, s.derivative(), 1) for s in (a, b)},
        "c speed": (-0.5, vc, 0.5),
    }
    model = constrained(triples)
    system = Controlled(model, gain=share / DT)
    assert system.rows.names.count("between") == 2
    q = np.zeros(3)
    for _ in range(30):
        q = system.step(q, rng.normal(size=3))
        assert excess(model, q) == 0


def test_a_row_is_the_difference_of_gradients() -> None:
    phi, upper = np.sin(a) * b, np.cos(c) * 2
    rows = rows_of({"n": (-math.inf, phi, upper)}, gain=3.0)
    at = {"a": 0.3, "b": 0.7, "c": 0.2}
    assert rows.speeds == (va, vb, vc)
    expected = [np.cos(0.3) * 0.7, np.sin(0.3), 2 * np.sin(0.2)]
    np.testing.assert_allclose(rows.matrix(at), [expected])
    np.testing.assert_allclose(rows.upper(at), [3 * (2 * np.cos(0.2) - np.sin(0.3) * 0.7)])
    assert rows.lower(at) == [-math.inf]


def test_a_bound_with_a_gradient_of_its_own_moves_by_it() -> None:
    rows = rows_of({"n": (-math.inf, a, kv.parameter("u", 1.0).augment({vb: 0.5}))})
    np.testing.assert_array_equal(rows.matrix({"a": 0.0, "u": 1.0}), [[1, -0.5]])


def test_heuristic_gradients_make_no_rows() -> None:
    rows = rows_of({"n": (-1, a.augment({vb: 5.0}, heuristic=True), 2 + ((b < 1) & (c < 1)))})
    assert rows.speeds == (va,)
    at = {"a": 0.0, "b": 0.0, "c": 0.0}
    np.testing.assert_array_equal(rows.matrix(at), [[1]])
    np.testing.assert_allclose(rows.upper(at), [3 / DT])


# -- positions: outside leads back -----------------------------------------------------------------------------

SINGLE: dict[str, Triples] = {
    "alone": {"a": (-1, a, 2), "speed": (-0.5, va, 1)},
    "scaled": {"a": (-1, -3 * a, 2), "speed": (-0.5, va, 1)},
    "speed of what follows": {"a": (-1, a, 2), "speed": (-5, va, 5), "follower": (-1, -2 * va, 2)},
    "norm": {"a": (-1, a, 2), "b": (-1, b, 1), "both": (-math.inf, kv.norm(kv.array([va, vb])), 0.5)},
    "norm, then single": {
        "a": (-1, a, 2),
        "b": (-1, b, 1),
        "single": (-3, va, 3),
        "other": (-3, vb, 3),
        "both": (-math.inf, kv.norm(kv.array([va, vb])), 0.5),
    },
    "sum of speeds": {
        "a": (-1, a, 2),
        "b": (-1, b, 1),
        "single": (-3, va, 3),
        "other": (-1, vb, 1),
        "together": (-0.4, 2 * va + vb, 0.6),
    },
    "slow where it is": {
        "a": (-1, a, 2),
        "b": (-1, b, 1),
        "single": (-3, va, 3),
        "other": (-1, vb, 1),
        "together": (-0.4, np.sin(a) * va + np.cos(b) * vb, 0.6),
    },
    "norm of three": {
        **{f"{s}": (-1, s, 1) for s in (a, b, c)},
        "all": (-math.inf, kv.norm(kv.array([va, vb, vc])), 0.5),
    },
}


FEW = ("alone", "norm, then single", "slow where it is")


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("name", "share"),
    [
        *((name, 1.0) for name in SINGLE),
        *(pytest.param(name, 0.3, marks=() if name in FEW else pytest.mark.long) for name in SINGLE),
    ],
)
def test_velocity_rows_lead_back_monotonically_from_outside(name: str, share: float) -> None:
    model = constrained(SINGLE[name])
    system, n = Controlled(model, gain=share / DT), len(model.symbols)
    rng = np.random.default_rng(0)
    q = rng.choice([-1, 1], n) * rng.uniform(2, 4, n)
    outwards = np.sign(q)
    before, steps_inside = excess(model, q), 0
    assert before > 0
    for _ in range(900):
        q = system.step(q, outwards)
        now = excess(model, q)
        assert now < before or now == 0
        before = now
        steps_inside += now == 0
        if steps_inside > 20:
            return
    assert before < 1e-6  # with a small gain the bound is approached for ever


def test_the_way_back_is_as_fast_as_limits_allow() -> None:
    rows = rows_of(SINGLE["alone"])
    row = rows.names.index("a")
    assert rows.upper({"a": 9.0})[row] == -0.5
    assert rows.upper({"a": 2.01})[row] == pytest.approx(-0.1)  # 1/Δt times what it is outside
    assert rows.lower({"a": -9.0})[row] == 1
    followed = rows_of(SINGLE["speed of what follows"])
    assert followed.lower({"a": -9.0})[followed.names.index("a")] == 0.5
    norm, inner = rows_of(SINGLE["norm, then single"]), 0.5 * math.cos(math.pi / 16)
    row = norm.names.index("a")
    assert norm.upper({"a": 9.0, "b": 0.0})[row] == pytest.approx(-inner)
    assert norm.upper({"a": 9.0, "b": 9.0})[row] == pytest.approx(-inner / math.sqrt(2))  # both come back
    # Who may stand still only does that.
    locked = rows_of({"a": (-1, a, 2), "lock": (-(b > 0), va, b > 0)})
    assert locked.upper({"a": 9.0, "b": -1.0})[locked.names.index("a")] == 0
    assert locked.upper({"a": 9.0, "b": 1.0})[locked.names.index("a")] == -1


@settings(max_examples=attempts(10))
@given(seed=st.integers(0, 10**6))
def test_rows_can_be_obeyed_wherever_it_starts(seed: int) -> None:
    """Random limits on speeds, single, summed, scaled, of norms; positions each limited by itself."""
    rng, speeds = np.random.default_rng(seed), [va, vb, vc]
    triples: dict[str, tuple[Any, Any, Any]] = {}
    for s in (a, b, c):
        triples[f"{s}"] = (-rng.uniform(0, 1), rng.choice([-2.0, 0.5, 1]) * s, rng.uniform(0, 1))
        triples[f"{s} speed"] = (-rng.uniform(0, 2), s.derivative(), rng.uniform(0, 2))
    for k in range(3):
        weights = rng.normal(size=3) * rng.integers(0, 2, 3)
        total = sum((w * v for w, v in zip(weights, speeds, strict=True) if w), kv.Expression(0.0))
        if total.symbols:
            lower = -math.inf if rng.random() < 0.3 else -rng.uniform(0, 1)
            triples[f"sum {k}"] = (lower, total, rng.uniform(0, 1))
    size = int(rng.integers(1, 4))
    triples["norm"] = (
        -math.inf,
        kv.norm(kv.array([speeds[i] for i in rng.permutation(3)[:size]])),
        rng.uniform(0, 1),
    )
    names = list(triples)
    rng.shuffle(names)
    system = Controlled(constrained({name: triples[name] for name in names}), dt=rng.uniform(0.01, 1))
    assert not system.rows.skipped
    for _ in range(4):
        system.program(rng.normal(size=3) * 4, rng.normal(size=3))


def test_one_sided_limits_give_numbers() -> None:
    speeds = {"a speed": (-math.inf, va, 1), "b speed": (-1, vb, math.inf)}
    rows = rows_of({"n": (-1, np.sin(a) + b, 1), "m": (-1, a - b, 1), **speeds})
    for values in ({"a": 0.0, "b": 7.0}, {"a": math.pi / 2, "b": -7.0}):
        for part in (rows.matrix, rows.lower, rows.upper):
            assert not np.isnan(part(kv.State(values))).any()


# -- braking ---------------------------------------------------------------------------------------------------


@settings(max_examples=attempts(15))
@given(
    brake=st.floats(0.2, 5),
    weight=st.sampled_from([1.0, -2.0, 0.3]),
    dt=st.floats(0.005, 0.2),
    start=st.floats(0, 5),
)
@example(brake=1.0, weight=1.0, dt=0.125, start=5.0)  # there already
def test_velocity_rows_leave_the_braking_distance(
    brake: float, weight: float, dt: float, start: float
) -> None:
    model = constrained({"range": (-5, weight * a, 5), "brake": (-brake, va.derivative(), 3 * brake)})
    rows = model.velocity_rows(dt)
    assert rows.names == ("range",)
    bounds = kv.compile([rows.lower, rows.upper], [a], tier="interpreter")
    for side in (-1, 1):
        q, phi = start * side / weight, start * side
        speed: float | None = None
        for _ in range(400):
            lower, upper = bounds([q])
            now = float(upper[0] if side > 0 else lower[0]) / weight
            if speed is not None:
                assert abs(now) >= abs(speed) - brake * dt - 1e-9
            speed = now
            q += dt * now
            phi = weight * q
            assert side * phi <= 5 + 1e-9
        # And it does get there: rows are not careful for nothing.
        assert side * phi >= start + 0.9 * (5 - start) - 1e-9 or 400 * dt < 4 * math.sqrt(10 / brake)


def test_braking_counts_only_where_everything_that_moves_can_brake() -> None:
    triples = {"sum": (-1, a + 2 * b, 1), "brake": (-2, va.derivative(), 2)}
    assert rows_of(triples).upper({"a": 0, "b": 0}) == pytest.approx([10])
    both = rows_of({**triples, "other": (-1, vb.derivative(), 5)})
    step = 4 * DT  # 2 from a, and 2·1 from b
    assert both.upper({"a": 0, "b": 0}) == pytest.approx([math.sqrt(step**2 + 8) - step])


@pytest.mark.parametrize("names", [("weak", "strong"), ("strong", "weak")])
def test_the_weaker_brake_counts(names: tuple[str, str]) -> None:
    brakes = {"weak": (-1, va.derivative(), 1), "strong": (-9, va.derivative(), 9)}
    rows = rows_of({"a": (-1, a, 1), **{n: brakes[n] for n in names}})
    assert rows.upper({"a": 0.0}) == pytest.approx([math.sqrt(0.01 + 2) - 0.1])


def test_a_brake_without_bounds_is_none() -> None:
    rows = rows_of({"a": (-1, a, 1), "free": (-math.inf, va.derivative(), math.inf)})
    assert rows.upper({"a": 0.0}) == pytest.approx([10])
    assert dict(rows.skipped) == {"free": "it has no bounds"}


# -- speeds ----------------------------------------------------------------------------------------------------


def test_a_constraint_on_speeds_is_the_row_itself() -> None:
    rows = rows_of({"n": (-1, 2 * va - np.cos(c) * vb + np.sin(a), b)})
    at = kv.State({"a": 0.4, "b": 3.0, "c": 0.9})
    np.testing.assert_allclose(rows.matrix(at), [[2, -np.cos(0.9)]])
    np.testing.assert_allclose(rows.lower(at), [-1 - np.sin(0.4)])
    np.testing.assert_allclose(rows.upper(at), [3 - np.sin(0.4)])
    assert rows.speeds == (va, vb)


def test_given_gradients_do_not_change_a_row_of_speeds() -> None:
    hinted = (va + 2 * vb).augment({va.derivative(): 7.0, vc.derivative(): 1.0}, heuristic=True)
    rows = rows_of({"n": (-1, hinted, 1)})
    assert rows.speeds == (va, vb)
    np.testing.assert_array_equal(rows.matrix({}), [[1, 2]])


def on_the_rim(rows: VelocityRows, directions: np.ndarray) -> np.ndarray:
    """Return how far one can go in each direction."""
    matrix, upper = rows.matrix({}), rows.upper({})
    reach = matrix @ directions.T
    return np.min(np.where(reach > 1e-12, upper[:, None] / np.maximum(reach, 1e-12), math.inf), axis=0)


@pytest.mark.parametrize(("dimensions", "loss"), [(1, 0), (2, 0.01922), (3, 0.03807)])
def test_a_norm_becomes_a_body_inside_the_ball(dimensions: int, loss: float) -> None:
    rows = rows_of({"n": (0, kv.norm(kv.array([va, vb, vc][:dimensions])), 2.0)})
    assert len(rows.names) == (2, 16, 128)[dimensions - 1]
    directions = np.random.default_rng(0).normal(size=(20_000, dimensions))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    reach = on_the_rim(rows, directions) / 2
    assert reach.max() <= 1 + 1e-12
    assert reach.min() >= 1 - loss
    assert reach.min() == pytest.approx(1 - loss, abs=2e-3)
    if dimensions > 1:
        halfspaces = np.hstack([rows.matrix({}), -rows.upper({})[:, None]])
        corners = np.linalg.norm(
            HalfspaceIntersection(halfspaces, np.zeros(dimensions)).intersections, axis=1
        )
        assert corners.max() == pytest.approx(2)  # touches the ball, and does not leave it


def test_the_limit_of_a_norm_may_be_an_expression() -> None:
    rows = rows_of({"n": (-math.inf, kv.norm(kv.array([va, vb])), 1 + b)})
    np.testing.assert_allclose(rows.upper({"b": 1.0}), np.full(16, 2 * math.cos(math.pi / 16)))


def test_a_norm_of_wheels_is_written_in_wheels() -> None:
    """A drive's speed over the floor, whichever way it points, is within 1.92 % of its limit."""
    drive = kv.articulations.DifferentialDrive(
        name="base", parent="world", child="base", radius=0.1, track=0.5
    )
    floor = kv.norm(kv.array([kv.velocity("base/x"), kv.velocity("base/y")]))
    rows = constrained({"floor": (-math.inf, floor, 0.3)}, drive).velocity_rows(DT)
    assert [str(s) for s in rows.speeds] == ["base/left_wheel:velocity", "base/right_wheel:velocity"]
    for angle in np.linspace(-3, 3, 13):
        at = {"base/x": 0.0, "base/y": 0.0, "base/angle": angle}
        matrix = rows.matrix({s: at[str(s)] for s in rows.matrix.symbols})
        straight = np.min(rows.upper({})[:, None] / np.maximum(matrix @ [[1.0], [1.0]], 1e-12)) * 0.1
        assert 0.3 * (1 - 0.01922) <= straight <= 0.3 + 1e-12


def test_velocity_rows_eliminate_speeds_of_driven_coordinates() -> None:
    drive = kv.articulations.DifferentialDrive(
        name="base", parent="world", child="base", radius=0.1, track=0.5
    )
    model = constrained({}, drive)
    x = kv.position("base/x")
    with model.edit() as edit:
        edit.constrain("x", -1, x, 1)
        edit.constrain("given", -1, (0 * a + b).augment({x.derivative(): 3.0}), 1)
        edit.constrain("speed", -1, 3 * x.derivative(), 1)
    rows = model.velocity_rows(DT)
    at = dict.fromkeys(model.symbols, 0.0) | {kv.position("base/angle"): 0.5}
    matrix = rows.matrix({s: at[s] for s in rows.matrix.symbols})
    wheel = 0.05 * np.cos(0.5)
    expected = {
        "x": [0, wheel, wheel],
        "given": [1, 3 * wheel, 3 * wheel],
        "speed": [0, 3 * wheel, 3 * wheel],
    }
    assert [str(s) for s in rows.speeds] == [
        "b:velocity",
        "base/left_wheel:velocity",
        "base/right_wheel:velocity",
    ]
    for name, row in zip(rows.names, matrix, strict=True):
        np.testing.assert_allclose(row, expected[name], err_msg=name)


@pytest.mark.parametrize("seed", range(3))
def test_rows_of_poses_are_their_rates_in_every_kind_of_joint(seed: int) -> None:
    """A limit on where a gripper is: the row times the speeds is how fast it goes, wheels and all."""
    model = random_tree(seed, 9)
    height = model.fk(list(model.frames)[-1])[2, 3]
    with model.edit() as edit:
        edit.constrain("height", -100, height, 100)
    rows = model.velocity_rows(DT, speeds=model.speeds)
    state, speeds = random_state(model, seed), random_speeds(model, seed)
    row = rows.matrix({s: state[s] for s in rows.matrix.symbols})[rows.names.index("height")]
    forth, back = model.integrate(state, speeds, 1e-4), model.integrate(state, speeds, -1e-4)
    rate = (height(forth) - height(back)) / 2e-4
    assert row @ [speeds[s] for s in rows.speeds] == pytest.approx(rate, rel=1e-5, abs=1e-7)


# -- what there is no row for ----------------------------------------------------------------------------------

NO_ROWS: dict[str, tuple[tuple[Any, Any, Any], str]] = {
    "product": ((-1, va * vb, 1), "neither affine"),
    "square": ((-1, va**2, 1), "neither affine"),
    "bounds": ((-1, va, vb), "bounds depend on speeds"),
    "at least": ((0.5, kv.norm(kv.array([va, vb])), 1), "from above only"),
    "maybe at least": ((b, kv.norm(kv.array([va, vb])), 1), "from above only"),
    "four": ((0, kv.norm(kv.array([va, vb, vc, kv.velocity("d")])), 1), "more than three"),
    "products": ((0, kv.norm(kv.array([va * vb, vc])), 1), "not affine"),
    "jerk": ((-1, va.derivative().derivative(), 1), "beyond speeds"),
    "accelerations": ((-1, va.derivative() + vb.derivative(), 1), "beyond speeds"),
    "parameter": ((0, kv.parameter("p", 1.0), 2), "nothing that moves"),
    "unbounded": ((-math.inf, a, math.inf), "no bounds"),
    "unbounded norm": ((0, kv.norm(kv.array([va, vb])), math.inf), "no bounds"),
    "given acceleration": ((-1, a.augment({va.derivative(): 1.0}), 1), "beyond speeds"),
}


@pytest.mark.parametrize("name", NO_ROWS)
def test_skipped_constraints_have_a_reason(name: str) -> None:
    triple, reason = NO_ROWS[name]
    rows = rows_of({name: triple, "a": (-1, a, 1)})
    assert rows.names == ("a",)
    ((skipped, why),) = rows.skipped
    assert skipped == name
    assert reason in why


def test_no_constraints_are_no_rows() -> None:
    rows = rows_of({})
    assert rows.matrix.shape == (0, 0)
    assert rows.lower.shape == rows.upper.shape == (0,)


def test_columns_may_be_chosen() -> None:
    triples = {"a": (-1, a, 1), "sum": (-1, a + b, 1), "c": (-1, c, 1)}
    rows = rows_of(triples, speeds=[vb, kv.velocity("other"), va])
    assert rows.names == ("a", "sum")
    np.testing.assert_array_equal(rows.matrix({}), [[0, 0, 1], [1, 0, 1]])


@pytest.mark.parametrize("dt", [0, -0.1, math.inf, math.nan])
def test_a_step_is_a_positive_time(dt: float) -> None:
    with pytest.raises(InvalidValueError, match="positive time"):
        rows_of({"a": (-1, a, 1)}, dt)


@pytest.mark.parametrize("gain", [0, -1, 10.1, math.nan])
def test_a_gain_that_would_cross_the_bound_is_refused(gain: float) -> None:
    with pytest.raises(InvalidValueError, match=r"\(0, 1/dt\]"):
        rows_of({"a": (-1, a, 1)}, gain=gain)


def test_rows_can_be_asked_for_one_subject() -> None:
    model = constrained({"a": (-1, a, 1), "b": (-1, b, 1)})
    select: Callable[..., VelocityRows] = model.velocity_rows
    assert select(DT, subject=a * 2).names == ("a",)
    assert set(select(DT).names) == {"a", "b"}
