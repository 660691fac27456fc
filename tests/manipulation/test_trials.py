"""Trials: what skills claim is compared with the truth of their world."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import kineverse as kv
from kineverse.articulations import Ackermann
from kineverse.grasping import find_handle
from kineverse.manipulation import (
    Session,
    judge_outcome,
    open_object,
    stand_at_handle,
)
from kineverse.worlds import KinematicWorld, RunMetrics, TrueBelief
from robot_interface_proxy import InterfaceOnly

sys.path.insert(0, str(Path(__file__).parents[1] / "worlds"))
from pusher import pusher, solid

from kineverse.model.body import Box, Cylinder

DRAWER = "room/drawer"


def start(model):
    return model.default_state().updated({"robot/finger": 0.05, "robot/z": 2.0})


@pytest.fixture(scope="module")
def world():
    model = pusher()
    world = KinematicWorld(model, "robot")
    world.reset(start(model))
    return world


def test_what_is_claimed_is_done_if_it_is_true(world):
    metrics = RunMetrics(world, world.model.symbol(DRAWER))
    session = Session(InterfaceOnly(world), belief=TrueBelief(world), on_step=metrics)
    outcome = judge_outcome(open_object(session, DRAWER, target=0.3), metrics)
    assert outcome.done
    assert outcome.claimed
    assert outcome.value == world.state[DRAWER] == pytest.approx(0.3, abs=0.01)
    assert outcome.measures["limit_violation"] < 1e-6
    assert outcome.measures["estimate_largest"] == 0.0
    assert "failure" not in outcome.measures
    believed = open_object(session, DRAWER, target=0.3)
    apart = judge_outcome(replace(believed, measures=believed.measures | {"target": 0.2}), metrics)
    assert (apart.done, apart.claimed, apart.measures["failure"]) == (False, True, "other")
    assert f"The world says {apart.value:.4g}, not 0.2 ± " in apart.reason
    for unknown in (RunMetrics(world), believed), (metrics, replace(believed, measures={"target": 0.3})):
        unproven = judge_outcome(unknown[1], unknown[0])
        assert (unproven.done, unproven.claimed) == (False, True)
        assert "No truth was measured" in unproven.reason
    unwatched = RunMetrics(world, world.model.symbol(DRAWER))
    session.act({})
    unmeasured = judge_outcome(believed, unwatched)
    assert (unmeasured.done, unmeasured.claimed) == (False, True)
    assert "The run was not measured" in unmeasured.reason
    no = judge_outcome(open_object(session, DRAWER, target=0.1, seconds=0.5), metrics)
    assert (no.done, no.claimed, no.measures["failure"]) == (False, False, "time")


def test_nothing_is_done_where_bodies_overlapped_on_the_way(world):
    """A block in the way of the robot is in the world, and not in the model of the skill."""
    model = world.model.copy()
    with model.edit() as edit:
        edit.add_frame("block", "world", kv.translation(0.65, 0.0, 2.5), solid(Box((0.02, 0.1, 0.1))))
    other = KinematicWorld(model, "robot")
    other.reset(start(model))
    metrics = RunMetrics(other, model.symbol(DRAWER))
    robot = SimpleNamespace(
        name="naive", model=world.model, robot=world.robot, remarks=(), timeout=other.timeout,
        apply=other.apply, observe=other.observe, time=0.0,
    )  # fmt: skip

    def apply(*speeds, **options):
        other.apply(*speeds, **options)
        robot.time = other.time

    robot.apply = apply
    believed = open_object(Session(robot, belief=TrueBelief(other), on_step=metrics), DRAWER, target=0.3)
    assert believed, believed.reason
    outcome = judge_outcome(believed, metrics)
    assert not outcome
    assert outcome.claimed
    assert "overlapped" in outcome.reason
    assert outcome.measures["failure"] == "collision"


@pytest.fixture(scope="module")
def car():
    """A gripper on a lift on a car, which cannot turn on the spot, before a drawer."""
    lift, turn, out, wrist, finger = (
        kv.position(f"car/{n}") for n in ("lift", "turn", "out", "wrist", "finger")
    )
    model, drawer = kv.Model(), kv.position("drawer")
    with model.edit() as edit:
        edit.apply(
            Ackermann(name="car/base", parent="world", child="car/chassis", wheelbase=0.4, steering=0.6)
        )
        edit.add_frame("car/body", "car/chassis", kv.translation(0, 0, 0.2), solid(Box((0.4, 0.4, 0.2))))
        edit.add_frame("car/boom", "car/chassis", kv.translation(0, 0, lift) @ kv.rotation_z(turn))
        palm = kv.translation(0.3 + out, 0, 0) @ kv.rotation_z(wrist)
        edit.add_frame("car/palm", "car/boom", palm, solid(Box((0.04, 0.12, 0.06))))
        for side in (1, -1):
            at = kv.translation(0.06, side * finger, 0)
            edit.add_frame(f"car/finger_{side + 1}", "car/palm", at, solid(Box((0.06, 0.01, 0.03))))
        edit.constrain("car/finger/range", 0.006, finger, 0.05)
        for name, lower, joint, upper in (
            ("lift", 0.5, lift, 1.2), ("out", 0.0, out, 0.7), ("turn", -2, turn, 2), ("wrist", -2, wrist, 2),
        ):  # fmt: skip
            edit.constrain(f"car/{name}/range", lower, joint, upper)
        edit.add_frame("front", "world", kv.translation(2 - drawer, 0, 1), solid(Box((0.02, 0.4, 0.2))))
        edit.add_frame("handle", "front", kv.translation(-0.06, 0, 0), solid(Cylinder(0.01, 0.1)))
        edit.constrain("drawer/range", 0.0, drawer, 0.3)
    return model


def test_a_base_that_cannot_drive_is_put_to_the_handle_by_a_trial(car):
    world = KinematicWorld(car, "car")
    begin = car.default_state().updated({"car/finger": 0.05, "car/lift": 0.6})
    world.reset(begin)
    session = Session(InterfaceOnly(world), belief=TrueBelief(world))
    outcome = open_object(session, "drawer", target=0.25)
    assert not outcome
    assert outcome.measures["failure"] == "reach"
    assert "The base cannot turn on the spot" in outcome.reason
    assert dict(world.state) == dict(begin)
    handle = find_handle(car, "drawer")
    assert stand_at_handle(session, world, handle, 0.25)
    assert session.time == world.time == 0.0
    place = [world.state[f"car/base/{name}"] for name in ("x", "y", "angle")]
    assert np.hypot(place[0] - 2.0, place[1]) < 1.5
    outcome = open_object(session, "drawer", target=0.25)
    assert outcome, outcome.reason
    assert world.state["drawer"] == pytest.approx(0.25, abs=0.01)
    assert [world.state[f"car/base/{name}"] for name in ("x", "y", "angle")] == place


def test_a_base_that_drives_stays_where_it_is(world):
    handle = find_handle(world.model, DRAWER)
    session = Session(InterfaceOnly(world), belief=TrueBelief(world))
    before = dict(world.state)
    assert not stand_at_handle(session, world, handle, 0.25)
    assert dict(world.state) == before
