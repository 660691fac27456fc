"""Conditions on dependent coordinates: expressed by independent ones, and by angles within a turn."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from constraint_models import model as of_constraints
from scipy.optimize import brentq

import kineverse as kv
from kineverse import reasoning
from kineverse.reasoning import Interlock, Interlocks, Interval, IntervalBox, interlocks

DOOR = kv.position("door")
CRANK, ROCKER = (kv.position(f"four_bar/{name}") for name in ("crank", "rocker"))


def locked(name: str, truth: kv.Expression) -> kv.Model:
    """Return a linkage of the gallery with a door that moves while something is true of it."""
    result = kv.load(f"articulations/{name}")
    with result.edit() as edit:
        edit.constrain("lock", -truth, DOOR.derivative(), truth)
    return result


@cache
def slider_locked() -> kv.Model:
    return locked("slider_crank", kv.position("slider_crank/slider") > 0.3)


def test_lock_on_a_slider_is_expressed_by_its_crank() -> None:
    model = slider_locked()
    found = interlocks(model)
    assert found.undecided == ()
    (lock,) = found
    crank = kv.position("slider_crank/crank")
    assert (lock.hold, lock.constraints, lock.keys) == ("stands still", ("lock",), (crank,))
    ((axis, side),) = lock.when[0].items()
    assert (
        str(lock) == f"door:velocity stands still: when {side.describe('slider_crank/crank mod 2π')} (lock)"
    )
    # The law of cosines: crank 0.1, rod 0.3, slider at 0.3.
    there = math.acos(0.1**2 / (2 * 0.1 * 0.3))
    assert [side.lower, side.upper] == pytest.approx([there, math.tau - there], abs=1e-9)
    assert reasoning.contradictions(model, found) == []
    for turns in (-3, 0, 5):
        assert axis({crank: 3.0 + turns * math.tau}) == pytest.approx(3.0, abs=1e-12)


@pytest.mark.long
def test_lock_on_a_rocker_is_expressed_by_its_crank() -> None:
    model = locked("four_bar", ROCKER < 1.9)
    found = interlocks(model)
    assert found.undecided == ()
    (lock,) = found
    assert (lock.hold, lock.constraints, lock.keys) == ("stands still", ("lock",), (CRANK,))
    ((axis, side),) = lock.when[0].items()
    assert str(lock) == f"door:velocity stands still: when {side.describe('four_bar/crank mod 2π')} (lock)"
    # Where the rocker of lengths 0.12, 0.33, 0.27 on a ground of 0.3 stands, by the two triangles.
    assert [side.lower, side.upper] == pytest.approx(by_triangles(), abs=1e-9)
    assert reasoning.contradictions(model, found) == []
    for turns in (-3, 0, 5):
        assert axis({CRANK: 3.0 + turns * math.tau}) == pytest.approx(3.0, abs=1e-12)


def by_triangles() -> list[float]:
    """Return the angles of the crank at which the rocker is at 1.9."""

    def excess(angle: float) -> float:
        x, y = 0.12 * math.cos(angle) - 0.3, 0.12 * math.sin(angle)
        d = math.hypot(x, y)
        return math.atan2(y, x) - math.acos((d * d + 0.27**2 - 0.33**2) / (2 * d * 0.27)) - 1.9

    angles = np.linspace(0, math.tau, 500)
    values = [math.remainder(excess(a), math.tau) for a in angles]
    return [
        brentq(lambda a: math.remainder(excess(a), math.tau), a, b)
        for a, b, u, v in zip(angles, angles[1:], values, values[1:], strict=False)
        if u * v < 0 and abs(u) + abs(v) < 1
    ]


def test_contradictions_reports_a_wrong_crank_interval() -> None:
    model = slider_locked()
    (lock,) = interlocks(model)
    ((axis, side),) = lock.when[0].items()
    shifted = Interval(side.lower + 0.05, side.upper + 0.05)
    wrong = Interlock(lock.held, lock.hold, lock.constraints, (IntervalBox({axis: shifted}),))
    assert reasoning.contradictions(model, Interlocks([wrong]))


def test_lock_on_a_rocker_with_a_limited_crank() -> None:
    model = locked("slider_crank", kv.position("slider_crank/slider") > 0.3)
    crank = kv.position("slider_crank/crank")
    with model.edit() as edit:
        edit.constrain("range", 0, crank, 3)
    (lock,) = interlocks(model)
    ((axis, side),) = lock.when[0].items()
    assert axis == crank
    # The law of cosines: crank 0.1, rod 0.3, slider at 0.3.
    assert side.lower == pytest.approx(math.acos((0.1**2 + 0.3**2 - 0.3**2) / (2 * 0.1 * 0.3)), abs=1e-9)
    assert side.upper == math.inf
    assert reasoning.contradictions(model, interlocks(model)) == []


def test_lock_that_a_linkage_never_reaches_is_omitted() -> None:
    always = locked("slider_crank", kv.position("slider_crank/slider") > 0.5)
    assert [str(lock) for lock in interlocks(always)] == ["door:velocity stands still: always (lock)"]
    assert interlocks(locked("slider_crank", kv.position("slider_crank/slider") > 0.1)) == Interlocks([])


def test_range_of_a_dependent_coordinate_keeps_its_name() -> None:
    """The condition is about the crank, the bound is where the slider is."""
    model, slider = kv.load("articulations/slider_crank"), kv.position("slider_crank/slider")
    with model.edit() as edit:
        edit.constrain("door", 0, DOOR, 0.3)
        edit.constrain("wedge", 0, DOOR, slider)
    (lock,) = interlocks(model)
    assert (lock.hold, lock.upper, lock.keys) == (
        "stays within",
        slider,
        (kv.position("slider_crank/crank"),),
    )
    assert reasoning.contradictions(model, interlocks(model)) == []


@pytest.mark.parametrize("name", ["second", "third"])
def test_lock_on_a_gear_is_expressed_by_its_driver(name: str) -> None:
    model = kv.load("articulations/gearbox")
    gear = model.articulations[f"gearbox/{name}"].position
    with model.edit() as edit:
        edit.constrain("lock", -(gear < 0.4), DOOR.derivative(), gear < 0.4)
    found = interlocks(model)
    (lock,) = found
    first = kv.position("gearbox/first")
    assert lock.keys == (first,)
    ((_, side),) = lock.when[0].items()
    (end,) = (e for e in (side.lower, side.upper) if math.isfinite(e))
    assert gear({first: end}) == pytest.approx(0.4, abs=1e-12)
    assert reasoning.contradictions(model, found) == []


def test_lock_on_a_nonlinear_mimic_joint() -> None:
    model = kv.load("articulations/mimic")
    tip = model.articulations["mimic/tip"].position
    with model.edit() as edit:
        edit.constrain("lock", -(tip < 0.9), DOOR.derivative(), tip < 0.9)
    (lock,) = interlocks(model)
    ((axis, side),) = lock.when[0].items()
    assert axis == kv.position("mimic/finger")
    assert tip({axis: side.lower}) == pytest.approx(0.9, abs=1e-9)
    assert reasoning.contradictions(model, interlocks(model)) == []


def test_lock_on_a_wheel_without_limits_is_periodic() -> None:
    wheel = kv.position("wheel")
    subject = of_constraints(lock=(-1, DOOR.derivative(), np.sin(wheel) < 0.5))
    (lock,) = interlocks(subject)
    (side,) = lock.when[0].values()
    assert [side.lower, side.upper] == pytest.approx([math.pi / 6, 5 * math.pi / 6], abs=1e-9)
    assert reasoning.contradictions(subject, interlocks(subject)) == []
    # Half the angle comes back after two turns only.
    (unknown,) = interlocks(of_constraints(lock=(-1, DOOR.derivative(), np.sin(wheel / 2) < 0.5))).undecided
    assert "wheel has no limits" in unknown.reason
