"""Interlocks of models: robots without any, loops, mechanisms of the library."""

from __future__ import annotations

import inspect

import pytest

import kineverse as kv
from kineverse import reasoning
from kineverse.articulations import mechanisms
from kineverse.reasoning import Interlocks, interlocks


@pytest.mark.parametrize("name", ["pr2", "kitchen", "fetch", "hsr"])
def test_robots_and_kitchens_have_no_interlocks(name: str) -> None:
    model = kv.load(name)
    assert interlocks(model) == Interlocks([])
    assert interlocks(model.snapshot()) == Interlocks([])
    assert reasoning.contradictions(model, Interlocks([]), points=3) == []


@pytest.mark.long  # docs/interlocks.md has it, too
def test_dependent_coordinate_as_key() -> None:
    model, door = kv.load("articulations/four_bar"), kv.position("door")
    rocker = max(model.rates.dependent, key=str)
    with model.edit() as edit:
        edit.constrain("lock", -(rocker < 1.9), door.derivative(), rocker < 1.9)
    result = interlocks(model)
    (lock,) = result
    assert lock.keys == result.keys("door") == (kv.position("four_bar/crank"),)
    assert result.undecided == ()
    assert reasoning.contradictions(model, result) == []


def test_wheel_driven_coordinate_as_key() -> None:
    model = kv.Model()
    drive = kv.articulations.DifferentialDrive(
        name="base", parent="world", child="base", radius=0.1, track=0.4
    )
    flap = kv.position("flap")
    with model.edit() as edit:
        edit.apply(drive)
        x = kv.position("base/x")
        edit.constrain("dock", -(x > 1), flap.derivative(), x > 1)
        edit.constrain("brake", -(flap < 1), x.derivative(), flap < 1)
    result = interlocks(model)
    assert [str(lock) for lock in result] == [
        f"flap:velocity stands still: when {x} < 1 (dock)",
        f"{x}:velocity stands still: when flap > 1 (brake)",
    ]
    assert reasoning.contradictions(model, result) == []


MECHANISMS = [
    kind
    for _, kind in inspect.getmembers(mechanisms, inspect.isclass)
    if issubclass(kind, mechanisms.Mechanism) and kind is not mechanisms.Mechanism
]


@pytest.mark.parametrize("kind", MECHANISMS, ids=lambda kind: kind.__name__)
def test_interlocks_of_library_mechanisms_pass_the_checker(kind: type[mechanisms.Mechanism]) -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kind(name="it", parent="world"))
    result = interlocks(model)
    assert result.undecided == ()
    assert reasoning.contradictions(model, result) == []


def test_texts_of_interlocks_of_mechanisms() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(mechanisms.GarageDoor(name="garage", parent="world", form="published"))
        edit.apply(mechanisms.Ratchet(name="wheel", parent="world"))
    assert str(interlocks(model)).splitlines() == [
        "garage/door:velocity stands still: when garage/bolt < 0.3 and garage/door > 1.99 (garage/lock)",
        "wheel/wheel:velocity cannot decrease: when wheel/pawl < 0.2 (wheel/lock)",
    ]
