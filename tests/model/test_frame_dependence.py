"""Frames that symbols move: by structure, as their Jacobians say."""

from __future__ import annotations

import pytest
from random_models import random_tree

import kineverse as kv
from kineverse.errors import UnknownNameError
from kineverse.model.frame_dependence import FrameDependence, count_moved_bodies, moved_frames


@pytest.mark.parametrize("seed", range(3))
def test_moved_frames_are_those_with_a_column(seed: int) -> None:
    model = random_tree(seed, 12)
    moved = moved_frames(model, model.speeds)
    assert tuple(moved) == model.speeds
    for speed, frames in moved.items():
        assert list(frames) == [f for f in model.frames if speed in model.speeds_of(f)]
        alone = FrameDependence(model, [speed])
        assert set(frames) == {f for f in model.frames if alone.moves(f)}


def test_a_base_moves_the_robot_and_a_door_itself() -> None:
    model = kv.load("fetch")
    model.include("kitchen", prefix="kitchen")
    wheel, door = model.symbol("fetch/l_wheel_joint:velocity"), model.symbol("kitchen/fridge_door")
    moved = moved_frames(model, [wheel, "kitchen/fridge_door"])
    assert all(name.startswith("fetch/") for name in moved[wheel])
    assert set(moved[door]) == {"kitchen/fridge_door", "kitchen/fridge_door_handle"}
    counts = count_moved_bodies(model, model.speeds)
    assert counts[door.derivative()] == 2
    gripper = model.symbol("fetch/r_gripper_finger_joint:velocity")
    assert 0 < counts[gripper] < counts[wheel] <= len(model.bodies)


def test_a_crank_moves_the_frames_of_dependent_coordinates() -> None:
    model = kv.load("articulations/four_bar")
    (crank,) = model.degrees_of_freedom
    assert len(moved_frames(model, [crank])[crank]) >= 3


def test_a_symbol_of_another_model_is_refused() -> None:
    model = kv.load("kitchen")
    with pytest.raises(UnknownNameError, match="no symbol 'kitchen/fridge_dor'"):
        moved_frames(model, [kv.position("kitchen/fridge_dor")])
    with pytest.raises(UnknownNameError, match="Did you mean"):
        moved_frames(model, ["kitchen/fridge_dor"])
