"""Faces that are nearly parallel keep their distance while a body turns to and fro beside another one."""

from __future__ import annotations

import numpy as np
import pytest

import kineverse as kv
from kineverse.articulations import OmniBase
from kineverse.control import Controller, Goal, contact_constraints
from kineverse.geometry import Scene
from kineverse.model.body import Body, Box, Pose, Shape


def slab(*size):
    return Body(collisions=(Shape(Box(size), Pose.from_matrix(np.eye(4))),))


@pytest.fixture(scope="module")
def model():
    """A base, 1 m wide, that drives on a floor without a shape, and a wall at x = 1."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(OmniBase(name="robot/base", parent="world", child="robot/base", speed=0.5, turn=0.6))
        edit.add_frame("robot/box", "robot/base", np.eye(4), body=slab(0.4, 1.0, 0.2))
        edit.add_frame("wall", "world", kv.translation(1.05, 0, 0), body=slab(0.1, 4, 2))
    return model


def least_distance(model):
    """Return the least distance to the wall of a base that is drawn to it and turned to and fro."""
    x, y, angle = (model.symbol(f"robot/base/{name}") for name in ("x", "y", "angle"))
    swing = kv.control.Target("swing", 0.0)
    tasks = [
        Goal(x, 2.0, name="x"),
        Goal(y, 1.5, name="y", speed=0.1),
        Goal(angle, swing.expression, name="turn", weight=10.0),
    ]
    controller = Controller(model, tasks, dt=0.02, scene=Scene(model), contacts=8)
    state = model.default_state().updated({x: 0.793})
    scene = Scene(model)
    least = np.inf
    for k in range(200):
        controller.set(swing, 0.3 * (-1.0) ** (k // 3))
        state = model.integrate(state, controller.step(state).speeds, 0.02)
        scene.update(state)
        least = min(least, scene.distance("robot/box", "wall").distance)
    assert state[y] > 0.2
    return least


def test_a_base_that_turns_to_and_fro_beside_a_wall_does_not_touch_it(model, monkeypatch):
    assert least_distance(model) > 2e-3
    monkeypatch.setattr(contact_constraints, "FacingPoints", lambda *_: None)
    assert least_distance(model) < -0.005
