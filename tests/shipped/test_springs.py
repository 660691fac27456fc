"""Springs of the shipped kitchen: doors that hang below stay where they are left."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import kineverse as kv
from kineverse.lie import Array

GRAVITY = 9.81
DOORS = ("oven_door", "dishwasher_door")


def torque(model: kv.Model, name: str) -> Array:
    """Return the torque of gravity and spring that opens a door, over its range [N m]."""
    q, height = model.symbol(name), model.center_of_mass(name)[2]
    weight = -model.mass(name) * GRAVITY * height.gradient()[q.derivative()]
    spring = dict(model.articulations[name].dynamics)
    angles = np.linspace(*model.limits(q), 50)
    values = np.array([float(weight({q: angle})) for angle in angles])
    return values - spring["spring_stiffness"] * (angles - spring["spring_reference"])


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("prefix", [None, "", "room/kitchen"])
def test_friction_exceeds_what_spring_and_weight_leave(door: str, prefix: str | None) -> None:
    model = kv.load("kitchen", prefix)
    name = "/".join(filter(None, ("kitchen" if prefix is None else prefix, door)))
    left = torque(model, name)
    assert np.abs(left).max() < dict(model.articulations[name].dynamics)["friction"]
    assert left[0] < 0  # it stays shut


def test_doors_with_springs_are_those_with_a_hinge_at_their_bottom() -> None:
    model = kv.load("kitchen")
    sprung = {n for n, r in model.articulations.items() if "spring_stiffness" in dict(r.dynamics)}
    assert sprung == {f"kitchen/{door}" for door in DOORS}


def test_springs_survive_mjcf_and_documents(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    model = kv.load("kitchen")
    for file in ("kitchen.kv.json", "kitchen.xml"):
        model.save(tmp_path / file)
        again = kv.load(tmp_path / file)
        for door in DOORS:
            given = dict(model.articulations[f"kitchen/{door}"].dynamics)
            assert dict(again.articulations[f"kitchen/{door}"].dynamics) == pytest.approx(given)
    remarks = model.save(tmp_path / "kitchen.urdf").remarks
    assert any("no spring_stiffness: that of 'kitchen/oven_door'" in remark for remark in remarks)
