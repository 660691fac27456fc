"""Grasps of the shipped robots at the shipped furniture, judged by a scene of both."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest
from grasp_oracle import GraspJudge

import kineverse as kv
from kineverse import lie
from kineverse.errors import InvalidValueError
from kineverse.grasping import Grasp, Gripper, Handle, find_gripper, find_handle, sample_grasps
from kineverse.model.body import Body, Box, Pose, Shape

KITCHEN = (
    "fridge_door",
    "oven_door",
    "oven_left_drawer",
    "sink_left_upper_drawer",
    "oven_knob",
    "stove_knob_1",
)


@cache
def handles(name: str) -> tuple[Handle, ...]:
    """Return a handle of each size and direction."""
    model = kv.load(name)
    coordinates = [f"kitchen/{c}" for c in KITCHEN] if name == "kitchen" else model.degrees_of_freedom
    return tuple(find_handle(model, coordinate) for coordinate in coordinates)


def check(judge: GraspJudge, grasp: Grasp) -> None:
    """Check that nothing touches on the way and while the fingers close, and that then both do."""
    judge.place(grasp, grasp.approach)
    assert judge.distance() > 1e-3
    judge.place(grasp, grasp.pose)
    assert judge.distance() > 9e-4
    judge.place(grasp, grasp.pose, grasp.thickness + 0.004)
    assert judge.distance() > 9e-4
    judge.place(grasp, grasp.pose, grasp.thickness - 0.001)
    assert max(judge.finger_distances(grasp.handle.frame)) < 0.0, f"{grasp}: a finger does not touch"


SHORT = {("kitchen", "fetch"), ("shelf_door", "hsr"), ("shelf_drawers", "pr2")}
"""Each furniture and each robot once; the other pairs take long."""


@pytest.mark.parametrize(
    ("name", "robot"),
    [
        pytest.param(*pair, marks=() if pair in SHORT else pytest.mark.long)
        for pair in product(("kitchen", "shelf_door", "shelf_drawers"), ("pr2", "fetch", "hsr"))
    ],
)
def test_every_object_can_be_grasped(name: str, robot: str) -> None:
    model = kv.load(name)
    top = next(f for f, frame in model.frames.items() if frame.parent == "world")
    model.include(robot)
    gripper = find_gripper(model, robot)
    judge = GraspJudge(model, top, gripper)
    for handle in handles(name):
        grasps = sample_grasps(model, gripper, handle, count=4, seed=1)
        check(judge, grasps[0])
        check(judge, grasps[-1])


@cache
def before_the_fridge() -> tuple[kv.Model, Gripper, Handle, GraspJudge]:
    """Return the kitchen with the HSR, its gripper, the handle of the fridge, and a judge."""
    model = kv.load("kitchen")
    model.include("hsr")
    gripper, handle = find_gripper(model, "hsr"), find_handle(model, "kitchen/fridge_door")
    return model, gripper, handle, GraspJudge(model, "kitchen/kitchen", gripper)


def test_grasps_differ_in_angle_place_and_half_turn() -> None:
    model, gripper, handle, judge = before_the_fridge()
    grasps = sample_grasps(model, gripper, handle, count=40, seed=3)
    again = sample_grasps(model, gripper, handle, count=40, seed=3)
    other = sample_grasps(model, gripper, handle, count=40, seed=4)
    assert np.array_equal([g.pose for g in grasps], [g.pose for g in again])
    assert not np.array_equal([g.pose for g in grasps], [g.pose for g in other])
    assert len(grasps) == 40
    tilts, places = [g.tilt for g in grasps], [g.place for g in grasps]
    assert min(tilts) < -0.4 < 0.4 < max(tilts)
    assert max(map(abs, tilts)) <= math.pi / 3
    assert min(places) < -0.15 < 0.15 < max(places)
    assert max(map(abs, places)) < handle.length / 2
    up = [(handle.pose[:3, :3].T @ g.pose[:3, :3] @ gripper.grasp_pose[:3, 2])[2] for g in grasps]
    assert {round(float(value)) for value in up} == {-1, 1}
    for grasp in grasps[::8]:
        check(judge, grasp)
        # The hand approaches straight out of its fingers.
        way = grasp.pose[:3, :3].T @ (grasp.pose - grasp.approach)[:3, 3]
        assert np.allclose(way, 0.1 * gripper.grasp_pose[:3, 0])


def test_slanted_grasps_come_from_along_the_bar() -> None:
    model, gripper, handle, judge = before_the_fridge()
    grasps = sample_grasps(model, gripper, handle, count=24, slant=0.9)
    slants = [grasp.slant for grasp in grasps]
    assert -0.9 <= min(slants) < -0.3
    assert 0.3 < max(slants) <= 0.9
    for grasp in grasps[::6]:
        check(judge, grasp)
        way, along = grasp.pose[:3, :3] @ gripper.grasp_pose[:3, 0], handle.pose[:3, 2]
        assert abs(math.asin(way @ along)) == pytest.approx(abs(grasp.slant), abs=1e-9)
    assert all(grasp.slant == 0.0 for grasp in sample_grasps(model, gripper, handle, count=4))


@pytest.mark.parametrize("robot", ["fetch", "hsr"])
def test_both_fingers_touch_a_deep_bar_at_any_angle(robot: str) -> None:
    # A tilted hand meets two edges of it, which are not opposite each other in the middle.
    panel, bar = Shape(Box((0.02, 0.4, 0.6))), Shape(Box((0.05, 0.015, 0.3)), Pose.from_matrix(place(-0.045)))
    model, q = kv.load(robot), kv.position("door")
    with model.edit() as edit:
        edit.add_frame("case", "world")
        hinge = kv.translation(0, -0.2, 0) @ kv.rotation_z(q) @ kv.translation(0, 0.2, 0)
        edit.add_frame("panel", "case", hinge, Body(collisions=(panel, bar)))
        edit.constrain("range", 0, q, 1.5)
    gripper, handle = find_gripper(model, robot), find_handle(model, "door")
    grasps = sample_grasps(model, gripper, handle, count=24)
    assert max(abs(grasp.tilt) for grasp in grasps) > 0.2
    assert max(grasp.thickness for grasp in grasps) > 0.016
    judge = GraspJudge(model, "case", gripper)
    for grasp in grasps[::3]:
        check(judge, grasp)


def place(x: float) -> np.ndarray:
    return np.asarray(lie.translation(np.array([x, 0.0, 0.0])))


def test_a_bar_that_is_too_thick_or_without_room_is_refused() -> None:
    model = kv.load("kitchen")
    model.include("fetch")
    gripper, handle = find_gripper(model, "fetch"), find_handle(model, "kitchen/fridge_door")
    with pytest.raises(
        InvalidValueError, match="is 200 mm thick, and the gripper of fetch/gripper_link opens 102 mm"
    ):
        sample_grasps(model, gripper, replace(handle, thickness=0.2))
    inside = handle.pose @ place(-0.06)  # as if the bar were in the door
    with pytest.raises(InvalidValueError, match=r"no room at .* collide: .* at kitchen/fridge_door \("):
        sample_grasps(model, gripper, replace(handle, pose=inside))
