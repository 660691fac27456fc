"""Locks and limits that depend on the state: held where they hold, feasible everywhere, and saying the way out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from articulation_checks import assert_rows_keep_limits, model_of

import kineverse as kv

nan, inf = float("nan"), float("inf")
door, bolt = kv.position("door"), kv.position("bolt")
DOOR = kv.Revolute(
    name="door", parent="world", child="door", axis=(0, 0, 1), lower=0, upper=1.5, velocity=1.0
)
BOLT = kv.Prismatic(name="bolt", parent="world", child="bolt", lower=0, upper=0.02, velocity=0.1)
BACK = bolt > 0.01


def model_with(lock: Any) -> kv.Model:
    model = model_of(DOOR, BOLT)
    with model.edit() as edit:
        edit.constrain("lock", *lock)
    return model


def row(model: kv.Model, at: dict[str, float], name: str = "lock") -> tuple[float, float]:
    """Return what the row of a constraint leaves of the door's speed."""
    rows = model.velocity_rows(0.1)
    assert not rows.skipped
    i = rows.names.index(name)
    weights = dict(zip(map(str, rows.speeds), rows.matrix(at)[i], strict=True))
    assert weights == {"door:velocity": 1.0, "bolt:velocity": 0.0}
    return float(rows.lower(at)[i]), float(rows.upper(at)[i])


def trend(e: kv.Expression, at: dict[str, float]) -> dict[str, float]:
    return {s: v for s, v in {str(s): float(entry(at)) for s, entry in e.gradient().items()}.items() if v}


# -- unlocked while ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("blocks", "locked"), [("both", (0, 0)), ("forward", (-0.5, 0)), ("backward", (0, 0.5))]
)
def test_speed_lock_holds_the_speed_in_its_directions(blocks: Any, locked: tuple[float, float]) -> None:
    model = model_with(kv.articulations.speed_lock(door, open_if=BACK, max_speed=0.5, blocks=blocks))
    for q in (0.0, 1.0):
        assert row(model, {"door": q, "bolt": 0.0}) == locked
        assert row(model, {"door": q, "bolt": 0.02}) == (-0.5, 0.5)


def test_speed_lock_equals_equation_13_of_the_paper() -> None:
    """Values and trends of Eq. 13, written with & and ~."""
    lower, speed, upper = kv.articulations.speed_lock(door, open_if=bolt > 0.3, engaged_if=door > 1.99)
    unlocked = ~((bolt < 0.3) & (door > 1.99))
    assert speed is door.derivative()
    for q in (1.0, 1.99, 2.0):
        for b in (0.0, 0.3, 0.6):
            at = {"door": q, "bolt": b}
            assert upper(at) == unlocked(at) == -lower(at)
            assert trend(upper, at) == trend(unlocked, at)
            assert trend(lower, at) == {s: -v for s, v in trend(unlocked, at).items()}


def test_speed_lock_takes_a_speed_or_a_position() -> None:
    of_speed = kv.articulations.speed_lock(door.derivative(), open_if=BACK)
    assert of_speed == kv.articulations.speed_lock(door, open_if=BACK)
    _, rate, _ = kv.articulations.speed_lock(door**2, open_if=BACK)
    assert rate({"door": 3.0, "door:velocity": 0.5}) == 3.0


def test_speed_lock_gradients_show_what_unlocks() -> None:
    lower, _, upper = kv.articulations.speed_lock(door, open_if=BACK, engaged_if=door < 0.01, max_speed=2.0)
    shut = {"door": 0.0, "bolt": 0.0}
    assert trend(upper, shut) == {"bolt:velocity": 2.0, "door:velocity": 2.0}
    assert trend(lower, shut) == {"bolt:velocity": -2.0, "door:velocity": -2.0}
    assert not upper.gradient(heuristic=False)
    # Along the trend the lock opens.
    assert upper({**shut, "bolt": 0.02}) == upper({**shut, "door": 0.02}) == 2.0


# -- blocked unless ------------------------------------------------------------------------------------

BLOCK = kv.articulations.position_lock(door, open_if=BACK, upper=0)


def test_position_lock_holds_inside_its_bounds_only() -> None:
    model = model_with(BLOCK)
    for q, b, left in (
        (0.0, 0.0, (-inf, 0.0)),  # shut: it cannot open
        (0.0, 0.02, (-inf, inf)),  # the bolt is back
        (0.5, 0.0, (-inf, inf)),  # open: neither opening nor shutting is blocked
        (5e-4, 0.0, (-inf, -0.005)),  # within the margin: led back
        (0.0, 0.01, (-inf, 0.0)),  # in doubt it holds
    ):
        assert row(model, {"door": q, "bolt": b}) == pytest.approx(left)
    assert not model.violations({"door": 0.5, "bolt": 0.0})
    assert [v.name for v in model.violations({"door": 5e-4, "bolt": 0.0})] == ["lock"]


def test_position_lock_has_a_margin_at_both_bounds() -> None:
    model = model_with(kv.articulations.position_lock(door, open_if=BACK, lower=0.5, upper=0.7, margin=0.01))
    for q, left in (
        (0.495, (0.05, 2.05)),
        (0.705, (-2.05, -0.05)),
        (0.6, (-1.0, 1.0)),
        (0.48, (-inf, inf)),
        (0.72, (-inf, inf)),
    ):
        assert row(model, {"door": q, "bolt": 0.0}) == pytest.approx(left)


@pytest.mark.parametrize("q", [0.0, 1e-12, 5e-4, 9.99e-4, 1e-3, 0.2, 1.5, 2.0])
@pytest.mark.parametrize("b", [0.0, 0.005, 0.01, 0.02])
def test_position_lock_velocity_rows_are_feasible_everywhere(q: float, b: float) -> None:
    model = model_with(kv.articulations.position_lock(door, open_if=BACK, lower=0, upper=0))
    low, high = -inf, inf
    rows = model.velocity_rows(0.1)
    at = {"door": q, "bolt": b}
    for weights, lower, upper in zip(rows.matrix(at), rows.lower(at), rows.upper(at), strict=True):
        if weights[list(map(str, rows.speeds)).index("door:velocity")]:
            low, high = max(low, lower), min(high, upper)
    assert low <= high


def test_locked_door_stays_and_free_door_opens() -> None:
    model = model_with(BLOCK)
    shut = dict.fromkeys(model.symbols, 0.0)
    wish = {"door:velocity": 1.0}
    assert assert_rows_keep_limits(model, shut, wish, 10, 0.1)[door] == pytest.approx(0, abs=1e-12)
    assert assert_rows_keep_limits(model, {**shut, bolt: 0.02}, wish, 10, 0.1)[door] == pytest.approx(1.0)
    # Open, with the bolt out: it comes back, and is held again.
    back = assert_rows_keep_limits(model, {**shut, door: 0.3}, {"door:velocity": -1.0}, 10, 0.1)
    assert back[door] == pytest.approx(0.0, abs=1e-12)
    assert assert_rows_keep_limits(model, back, wish, 5, 0.1)[door] == pytest.approx(0, abs=1e-12)


def test_position_lock_gradients_show_what_unlocks() -> None:
    lower, _, upper = kv.articulations.position_lock(door, open_if=BACK, lower=-0.1, upper=0.1)
    at = {"door": 0.0, "bolt": 0.0}
    # Above and below are as near: only the bolt helps.
    assert trend(upper, at) == {"bolt:velocity": 1.0}
    assert trend(lower, at) == {"bolt:velocity": -1.0}
    assert (lower(at), upper(at)) == (-0.1, 0.1)
    assert (lower({**at, "bolt": 0.02}), upper({**at, "bolt": 0.02})) == (-inf, inf)
    for bound in (lower, upper):
        assert not {s: e for s, e in bound.gradient(heuristic=False).items() if e != 0}
    (_, _, one_sided) = BLOCK
    assert trend(one_sided, at)["bolt:velocity"] > 0


def test_position_lock_bounds_may_be_expressions() -> None:
    model = model_with(kv.articulations.position_lock(door, open_if=bolt > 0.015, upper=10 * bolt))
    rows = model.velocity_rows(0.1)
    i = rows.names.index("lock")
    at = {"door": 0.02, "bolt": 0.01}
    assert dict(zip(map(str, rows.speeds), rows.matrix(at)[i], strict=True)) == (
        {"door:velocity": 1.0, "bolt:velocity": -10.0}
    )
    assert rows.upper(at)[i] == pytest.approx(0.8)


# -- tables --------------------------------------------------------------------------------------------

POINTS = {0.0: 0.0, 0.01: 0.5, 0.02: 0.2}


def test_tabulated_limit_is_linear_between_its_points() -> None:
    limit = kv.articulations.tabulated_limit(bolt, POINTS)
    knots, values = list(POINTS), list(POINTS.values())
    for b in (-1.0, 0.0, 0.004, 0.01, 0.0177, 0.02, 3.0):
        assert limit({"bolt": b}) == pytest.approx(np.interp(b, knots, values), abs=1e-15)
    slope = limit.gradient()[bolt.derivative()]
    assert [float(slope({"bolt": b})) for b in (-1, 0.005, 0.015, 1)] == pytest.approx([0, 50, -30, 0])
    assert kv.articulations.tabulated_limit(bolt, POINTS.items()) == limit


def test_smooth_tabulated_limit_is_a_spline() -> None:
    smooth = kv.articulations.tabulated_limit(bolt, POINTS, smooth=True)
    assert smooth == kv.spline(bolt, tuple(POINTS), tuple(POINTS.values()))


def test_velocity_rows_keep_a_tabulated_limit() -> None:
    model = model_with((0, door, kv.articulations.tabulated_limit(bolt, {0.0: 0.0, 0.01: 0.5, 0.02: 0.6})))
    start = dict.fromkeys(model.symbols, 0.0)
    end = assert_rows_keep_limits(model, start, {"door:velocity": 1, "bolt:velocity": 0.02}, 40, 0.05)
    # It is pushed along as fast as the bolt goes, then as fast as the table rises.
    assert end[bolt] == pytest.approx(0.02)
    assert end[door] == pytest.approx(0.6)


# -- documents and bad input ---------------------------------------------------------------------------


def test_locks_survive_a_document(tmp_path: Path) -> None:
    model = model_with(kv.articulations.speed_lock(door, open_if=BACK, engaged_if=door < 0.01))
    with model.edit() as edit:
        edit.constrain("block", *BLOCK)
        edit.constrain("table", -inf, door, kv.articulations.tabulated_limit(bolt, POINTS))
    model.save(tmp_path / "locks.kv.json")
    read = kv.load(tmp_path / "locks.kv.json")
    assert read.snapshot() == model.snapshot()
    for name in ("lock", "block", "table"):
        for b in (0.0, 0.01, 0.02):
            at = kv.State({"door": 0.0, "bolt": b})
            ours, theirs = (m.constraints[name].upper for m in (model, read))
            assert ours(at) == theirs(at)
            assert trend(ours, at) == trend(theirs, at)


VECTOR = kv.array([door, bolt])
BROKEN: list[tuple[Any, str]] = [
    (lambda: kv.articulations.speed_lock(door, open_if=True), "open_if of a lock is an expression, not True"),
    (lambda: kv.articulations.speed_lock("door", open_if=BACK), "speed of a lock is an expression, not 'door'"),
    (lambda: kv.articulations.speed_lock(VECTOR, open_if=BACK), r"scalar, not of shape \(2,\)"),
    (lambda: kv.articulations.speed_lock(kv.parameter("p", 1.0), open_if=BACK), "The speed of a lock depends on coordinates"),
    (lambda: kv.articulations.speed_lock(door, open_if=BACK, engaged_if=3), "engaged_if of a lock is an expression, not 3"),
    (lambda: kv.articulations.speed_lock(door, open_if=BACK, max_speed=0), "speed .* positive, finite number, not 0"),
    (lambda: kv.articulations.speed_lock(door, open_if=BACK, max_speed=inf), "not inf"),
    (lambda: kv.articulations.speed_lock(door, open_if=BACK, max_speed=nan), "not nan"),
    (lambda: kv.articulations.speed_lock(door, open_if=BACK, max_speed=None), "is a number, not None"),
    (lambda: kv.articulations.speed_lock(door, open_if=BACK, blocks="left"), "'both', 'forward' or 'backward', not 'left'"),
    (lambda: kv.articulations.position_lock(door, open_if=BACK), "neither is given"),
    (lambda: kv.articulations.position_lock(door, open_if=BACK, lower=1, upper=0.5), "lower bound 1 and the upper bound 0.5"),
    (lambda: kv.articulations.position_lock(door, open_if=BACK, upper=nan), "upper bound .* finite number, not nan"),
    (lambda: kv.articulations.position_lock(door, open_if=BACK, lower=inf), "lower bound .* finite number, not inf"),
    (lambda: kv.articulations.position_lock(door, open_if=BACK, lower=VECTOR), r"lower bound .* not of shape \(2,\)"),
    (lambda: kv.articulations.position_lock(door, open_if=BACK, lower="low"), "lower bound .* is a number, not 'low'"),
    (lambda: kv.articulations.position_lock(door, open_if=BACK, upper=0, margin=0), "margin .* positive, finite number, not 0"),
    (lambda: kv.articulations.position_lock(door, open_if=BACK, upper=0, margin=nan), "not nan"),
    (lambda: kv.articulations.position_lock(door.derivative(), open_if=BACK, upper=0), "expression of positions, not door:velocity"),
    (lambda: kv.articulations.tabulated_limit(door, {0: 1}), "table of limits is not valid. There are at least two knots, not 1"),
    (lambda: kv.articulations.tabulated_limit(door, {}), "at least two knots, not 0"),
    (lambda: kv.articulations.tabulated_limit(door, {0: 1, 2: 3, 1: 4}), "Knots increase: knot 2 is 1, and knot 1 is 2"),
    (lambda: kv.articulations.tabulated_limit(door, [(0, 1), (0, 2)], smooth=True), "Knots increase"),
    (lambda: kv.articulations.tabulated_limit(door, {0: 1, 1: nan}), "number .* is nan"),
    (lambda: kv.articulations.tabulated_limit(door, {0: 1, nan: 2}), "number 1 is nan"),
    (lambda: kv.articulations.tabulated_limit(door, 5), r"points \{driver: limit\}, and is not 5"),
    (lambda: kv.articulations.tabulated_limit(1.0, {0: 1, 1: 2}), "driver of a table of limits is an expression, not 1.0"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "words"), BROKEN)
def test_invalid_lock_raises_a_clear_error(make: Any, words: str) -> None:
    with pytest.raises(kv.errors.InvalidValueError, match=words):
        make()
