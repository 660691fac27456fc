"""Bases that drive: cars, mecanum wheels, and speed limits that mean speed."""

from __future__ import annotations

import dataclasses
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
    homogeneous,
    model_of,
)
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse.articulations import Base

nan = float("nan")
FLAT: dict[str, Any] = {"name": "j", "parent": "world", "child": "c"}
CAR = kv.articulations.Ackermann(**FLAT, wheelbase=2.5, steering=0.5, steering_speed=0.4, speed=3)
WHEELED = kv.articulations.Mecanum(
    **FLAT, radius=0.1, track=0.5, wheelbase=0.7, wheel_speed=30, speed=2, turn=1
)
TWO_WHEELED = kv.articulations.DifferentialDrive(
    **FLAT, radius=0.1, track=0.5, wheel_speed=30, speed=1, turn=2
)
EVERY: list[Base] = [CAR, WHEELED, TWO_WHEELED, kv.articulations.OmniBase(**FLAT)]
CORNERS = ("front_left", "front_right", "rear_left", "rear_right")


def wheels(*speeds: float) -> dict[str, float]:
    return {f"j/{corner}_wheel:velocity": float(s) for corner, s in zip(CORNERS, speeds, strict=True)}


RADIUS, SECOND = kv.parameter("radius", 0.1), kv.parameter("second", 0.12)
TRACK, LONG = kv.parameter("track", 0.5), kv.parameter("long", 0.7)
SIZED_BY_EXPRESSIONS = [
    kv.articulations.DifferentialDrive(**FLAT, radius=RADIUS, track=TRACK, speed=1, turn=2),
    kv.articulations.DifferentialDrive(**FLAT, radius=(RADIUS, SECOND), track=TRACK, speed=1, turn=2),
    kv.articulations.Mecanum(**FLAT, radius=RADIUS, track=TRACK, wheelbase=LONG, speed=1, turn=2),
    kv.articulations.Ackermann(**FLAT, wheelbase=LONG, speed=1),
]


@pytest.mark.parametrize("base", SIZED_BY_EXPRESSIONS)
def test_sizes_may_be_expressions_which_rates_and_limits_follow(base: Any, tmp_path: Path) -> None:
    model = model_of(base)
    assert_is_a_value(base, model, tmp_path)
    sizes = {RADIUS: 0.2, SECOND: 0.25, TRACK: 0.4, LONG: 0.6}

    def number(size: Any) -> Any:
        return tuple(map(number, size)) if isinstance(size, tuple) else sizes[size]

    given = {f: number(getattr(base, f)) for f in ("radius", "track", "wheelbase") if hasattr(base, f)}
    numeric = model_of(dataclasses.replace(base, **given))
    state = {s: 0.3 * (i + 1) for i, s in enumerate((*model.degrees_of_freedom, *model.speeds))} | sizes

    def value(expression: Any) -> float:
        one = kv.array(expression)
        return float(one({s: state[s] for s in one.symbols}))

    for coordinate, row in model.rates.items():
        for speed, factor in row.items():
            assert value(factor) == pytest.approx(value(numeric.rates[coordinate][speed]), rel=1e-14)
    assert set(model.constraints) == set(numeric.constraints)
    for name, constraint in model.constraints.items():
        wanted = numeric.constraints[name].expression
        assert value(constraint.expression) == pytest.approx(value(wanted), rel=1e-14)


def test_wheels_of_two_radii_drive_a_curve() -> None:
    base = kv.articulations.DifferentialDrive(**FLAT, radius=(0.1, 0.12), track=0.5)
    model = model_of(base)
    speeds = {"j/left_wheel:velocity": 2.0, "j/right_wheel:velocity": 2.0}
    end = model.integrate(model.default_state(), speeds, 0.01)
    assert end["j/angle"] == pytest.approx(2.0 * 0.02 / 0.5 * 0.01)
    assert end["j/x"] == pytest.approx(2.0 * 0.11 * 0.01, rel=1e-6)


@pytest.mark.parametrize("base", EVERY, ids=lambda o: type(o).__name__)
def test_base_poses_follow_their_coordinates(base: Base) -> None:
    kind, given = type(base), {**base.__dict__, **WHERE}
    pose = model_of(kind(**given)).fk("c")
    for x, y, angle in ((0, 0, 0), (1, -2, 0.7), (3, 1, -4)):
        expected = ORIGIN @ homogeneous(Rotation.from_euler("z", angle), (x, y, 0))
        np.testing.assert_allclose(pose({"j/x": x, "j/y": y, "j/angle": angle}), expected, atol=1e-14)


@pytest.mark.parametrize("base", EVERY, ids=lambda o: type(o).__name__)
@pytest.mark.parametrize("seed", range(3))
def test_base_jacobians_equal_finite_differences(base: Base, seed: int) -> None:
    assert_jacobian(model_of(base), "c", seed)


@pytest.mark.parametrize("base", EVERY, ids=lambda o: type(o).__name__)
def test_base_tangents_equal_motion_along_rates(base: Base) -> None:
    model = model_of(base, kv.Revolute(name="arm", parent="c", child="arm", axis=(1, 2, 3)))
    assert_motion_law(model, [model.fk("arm"), model.jacobian("arm"), model.fk("c", "arm")], seed=4)


@pytest.mark.parametrize("base", EVERY, ids=lambda o: type(o).__name__)
def test_bases_are_hashable_and_survive_a_document(base: Any, tmp_path: Path) -> None:
    assert_is_a_value(base, model_of(base), tmp_path)


# -- the car -------------------------------------------------------------------------------------------


def test_ackermann_drives_a_circle_about_a_point_on_its_rear_axle() -> None:
    model = model_of(CAR)
    assert [str(s) for s in model.speeds] == ["j/drive:velocity", "j/steering:velocity"]
    assert [s.path for s in model.articulations["j"].coordinates] == ["j/x", "j/y", "j/angle", "j/steering"]
    radius = 2.5 / math.tan(0.4)
    start = model.default_state().updated({"j/steering": 0.4})
    after = model.integrate(start, {"j/drive:velocity": 2.0}, 3.0)
    turned = 6.0 / radius
    assert after["j/angle"] == pytest.approx(turned)
    assert after["j/x"] == pytest.approx(radius * math.sin(turned))
    assert after["j/y"] == pytest.approx(radius * (1 - math.cos(turned)))


def test_ackermann_steers_while_it_drives() -> None:
    """With δ = ct, the angle is -v/(Lc)·log cos(ct)."""
    model = model_of(CAR)
    after = model.integrate(model.default_state(), {"j/drive:velocity": 2.0, "j/steering:velocity": 0.3}, 1.5)
    assert after["j/steering"] == pytest.approx(0.45)
    assert after["j/angle"] == pytest.approx(-2 / (2.5 * 0.3) * math.log(math.cos(0.45)))


def test_ackermann_cannot_move_sideways() -> None:
    sideways = model_of(CAR).jacobian("c", form="body")[1]
    for angle, steering in ((0, 0), (1.0, 0.3), (-2.0, -0.5)):
        at = {"j/x": 1, "j/y": 2, "j/angle": angle, "j/steering": steering}
        np.testing.assert_allclose(
            sideways({s: v for s, v in at.items() if kv.position(s) in sideways.symbols}), 0, atol=1e-15
        )


def test_ackermann_limits() -> None:
    model = model_of(CAR)
    assert model.limits("j/steering") == (-0.5, 0.5)
    assert model.limits("j/steering:velocity") == (-0.4, 0.4)
    assert model.limits("j/drive:velocity") == (-3, 3)
    wish = {"j/drive:velocity": 1, "j/steering:velocity": 1}
    end = assert_rows_keep_limits(model, model.default_state(), wish, 20, 0.1)
    assert end[kv.position("j/steering")] == pytest.approx(0.5)
    free = model_of(kv.articulations.Ackermann(**FLAT, wheelbase=1))
    assert set(free.constraints) == {"j/steering/position"}


# -- mecanum wheels ------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 0.8, -2.0])
def test_mecanum_wheels_move_three_coordinates(angle: float) -> None:
    model = model_of(WHEELED)
    jacobian = model.jacobian("c", form="body")(kv.State({"j/x": 1.0, "j/y": 2.0, "j/angle": angle}))
    columns = {s: jacobian[:, i] for i, s in enumerate(map(str, model.speeds_of("c")))}
    r, reach = 0.1, (0.5 + 0.7) / 2

    def twist(*speeds: float) -> Any:
        return sum(v * columns[s] for s, v in wheels(*speeds).items())

    np.testing.assert_allclose(twist(1, 1, 1, 1), [r, 0, 0, 0, 0, 0], atol=1e-15)
    np.testing.assert_allclose(twist(-1, 1, 1, -1), [0, r, 0, 0, 0, 0], atol=1e-15)
    np.testing.assert_allclose(twist(-1, 1, -1, 1), [0, 0, 0, 0, 0, r / reach], atol=1e-15)
    np.testing.assert_allclose(twist(1, 1, -1, -1), 0, atol=1e-15)  # the wheels slip


def test_mecanum_inverse_kinematics_gives_the_requested_motion() -> None:
    """Each roller's axis is at 45°: ω r = v_x ∓ v_y ∓ (b + L)/2 θ̇."""
    model = model_of(WHEELED)
    vx, vy, turning, reach = 0.4, -0.3, 0.7, 0.6
    needed = [
        (vx - vy - reach * turning) / 0.1,
        (vx + vy + reach * turning) / 0.1,
        (vx + vy - reach * turning) / 0.1,
        (vx - vy + reach * turning) / 0.1,
    ]
    after = model.integrate(model.default_state(), wheels(*needed), 1e-6)
    assert after["j/x"] == pytest.approx(vx * 1e-6, rel=1e-5)
    assert after["j/y"] == pytest.approx(vy * 1e-6, rel=1e-5)
    assert after["j/angle"] == pytest.approx(turning * 1e-6, rel=1e-5)
    assert needed[0] + needed[1] == pytest.approx(needed[2] + needed[3])  # no slip


def test_mecanum_wheels_take_names() -> None:
    names = ("a", "b", "c/d", "e")
    model = model_of(kv.articulations.Mecanum(**FLAT, radius=0.1, track=1, wheelbase=1, wheels=names))
    assert [s.path for s in model.articulations["j"].speeds] == list(names)
    assert not model.constraints


# -- speed limits --------------------------------------------------------------------------------------


@pytest.mark.parametrize("heading", [0.0, 1.0, 4.0])
def test_mecanum_speed_limit_holds_in_every_direction(heading: float) -> None:
    model = model_of(WHEELED)
    for direction in np.linspace(0, 6, 7):
        c, s = math.cos(direction), math.sin(direction)
        for speed, broken in ((1.99, []), (2.01, ["j/speed"])):
            moving = wheels(*(speed / 0.1 * np.array([c - s, c + s, c + s, c - s])))
            at = {"j/x": 30.0, "j/y": -40.0, "j/angle": heading, **moving}
            assert [v.name for v in model.violations(at)] == broken
    for speed, broken in ((0.99, []), (1.01, ["j/turn"])):
        moving = wheels(*(speed * 0.6 / 0.1 * np.array([-1, 1, -1, 1])))
        assert [v.name for v in model.violations({"j/angle": heading, **moving})] == broken
    fast = model.violations(wheels(31, 31, -31, -31))
    assert [v.name for v in fast] == [f"j/{corner}_wheel_speed" for corner in sorted(CORNERS)]


def test_differential_drive_limits_of_speed_and_turn() -> None:
    model = model_of(TWO_WHEELED)

    def broken(left: float, right: float) -> list[str]:
        at = {"j/left_wheel:velocity": left, "j/right_wheel:velocity": right}
        return [v.name for v in model.violations(at)]

    assert broken(9.9, 9.9) == []
    assert broken(-10.1, -10.1) == ["j/speed"]
    assert broken(-4.9, 4.9) == []
    assert broken(5.1, -5.1) == ["j/turn"]
    assert broken(31, 31)[-1:] + broken(-31, 31)[-1:] == ["j/right_wheel_speed"] * 2


@pytest.mark.parametrize("base", [WHEELED, TWO_WHEELED], ids=lambda o: type(o).__name__)
@pytest.mark.parametrize("seed", range(3))
def test_velocity_rows_keep_speed_limits_of_bases(base: Base, seed: int) -> None:
    model, rng = model_of(base), np.random.default_rng(seed)
    wish = {str(s): float(rng.normal()) for s in model.speeds}
    assert_rows_keep_limits(model, model.default_state(), wish, 5, 0.1)


# -- bad input -----------------------------------------------------------------------------------------

SIZES = {"radius": 0.1, "track": 0.5, "wheelbase": 0.7}
BROKEN: list[tuple[type[Any], dict[str, Any], str]] = [
    (kv.articulations.Ackermann, {"wheelbase": 0}, "wheelbase of the ackermann 'j' is a positive, finite number, not 0"),
    (kv.articulations.Ackermann, {"wheelbase": nan}, "not nan"),
    (kv.articulations.Ackermann, {"wheelbase": 1, "steering": 1.6}, r"'j' is limited to something in \(0, π/2\) rad, not 1.6"),
    (kv.articulations.Ackermann, {"wheelbase": 1, "steering": 0}, "not 0"),
    (kv.articulations.Ackermann, {"wheelbase": 1, "steering": None}, "steering angle of the ackermann 'j' is a number, not None"),
    (kv.articulations.Ackermann, {"wheelbase": 1, "steering_speed": -1}, "'steering_speed' of the ackermann 'j' is -1"),
    (kv.articulations.Ackermann, {"wheelbase": 1, "speed": nan}, "'speed' of the ackermann 'j' is nan; it cannot be negative"),
    (kv.articulations.Ackermann, {"wheelbase": 1, "speed": "fast"}, "'speed' of the ackermann 'j' is a number or None, not 'fast'"),
    (kv.articulations.Ackermann, {"wheelbase": 1, "name": "old"}, "There is an articulation 'old' already"),
    (kv.articulations.Ackermann, {"wheelbase": 1, "child": "old"}, "There is a frame 'old' already, so the ackermann 'j'"),
    *((kv.articulations.Mecanum, {**SIZES, what: -1}, f"{what} of the mecanum 'j' is a positive") for what in SIZES),
    (kv.articulations.Mecanum, {**SIZES, "wheels": ("a", "b")}, r"wheels of the mecanum 'j' are 4 different paths, not \('a', 'b'\)"),
    (kv.articulations.Mecanum, {**SIZES, "wheels": ("a", "b", "c", "a")}, "4 different paths"),
    (kv.articulations.Mecanum, {**SIZES, "wheel_speed": -3}, "'wheel_speed' of the mecanum 'j' is -3"),
    (kv.articulations.Mecanum, {**SIZES, "speed": -3}, "'speed' of the mecanum 'j' is -3"),
    (kv.articulations.Mecanum, {**SIZES, "child": "old"}, "There is a frame 'old' already"),
    (kv.articulations.Mecanum, {**SIZES, "wheels": 4}, "not 4"),
    (kv.articulations.DifferentialDrive, {"radius": 1, "track": 1, "left": "a", "right": "a"}, r"'j' are 2 different paths, not \('a', 'a'\)"),
    (kv.articulations.DifferentialDrive, {"radius": 1, "track": 1, "left": "j/right_wheel"}, "2 different paths"),
    (kv.articulations.DifferentialDrive, {"radius": (1, 0), "track": 1}, "radius of the differential drive 'j' is a positive, finite number, not 0"),
    (kv.articulations.DifferentialDrive, {"radius": (1, 1, 1), "track": 1}, "one number or a pair"),
    (kv.articulations.DifferentialDrive, {"radius": "x", "track": 1}, "is a number, not 'x'"),
    (kv.articulations.DifferentialDrive, {"radius": 1, "track": kv.parameter("p", -1.0)}, "track of the differential drive 'j' is a positive, finite number, not -1.0"),
    (kv.articulations.DifferentialDrive, {"radius": 1, "track": kv.velocity("p")}, "is about positions"),
    (kv.articulations.Mecanum, {**SIZES, "radius": kv.parameter("p", 0.0)}, "radius of the mecanum 'j' is a positive"),
    (kv.articulations.DifferentialDrive, {"radius": 1, "track": 1, "speed": -1}, "'speed' of the differential drive 'j' is -1"),
    (kv.articulations.DifferentialDrive, {"radius": 1, "track": 1, "turn": nan}, "'turn' of the differential drive 'j' is nan"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "given", "words"), BROKEN)
def test_invalid_base_error_names_base_and_number(kind: type[Any], given: dict[str, Any], words: str) -> None:
    model = model_of(kv.Fixed(name="old", parent="world", child="old"))
    before = model.snapshot()
    with pytest.raises(kv.KineverseError, match=words), model.edit() as edit:
        edit.apply(kind(**{**WHERE, **given}), tag="mine")
    assert model.snapshot() == before
