"""Gears, racks and cams: functions of a driver, chained, and run again when the driver is exchanged."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from articulation_checks import (
    ORIGIN,
    WHERE,
    assert_is_a_value,
    assert_jacobian,
    assert_motion_law,
    assert_rows_keep_limits,
    model_of,
    slid,
    turned,
)
from scipy.interpolate import CubicSpline

import kineverse as kv

nan, inf = float("nan"), float("inf")
AXES = [(0, 0, 1), (2.0, 0, 0), (1, 2, 3)]
MOTOR = kv.Revolute(name="motor", parent="world", child="shaft", axis=(0, 0, 1))
ANGLES = (0.0, 1.0, 2.5, 4.0, math.tau)
LIFTS = (0.0, 0.01, 0.03, 0.02, 0.0)
PROFILE = CubicSpline(ANGLES, LIFTS, bc_type="periodic")
SPEED = kv.velocity("motor")
d = kv.position("motor")

EVERY: list[Any] = [
    kv.articulations.Gearbox(
        **WHERE, axis=(1, 2, 3), driver="motor", ratio=-2.5, offset=0.3, lower=-1, upper=2, velocity=3
    ),
    kv.articulations.Gearbox(**WHERE, driver=d**2 + kv.position("other"), ratio=0.5),
    kv.articulations.RackAndPinion(
        **WHERE, axis=(0, 1, 1), driver="motor", radius=0.02, offset=-0.1, upper=0.5
    ),
    kv.articulations.Cam(**WHERE, driver="motor", angles=ANGLES, values=LIFTS, velocity=1),
    kv.articulations.Cam(
        **WHERE, driver=2 * d, angles=(0, 1, 2), values=(0, 0.5, 0.1), periodic=False, turns=True
    ),
]


def driven(operation: kv.Operation) -> kv.Model:
    return model_of(MOTOR, operation)


@pytest.mark.parametrize("axis", AXES)
def test_transmission_position_is_a_function_of_its_driver(axis: Any) -> None:
    gear = driven(kv.articulations.Gearbox(**WHERE, axis=axis, driver="motor", ratio=-2.5, offset=0.3)).fk(
        "c"
    )
    rack = driven(
        kv.articulations.RackAndPinion(**WHERE, axis=axis, driver="motor", radius=0.02, offset=0.1)
    ).fk("c")
    cam = driven(kv.articulations.Cam(**WHERE, axis=axis, driver="motor", angles=ANGLES, values=LIFTS)).fk(
        "c"
    )
    lever = driven(
        kv.articulations.Cam(**WHERE, axis=axis, driver="motor", angles=ANGLES, values=LIFTS, turns=True)
    ).fk("c")
    for angle in (0.0, 0.4, -2.0, 3.0, 20.0, *ANGLES):
        lift = float(PROFILE(angle))
        at = {"motor": angle}
        np.testing.assert_allclose(gear(at), ORIGIN @ turned(axis, 0.3 - 2.5 * angle), atol=1e-13)
        np.testing.assert_allclose(rack(at), ORIGIN @ slid(axis, 0.1 + 0.02 * angle), atol=1e-13)
        np.testing.assert_allclose(cam(at), ORIGIN @ slid(axis, lift), atol=1e-13)
        np.testing.assert_allclose(lever(at), ORIGIN @ turned(axis, lift), atol=1e-13)


@pytest.mark.parametrize("operation", EVERY, ids=lambda o: type(o).__name__)
@pytest.mark.parametrize("seed", range(4))
def test_transmission_jacobians_equal_finite_differences(operation: kv.Operation, seed: int) -> None:
    assert_jacobian(driven(operation), "c", seed, reach=3.0)


@pytest.mark.parametrize("operation", EVERY, ids=lambda o: type(o).__name__)
def test_transmission_tangents_equal_motion_along_rates(operation: kv.Operation) -> None:
    model = driven(operation)
    assert_motion_law(model, [model.fk("c"), model.jacobian("c")], seed=5)


@pytest.mark.parametrize("operation", EVERY, ids=lambda o: type(o).__name__)
def test_transmissions_are_hashable_and_survive_a_document(operation: Any, tmp_path: Path) -> None:
    model = driven(operation)
    assert_is_a_value(operation, model, tmp_path)
    record = model.articulations["j"]
    assert record.coordinates == record.speeds == ()
    assert record.position is record.follows is not None
    read = kv.load(tmp_path / "model.kv.json", prefix="new")
    assert {s.path for s in read.articulations["new/j"].position.symbols} <= {"new/motor", "new/other"}


def test_cam_follower_acceleration_is_continuous() -> None:
    height = (
        driven(kv.articulations.Cam(**WHERE, driver="motor", angles=ANGLES, values=LIFTS))
        .articulations["j"]
        .follows
    )
    first = height.jacobian([d])
    second = first.jacobian([d])
    for knot in (*ANGLES, -ANGLES[1]):
        for e in (height, first, second):
            before, at, after = (e({d: knot + step}).item() for step in (-1e-9, 0, 1e-9))
            assert before == pytest.approx(at, abs=1e-7)
            assert after == pytest.approx(at, abs=1e-7)


# -- limits --------------------------------------------------------------------------------------------


def test_transmission_limits_constrain_the_function_of_the_driver() -> None:
    model = driven(
        kv.articulations.Gearbox(**WHERE, driver="motor", ratio=-2, offset=1, lower=-1, upper=3, velocity=4)
    )
    constraints = {n: (c.lower, c.expression, c.upper) for n, c in model.constraints.items()}
    assert constraints == {"j/position": (-1, -2 * d + 1, 3), "j/velocity": (-4, -2 * SPEED, 4)}
    broken = model.violations({"motor": 1.5, "motor:velocity": 2.1})
    assert [(v.name, v.value) for v in broken] == [("j/position", -2.0), ("j/velocity", -4.2)]
    assert not model.violations({"motor": 1.0, "motor:velocity": -2.0})
    assert set(model.constraints_for(model.fk("shaft"))) == {"j/position", "j/velocity"}


def test_velocity_rows_keep_transmission_limits() -> None:
    gear = kv.articulations.Gearbox(**WHERE, driver="motor", ratio=-2, upper=3, lower=-3, velocity=4)
    cam = kv.articulations.Cam(
        name="k", parent="world", child="k", driver="j", angles=ANGLES, values=LIFTS, upper=0.025
    )
    model = model_of(MOTOR, gear, cam)
    # The lift is no straight line in the angle, so a step of the row passes it by what bends within a step.
    end = assert_rows_keep_limits(model, model.default_state(), {"motor:velocity": -1}, 200, 0.02, slack=1e-5)
    assert float(PROFILE(-2 * end[d])) == pytest.approx(0.025, abs=1e-5)


# -- trains --------------------------------------------------------------------------------------------


def gear(name: str, driver: Any, ratio: float, **others: Any) -> kv.articulations.Gearbox:
    return kv.articulations.Gearbox(
        name=name, parent="world", child=f"{name}_wheel", axis=(0, 0, 1), driver=driver, ratio=ratio, **others
    )


def train() -> kv.Model:
    rack = kv.articulations.RackAndPinion(
        name="rack", parent="world", child="rack", driver="third", radius=0.05
    )
    return model_of(
        MOTOR, gear("first", "motor", -2), gear("second", "first", -3), gear("third", "second", 0.5), rack
    )


def test_transmissions_drive_transmissions() -> None:
    model = train()
    assert model.degrees_of_freedom == (d,)
    assert model.fk("rack")({d: 0.7})[0, 3] == pytest.approx(0.05 * 3 * 0.7)
    np.testing.assert_allclose(model.fk("second_wheel")({d: 0.7}), turned((0, 0, 1), 4.2), atol=1e-14)
    ((speed, ratio),) = model.fk("rack")[0, 3].gradient().items()
    assert (speed, float(ratio)) == (SPEED, pytest.approx(0.15))


def test_replacing_the_driver_reruns_the_gear_train_only() -> None:
    model = train()
    heard: list[kv.model.Diff] = []
    with model.listen(heard.append):
        with model.edit() as edit:
            edit.replace("joint first", gear("first", "motor", -4))
        assert model.fk("rack")({d: 0.7})[0, 3] == pytest.approx(0.05 * 6 * 0.7)
        assert heard[-1].reruns == 4
        with model.edit() as edit:  # the last wheel turns the same: the rack is left alone
            edit.replace("joint third", gear("third", "second", 0.5, upper=100))
        assert heard[-1].reruns == 1
        with model.edit() as edit:  # a motor that is driven itself
            crank = kv.position("crank")
            edit.replace(
                "joint motor", kv.Revolute(name="motor", parent="world", child="shaft", position=crank**2)
            )
        assert model.degrees_of_freedom == (crank,)
        assert model.fk("rack")({crank: 0.7})[0, 3] == pytest.approx(0.05 * 6 * 0.49)


def test_removing_the_driver_of_a_train_is_refused() -> None:
    model = train()
    before = model.snapshot()
    with pytest.raises(kv.errors.EditError) as info, model.edit() as edit:
        edit.remove("joint second")
    assert "'joint third': The driver of the gearbox 'third' is missing." in str(info.value)
    assert model.snapshot() == before


def test_any_articulation_with_one_coordinate_is_a_driver() -> None:
    """A slider, a mimic joint, a screw, one of two coordinates, a wheel of a base."""
    where = {"parent": "world"}
    operations = [
        kv.Prismatic(name="slider", child="slider", **where),
        kv.Revolute(name="mimic", child="mimic", position=2 * kv.position("slider"), **where),
        kv.articulations.Screw(name="screw", child="screw", pitch=0.1, **where),
        kv.articulations.Cylindrical(name="rod", child="rod", **where),
        kv.articulations.DifferentialDrive(name="base", child="base", radius=0.1, track=0.5, **where),
    ]
    drivers = ["slider", "mimic", "screw", kv.position("rod/turn"), kv.position("base/angle")]
    followers = [gear(f"g{i}", driver, 2) for i, driver in enumerate(drivers)]
    model = model_of(*operations, *followers)
    angles = [model.articulations[f"g{i}"].position for i in range(5)]
    values = {"slider": 0.1, "screw": 0.2, "rod/turn": 0.3, "base/angle": 0.4}
    assert [float(a({k: v for k, v in values.items() if kv.position(k) in a.symbols})) for a in angles] == (
        pytest.approx([0.2, 0.4, 0.4, 0.6, 0.8])
    )
    moved_by = {str(s) for s in model.speeds_of("g4_wheel")}
    assert moved_by == {"base/left_wheel:velocity", "base/right_wheel:velocity"}


# -- bad input -----------------------------------------------------------------------------------------

CAM: dict[str, Any] = {"driver": "motor", "angles": ANGLES, "values": LIFTS}
GEAR: dict[str, Any] = {"driver": "motor", "ratio": 2}
BROKEN: list[tuple[type[Any], dict[str, Any], str]] = [
    (kv.articulations.Gearbox, {**GEAR, "ratio": 0}, "ratio of the gearbox 'j' is 0"),
    (kv.articulations.Gearbox, {**GEAR, "ratio": nan}, "ratio of the gearbox 'j' is a finite number, not nan"),
    (kv.articulations.Gearbox, {**GEAR, "ratio": "two"}, "ratio of the gearbox 'j' is a number, not 'two'"),
    (kv.articulations.Gearbox, {**GEAR, "offset": inf}, "offset of the gearbox 'j' is a finite number, not inf"),
    (kv.articulations.Gearbox, {**GEAR, "axis": (0, 0, 0)}, "axis of joint 'j' has length zero"),
    (kv.articulations.Gearbox, {**GEAR, "lower": 1, "upper": 0.5}, "limits of 'j' are no range.* 1 and the upper bound 0.5"),
    (kv.articulations.Gearbox, {**GEAR, "velocity": -2}, "velocity limit of 'j' is -2"),
    (kv.articulations.Gearbox, {**GEAR, "driver": "moter"}, "driver of the gearbox 'j' is missing. .*'moter'. Did you mean 'motor'"),
    (kv.articulations.Gearbox, {**GEAR, "driver": "j"}, "driver of the gearbox 'j' is missing"),
    (kv.articulations.Gearbox, {**GEAR, "driver": "rod"}, "'rod', has 2 coordinates, 'rod/slide', 'rod/turn'; give one of them"),
    (kv.articulations.Gearbox, {**GEAR, "driver": "old"}, "driver of the gearbox 'j', 'old', has no position"),
    (kv.articulations.Gearbox, {**GEAR, "driver": 3}, "driver of the gearbox 'j' is the name of an articulation.*not 3"),
    (kv.articulations.Gearbox, {**GEAR, "driver": kv.Expression(0.5)}, "driver of the gearbox 'j' is constant: 0.5"),
    (kv.articulations.Gearbox, {**GEAR, "driver": kv.array([d, d])}, r"driver of the gearbox 'j' is a scalar, not of shape \(2,\)"),
    (kv.articulations.Gearbox, {**GEAR, "driver": SPEED}, "driver of the gearbox 'j' is about positions.*motor:velocity"),
    (kv.articulations.Gearbox, {**GEAR, "name": "old"}, "There is an articulation 'old' already"),
    (kv.articulations.Gearbox, {**GEAR, "child": "shaft"}, "There is a frame 'shaft' already, so the gearbox 'j'"),
    (kv.articulations.RackAndPinion, {"driver": "motor", "radius": 0}, "radius of the rack and pinion 'j' is a positive.*not 0"),
    (kv.articulations.RackAndPinion, {"driver": "motor", "radius": -0.1}, "not -0.1"),
    (kv.articulations.RackAndPinion, {"driver": "motor", "radius": nan}, "not nan"),
    (kv.articulations.RackAndPinion, {"driver": "motor", "radius": 1, "offset": nan}, "offset of the rack and pinion 'j'"),
    (kv.articulations.Cam, {**CAM, "angles": (0, 1, 1, 4, 5)}, "profile of the cam 'j' is invalid. Knots increase: knot 2 is 1"),
    (kv.articulations.Cam, {**CAM, "angles": (0, 1)}, "profile of the cam 'j' .* not 5 for 2"),
    (kv.articulations.Cam, {**CAM, "values": (0, 1, 2, 3, 4)}, "profile of the cam 'j' .*last value 4 is not its first, 0"),
    (kv.articulations.Cam, {**CAM, "values": (0, 1, nan, 3, 0)}, "profile of the cam 'j' .*number 2 is nan"),
    (kv.articulations.Cam, {**CAM, "angles": 3}, "angles of the cam 'j' are numbers, not 3"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "given", "words"), BROKEN)
def test_invalid_transmission_error_names_articulation_and_number(
    kind: type[Any], given: dict[str, Any], words: str
) -> None:
    model = model_of(
        kv.Fixed(name="old", parent="world", child="old"),
        MOTOR,
        kv.articulations.Cylindrical(name="rod", parent="world", child="rod"),
    )
    before = model.snapshot()
    with pytest.raises(kv.KineverseError, match=words), model.edit() as edit:
        edit.apply(kind(**{**WHERE, **given}), tag="mine")
    assert model.snapshot() == before


def test_cam_profiles_given_as_arrays_are_hashable() -> None:
    one = kv.articulations.Cam(**WHERE, driver="motor", angles=np.array(ANGLES), values=list(LIFTS))
    assert one == kv.articulations.Cam(**WHERE, driver="motor", angles=ANGLES, values=LIFTS)
    assert hash(one) == hash(kv.articulations.Cam(**WHERE, driver="motor", angles=ANGLES, values=LIFTS))
