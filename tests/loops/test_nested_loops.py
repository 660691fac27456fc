"""Closed loops on loops, on moving bases, and driven by wheels."""

from __future__ import annotations

import numpy as np
import pytest
from linkages import at, four_bar, scene
from loop_checks import record

import kineverse as kv

crank, rocker = kv.position("crank"), kv.position("rocker")


def test_loops_on_loops():
    leg = scene("jansen_leg")
    assert leg.degrees_of_freedom == (crank,)
    assert {record(leg, n)["free"] for n in ("top", "bottom", "knee")} == {("crank",)}
    assert set(leg.rates.dependent) == {
        kv.position(f"{n}_{i}") for n in ("top", "bottom", "knee") for i in (1, 2)
    }
    for e in leg.rates.dependent.values():
        assert set(e.symbols) == {crank}


def mounted(base: kv.Operation) -> kv.Model:
    """Return a four-bar that a robot with a base and an arm has picked up."""
    model = four_bar()
    with model.edit() as edit:
        edit.apply(base, "base")
        edit.apply(kv.Revolute(name="arm", parent="base", child="hand", axis=(1, 2, 3), origin=at(0.2)))
        edit.add_frame("mount", "hand", kv.translation(0.1, 0.2, 0.3) @ kv.rotation_x(0.4))
        for name, x in (("crank", 0.0), ("rocker", 1.0)):
            edit.attach(name, "mount", _hinge(name, x))
    return model


def _hinge(name: str, x: float) -> list:
    return [kv.translation(x, 0, 0), kv.rotation_z(kv.position(name))]


def test_on_a_moving_base():
    still, robot = four_bar(), mounted(kv.articulations.OmniBase(name="base", parent="world", child="base"))
    assert crank in robot.degrees_of_freedom
    assert rocker not in robot.symbols
    values = dict(
        zip(robot.degrees_of_freedom, np.linspace(0.2, 0.9, len(robot.degrees_of_freedom)), strict=True)
    )
    inside = robot.fk("rocker_tip", "mount")
    assert set(inside.symbols) == {crank}
    np.testing.assert_allclose(
        inside(values), still.fk("rocker_tip")({crank: values[crank]}), rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(
        robot.fk("coupler_tip")(values), robot.fk("mount")(values) @ still.fk("coupler_tip")({crank: values[crank]}),
        rtol=0, atol=1e-12,
    )  # fmt: skip
    assert robot.jacobian("coupler_tip", "mount").shape == (6, 1)
    assert_moves_as_its_jacobian_says_at(robot, "coupler_tip", values)
    assert_moves_as_its_jacobian_says_at(robot, "coupler_tip", values, "mount")


def assert_moves_as_its_jacobian_says_at(model, frame, values, to="world"):
    """Compare the linear rows along a random motion of the free speeds, by integration."""
    speeds = {s: 0.3 + 0.1 * i for i, s in enumerate(model.speeds)}
    twist = model.jacobian(frame, to, symbols=model.speeds)(values) @ list(speeds.values())
    after, before = (model.fk(frame, to)(model.integrate(kv.State(values), speeds, s)) for s in (1e-5, -1e-5))
    np.testing.assert_allclose(twist[:3], (after - before)[:3, 3] / 2e-5, rtol=0, atol=1e-8)


def test_wheels_below():
    """Poses of the linkage show the wheels' speeds and the crank's, and nothing that is not free."""
    drive = kv.articulations.DifferentialDrive(
        name="base", parent="world", child="base", radius=0.1, track=0.4
    )
    robot = mounted(drive)
    keys = set(robot.fk("rocker_tip").gradient())
    assert keys == set(robot.speeds_of("rocker_tip"))
    assert crank.derivative() in keys
    assert len(keys) == 4
    values = dict(
        zip(robot.degrees_of_freedom, np.linspace(0.2, 0.9, len(robot.degrees_of_freedom)), strict=True)
    )
    assert_moves_as_its_jacobian_says_at(robot, "rocker_tip", values)


def test_a_crank_that_a_wheel_drives():
    """Rates of what is free reach what follows."""
    bars, wheel = four_bar(), kv.velocity("wheel")
    with bars.edit() as edit:
        edit.set_rate(crank, {wheel: 0.25})
    assert bars.speeds == (wheel,)
    assert set(bars.fk("rocker_tip").gradient()) == {wheel}
    plain = four_bar().jacobian("rocker_tip")({"crank": 0.4})
    np.testing.assert_allclose(bars.jacobian("rocker_tip")({"crank": 0.4}), 0.25 * plain, rtol=0, atol=1e-12)
    assert bars.rates.eliminate(kv.velocity("rocker"))(
        {"crank": 0.4, "wheel:velocity": 1.0}
    ) == pytest.approx(0.25 * plain[5, 0], abs=1e-12)
