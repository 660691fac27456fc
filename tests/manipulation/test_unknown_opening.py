from types import SimpleNamespace

import numpy as np
import pytest
from test_pushing import READING_FAULTS, FaultyReadings

import kineverse as kv
from kineverse.control import Goal, same_pose
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.estimation import identify, pose_covariance
from kineverse.lie import inverse, pose_difference, quaternion, retract, rotation_z, transform, translation
from kineverse.manipulation import Session, open_unknown
from kineverse.manipulation.opening import PlacementSearch
from kineverse.manipulation.opening.hand_motion import HandMotion
from kineverse.manipulation.skill_run import SkillRun
from kineverse.manipulation.unknown_objects import forget_joint
from kineverse.manipulation.unknown_objects.joint_learning import JointLearning
from kineverse.manipulation.unknown_objects.part_belief import PartBelief, PoseMean
from kineverse.manipulation.unknown_objects.unknown_opening import (
    ArmEndError,
    UnknownOpeningRun,
    guess_hinges,
)
from kineverse.manipulation.unknown_objects.unmodelled_joint import JointPath, free_part, write_joint
from kineverse.worlds import KinematicWorld, Observation, Robot, RunMetrics, Sensors
from kineverse.worlds.run_metrics import measure_way
from robot_interface_proxy import InterfaceOnly

DOOR, HANDLE = "shelf_door/door", "shelf_door/door_handle"
NOISE = np.array([0.0045] * 3 + [0.0087] * 3)


def make_model():
    model = kv.load("hsr")
    with model.edit() as edit:
        edit.include("shelf_door", "shelf_door")
        edit.attach("shelf_door/shelf", parent="world", transform=kv.translation(1, 0, 0.7))
    return model


@pytest.fixture(scope="module")
def floating(truth):
    return free_part(truth, DOOR, HANDLE, truth.default_state())


@pytest.fixture(scope="module")
def search(truth, floating):
    robot = Robot.of(floating.model, "hsr")
    return PlacementSearch(floating.model, robot, robot.gripper(), floating.model.default_state())


def believe_that_it_slides(model):
    tag = f"joint {DOOR}"
    old = model.history.operation(tag)
    slide = kv.Prismatic(
        name=old.name,
        parent=old.parent,
        child=old.child,
        origin=old.origin,
        axis=(1, 0, 0),
        lower=0,
        upper=0.3,
    )
    with model.edit() as edit:
        edit.replace(tag, slide)


@pytest.fixture(scope="module")
def truth():
    return make_model()


def look(pose, random, outliers=0.05):
    if random.random() < outliers:
        return transform(quaternion(random.normal(size=4)), pose[:3, 3] + random.uniform(-1, 1, 3))
    return retract(pose, NOISE * random.normal(size=6))


def hinge(way):
    return transform(rotation_z(way / 0.38), np.zeros(3)) @ translation(np.array([0.0, -0.38, 0.0]))


def rail(way):
    return translation(np.array([way, 0.0, 0.0]))


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize(("path", "family"), [(hinge, "revolute"), (rail, "prismatic")])
def test_family_is_known_before_8_cm_with_outliers(path, family, seed):
    random, learning = np.random.default_rng(seed), JointLearning()
    for moved in [*np.zeros(20), *np.arange(0.0, 0.09, 0.05 / 30)]:
        seen = look(path(moved), random)
        if np.linalg.norm(seen[:3, 3] - path(moved)[:3, 3]) < 0.06:  # a part in a hand is near it
            learning.add(seen, np.diag(NOISE**2))
        learning.update(moved, moved / 0.38 if family == "revolute" else 0.0, 0.0)
    found = learning.learned
    assert found is not None
    assert found.fit.family == family
    assert found.distance < 0.08


def test_mean_of_poses_leaves_a_first_outlier_out():
    random, true = np.random.default_rng(0), translation(np.array([1.0, 2.0, 0.5]))
    mean = PoseMean(60.0)
    mean.add(translation(np.array([2.0, 2.0, 0.5])))
    for _ in range(40):
        mean.add(look(true, random, 0.2))
    np.testing.assert_allclose(mean.pose, true, atol=5e-3)
    assert not mean.add(translation(np.array([2.0, 2.0, 0.5])))


def test_free_part_is_where_it_is_seen_and_is_pulled_along_the_normal(floating):
    unknown = floating
    seen = retract(unknown.origin, np.array([0.02, -0.01, 0.03, 0.1, 0.2, -0.3]))
    state = unknown.model.default_state().updated(unknown.values(seen))
    np.testing.assert_allclose(unknown.model.fk(DOOR, unknown.parent)(state), seen, atol=1e-12)
    pulled = state.updated({unknown.handle.coordinate: 0.1})
    handle = unknown.model.fk(HANDLE)
    shift = (inverse(handle(state) @ unknown.handle.pose) @ handle(pulled) @ unknown.handle.pose)[:3, 3]
    np.testing.assert_allclose(shift, [0.1, 0.0, 0.0], atol=1e-12)


def test_pull_along_a_learned_twist_moves_the_part_as_its_hinge_does(truth, floating):
    door = truth.fk(DOOR, "shelf_door/body")
    here, ahead = door({DOOR: 0.4}), door({DOOR: 0.4 + 1e-6})
    further = floating.pulled_along(pose_difference(ahead, here) / 1e-6)
    state = further.model.default_state().updated(further.values(here))
    pull = further.handle.coordinate
    moved = further.model.fk(DOOR, further.parent)(state.updated({pull: 0.2}))
    way, turn = measure_way(here, moved, further.point)
    radius = way / (2.0 * np.sin(turn / 2.0))
    assert radius * turn == pytest.approx(0.2, abs=1e-6)
    np.testing.assert_allclose(moved, door({DOOR: 0.4 + turn}), atol=1e-6)


def test_hinge_of_a_door_is_guessed_at_the_edge_far_from_its_handle(truth, floating, search):
    (twist,) = guess_hinges(floating, search, floating.model.default_state())
    door = truth.fk(DOOR, "shelf_door/body")
    true = pose_difference(door({DOOR: 1e-6}), door({DOOR: 0.0})) / 1e-6
    np.testing.assert_allclose(twist[3:], true[3:], atol=1e-6)
    np.testing.assert_allclose(twist[:3], true[:3], atol=0.05)


def test_learned_joint_replaces_the_attachment_without_limits(truth):
    random, model = np.random.default_rng(1), forget_joint(truth, DOOR, truth.default_state())
    door, angles = truth.fk(DOOR, "shelf_door/body"), np.linspace(0.0, 1.0, 60)
    poses = np.array([look(door({DOOR: q}), random, 0.0) for q in angles])
    fit = identify(None, poses, noise=pose_covariance(0.0045, 0.0087)).best
    coordinate = write_joint(model, DOOR, fit, "shelf_door/body")
    assert coordinate in model.degrees_of_freedom
    assert model.limits(coordinate) == (-np.inf, np.inf)
    expression = model.fk(DOOR, "shelf_door/body")
    path = JointPath(lambda q: expression({coordinate: q}), door({DOOR: 0.0}))
    value = path.project(door({DOOR: 1.5}))
    np.testing.assert_allclose(expression({coordinate: value}), door({DOOR: 1.5}), atol=0.02)
    assert abs(path.value - path.start) == pytest.approx(1.5, abs=0.02)


SENSORS = Sensors.parse("3mm+3mm/m,0.5deg,30Hz,outliers=0.05")


def make_world(model, seed=1):
    world = KinematicWorld(model, "hsr", sensors=SENSORS, seed=seed)
    world.reset(model.default_state().updated({"hsr/base/x": -0.5}))
    return world


def run(model, world, part=None, on_step=None, **options):
    session = Session(InterfaceOnly(world), on_step=on_step, patience=3.0)
    return open_unknown(session, HANDLE, model=model, part=part, sensors=SENSORS, **options)


@pytest.mark.long
def test_door_that_was_believed_to_slide_is_relearned_and_opened(truth):
    model = truth.copy()
    believe_that_it_slides(model)
    world = make_world(truth)
    gripper = Robot.of(truth, "hsr").gripper()
    metrics = RunMetrics(world, truth.symbol(DOOR), gripper=gripper, handle=HANDLE, part=DOOR)
    outcome = run(model, world, turn=np.radians(15), on_step=metrics)
    assert outcome, outcome.reason
    assert world.state[DOOR] == pytest.approx(np.radians(15), abs=0.05)
    assert outcome.value == pytest.approx(metrics.turn, abs=0.02)
    assert metrics.overlap is None
    assert outcome.measures["believed"] == "refuted"
    assert outcome.measures["decided_turn"] < np.radians(10)
    assert outcome.measures["opened_seconds"] < 15
    assert model.articulations[DOOR].kind == "revolute"


@pytest.mark.long
def test_door_that_nothing_moves_is_said_not_to_follow(truth):
    model, locked = forget_joint(truth, DOOR, truth.default_state()), truth.copy()
    with locked.edit() as edit:
        edit.constrain("lock", 0, kv.position(DOOR).derivative(), 0)
    world = make_world(locked)
    outcome = run(model, world, part=DOOR, turn=np.radians(15))
    assert not outcome
    assert abs(outcome.value) < 0.02
    assert world.state[DOOR] == 0.0
    assert "does not follow the hand" in outcome.reason
    assert outcome.measures["failure"] == "other"
    assert model.articulations[DOOR].kind == "fixed"


def test_looks_at_a_part_that_slips_through_the_hand_are_those_of_its_joint(truth, floating):
    """The hand stands still while the part moves by 4 cm: all that is learned is of the markers."""
    state, door = truth.default_state(), truth.fk(DOOR)
    robot = Robot.of(floating.model, "hsr")
    belief = PartBelief(floating, robot, state, robot.gripper().hand, [DOOR], [], Sensors())

    def see(time, angle):
        belief.update(Observation(time, state, {DOOR: door({DOOR: angle})}), time)

    for time in np.arange(10) / 30:
        see(time, 0.0)
    assert belief.is_seen
    belief.hold()
    belief.begin_motion()
    place, angles = inverse(belief.pose) @ belief.hand_pose, np.linspace(0.0, 0.04 / 0.38, 60)
    for k, angle in enumerate(angles):
        see((k + 10) / 30, angle)
        see((k + 10) / 30, 1.0)  # the stamp is that of the last look
    np.testing.assert_allclose([pose for pose, _ in belief.looks], [door({DOOR: q}) for q in angles])
    assert belief.slip(place, floating.point) > 0.02


@pytest.mark.parametrize(
    ("fault", "seconds", "says"),
    [pytest.param(*fault, marks=pytest.mark.long) for fault in READING_FAULTS[:-1]] + [READING_FAULTS[-1]],
)
def test_pull_waits_for_readings_and_says_which_have_ended(truth, fault, seconds, says):
    world, fastest = make_world(truth), [0.0]
    faulty = FaultyReadings(world, DOOR, fault, seconds)

    def look(session):
        if session.phase == "pull":
            fastest.append(max(map(abs, session.commands.values()), default=0.0))

    model = forget_joint(truth, DOOR, truth.default_state())
    outcome = run(model, faulty, part=DOOR, turn=np.radians(15), on_step=look)
    assert (bool(outcome), says in outcome.reason) == (not says, True), outcome.reason
    assert (world.state[DOOR] > np.radians(12)) == (not says)
    assert faulty.moving <= 0.1
    assert max(fastest) < 1.0


@pytest.mark.parametrize(
    ("why", "kind", "error"), [("The arm ends.", "reach", ArmEndError), ("It slipped.", "", None)]
)
def test_end_of_an_arm_is_not_the_stop_of_a_part(monkeypatch, why, kind, error):
    motion = SimpleNamespace(close=lambda grasp: True, follow_line=lambda a, b: None)
    pulling = UnknownOpeningRun.__new__(UnknownOpeningRun)
    pulling.session, pulling.motion = SimpleNamespace(time=0.0), motion
    pulling.learning = SimpleNamespace(poses=1, learned=object())
    pulling.belief = SimpleNamespace(pose=np.eye(4), hand_pose=np.eye(4))
    pulling.frame_T_handle, pulling.unknown = np.eye(4), SimpleNamespace(frame=DOOR)
    pulling._first_pull, pulling._reached, pulling.measures = 0.0, 0.0, {"grasps": 0}
    monkeypatch.setattr(UnknownOpeningRun, "opening", (0.3, 0.8))
    monkeypatch.setattr(UnknownOpeningRun, "_pull_once", lambda self: (why, kind))
    monkeypatch.setattr(UnknownOpeningRun, "_open_fingers", lambda self: None)
    grasp = SimpleNamespace(pose=np.eye(4))
    if error is None:
        assert "this is its stop" in pulling._pull_open(grasp)
        return
    with pytest.raises(error, match="was pulled") as caught:
        pulling._pull_open(grasp)
    assert caught.value.kind == "reach"


def test_robot_alone_moves_on_lines_relative_to_a_part_that_floats(truth, floating, search):
    session = Session(InterfaceOnly(KinematicWorld(truth, "hsr")))
    unknown, gripper = floating, search.contacts.gripper
    opener = SimpleNamespace(gripper=gripper, search=search, approaches=None, controllers={})
    motion = HandMotion(SkillRun(session, None, 1.0), opener, unknown.handle)
    goal = Goal(same_pose(unknown.model.fk(HANDLE), unknown.model.fk(gripper.hand)), name="hand")
    assert {s.path.partition("/")[0] for s in motion.controller([goal]).speeds} == {"hsr"}


def test_wrong_arguments_name_the_mistake(truth):
    model, session = truth, Session(InterfaceOnly(KinematicWorld(truth, "hsr")))
    with pytest.raises(InvalidValueError, match="none can be forgotten"):
        forget_joint(model, "shelf_door/body", model.default_state())
    with pytest.raises(UnknownNameError, match="door_handle"):
        open_unknown(session, "shelf_door/handle", model=model)
    with pytest.raises(InvalidValueError, match="is a frame of the robot 'hsr', not a handle"):
        open_unknown(session, "hsr/hand_palm_link", model=model)
    with pytest.raises(UnknownNameError, match="no hand closes around it"):
        free_part(model, DOOR, DOOR, model.default_state())
    with pytest.raises(InvalidValueError, match="way="):
        open_unknown(session, HANDLE, model=model, way=-1.0)
    with pytest.raises(InvalidValueError, match="is not below the part"):
        open_unknown(session, HANDLE, model=model, part="hsr/hand_palm_link")
