"""Grasps of the shipped robots at the shipped furniture, judged by a scene of both."""

from __future__ import annotations

import pytest
from grasp_oracle import GraspJudge

import kineverse as kv
from kineverse.grasping import find_gripper, find_handle, sample_grasps


@pytest.mark.parametrize("robot", ["pr2", "fetch", "hsr"])
@pytest.mark.parametrize("name", ["kitchen", "shelf_door", "shelf_drawers"])
def test_every_object_can_be_grasped(robot: str, name: str) -> None:
    model = kv.load(name)
    coordinates = model.degrees_of_freedom
    top = next(f for f, frame in model.frames.items() if frame.parent == "world")
    model.include(robot)
    judge = GraspJudge(model, top)
    gripper = find_gripper(model, robot)
    for coordinate in coordinates:
        handle = find_handle(model, coordinate)
        grasps = sample_grasps(model, gripper, handle, count=6, seed=1)
        assert grasps
        for grasp in grasps[:2]:
            judge.place(grasp, grasp.approach)
            assert judge.distance(grasp) > 1e-3
            judge.place(grasp, grasp.pose)  # open
            assert judge.distance(grasp) > 1e-3
            judge.place(grasp, grasp.pose, grasp.thickness + 0.004)
            assert judge.distance(grasp) > 5e-4
            judge.place(grasp, grasp.pose, grasp.thickness - 0.001)
            assert max(judge.finger_distances(grasp)) < 0.0, f"{grasp}: a finger does not touch"
