"""Opening of what nobody has described, with a learner beside it, in lock step."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("zenoh")

from lock_step import LockStep
from watched_kitchenette import BOX, DOOR, HANDLE, make_served, make_truth

import kineverse as kv
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.live import OpenUnknown, make_unknown_scene
from kineverse.live.model_estimator import ModelEstimator
from kineverse.live.unknown_behaviour import find_bar, find_coordinate
from kineverse.model import Body, Box, Cylinder, Shape
from kineverse.model.basic_operations import SetBody
from kineverse.state import State
from kineverse.worlds import KinematicWorld

sys.path.insert(0, str(Path(__file__).parents[1] / "worlds"))
from pusher import pusher

DRAWER = "room/drawer"


class Served:
    """World whose robot is told of another model than the truth."""

    def __init__(self, world, served):
        self._world, self.served = world, served

    def __getattr__(self, name):
        return getattr(self._world, name)

    @property
    def model(self):
        """The served model as it is now."""
        return self.served.snapshot()


class Beliefs:
    """Belief that knows where the robot is, and the drawer once the model has a coordinate for it."""

    def __init__(self, world):
        self._world = world

    def update(self, observation, time, commands=None):
        truth = self._world.state
        known = {s: truth[s] for s in truth if str(s) in map(str, self._world.served.symbols)}
        drawer = find_coordinate(self._world.served, DRAWER)
        if drawer is not None:
            known[drawer] = truth[DRAWER]
        state = self._world.served.default_state().updated(known)
        return State(state, stamp=observation.stamp, source="truth")

    def deviation(self, coordinate):
        return 0.0


@pytest.mark.long
def test_a_drawer_that_nobody_has_described_is_opened_learned_and_closed_by_name():
    world = KinematicWorld(pusher(), "robot")
    world.reset(world.model.default_state().updated({"robot/finger": 0.05, "robot/z": 2.0, "robot/x": 0.2}))
    served = pusher()
    with served.edit() as edit:
        edit.attach(DRAWER, "world", kv.translation(1, 0, 2))
        edit.remove("constraint room/drawer/range")
        edit.remove("constraint room/drawer/speed")
    there = Served(world, served)
    sessions = LockStep(there, Beliefs(there))
    estimator, opened = ModelEstimator(served, [DRAWER]), []

    def look(session):
        opened.append(world.state[DRAWER])
        seen = session.observation
        if seen.poses and len(opened) % 3 == 0:
            estimator.add(seen.poses, seen.picture_stamp)
            estimator.think()
            for proposal in estimator.find_due():
                with served.edit() as edit:
                    proposal.write(edit, served)
                estimator.confirm(proposal)
                sessions.version += 1

    sessions.on_step = look
    behaviour = OpenUnknown(sessions, patterns=[DRAWER])
    behaviour.in_thread = False
    for _ in range(400):
        behaviour.step()
        if behaviour.is_done:
            break
    results = [(one.what, one.skill, one.done) for one in behaviour.note.results]
    assert results == [(DRAWER, "open", True), (f"{DRAWER}/joint", "close", True)], behaviour.note
    assert max(opened) > 0.2
    assert world.state[DRAWER] == pytest.approx(0.0, abs=0.02)
    assert estimator.edits >= 1


def add_bodies(model: kv.Model) -> kv.Model:
    """Give the door a panel and a bar."""
    panel, bar = Box((0.02, 0.6, 0.4)), Cylinder(0.01, 0.2)
    with model.edit() as edit:
        edit.apply(SetBody(DOOR, Body(collisions=(Shape(panel),))), tag="body door")
        edit.apply(SetBody(HANDLE, Body(collisions=(Shape(bar),))), tag="body handle")
    return model


def test_a_scene_without_a_joint_has_the_part_fixed_and_its_handle_on_it():
    truth = add_bodies(make_truth())
    scene = make_unknown_scene(truth, DOOR)
    assert (scene.part, scene.handle) == (DOOR, HANDLE)
    assert find_coordinate(scene.model, DOOR) is None
    assert find_coordinate(truth, DOOR) == kv.position(DOOR)
    there, before = scene.model.fk(HANDLE)({}), truth.fk(HANDLE)({DOOR: 0.0})
    np.testing.assert_allclose(there, before, atol=1e-12)
    assert find_bar(scene.model, DOOR, scene.model.default_state()) == HANDLE
    with pytest.raises(UnknownNameError):
        make_unknown_scene(truth, "room/dor")
    with pytest.raises(UnknownNameError, match="no handle"):
        find_bar(make_served("joint"), DOOR, make_served("joint").default_state())


def test_what_is_unknown_has_to_be_named():
    with pytest.raises(InvalidValueError, match="name the frame"):
        OpenUnknown(None)
    assert OpenUnknown(None, patterns=[BOX]).name == "unknown"
