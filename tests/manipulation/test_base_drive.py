"""Drives of bases on wheels: ways between walls, and their execution in a world."""

from itertools import pairwise

import numpy as np
import pytest

import kineverse as kv
from kineverse.articulations import Ackermann, DifferentialDrive, OmniBase
from kineverse.geometry import Scene
from kineverse.manipulation import Session, open_object
from kineverse.manipulation.base_drive import BaseDrive
from kineverse.manipulation.skill_run import SkillRun
from kineverse.model.body import Body, Box, Pose, Shape
from kineverse.worlds import KinematicWorld, RunMetrics, TrueBelief
from robot_interface_proxy import InterfaceOnly

MARGIN = 0.02


def block(x, y, height=0.4):
    return Body(collisions=(Shape(Box((x, y, height)), Pose.from_matrix(np.eye(4))),))


def make_model(base, walls):
    """Return a model of a robot of 0.5 m by 0.4 m among walls, given as (x, y, length, width)."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(base)
        edit.add_frame("robot/body", "robot/base", kv.translation(0, 0, 0.3), block(0.5, 0.4))
        for k, (x, y, length, width) in enumerate(walls):
            edit.add_frame(f"wall_{k}", "world", kv.translation(x, y, 0.3), block(length, width))
    return model


def two_wheels(**limits):
    return DifferentialDrive(
        name="robot/base", parent="world", child="robot/base", radius=0.1, track=0.4, **limits
    )


# A room of 4 m by 3 m with a wall in the middle, which leaves a passage of 1 m.
ROOM = [(0, 1.55, 4.2, 0.1), (0, -1.55, 4.2, 0.1), (-2.05, 0, 0.1, 3), (2.05, 0, 0.1, 3)]
WALL = (0.0, -0.5, 0.2, 2.0)
CLOSED = (0.0, 0.0, 0.2, 3.0)


def make_drive(model):
    base = [model.symbol(f"robot/base/{name}") for name in ("x", "y", "angle")]
    scene = Scene(model)
    others = [b for b in scene.bodies if b != "robot/body"]
    return BaseDrive(model, base, scene, ["robot/body"], others, MARGIN)


def at(model, x, y, angle):
    return model.default_state().updated({"robot/base/x": x, "robot/base/y": y, "robot/base/angle": angle})


@pytest.fixture(scope="module")
def model():
    return make_model(two_wheels(wheel_speed=2.0), [*ROOM, WALL])


def connect(world, look):
    """Return a run of a skill in a world, of which something is looked at after each step."""
    session = Session(InterfaceOnly(world), belief=TrueBelief(world), on_step=look)
    return SkillRun(session, None, 120.0)


def least_distance(model, scene, state):
    scene.update(state)
    return min(scene.distance("robot/body", b).distance for b in scene.bodies if b != "robot/body")


@pytest.mark.parametrize(
    "goal",
    [
        (1.2, -1.0, 0.0),
        pytest.param((1.0, 0.5, 3.0), marks=pytest.mark.long),
        pytest.param((-1.3, 1.1, -1.5), marks=pytest.mark.long),
    ],
)
def test_a_base_on_two_wheels_drives_around_a_wall(model, goal):
    drive, start = make_drive(model), at(model, -1.2, -1.0, 1.0)
    places = drive.search(start).find(goal)
    np.testing.assert_allclose(places[0], [-1.2, -1.0, 1.0])
    assert np.allclose(places[-1][:2], goal[:2])
    assert np.cos(places[-1][2] - goal[2]) == pytest.approx(1.0)
    for a, b in pairwise(places):  # no leg slips sideways
        away = b[:2] - a[:2]
        if np.hypot(*away) > 1e-9:
            assert a[2] == pytest.approx(b[2])
            assert away @ [-np.sin(b[2]), np.cos(b[2])] == pytest.approx(0.0, abs=1e-9)
    world, scene = KinematicWorld(model, "robot"), Scene(model)
    world.reset(start)
    least = [np.inf]

    def look(session):
        assert max(map(abs, session.commands.values())) <= 2.0
        least[0] = min(least[0], least_distance(model, scene, world.state))

    drive.follow(connect(world, look), places)
    x, y, angle = (world.state[s] for s in drive.base)
    assert np.hypot(x - goal[0], y - goal[1]) < 2e-3
    assert np.cos(angle - goal[2]) == pytest.approx(1.0, abs=1e-5)
    assert least[0] > MARGIN - 5e-3
    assert world.time < 60.0


def test_one_search_finds_ways_to_several_goals(model):
    search = make_drive(model).search(at(model, -1.2, -1.0, 1.0))
    goals = [(1.2, -1.0, 0.0), (1.2, -0.9, 1.0), (0.9, 1.0, 2.0)]
    assert all(search.find(goal) is not None for goal in goals)
    assert search.find((0.0, -1.0, 0.0)) is None  # in the wall


def test_there_is_no_way_through_a_wall():
    model = make_model(two_wheels(), [*ROOM, CLOSED])
    search = make_drive(model).search(at(model, -1.2, 0.0, 0.0))
    assert search.find((1.2, 0.0, 0.0)) is None
    assert search.find((-1.0, 0.5, 1.0)) is not None


def test_a_base_that_touches_something_says_so(model):
    drive = make_drive(model)
    assert drive.search(at(model, -1.2, -1.0, 0.0)).begins_free
    assert not drive.search(at(model, -1.75, -1.0, 0.0)).begins_free


def test_only_bases_that_turn_on_the_spot_drive():
    names = {"name": "robot/base", "parent": "world", "child": "robot/base"}
    assert make_drive(make_model(two_wheels(), ROOM)).is_possible
    assert not make_drive(make_model(Ackermann(**names, wheelbase=0.4, steering=0.6), ROOM)).is_possible
    assert not make_drive(make_model(OmniBase(**names), ROOM)).is_possible


@pytest.mark.sampled(3)
@pytest.mark.parametrize("limits", [{"speed": 0.1}, {"turn": 0.2}, {"wheel_speed": 0.5}])
def test_drives_keep_the_limits_of_speeds(limits):
    model = make_model(two_wheels(**limits), ROOM)
    drive, world = make_drive(model), KinematicWorld(model, "robot")
    world.reset(at(model, 0.0, 0.0, 0.0))
    names = [name for name in model.constraints if name.startswith("robot/base/")]
    assert names

    def look(session):
        state = {**world.state, **session.commands}
        for name in names:
            limit = model.constraints[name]
            assert abs(float(limit.expression(state))) <= float(limit.upper(state)) + 1e-9

    drive.follow(connect(world, look), drive.search(world.state).find((0.3, 0.4, -2.0)))
    assert world.state["robot/base/x"] == pytest.approx(0.3, abs=2e-3)


@pytest.mark.parametrize("targets", [(0.1,), pytest.param((0.2, 0.0), marks=pytest.mark.long)])
@pytest.mark.long
def test_fetch_drives_to_a_drawer_and_back_to_it_with_its_arm_out(targets):
    model = kv.load("fetch")
    with model.edit() as edit:
        edit.include("shelf_drawers", "shelf_drawers")
        edit.attach("shelf_drawers/shelf", parent="world", transform=kv.translation(1, 0, 0.7))
        edit.add_frame("floor", "world", kv.translation(0, 0, -0.05), block(6, 6, 0.1))
    world, phases, before = KinematicWorld(model, "fetch"), [], []
    world.reset(model.default_state().updated({"fetch/base/x": -1.0, "fetch/base/angle": 2.0}))

    metrics = RunMetrics(world, model.symbol("shelf_drawers/upper_drawer"))

    def look(session):
        metrics(session)
        phases.append(session.phase)
        place = np.array([world.state[f"fetch/base/{name}"] for name in ("x", "y")])
        assert not before or np.hypot(*(place - before[-1])) < 0.01  # no jump
        before.append(place)

    session = Session(InterfaceOnly(world), belief=TrueBelief(world), on_step=look)
    for target in targets:
        outcome = open_object(session, "shelf_drawers/upper_drawer", target=target)
        assert outcome, outcome.reason
        assert world.state["shelf_drawers/upper_drawer"] == pytest.approx(target, abs=0.02)
    assert metrics.measures["penetration"] < 5e-4
    assert metrics.measures["limit_violation"] < 1e-6
    assert "drive" in phases
    assert np.ptp([p[0] for p in before]) > 0.3
