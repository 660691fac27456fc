"""Undecided constraints are reported with reason and region."""

from __future__ import annotations

import numpy as np
import pytest
from constraint_models import model

import kineverse as kv
from kineverse import reasoning
from kineverse.reasoning import Interval, IntervalBox, interlocks
from kineverse.reasoning.case_split import MAX_CASES

A, B, C = (kv.position(name) for name in "abc")
SPEED = A.derivative()


def undecided(lower, upper, **others) -> tuple[reasoning.Undecided, ...]:
    subject = model(b=(-1, B, 1), c=(-1, C, 1), lock=(lower, SPEED, upper), **others)
    result = interlocks(subject)
    assert reasoning.contradictions(subject, result) == []
    assert {u.constraint for u in result.undecided} <= {"lock"}
    return result.undecided


def test_nonlinear_condition_on_two_coordinates_is_undecided() -> None:
    (unknown,) = undecided(-1, B * C < 0.3)
    assert unknown.reason == "b and c occur together in a condition that is not linear"
    assert unknown.where == (IntervalBox({}),)
    assert str(unknown).startswith("lock: unknown, as b and c occur together")


def test_undecided_region_excludes_decided_cases() -> None:
    (unknown,) = undecided(-1, (np.sin(B * C) < 0.3) & (B < 0.5))
    assert unknown.where == (IntervalBox({B: Interval(upper=0.5)}),)


def test_condition_decided_by_limits_is_not_undecided() -> None:
    assert undecided(-1, B * C < 1.5) == ()
    assert undecided(-1, kv.norm([B, C]) < 2) == ()
    assert undecided(-1, 2 + np.sin(B * C)) == ()


def test_bounds_that_are_not_numbers_are_undecided() -> None:
    (unknown,) = undecided(-1, np.sqrt(B) + 0.1)
    assert (unknown.reason, unknown.where) == (
        "a bound is not a number",
        (IntervalBox({B: Interval(upper=0)}),),
    )
    (unknown,) = undecided(-1, np.arccos(2 * B) < 1)
    assert unknown.where == (IntervalBox({B: Interval(upper=-0.5)}), IntervalBox({B: Interval(lower=0.5)}))
    (unknown,) = undecided(-1, 1 / B**2)
    assert unknown.where[0][B] == Interval(0, 0, True, True)
    # In the branch that is not taken NaN does no harm.
    assert undecided(-1, kv.where(B > 0, np.sqrt(B), 0.0)) == ()


def test_many_thresholds_without_limits_are_undecided() -> None:
    angle = kv.position("angle")
    (unknown,) = undecided(-1, np.sin(angle**2) < 0.3)
    reason = "angle has no limits, and where a condition on angle changes cannot be made certain"
    assert unknown.reason == reason
    assert undecided(-1, np.arctan(angle) < 0.3) == ()


def test_threshold_that_is_only_touched_is_undecided() -> None:
    assert undecided(-1, (B - 0.25) ** 2 > 0) == ()  # a polynomial: exact
    (unknown,) = undecided(-1, np.cos(B) < 1)
    assert "cannot be made certain" in unknown.reason


def test_ramp_of_a_smooth_comparison_is_undecided() -> None:
    (unknown,) = undecided(-1, kv.logic.less(B, 0.1, contrast=100))
    assert unknown.reason == "a comparison of contrast 100 is on its ramp, 0.4 wide"
    side = unknown.where[0][B]
    assert (side.lower, side.upper) == pytest.approx((-0.1, 0.3))


def test_too_many_cases_are_undecided() -> None:
    many = [kv.position(f"x{i}") for i in range(9)]
    parity = kv.logic.less(many[0], 0.5)
    for x in many[1:]:
        other = kv.logic.less(x, 0.5)
        parity = (parity & ~other) | (~parity & other)
    unknown = undecided(-1, parity)
    assert f"there are more than {MAX_CASES} cases to distinguish" in {u.reason for u in unknown}


def test_nonlinear_limit_of_several_coordinates_is_undecided() -> None:
    (unknown,) = interlocks(model(both=(0, A * A + B * B, 1))).undecided
    assert unknown.reason == "it limits several coordinates at once, and they are not just added"


def test_condition_on_a_winding_angle_is_undecided() -> None:
    """The angle between crank and coupler comes back after a turn with a turn less: there is no period."""
    four_bar, angle = kv.load("articulations/four_bar"), kv.position("four_bar/coupler")
    with four_bar.edit() as edit:
        edit.constrain("lock", -1, SPEED, angle < 0.1)
    found = interlocks(four_bar)
    assert [str(lock) for lock in found] == ["a:velocity cannot increase: when four_bar/coupler > 0.1 (lock)"]
    (unknown,) = found.undecided
    assert unknown.reason.startswith(
        "four_bar/coupler follows four_bar/crank, and four_bar/crank has no limits"
    )
    assert reasoning.contradictions(four_bar, found) == []


def test_condition_on_a_coordinate_of_several_drivers_is_undecided() -> None:
    """A box of three motors cannot say it; what is known is told by the name."""
    delta = kv.load("articulations/delta_robot")
    with delta.edit() as edit:
        edit.constrain("lock", -1, SPEED, kv.position("delta_robot/platform") < -0.5)
    found = interlocks(delta)
    assert [lock.keys for lock in found] == [(kv.position("delta_robot/platform"),)]
    (unknown,) = found.undecided
    assert "motor_0 and delta_robot/motor_1 and delta_robot/motor_2 occur together" in unknown.reason
