"""Cranks, pedals, lifts, lamps, screws, ratchets and taps against their formulas."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from articulation_checks import assert_rows_keep_limits, model_of, turned
from mechanism_cases import WHERE, about_y, at, pose, refused

import kineverse as kv
from kineverse.articulations import Mechanism

nan = float("nan")
q = kv.position("m")


def origin(mechanism: Mechanism, part: str, **values: float) -> np.ndarray:
    values = {"m" if name == "m" else f"m/{name}": value for name, value in values.items()}
    found: np.ndarray = pose(mechanism, part, values)[:3, 3]
    return found


# -- cranks --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("crank", "rod"), [(0.04, 0.13), (0.1, 0.1001)])
def test_piston_position_over_a_whole_revolution(crank: float, rod: float) -> None:
    engine = kv.articulations.PistonAndRod(**WHERE, crank=crank, rod=rod)
    for angle in np.linspace(-7, 7, 29):
        height = crank * math.cos(angle) + math.sqrt(rod**2 - (crank * math.sin(angle)) ** 2)
        np.testing.assert_allclose(pose(engine, "crank", {"m": angle}), about_y(angle), atol=1e-15)
        np.testing.assert_allclose(pose(engine, "piston", {"m": angle}), at(z=height), atol=1e-14)
        big_end = pose(engine, "rod", {"m": angle})
        pin = (crank * math.sin(angle), 0, crank * math.cos(angle))
        np.testing.assert_allclose(big_end[:3, 3], pin, atol=1e-15)
        np.testing.assert_allclose((big_end @ [0, 0, rod, 1])[:3], (0, 0, height), atol=1e-13)


def test_piston_speed_is_zero_at_the_dead_centres() -> None:
    model = model_of(kv.articulations.PistonAndRod(**WHERE))
    for angle in (0.0, math.pi, -math.pi):
        np.testing.assert_allclose(model.jacobian("m/piston")({"m": angle}), 0, atol=1e-16)
    assert model.limits("m") == (-math.inf, math.inf)


def test_pedal_bin_lid_angle_is_the_arcsine_formula() -> None:
    can = kv.articulations.PedalBin(**WHERE)
    for p in np.linspace(0, 0.25, 11):
        lift = can.arm * math.sin(p)
        lid = pose(can, "lid", {"m": p})
        np.testing.assert_allclose(
            lid, at(can.radius, 0, can.height) @ about_y(math.asin(lift / can.lever)), atol=1e-14
        )
        # Where the rod pushes: as high above the closed lid as the rod has risen.
        slot = lid @ [-can.lever, 0, 0, 1]
        assert slot[2] - can.height == pytest.approx(lift)
        assert origin(can, "rod", m=p)[2] - origin(can, "rod", m=0.0)[2] == pytest.approx(lift)
        end = pose(can, "pedal", {"m": p}) @ [can.arm, 0, 0, 1]
        assert end[2] == pytest.approx(origin(can, "rod", m=p)[2])
    slope = model_of(can).jacobian("m/lid", "m/base")[4, 0]
    steep, flat = slope({"m": 0.25}), slope({"m": 0.0})
    assert flat == pytest.approx(can.arm / can.lever)
    assert flat < steep < math.inf


# -- parallelograms ------------------------------------------------------------------------------------


@pytest.mark.parametrize("stages", [1, 3])
def test_scissor_lift_platform_rises_vertically(stages: int) -> None:
    lift = kv.articulations.ScissorLift(**WHERE, stages=stages, arm=0.8, angle=kv.Limits(0.0, math.pi / 2))
    for angle in np.linspace(0, math.pi / 2, 7):
        rise, reach = 0.8 * math.sin(angle), 0.8 * math.cos(angle)
        np.testing.assert_allclose(pose(lift, "platform", {"m": angle}), at(z=stages * rise), atol=1e-15)
        np.testing.assert_allclose(pose(lift, "slider", {"m": angle}), at(x=reach), atol=1e-15)
        for i in range(stages):
            # Arm a leads from the fixed side up to the sliding one, arm b back; they meet in their middles.
            a, b = (pose(lift, f"arm_{i + 1}{letter}", {"m": angle}) for letter in "ab")
            ends = {
                (0.0, i * rise): a @ [-0.4, 0, 0, 1],
                (reach, (i + 1) * rise): a @ [0.4, 0, 0, 1],
                (0.0, (i + 1) * rise): b @ [-0.4, 0, 0, 1],
                (reach, i * rise): b @ [0.4, 0, 0, 1],
            }
            for (x, z), end in ends.items():
                np.testing.assert_allclose(end, [x, 0, z, 1], atol=1e-14)
    assert len(model_of(lift).frames) == 3 + 2 * stages


def test_desk_lamp_head_keeps_its_orientation() -> None:
    lamp = kv.articulations.DeskLamp(**WHERE)
    for a in np.linspace(-0.8, 0.8, 5):
        for b in np.linspace(-0.9, 0.9, 5):
            where = {"m/lower": a, "m/upper": b}
            elbow = at(0.4 * math.sin(a), 0, 0.4 * math.cos(a))
            head = elbow @ at(0.38 * math.cos(b), 0, 0.38 * math.sin(b))
            np.testing.assert_allclose(pose(lamp, "elbow", where), elbow, atol=1e-14)
            np.testing.assert_allclose(pose(lamp, "head", where), head, atol=1e-14)
            np.testing.assert_allclose(pose(lamp, "light", where)[:3, 2], [0, 0, -1], atol=1e-14)
            # The bars end on elbow and head.
            bar = pose(lamp, "lower_bar", where) @ [0, 0, 0.4, 1]
            np.testing.assert_allclose(bar, elbow @ [lamp.offset, 0, 0, 1], atol=1e-14)
            bar = pose(lamp, "upper_bar", where) @ [0.38, 0, 0, 1]
            np.testing.assert_allclose(bar, head @ [0, 0, lamp.offset, 1], atol=1e-14)
    turning = model_of(lamp).jacobian("m/head")({"m/lower": 0.3, "m/upper": -0.4})[3:]
    np.testing.assert_allclose(turning, 0, atol=1e-15)


# -- screws, ratchets, taps ----------------------------------------------------------------------------


@pytest.mark.parametrize(("pitch", "start"), [(0.004, 0.2), (-0.004, 0.0)])
def test_nut_slides_while_the_screw_rotates(pitch: float, start: float) -> None:
    vice = kv.articulations.ScrewAndNut(**WHERE, pitch=pitch)
    assert model_of(vice).limits("m") == (0, pytest.approx(math.tau * 50))
    for angle in (0.0, 1.0, math.tau, math.tau * 50):
        nut = at(z=start - pitch * angle / math.tau)
        np.testing.assert_allclose(pose(vice, "nut", {"m": angle}), nut, atol=1e-14)
        np.testing.assert_allclose(pose(vice, "screw", {"m": angle}), turned((0, 0, 1), angle), atol=1e-13)
    assert origin(vice, "nut", m=math.tau * 50)[2] == pytest.approx(0.2 - start)


def test_nut_relative_to_screw_is_a_screw_joint() -> None:
    """Seen from the screw, the nut turns the other way and goes along by the pitch: that is the thread."""
    vice = model_of(kv.articulations.ScrewAndNut(**WHERE, pitch=0.01))
    thread = model_of(kv.articulations.Screw(name="t", parent="world", child="t", axis=(0, 0, 1), pitch=0.01))
    for angle in (0.5, 4.0):
        start = vice.fk("m/nut", "m/screw")({"m": 0.0})
        found = np.linalg.inv(start) @ vice.fk("m/nut", "m/screw")({"m": angle})
        np.testing.assert_allclose(found, thread.fk("t")({"t": -angle}), atol=1e-14)


def test_ratchet_turns_one_way_until_its_pawl_is_lifted() -> None:
    model = model_of(kv.articulations.Ratchet(**WHERE))
    wheel, pawl = kv.position("m/wheel"), kv.position("m/pawl")
    assert dict(model.articulations["m"].dynamics) == {"teeth": 24, "pitch": math.tau / 24}
    assert model.limits("m/wheel:velocity", {pawl: 0.0}) == (0, 10)
    assert model.limits("m/wheel:velocity", {pawl: 0.3}) == (-10, 10)
    back = {"m/wheel": 3.0, "m/pawl": 0.0, "m/wheel:velocity": -0.1, "m/pawl:velocity": 0.0}
    assert [v.name for v in model.violations(back)] == ["m/lock"]
    assert not model.violations({**back, "m/pawl": 0.3})
    assert not model.violations({**back, "m/wheel:velocity": 0.0, "m/wheel": -100.0})
    # Its gradient says what to do: lift the pawl.
    assert model.constraints["m/lock"].lower.gradient()[pawl.derivative()]({pawl: 0.0}) < 0
    for held, turned_to in ((0.0, 1.0), (0.3, -4.0)):
        assert assert_rows_keep_limits(
            model, {wheel: 1.0, pawl: held}, {"m/wheel:velocity": -10.0, "m/pawl:velocity": 0.0}, 5, 0.1
        )[wheel] == pytest.approx(turned_to)
    np.testing.assert_allclose(
        pose(kv.articulations.Ratchet(**WHERE), "wheel", {"m/wheel": 0.7, "m/pawl": 0.0}),
        about_y(0.7),
        atol=1e-15,
    )
    # Lifted, its nose is higher.
    up, down = (
        pose(kv.articulations.Ratchet(**WHERE), "pawl", {"m/wheel": 0.0, "m/pawl": p}) for p in (0.4, 0.0)
    )
    assert (up @ [-0.035, 0, 0, 1])[2] > (down @ [-0.035, 0, 0, 1])[2] + 0.01


def test_faucet_poses_and_flow() -> None:
    tap = kv.articulations.Faucet(**WHERE)
    for lift, turn in ((0.0, -0.8), (0.2, 0.3), (0.5, 0.8)):
        where = kv.State({"m/lift": lift, "m/turn": turn})
        lever = at(z=0.16) @ turned((0, 0, 1), turn) @ about_y(lift)
        np.testing.assert_allclose(pose(tap, "lever", where), lever, atol=1e-15)
        data = model_of(tap).data
        assert data["m/flow"](where) == pytest.approx(1.5e-4 * lift / 0.5)
        assert data["m/hot"](where) == pytest.approx((turn + 0.8) / 1.6)
    assert (pose(tap, "lever", {"m/lift": 0.5, "m/turn": 0.0}) @ [-0.1, 0, 0, 1])[2] > 0.16


# -- bad input -----------------------------------------------------------------------------------------

BROKEN: list[tuple[type[Mechanism], dict[str, Any], str]] = [
    (kv.articulations.PistonAndRod, {"rod": 0.04}, "The rod of the piston and rod 'm' is longer than its crank, 0.04, and not 0.04"),
    (kv.articulations.PistonAndRod, {"crank": 0.2}, "longer than its crank, 0.2, and not 0.13"),
    (kv.articulations.PistonAndRod, {"bore": -1}, "The bore of the piston and rod 'm' is a positive, finite number, not -1"),
    (kv.articulations.PedalBin, {"lever": 0.04}, "The lever of the pedal bin 'm' is 0.04, and its pedal lifts the rod by 0.0494808"),
    (kv.articulations.PedalBin, {"pedal": kv.Limits(0, 0.5)}, "is 0.052, and its pedal lifts the rod by 0.0958851"),
    (kv.articulations.PedalBin, {"pedal": kv.Limits(-0.1, 0.2)}, "The pedal of the pedal bin 'm' is a range within [0, 1.5708], not from -0.1 to 0.2"),
    (kv.articulations.ScissorLift, {"stages": 0}, "The stages of the scissor lift 'm' are a whole number from 1 to 64, not 0"),
    (kv.articulations.ScissorLift, {"stages": 2.5}, "not 2.5"),
    (kv.articulations.ScissorLift, {"stages": True}, "not True"),
    (kv.articulations.ScissorLift, {"stages": 65}, "not 65"),
    (kv.articulations.ScissorLift, {"angle": kv.Limits(0, 1.6)}, "The angle of the scissor lift 'm' is a range within [0, 1.5708], not from 0 to 1.6"),
    (kv.articulations.ScissorLift, {"angle": kv.Limits(1, 1)}, "not from 1 to 1"),
    (kv.articulations.ScissorLift, {"angle": kv.Limits(0, nan)}, "its upper end, is a finite number, not nan"),
    (kv.articulations.DeskLamp, {"lower": kv.Limits(-1, math.pi / 2)}, "The lower of the desk lamp 'm' ends before ±π/2"),
    (kv.articulations.DeskLamp, {"upper": kv.Limits(-2, 1)}, "is a range within [-1.5708, 1.5708], not from -2 to 1"),
    (kv.articulations.DeskLamp, {"offset": 0}, "The offset of the desk lamp 'm' is a positive, finite number, not 0"),
    (kv.articulations.ScrewAndNut, {"pitch": 0}, "The pitch of the screw and nut 'm' is 0, so nothing would move the nut"),
    (kv.articulations.ScrewAndNut, {"travel": nan}, "The travel of the screw and nut 'm' is a positive, finite number, not nan"),
    (kv.articulations.ScrewAndNut, {"velocity": -1}, "The velocity of the screw and nut 'm' is -1; it cannot be negative"),
    (kv.articulations.Ratchet, {"teeth": 2}, "The teeth of the ratchet 'm' are a whole number from 3, not 2"),
    (kv.articulations.Ratchet, {"release": 0.5}, "The release of the ratchet 'm' lies between 0.0 and 0.4, and is not 0.5"),
    (kv.articulations.Ratchet, {"speed": 0}, "The speed of the ratchet 'm' is a positive, finite number, not 0"),
    (kv.articulations.Faucet, {"lift": kv.Limits(0)}, "The lift of the faucet 'm' has a number as its upper end, not None"),
    (kv.articulations.Faucet, {"turn": kv.Limits(-4, 4)}, "The turn of the faucet 'm' is a range within [-3.14159, 3.14159], not from -4 to 4"),
    (kv.articulations.Faucet, {"flow": 0}, "The flow of the faucet 'm' is a positive, finite number, not 0"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "given", "words"), BROKEN)
def test_invalid_mechanism_is_refused(kind: type[Mechanism], given: dict[str, Any], words: str) -> None:
    assert words in refused(kind, given)
