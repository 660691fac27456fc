"""Nodes of real ROS 2, from wheels, in processes of their own."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

import kineverse as kv
from kineverse.lie import quaternion, transform
from kineverse_ros.model_node import load_model

PROGRAM = Path(__file__).with_name("real_model_node.py")
TOOL = Path(__file__).parents[2] / "tools" / "ros_bridge_load.py"


@pytest.mark.ros
def test_transforms_at_another_node_are_the_forward_kinematics(ros_python):
    models = ["articulations/four_bar", "articulations/folding_door"]
    joint, frame = "four_bar/crank", "four_bar/rocker"
    done = subprocess.run(
        [ros_python, PROGRAM, joint, frame, *models], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    heard = json.loads(done.stdout)
    assert heard["status"] == 0, heard["errors"]
    assert "/robot_description" in heard["out"]
    assert "lost" not in heard["errors"]
    model = load_model(models)
    state = model.default_state().updated({joint: heard["value"]})
    assert set(heard["poses"]) == set(model.frames)
    for name, (parent, numbers) in heard["poses"].items():
        pose = model.fk(name, parent)
        found = transform(quaternion(np.array(numbers[3:])), np.array(numbers[:3]))
        expected = pose({symbol: state[symbol] for symbol in pose.symbols})
        np.testing.assert_allclose(found, expected, atol=1e-12)
    assert set(heard["joints"]) == {*map(str, model.degrees_of_freedom), *map(str, model.rates.dependent)}
    assert heard["joints"][joint] == heard["value"]
    assert set(heard["markers"]) == {name for name, body in model.bodies.items() if body.visuals}
    assert kv.formats.from_bytes(heard["document"].encode()).snapshot() == model.snapshot()
    assert "floating" in heard["description"]


@pytest.mark.ros
@pytest.mark.long
def test_the_load_of_the_node_is_measured(ros_python):
    """It depends on what else the machine does, so it has no bound here."""
    done = subprocess.run(
        [ros_python, TOOL, "--seconds", "10", "--json"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    measured = json.loads(done.stdout)
    assert 0.0 < measured["core"] < 1.0
    assert measured["difference"] < 1e-12
    assert measured["lost"] == 0
