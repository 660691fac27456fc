"""Which symbols a configuration consists of: coordinates and parameters, however they occur."""

from __future__ import annotations

import numpy as np
import pytest

import kineverse as kv

a, b, q = (kv.position(n) for n in "abq")

BASES = [
    kv.articulations.OmniBase(name="base", parent="world", child="base"),
    kv.articulations.DifferentialDrive(
        name="base", parent="world", child="base", radius=0.1, track=0.4, wheel_speed=5.0, speed=1.0, turn=1.0
    ),
    kv.articulations.Ackermann(name="base", parent="world", child="base", wheelbase=1.0, speed=1.0, steering_speed=1.0),
    kv.articulations.Mecanum(
        name="base", parent="world", child="base", radius=0.1, track=0.4, wheelbase=0.5, wheel_speed=5.0, speed=1.0
    ),
    kv.articulations.Ball(name="base", parent="world", child="base", velocity=1.0, cone=1.0, twist=1.0),
    kv.Floating(name="base", parent="world", child="base"),
]  # fmt: skip


@pytest.mark.parametrize("order", [1, 2])
def test_a_coordinate_with_only_a_speed_limit_is_a_symbol_of_the_model(order: int) -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("v", -1, kv.symbols.symbol("q", order), 1)
    assert model.symbols == model.degrees_of_freedom == (q,)
    assert model.speeds == (q.derivative(),)
    assert model.default_state() == kv.State({"q": 0.0}, source="default")
    assert model.symbol("q:velocity") == q.derivative()
    with model.edit() as edit:
        edit.remove("constraint v")
    assert model.symbols == ()


def test_a_lock_alone_is_about_the_door() -> None:
    model, unlocked = kv.Model(), b > 0.3
    with model.edit() as edit:
        edit.constrain("lock", -unlocked, a.derivative(), unlocked)
    assert model.symbols == (a, b)
    assert model.violations(model.default_state()).unchecked == ("lock",)


@pytest.mark.parametrize("operation", BASES, ids=lambda o: type(o).__name__)
def test_speeds_that_move_other_coordinates_are_none(operation: kv.Operation) -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(operation)
        if isinstance(operation, kv.Floating):
            edit.constrain("turning", 0, kv.norm(kv.array([kv.velocity(f"base/w{c}") for c in "xyz"])), 1)
    record = model.articulations["base"]
    assert set(model.symbols) == set(record.coordinates)
    assert set(model.speeds) == set(record.speeds)
    start = model.default_state()
    assert set(model.integrate(start, dict.fromkeys(model.speeds, 0.1), 0.5)) >= set(record.coordinates)


def test_a_wheel_that_is_somewhere_is_a_coordinate() -> None:
    model, wheel = kv.Model(), kv.position("base/left_wheel")
    with model.edit() as edit:
        edit.apply(BASES[1])
        edit.add_frame("wheel", "base", kv.rotation_y(wheel))
    assert wheel in model.symbols
    assert kv.position("base/right_wheel") not in model.symbols


def test_dependent_coordinates_are_no_symbols_of_the_model() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(Follows())
        edit.constrain("speed", -1, b.derivative(), 1)
    assert model.symbols == (a,)
    assert model.speeds == (a.derivative(),)


class Follows(kv.Operation):
    """b is what a says."""

    def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(rates={b: 2 * np.sin(a)})


@pytest.mark.parametrize("name", kv.shipped_models())
def test_models_that_ship_have_the_coordinates_of_their_joints(name: str) -> None:
    model = kv.load(name)
    joints = {c for record in model.articulations.values() for c in record.coordinates}
    assert set(model.degrees_of_freedom) <= joints
