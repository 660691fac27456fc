import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import kineverse as kv
from cupboards import box
from kineverse.articulations.locks import position_lock, speed_lock
from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError
from kineverse.grasping import find_gripper, find_handle, sample_grasps
from kineverse.manipulation import PlacementSearch, Robot, Session, TrackedBelief, open_object
from kineverse.manipulation.opening.arm_paths import CartesianPaths, PathCheck, find_least_time
from kineverse.manipulation.opening.base_placement import PlacementSampler
from kineverse.manipulation.opening.hand_motion import SLIPPED, HandMotion
from kineverse.manipulation.skill_run import choose_tolerance
from kineverse.worlds import KinematicWorld, MujocoWorld, RunMetrics, Sensors, TrueBelief
from robot_interface_proxy import InterfaceOnly

sys.path.insert(0, str(Path(__file__).parents[1] / "worlds"))
from pusher import pusher

DRAWER, DOOR = "shelf_drawers/upper_drawer", "shelf_door/door"


START = {"hsr/base/x": -1.5}


def make_model(furniture, height=0.7):
    model = kv.load("hsr")
    with model.edit() as edit:
        edit.include(furniture, furniture)
        edit.attach(f"{furniture}/shelf", parent="world", transform=kv.translation(1, 0, height))
    return model


@pytest.fixture(scope="module")
def model():
    return make_model("shelf_drawers")


def start(model):
    return model.default_state().updated(START)


RETRACTS = []
"""Times in the world at which hands of the session began to go away."""


def connect(world, belief=None, **options):
    """Return a session that knows nothing of a world but its interface, and what a belief says."""
    return Session(InterfaceOnly(world), belief=belief or TrueBelief(world), **options)


def measure(world, what=DRAWER):
    """Return the metrics of a run that moves an object by its handle."""
    handle = find_handle(world.model, what)
    return RunMetrics(world, handle.coordinate, gripper=world.robot.gripper(), handle=handle.frame)


@pytest.fixture(scope="module")
def world(model):
    world = KinematicWorld(model, "hsr")
    world.reset(start(model))
    return world


@pytest.fixture(scope="module")
def metrics(world):
    return measure(world)


@pytest.fixture(scope="module")
def session(world, metrics):
    def look(session):
        metrics(session)
        if session.phase == "retract":
            RETRACTS.append(session.time)

    return connect(world, on_step=look)


@pytest.fixture(scope="module")
def opened(session):
    return open_object(session, DRAWER)


def test_drawer_opens_without_contact_or_slip(opened, world, metrics):
    assert opened, opened.reason
    assert world.state[DRAWER] > 0.2
    assert world.held is None
    assert metrics.measures["penetration"] < 5e-4
    assert metrics.measures["limit_violation"] < 1e-6
    assert metrics.measures["grasp_error"] < 5e-4


def test_what_is_reached_counts_though_no_time_is_left_to_take_the_hand_away(opened, model):
    world = KinematicWorld(model, "hsr")
    world.reset(start(model))
    outcome = open_object(connect(world), DRAWER, seconds=RETRACTS[0] + 0.1)
    assert outcome, outcome.reason
    assert outcome.value == opened.value
    assert outcome.seconds < opened.seconds
    # What is not reached does not.
    world.reset(start(model))
    assert not open_object(connect(world), DRAWER, seconds=0.7 * RETRACTS[0])


def test_drawer_closes_again(opened, session, world):
    closed = open_object(session, DRAWER, target=0.0)
    assert closed, closed.reason
    assert world.state[DRAWER] < 0.02
    assert closed.measures["placements"] == 0  # the way of the opening, backwards


@pytest.mark.parametrize("is_known", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_hand_that_was_left_at_a_handle_lets_go_first(model, is_known):
    """The skill dies while it pulls, and another one knows nothing of that."""
    world = KinematicWorld(model, "hsr", sensors=Sensors.parse("3mm+3mm/m,0.5deg,30Hz"))
    world.reset(start(model))

    def break_off(session):
        if world.state[DRAWER] > 0.1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        open_object(connect(world, on_step=break_off), DRAWER)
    assert world.held
    phases, metrics = [], measure(world)

    def look(session):
        metrics(session)
        phases.append(session.phase)

    again = Session(InterfaceOnly(world), belief=TrueBelief(world) if is_known else None, on_step=look)
    outcome = open_object(again, DRAWER)
    assert outcome, outcome.reason
    assert world.state[DRAWER] == pytest.approx(0.22, abs=0.02)
    first = [phase for phase in dict.fromkeys(phases) if phase != "look"]
    assert first[:3] == ["release", "retract", "approach"]
    assert metrics.measures["penetration"] < 5e-4


def test_ways_lead_back_for_their_own_coordinate_only(opened, session, world):
    """A stage that carries the drawer is not taken for it, though the handle is the same."""
    grasp = session.made[-1].grasp
    other = replace(grasp, handle=replace(grasp.handle, coordinate=kv.position("stage")))
    again = connect(world)
    again.made.append(replace(session.made[-1], grasp=other))
    moved = open_object(again, DRAWER, target=0.2)
    assert moved, moved.reason
    # 2 % of the way, and not the 20 mm that are enough at a limit.
    assert moved.measures["tolerance"] == pytest.approx(0.004, rel=0.1)
    assert moved.value == pytest.approx(0.2, abs=moved.measures["tolerance"])
    assert moved.measures["placements"] > 0


def test_drawer_opens_by_friction_on_estimates(model):
    pytest.importorskip("mujoco")
    sensors = Sensors.parse("3mm+3mm/m,0.5deg,30Hz,drop=0.1,encoders=0.0002")
    world = MujocoWorld(model, "hsr", sensors=sensors)
    world.reset(start(model))
    metrics = measure(world)
    session = connect(world, TrackedBelief(model, "hsr", sensors), on_step=metrics)
    outcome = open_object(session, DRAWER)
    assert outcome, outcome.reason
    assert world.state[DRAWER] == pytest.approx(0.22, abs=0.02)
    assert world.held is None
    assert outcome.measures["slips"] == 0
    assert metrics.measures["grasp_error"] < 2e-3
    assert metrics.measures["penetration"] < 5e-4
    assert metrics.measures["estimate_mean"] < 0.003


@pytest.mark.long
def test_loss_of_a_drawer_that_moves_too_hard_is_noticed_and_said(model):
    pytest.importorskip("mujoco")
    world = MujocoWorld(model, "hsr", door_friction={DRAWER: 150.0})  # and friction holds 100 N
    world.reset(start(model))
    in_hand = model.fk(find_handle(model, DRAWER).frame, relative_to="hsr/hand_palm_link")[:3, 3]
    losses, phases, places = [], [""], []

    def watch(session):
        """Note how long the handle was further off than it slips before the arm stands."""
        if phases[-1] == "move" != session.phase:
            arm = [v for s, v in session.commands.items() if "hand_motor" not in str(s)]
            gone = (t for t, place in places if np.linalg.norm(place - places[0][1]) > SLIPPED)
            losses.append((world.time - session.dt - next(gone, world.time), max(map(abs, arm), default=0.0)))
            places.clear()
        phases.append(session.phase)
        if session.phase == "move":
            places.append((world.time, in_hand(world.state)))

    outcome = open_object(connect(world, on_step=watch), DRAWER)
    assert not outcome
    assert outcome.measures["slips"] == len(losses) == 2
    assert all(late <= 0.1 and speed == 0.0 for late, speed in losses), losses
    assert "slipped at" in outcome.reason
    assert "locked or jammed, or moves too hard" in outcome.reason


@pytest.fixture(scope="module")
def at_the_door():
    """Return a search of placements before a door, the handle, the initial state and grasps."""
    model = make_model("shelf_door")
    gripper, handle = find_gripper(model, "hsr"), find_handle(model, DOOR)
    state, grasps = start(model), sample_grasps(model, gripper, handle, 32)
    return PlacementSearch(model, "hsr", gripper, state), handle, state, grasps


def test_placement_keeps_the_grasp_along_the_way(at_the_door):
    search, handle, state, grasps = at_the_door
    model, gripper = search.model, search.gripper
    found = search.find(state, grasps, 1.2)
    assert found, found.why
    hand, bar = model.fk(gripper.hand), model.fk(handle.frame)
    for value, row in zip(found.values, found.path, strict=True):
        at = state.updated(dict(zip(found.coordinates, row.tolist(), strict=True))).updated({DOOR: value})
        np.testing.assert_allclose(hand(at), bar(at) @ found.grasp.pose, atol=1e-3)


@pytest.mark.long
def test_a_hand_from_below_opens_a_door_that_none_from_across_reaches():
    model = make_model("shelf_door", 1.5)
    gripper, handle, state = find_gripper(model, "hsr"), find_handle(model, DOOR), start(model)
    across = sample_grasps(model, gripper, handle, 32)
    found = PlacementSearch(model, "hsr", gripper, state).find(state, across, 1.2)
    assert found.failure == "reach"
    assert found.samples < 600  # no arm reached the handle at all
    world = KinematicWorld(model, "hsr")
    world.reset(state)
    metrics = measure(world, DOOR)
    outcome = open_object(connect(world, on_step=metrics), DOOR, target=0.6)
    assert outcome, outcome.reason
    assert not outcome.measures["pushed"]
    assert metrics.measures["penetration"] < 5e-4


def test_grasps_are_sampled_where_the_object_stands():
    model = kv.load("hsr")
    model.include("kitchens/17")
    door = "kitchen/oven_door"
    gripper, handle = find_gripper(model, "hsr"), find_handle(model, door)
    wide_open = model.default_state().updated({door: 1.5})
    assert len(sample_grasps(model, gripper, handle, 16)) == 16
    with pytest.raises(InvalidValueError, match="floor"):
        sample_grasps(model, gripper, handle, 16, state=wide_open)


def test_placement_says_how_far_it_leads_and_how_the_hand_goes_away(at_the_door):
    search, handle, state, grasps = at_the_door
    model, gripper = search.model, search.gripper
    seen = []
    found = search.find(state, grasps, 1.2, accept=lambda p: seen.append(p) or len(seen) > 1)
    assert found is seen[1]
    assert "no path to the handle" in found.why
    end = dict(zip(found.coordinates, found.retreat[-1].tolist(), strict=True))
    at = state.updated(end).updated({DOOR: found.values[-1]})
    expected = model.fk(handle.frame)(at) @ found.grasp.approach
    np.testing.assert_allclose(model.fk(gripper.hand)(at), expected, atol=1e-3)
    refused = search.find(state, grasps, 1.2, accept=lambda p: False)
    assert not refused
    assert refused.failure == "collision"
    assert not search.find_too_high(state, handle.coordinate, found.values)


def test_a_way_is_made_back_where_it_leads_to_the_target(at_the_door):
    search, handle, state, grasps = at_the_door
    placement, door = search.find(state, grasps, 1.0, seed=1), handle.coordinate
    ended = state.updated({door: 1.01})  # not exactly where the way ends
    back = search.retrace(ended, placement, 0.0)
    assert back is not None
    assert back.values[[0, -1]].tolist() == [1.01, 0.0]
    bar, hand = search.model.fk(handle.frame), search.model.fk(search.gripper.hand)
    for value, row in zip(back.values, back.path, strict=True):
        at = ended.updated({door: value} | dict(zip(back.coordinates, row, strict=True)))
        np.testing.assert_allclose(hand(at), bar(at) @ placement.grasp.pose, atol=1e-3)
    np.testing.assert_allclose(back.approach, placement.retreat[-1], atol=0.05)
    np.testing.assert_allclose(back.line[-1], back.path[0], atol=1e-3)
    assert search.retrace(ended, placement, 0.5).values[-1] == 0.5
    assert search.retrace(ended, placement, 0.0, accept=lambda found: False) is None
    with pytest.raises(InvalidValueError, match="hand_palm_link"):
        search.retrace(ended, search.find(state, grasps, 1.0, samples=1, accept=lambda found: False), 0.0)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("value", "target", "end"),
    [
        (1.01, 0.0, 0.0),
        (1.01, 0.5, 0.5),
        (0.99, -0.02, -0.02),
        (1.0, -0.5, 0.0),  # a part of the way
        (1.0, 1.3, None),  # it does not go on
        (0.6, 0.0, None),  # it begins elsewhere
    ],
)
def test_ways_lead_back_from_their_ends(at_the_door, value, target, end):
    search, _, state, grasps = at_the_door
    assert search.find(state, grasps, 1.0, seed=1).find_end_backwards(value, target) == end


def test_a_way_back_is_looked_at_anew(at_the_door, monkeypatch):
    search, handle, state, grasps = at_the_door
    placement = search.find(state, grasps, 1.0, seed=1)
    ended = state.updated({handle.coordinate: 1.0})
    monkeypatch.setattr(PathCheck, "_find", lambda *_, **__: 0)
    monkeypatch.setattr(PathCheck, "_note", lambda *_: "")
    assert search.retrace(ended, placement, 0.0) is None


def test_joints_at_their_limits_leave_the_rest_of_a_step_to_the_others():
    model = kv.load("hsr")
    arm = [s for s in model.symbols_of("hsr/hand_palm_link") if s in model.degrees_of_freedom]
    paths = CartesianPaths(model, "hsr/hand_palm_link", arm, (), np.ones(len(arm)))
    hand, low = model.fk("hsr/hand_palm_link"), paths.lower.copy()
    low[~np.isfinite(low)] = 0.0
    target = hand(model.default_state().updated(dict(zip(arm, low.tolist(), strict=True))))
    target[0, 3] -= 0.3  # so that the base has to move
    found, error = paths.solve(low[None], np.zeros((1, 0)), target[None], 12)
    assert error[0] < 1e-6
    assert (found >= paths.lower).all()


def test_fingers_that_close_and_open_keep_the_margin(at_the_door):
    search, _, _, grasps = at_the_door
    found = search.find(start(search.model), grasps, 1.2)
    handle, hand = grasps[0].handle.frame, search.gripper.bodies
    watch = search.scene.watch(hand, [b for b in search.others if b != handle], 0.05)
    for row, value in ((found.path[0], found.values[0]), (found.path[-1], found.values[-1])):
        at = start(search.model).updated(dict(zip(found.coordinates, row.tolist(), strict=True)))
        for gap in np.linspace(found.grasp.thickness, search.gripper.width, 15):
            search.scene.update(at.updated({**search.gripper.values_at(gap), DOOR: value}))
            assert all(pair.distance > search.margin - 1e-3 for pair in watch())


@pytest.mark.long
def test_retreats_go_aside_where_the_arm_does_not_reach_straight_back(at_the_door, monkeypatch):
    search, _, _, grasps = at_the_door
    follow, most = search.paths.follow, [1, 5, 5, 5, 5]

    def follow_less(Q, base, targets):
        ways, reached = follow(Q, base, targets)
        return ways, np.minimum(reached, most) if len(Q) == len(most) else reached

    monkeypatch.setattr(search.paths, "follow", follow_less)
    model, state = search.model, start(search.model)
    found = search.find(state, grasps, 0.6)
    ends = [dict(zip(found.coordinates, row.tolist(), strict=True)) for row in found.retreat[[0, -1]]]
    a, b = (model.fk("hsr/hand_palm_link")(state.updated(end))[:3, 3] for end in ends)
    bar = model.fk(grasps[0].handle.frame)(state.updated({DOOR: found.values[-1]})) @ grasps[0].handle.pose
    assert abs((b - a) @ bar[:3, 2]) / np.linalg.norm(b - a) > 0.3
    most[:] = [2] * 5
    none = search.find(state, grasps, 0.6, samples=100)
    assert not none
    assert none.reasons["no straight retreat"]


def test_locked_drawer_is_told_at_once():
    model = pusher(locked=True)
    with model.edit() as edit:
        edit.constrain("room/bolt/range", 0, kv.position("room/bolt"), 0.4)  # .5 would unlock it
    world = KinematicWorld(model, "robot")
    world.reset(world.model.default_state().updated({"robot/finger": 0.05, "robot/z": 2.0}))
    outcome = open_object(connect(world), "room/drawer")
    assert not outcome
    assert "room/drawer = 0.4: cannot be reached" in outcome.reason
    assert "'room/drawer' is locked at 0 while 'room/bolt' is 0" in outcome.reason
    assert (outcome.measures["failure"], outcome.steps) == ("other", 0)


@pytest.mark.long
def test_drawer_with_a_position_lock_opens_while_that_is_open():
    """The bolt locks it at the default state."""
    model, drawer = pusher(), kv.position("room/drawer")
    bolt = kv.position("room/bolt")
    with model.edit() as edit:
        edit.constrain("room/bolt/range", 0, bolt, 1)
        lock = position_lock(drawer, open_if=bolt > 0.5, lower=0.0, upper=0.0)
        edit.constrain("room/drawer/lock", *lock)
    world = KinematicWorld(model, "robot")
    world.reset(
        model.default_state().updated({"robot/finger": 0.05, "robot/z": 2.0, bolt: 1.0, drawer: 0.02})
    )
    outcome = open_object(connect(world), "room/drawer", target=0.12)
    assert outcome, outcome.reason


def test_hand_believes_that_a_locked_door_is_open_where_it_is():
    """The button holds the door at the default state, and is pressed now."""
    model = kv.load("articulations/microwave")
    door = model.symbol("microwave/oven/door")
    handle = SimpleNamespace(frame="microwave/oven/door", coordinate=door)
    search = SimpleNamespace(model=model, moving=())
    state = model.default_state().updated({door: 0.5, "microwave/oven/button": 0.006})
    hand = SimpleNamespace(hand="world")
    opener = SimpleNamespace(gripper=hand, search=search, approaches=None, controllers={})
    run = SimpleNamespace(session=SimpleNamespace(state=state))
    assert HandMotion(run, opener, handle).state[door] == 0.5


@pytest.mark.long
def test_drawer_that_is_locked_on_the_way_is_said_not_to_move():
    model = pusher()
    with model.edit() as edit:
        drawer = kv.position("room/drawer")
        edit.constrain("room/drawer/lock", *speed_lock(drawer, open_if=drawer < 0.05))
    world = KinematicWorld(model, "robot")
    world.reset(model.default_state().updated({"robot/finger": 0.05, "robot/z": 2.0}))
    moving, metrics = [], measure(world, "room/drawer")

    def watch(session):
        metrics(session)
        moving.append(session.phase == "move")

    watched = connect(world, on_step=watch)
    outcome = open_object(watched, "room/drawer")
    assert not outcome
    assert "does not move on" in outcome.reason
    assert "room/drawer/lock" in outcome.reason
    assert outcome.measures["failure"] == "other"
    assert metrics.measures["penetration"] < 5e-4  # of the retreat, too
    assert outcome.value < 0.06
    assert watched.dt * sum(moving) < 8.0  # the controller knows that nothing will move any more


def test_drawer_above_the_hand_is_said_to_be_too_high():
    model = make_model("shelf_drawers", height=2.0)
    world = KinematicWorld(model, "hsr")
    world.reset(start(model))
    outcome = open_object(connect(world), DRAWER)
    assert not outcome
    assert outcome.measures["failure"] == "reach"
    assert outcome.measures["placements"] >= 200
    assert "Too high" in outcome.reason
    # The arm is straight up: lift, flex and hand end at their limits.
    up = {"hsr/arm_lift_joint": 0.69, "hsr/arm_flex_joint": 0.0, "hsr/wrist_flex_joint": 0.0}
    hand = float(model.fk("hsr/hand_palm_link")(start(model).updated(up))[2, 3])
    reach = float(re.search(r"reaches (\S+) m", outcome.reason)[1])
    assert hand + 0.09 < reach < hand + 0.16


def test_arms_on_a_base_that_stays_are_the_present_one_or_random(model):
    search = PlacementSearch(model, "hsr", find_gripper(model, "hsr"), start(model))
    Q, standing = search.samples.stay(np.random.default_rng(0), start(model), 40)
    here = start(model).vector(search.moving)
    on_base = [s in search.base for s in search.moving]
    np.testing.assert_array_equal(Q[:, on_base], np.tile(here[on_base], (40, 1)))
    assert standing.shape == (40, len(search.standing))
    assert 10 < (here == Q).all(axis=1).sum() < 30


def test_a_way_takes_as_long_as_its_slowest_part():
    rows = np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.06]])
    assert find_least_time(rows, np.array([1.0, 0.02])) == pytest.approx(2 * 0.06 / 0.02)
    assert find_least_time(rows[:1], np.array([1.0, 0.02])) == 0.0


def test_base_of_a_whole_arm_stands_in_a_part_of_the_samples():
    least = {}
    for robot, hand in (("hsr", "hsr/hand_palm_link"), ("pr2", "pr2/r_gripper_palm_link")):
        model = kv.load(robot)
        own = [s for s in model.symbols_of(hand) if s in model.degrees_of_freedom]
        base = Robot.of(model, robot).planar_base
        samples = PlacementSampler(model, own, (), base)
        least[robot] = min(ease[own.index(base[0])] for ease in samples.eases)
        assert all(ease[own.index(s)] > 0 for ease in samples.eases for s in own if s not in base)
    assert least["pr2"] == 0.0 < least["hsr"]


@pytest.mark.parametrize(
    ("start", "target", "given", "tolerance"),
    [
        (0.0, 0.22, None, 0.02), (0.2, 0.0, None, 0.02), (0.0, 0.1, None, 0.002), (0.1, 0.12, None, 1e-3),
        (0.0, 0.1, 0.01, 0.01), (0.0, 0.1, 0.5, 0.022),
    ],
)  # fmt: skip
def test_tolerances_are_a_share_of_the_way_but_at_limits(model, start, target, given, tolerance):
    drawer = model.symbol(DRAWER)
    state = model.default_state().updated({drawer: start})
    assert choose_tolerance(model, drawer, state, target, given) == pytest.approx(tolerance, abs=1e-9)


def test_a_wall_that_the_robot_stands_at_is_in_its_way():
    """The base, a disc of .21 m, is 1 mm from a wall and from the floor; all arms are near to both."""
    model = make_model("shelf_drawers")
    with model.edit() as edit:
        edit.add_frame("wall", "world", kv.translation(-1.5, -0.221, 0.2), body=box(1.0, 0.02, 0.4))
        edit.add_frame("floor", "world", kv.translation(0.0, 0.0, -0.051), body=box(6.0, 6.0, 0.1))
    search = PlacementSearch(model, "hsr", find_gripper(model, "hsr"), start(model))
    assert search.scene.checks_pair("hsr/base_link", "wall")
    assert not search.scene.checks_pair("hsr/base_link", "floor")


def test_start_in_contact_is_refused(model):
    world = KinematicWorld(model, "hsr")
    world.reset(model.default_state().updated({"hsr/base/x": 0.9}))
    outcome = open_object(connect(world), DRAWER)
    assert not outcome
    assert "begins in contact" in outcome.reason
    assert outcome.measures["grasps"] == 0


def test_wrong_arguments_are_refused(session):
    with pytest.raises(UnknownNameError, match="upper_drawer"):
        open_object(session, "shelf_drawers/uper_drawer")
    with pytest.raises(InvalidValueError, match="of the robot"):
        open_object(session, "hsr/arm_lift_joint")
    with pytest.raises(InvalidValueError, match="moves from 0"):
        open_object(session, DRAWER, target=3.0)
    with pytest.raises(KineverseError):
        open_object(session, DRAWER, handle="shelf_drawers/lower_drawer_handle")
    for count in (0, 2.5, True):
        with pytest.raises(InvalidValueError, match="placements= is an integer of at least 1"):
            open_object(session, DRAWER, placements=count)


def test_an_object_that_is_never_seen_is_not_opened(model):
    sensors = Sensors.parse("3mm,0.5deg,drop=1")
    world = KinematicWorld(model, "hsr", sensors=sensors)
    world.reset(start(model).updated({DRAWER: 0.1}))
    outcome = open_object(connect(world, TrackedBelief(model, "hsr", sensors)), DRAWER)
    assert not outcome
    assert "not seen" in outcome.reason
    assert world.state[DRAWER] == 0.1


@pytest.mark.long  # with physics, it opens on estimates above
def test_drawer_opens_by_estimates_from_noisy_poses(model):
    sensors = Sensors.parse("3mm+3mm/m,0.5deg,30Hz,drop=0.1,encoders=0.0002")
    world = KinematicWorld(model, "hsr", sensors=sensors)
    world.reset(start(model))
    metrics = measure(world)
    outcome = open_object(connect(world, TrackedBelief(model, "hsr", sensors), on_step=metrics), DRAWER)
    assert outcome, outcome.reason
    assert metrics.measures["penetration"] < 5e-4
    assert metrics.measures["estimate_mean"] < 0.003
    assert metrics.measures["grasp_error"] < max(5e-4, 1.5 * metrics.measures["estimate_largest"])
