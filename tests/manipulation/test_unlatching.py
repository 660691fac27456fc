"""Doors that must be unlatched: contact phases, ways over several coordinates, presses, and whole openings."""

import numpy as np
import pytest

import kineverse as kv
from kineverse.grasping import find_handle
from kineverse.manipulation import Session, TrackedBelief, judge_outcome, open_object, place_robot
from kineverse.manipulation.opening.contact_phases import PhasePlanner, Way, find_keys
from kineverse.manipulation.outcome import SkillError
from kineverse.manipulation.skill_run import choose_target, choose_tolerance
from kineverse.worlds import KinematicWorld, MujocoWorld, Robot, RunMetrics, Sensors, TrueBelief
from robot_interface_proxy import InterfaceOnly

DOOR, LEVER = kv.position("door_with_handle/room/door"), kv.position("door_with_handle/room/handle")
OVEN, BUTTON = kv.position("oven/door"), kv.position("oven/button")
NOISE = "3mm+3mm/m,0.5deg,30Hz"
STARTS = (None, (-1.5, 0.2, 0.0), (-1.3, 1.3, -1.0))


def microwave():
    model = kv.Model()
    with model.edit() as edit:
        oven = kv.articulations.Microwave(name="oven", parent="world", origin=kv.translation(0, 0, 0.8))
        edit.apply(oven, tag="oven")
    return model


@pytest.fixture(scope="module")
def room():
    """Return a planner for the lever of a room door, in a model with a robot."""
    model = kv.load("articulations/door_with_handle")
    robot = Robot.of(model, place_robot(model, "hsr").name)
    return PhasePlanner(model, robot, find_handle(model, DOOR))


@pytest.fixture(scope="module")
def oven():
    model = microwave()
    robot = Robot.of(model, place_robot(model, "hsr").name)
    return PhasePlanner(model, robot, find_handle(model, OVEN))


def is_free(model, values):
    """Return whether the door may move on where the coordinates of a way have values."""
    return model.limits(DOOR.derivative(), model.default_state().updated(values))[1] > 0.0


@pytest.mark.parametrize("target", [1.9, 0.4, 0.07])
def test_lever_is_turned_before_the_door_and_let_back_as_soon_as_that_is_free(room, target):
    model = room._model
    phase = room.find_next(model.default_state(), target)
    way = phase.way
    assert (way.coordinates, way.keys) == ((LEVER, DOOR), (LEVER,))
    assert phase.handle.frame == "door_with_handle/room/handle"
    assert way.at(0) == {LEVER: 0.0, DOOR: 0.0}
    assert way.at(-1) == {LEVER: 0.0, DOOR: target}
    steps = np.diff(way.values, axis=0)
    assert (np.count_nonzero(steps, axis=1) == 1).all()  # one after the other
    assert np.abs(steps).max() < 0.0501
    for k in np.flatnonzero(steps[:, 1]):
        assert is_free(model, way.at(k)), way.at(k)
    # From the last run on nothing holds the lever, so what is reached is not latched again.
    assert all(is_free(model, way.at(k) | {LEVER: 0.0}) for k in range(way.last_run, len(way)))
    assert way.values[way.last_run, 1] == pytest.approx(min(0.111, target), abs=2e-3)
    assert [way.at(k) for k in way.corners][:1] == [{LEVER: pytest.approx(0.72), DOOR: 0.0}]


def test_door_that_is_open_is_moved_alone_and_one_that_may_be_shut_is_not(room):
    ajar = room._model.default_state().updated({DOOR: 0.02, LEVER: 0.1})
    way = room.find_next(ajar, 1.9).way
    assert way.keys == ()
    assert (way.values[:, 0] == 0.1).all()
    noisy = room.find_next(ajar, 1.9, deviation={DOOR: 0.01, LEVER: 0.05}.get).way
    assert noisy.keys == (LEVER,)
    assert noisy.at(0) == {LEVER: 0.1, DOOR: 0.02}
    wide = ajar.updated({DOOR: 1.0})
    assert room.find_next(wide, 0.0, deviation={DOOR: 0.01, LEVER: 0.05}.get).way.keys == ()
    assert room.latches(wide, 0.0)
    assert not room.latches(wide, 1.9)


def test_door_whose_lever_does_not_move_is_not_tried(room):
    with pytest.raises(SkillError, match=r"cannot be reached without .*handle") as error:
        room.find_next(room._model.default_state(), 1.9, still=[LEVER])
    assert "room/lock" in str(error.value)


def test_button_is_pressed_before_the_door_is_held(oven):
    start = oven._model.default_state()
    assert find_keys(oven._model, Robot.of(oven._model, "hsr"), OVEN) == (BUTTON,)
    phase = oven.find_next(start, 1.5)
    assert (phase.handle, phase.coordinate) == (None, BUTTON)
    assert phase.target - phase.tolerance > 0.004
    after = oven.find_next(start.updated({OVEN: 0.1}), 1.5)
    assert (after.handle.frame, after.coordinate, after.target) == ("oven/door", OVEN, 1.5)
    assert after.way.coordinates == (OVEN,)


def test_key_that_is_needed_all_the_way_is_let_back_at_the_end():
    model = kv.load("articulations/door_with_handle")
    with model.edit() as edit:
        lock = kv.articulations.speed_lock(DOOR, open_if=LEVER > 0.5, blocks="forward")
        edit.constrain("always", *lock)
    robot = Robot.of(model, place_robot(model, "hsr").name)
    way = PhasePlanner(model, robot, find_handle(model, DOOR)).find_next(model.default_state(), 1.0).way
    assert way.at(-1) == {LEVER: 0.0, DOOR: 1.0}
    assert way.last_run == len(way) - 1
    assert all(is_free(model, way.at(k)) for k in np.flatnonzero(np.diff(way.values[:, 1])))


def test_ways_are_cut_and_begin_where_they_end():
    there = Way.straight(DOOR, 0.0, 1.0)
    assert len(there) == 21
    assert there.cut(4, 9).values[:, 0] == pytest.approx(np.linspace(0.2, 0.4, 5))
    assert len(Way.straight(DOOR, 0.3, 0.3)) == 2


def test_locked_door_has_its_whole_range(oven):
    model, state = oven._model, oven._model.default_state()
    assert model.limits(OVEN, state) == (0.0, 0.0)
    assert choose_target(model, OVEN, state, None) == pytest.approx(1.9)
    assert choose_tolerance(model, OVEN, state, 1.9) == pytest.approx(0.02)


def move(model, robot, what, *, world, noise, target=None, start=None, at=None, seed=0):
    """Open or close something, on sensors alone if they are noisy; return what is true, and the phases."""
    placed = place_robot(model, robot, start)
    state = placed.start_state(model).updated(at or {})
    state, _ = placed.find_free_start(model, state)
    sensors = Sensors.parse(NOISE) if noise else None
    make = {"kinematic": KinematicWorld, "mujoco": MujocoWorld}[world]
    truth = make(model, placed.name, sensors=sensors, seed=seed)
    truth.reset(state)
    belief = TrackedBelief(model, placed.name, sensors) if noise else TrueBelief(truth)
    handle = find_handle(model, what)
    metrics = RunMetrics(truth, what, gripper=truth.robot.gripper(), handle=handle.frame)
    values = {}

    def look(session):
        metrics(session)
        values.setdefault(session.phase, []).append(truth.state)

    session = Session(InterfaceOnly(truth), belief=belief, on_step=look)
    outcome = judge_outcome(open_object(session, what, target=target, seconds=120.0, seed=seed), metrics)
    return outcome, values


def test_room_door_opens_by_its_lever_and_is_let_go_at_rest():
    model = kv.load("articulations/door_with_handle")
    outcome, values = move(model, "hsr", DOOR, world="kinematic", noise=False, target=0.5)
    assert outcome, outcome.reason
    assert outcome.measures["unlatched"] == [str(LEVER)]
    assert outcome.measures["pushed"] is False
    assert max(state[LEVER] for state in values["move"]) > 0.6
    assert values["release"][0][LEVER] < 0.05  # turned back before it is let go


@pytest.mark.long
def test_microwave_opens_by_its_button_on_estimates():
    model = microwave()
    outcome, values = move(model, "hsr", OVEN, world="kinematic", noise=True, target=0.5)
    assert outcome, outcome.reason
    assert outcome.measures["unlatched"] == [str(BUTTON)]
    assert max(state[BUTTON] for state in values["push"]) > 0.004
    assert values["move"][0][BUTTON] < 1e-6  # on its spring


@pytest.mark.long
@pytest.mark.parametrize("start", STARTS, ids=range(3))
@pytest.mark.parametrize("noise", [False, True], ids=["exact", "noisy"])
@pytest.mark.parametrize("world", ["kinematic", "mujoco"])
@pytest.mark.parametrize("robot", ["hsr", "pr2", "fetch"])
def test_room_door_is_opened_by_shipped_robots(robot, world, noise, start):
    model = kv.load("articulations/door_with_handle")
    outcome, _ = move(model, robot, DOOR, world=world, noise=noise, start=start)
    assert outcome, outcome.reason
    assert outcome.measures["unlatched"][0] == str(LEVER)


@pytest.mark.long
@pytest.mark.parametrize(
    ("robot", "world", "noise"),
    [("pr2", "kinematic", False), ("fetch", "kinematic", True), ("hsr", "mujoco", True)],
)
def test_microwave_is_opened_by_shipped_robots(robot, world, noise):
    outcome, _ = move(microwave(), robot, OVEN, world=world, noise=noise)
    assert outcome, outcome.reason
    assert str(BUTTON) in outcome.measures["unlatched"]


@pytest.mark.long
def test_microwave_is_latched_before_it_is_let_go():
    pytest.importorskip("mujoco")
    outcome, _ = move(microwave(), "hsr", OVEN, world="mujoco", noise=False, target=0.0, at={OVEN: 0.3})
    assert outcome, outcome.reason
    assert outcome.value < 0.003  # its spring would open it again
    assert "unlatched" not in outcome.measures
