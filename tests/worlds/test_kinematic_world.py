"""Law: objects move by the least that keeps the robot out of them, within their limits, and else not at all."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pusher import BALL, angle_of_door, gripper, pusher, solid
from scripted_world import Step

import kineverse as kv
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.formats import load
from kineverse.grasping import Gripper
from kineverse.model.body import Sphere
from kineverse.model.model import Model
from kineverse.worlds import KinematicWorld, RunMetrics, Sensors

OBJECTS = ("door", "drawer", "bolt", "puck", "first", "second", "left", "right")


@pytest.fixture(scope="module")
def model() -> Model:
    return pusher()


@pytest.fixture(scope="module")
def hand(model: Model) -> Gripper:
    return gripper(model)


@pytest.fixture(scope="module")
def world(model: Model, hand: Gripper) -> KinematicWorld:
    return KinematicWorld(model, "robot", hand)


def start(world: KinematicWorld, **values: float) -> None:
    prefixes = {name: "room" if name in OBJECTS else "robot" for name in values}
    world.reset({"robot/finger": 0.05} | {f"{prefixes[name]}/{name}": v for name, v in values.items()})


def move(world: KinematicWorld, seconds: float, dt: float = 0.02, **speeds: float) -> None:
    for _ in range(round(seconds / dt)):
        world.apply({f"robot/{name}:velocity": v for name, v in speeds.items()}, dt, stamp=world.time)


def objects(world: KinematicWorld) -> np.ndarray:
    return np.array([world.state[f"room/{name}"] for name in OBJECTS])


def gap(world: KinematicWorld) -> float:
    return min((c.distance for c in world.contacts()), default=math.inf)


def test_a_ball_pushes_a_door_to_the_angle_at_which_they_touch(world):
    start(world, x=0.9, y=0.5)
    for _ in range(40):
        before = objects(world)
        world.apply({"robot/x:velocity": 0.3, "robot/y:velocity": -0.2}, 0.02)
        x, y = world.state["robot/x"], world.state["robot/y"]
        wanted = max(0.0, angle_of_door(x, y))
        assert world.state["room/door"] == pytest.approx(wanted, abs=2e-5)
        # Nothing else moves, nor does the door before it is touched.
        assert np.array_equal(objects(world)[1:], before[1:])
        assert wanted > 0.0 or world.state["room/door"] == 0.0
        assert gap(world) > -1e-6
    assert world.state["room/door"] > 0.3
    # It stays where it is, both when the ball rests and when it goes.
    pushed = objects(world)
    world.apply({}, 0.1)
    assert [(c.a, c.b) for c in world.contacts()] == [("robot/ball", "room/panel")]
    assert world.contacts()[0].normal[0] > 0.5
    assert math.isnan(world.contacts()[0].force)
    move(world, 0.4, x=-0.3)
    assert np.array_equal(objects(world), pushed)
    assert not world.contacts()


def test_long_steps_push_as_short_ones_do(world):
    start(world, x=0.0, y=0.5)
    world.apply({"robot/x:velocity": 0.4}, 3.25)
    assert world.state["room/door"] == pytest.approx(angle_of_door(1.3, 0.5), abs=2e-5)
    # A sweep past the end of the door opens it until the ball is past.
    start(world, x=0.97, y=1.1, z=0.1)
    world.apply({"robot/y:velocity": -1.0}, 0.2)
    assert world.state["room/door"] == 0.0
    world.apply({"robot/y:velocity": -0.1}, 1.5)
    assert world.state["room/door"] == pytest.approx(angle_of_door(0.97, 0.75), abs=2e-5)


def test_speeds_of_objects_are_not_read(world):
    start(world, x=0.0)
    before = objects(world)
    world.apply({"room/door:velocity": 0.5, "room/drawer:velocity": math.nan}, 0.1)
    assert np.array_equal(objects(world), before)


def test_what_is_blocked_is_penetrated_and_reported(world):
    # The ball stands 0.5 m above the hand.
    start(world, x=0.9 - 0.01 - BALL - 0.005, y=0.1, z=1.5, drawer=0.1)
    for _ in range(50):
        move(world, 0.02, x=0.15)
        depth = world.state["robot/x"] - (1.0 - 0.01 - BALL)
        if 0.0 < depth < 0.009:
            assert gap(world) == pytest.approx(-depth, abs=1e-4)
        assert depth <= 0.0 or world.state["room/drawer"] == pytest.approx(0.0, abs=1e-9)
    # The ball is behind the drawer's front by now: it does not push it open from there.
    assert depth > 0.03
    # An object that is slower than the robot lags behind: its speed is limited to 0.2 m/s.
    start(world, x=0.7 - 0.01 - BALL, y=0.1, z=1.5, drawer=0.3)
    move(world, 0.5, x=0.25)
    assert world.state["room/drawer"] == pytest.approx(0.2, abs=1e-6)
    assert gap(world) == pytest.approx(-0.025, abs=1e-4)


def test_least_motion_is_shared_and_closures_stay_closed(world):
    start(world, x=1 - 0.01 - BALL, z=5.5)
    move(world, 0.2, x=0.3)
    values = world.state
    assert values["room/first"] + values["room/second"] == pytest.approx(0.06, abs=1e-5)
    # The least of a² + b² with a + b given has a = b, as both have the same weight.
    assert values["room/first"] == pytest.approx(0.03, abs=1e-5)
    start(world, x=1 - 0.01 - BALL, z=7.5)
    move(world, 0.2, x=0.3)
    values = world.state
    assert (values["room/left"], values["room/right"]) == pytest.approx((0.06, 0.12), abs=1e-5)


def test_fingers_hold_a_handle_and_the_door_follows_the_hand(world, model, hand):
    start(world, x=0.88, y=0.7)
    move(world, 1.0, dt=0.01, finger=-0.1)
    assert world.held == "room/door_handle"
    assert [e.text for e in world.events] == ["'room/door_handle' is held"]
    assert world.state["robot/finger"] == pytest.approx(0.015, abs=1e-5)  # a bar of 1 cm radius
    pose = model.fk("robot/base")
    in_door = np.linalg.inv(model.fk("room/door_handle")(world.state)) @ pose(world.state)
    dt, angle = 0.02, world.state["room/door"]
    for k in range(1, 41):
        wanted = angle - 0.012 * k  # opens towards the robot
        target = model.fk("room/door_handle")(world.state.updated({"room/door": wanted})) @ in_door
        now = world.state
        speeds = {
            "robot/x:velocity": (target[0, 3] - now["robot/x"]) / dt,
            "robot/y:velocity": (target[1, 3] - now["robot/y"]) / dt,
            "robot/turn:velocity": (math.atan2(target[1, 0], target[0, 0]) - now["robot/turn"]) / dt,
        }
        world.apply(speeds, dt)
        assert world.held
        assert world.state["room/door"] == pytest.approx(wanted, abs=1e-6)
    # Fingers still close, as nothing else was said; opening them lets go.
    assert world.state["robot/finger"] == pytest.approx(0.015, abs=1e-5)
    move(world, 0.3, finger=0.1)
    assert world.held is None
    assert world.events[-1].text == "'room/door_handle' is released"
    left = world.state["room/door"]
    move(world, 0.2, x=-0.2)
    assert world.state["room/door"] == left


def test_a_hand_that_does_not_hold_pulls_nothing(world):
    start(world, x=0.88, y=0.0, z=2.0, finger=0.03)
    before = objects(world)
    move(world, 0.5, x=-0.2)
    assert np.array_equal(objects(world), before)
    assert world.held is None


def test_a_finger_pushes_what_yields_and_stops_at_what_does_not(world):
    start(world, x=0.94, y=0.01, z=4.0)
    move(world, 0.5, finger=-0.1)
    # The puck is centred between the fingers.
    assert world.held == "room/puck"
    assert world.state["room/puck"] == pytest.approx(0.01, abs=world_gap(0.006))
    start(world, x=0.88, y=0.01, z=2.0)
    move(world, 1.0, finger=-0.1)
    # The drawer's bar does not move sideways: one finger stops, and the other is too far away to hold.
    assert world.held is None
    assert world.state["robot/finger"] == pytest.approx(0.01 + 0.005 + 0.01, abs=1e-5)
    assert gap(world) > -2e-6


def test_what_is_pushed_moves_at_most_twice_as_far_as_the_robot(model, hand):
    """Fingers close askew on a round bar, some from within it: its normals point anywhere, also nearly sideways."""
    world = KinematicWorld(model, "robot", hand, leave_out=["room/drawer/speed"])
    rng, dt, drawer, finger = np.random.default_rng(0), 0.02, "room/drawer", "robot/finger"
    names = [f"robot/{name}" for name in ("x", "y", "z", "turn")]
    pushed = inside = 0
    for trial in range(10):
        place = np.array([0.88, 0.0, 2.0, 0.0]) + rng.uniform(-1, 1, 4) * (0.03, 0.05, 0.05, 0.6)
        opened = 0.0 if trial % 2 else 0.05
        at = dict(zip(names, place, strict=True))
        # The finger at y = 5 cm may be in the bar at first.
        world.reset({finger: 0.05 - 0.04 * (trial % 3 == 0), drawer: opened} | at)
        for _ in range(3):
            speeds = rng.normal(size=4) * (0.08, 0.05, 0.05, 0.3)
            command = {f"{name}:velocity": v for name, v in zip(names, speeds, strict=True)}
            for _ in range(6):
                before = world.state
                inside += any(c.distance < -1e-3 for c in world.contacts())
                world.apply(command | {"robot/finger:velocity": -0.1}, dt)
                moved = abs(world.state[drawer] - before[drawer])
                arm = dt * (np.linalg.norm(speeds[:3]) + 0.1 * abs(speeds[3]))
                robot = arm + abs(world.state[finger] - before[finger])
                assert moved <= 2.0 * (robot + 0.1 * dt) + 1e-5
                pushed += moved > 1e-4
                if world.held:
                    break
            if world.held:
                break
    assert min(pushed, inside) > 4


def test_fingers_side_by_side_push_and_do_not_hold(world):
    start(world, x=0.85, y=0.3, z=0.5, finger=0.03)
    move(world, 0.6, x=0.15, finger=-0.01)
    pushed = world.state["room/door"]
    assert pushed > 0.05
    assert {c.a for c in world.contacts()} & {"robot/left_finger", "robot/right_finger"}
    move(world, 0.4, x=-0.1, finger=-0.01)
    assert world.held is None
    assert world.state["room/door"] == pushed


def world_gap(tolerance: float) -> float:
    """Return the largest offset of a held body from the middle of the fingers."""
    return tolerance / 2 + 1e-5


def test_a_drawer_follows_within_its_limits_and_is_lost_beyond(world):
    start(world, x=0.88, z=2.0)
    move(world, 0.5, finger=-0.1)
    assert world.held == "room/drawer_handle"
    move(world, 1.0, x=-0.1)
    assert world.state["room/drawer"] == pytest.approx(0.1, abs=1e-6)
    assert world.held
    move(world, 2.0, x=-0.15)
    assert world.state["room/drawer"] == pytest.approx(0.4, abs=1e-7)
    assert world.held
    move(world, 0.09, dt=0.03, x=-0.1)
    assert world.held
    move(world, 0.03, dt=0.03, x=-0.1)
    assert world.held is None
    assert "is lost: it is 12 mm" in world.events[-1].text
    # Fingers that were never opened hold nothing anew.
    move(world, 0.1, x=0.05)
    assert world.held is None


def test_locks_hold_what_is_pulled_until_they_open():
    model = pusher(locked=True)
    world = KinematicWorld(model, "robot", gripper(model), slip=(0.003, 0.1))
    start(world, x=0.88, z=2.0)
    move(world, 0.5, finger=-0.1)
    assert world.held
    move(world, 0.02, x=-0.1)
    assert world.held
    assert world.state["room/drawer"] == 0.0
    move(world, 0.02, x=-0.1)
    assert world.held is None
    assert world.state["room/drawer"] == 0.0
    start(world, x=0.88, z=2.0, bolt=0.8)
    move(world, 0.5, finger=-0.1)
    move(world, 1.0, x=-0.1)
    assert world.held
    assert world.state["room/drawer"] == pytest.approx(0.1, abs=1e-6)


def test_fingers_keep_within_the_limits_of_joints_that_mimic_them():
    model = pusher()
    with model.edit() as edit:
        edit.constrain("robot/thumb/range", 0.01, 0.5 * kv.position("robot/finger"), 0.02)
    world = KinematicWorld(model, "robot", gripper(model))
    start(world, finger=0.03)
    for speed, end in ((0.1, 0.04), (-0.1, 0.02)):
        move(world, 0.5, finger=speed)
        assert world.state["robot/finger"] == pytest.approx(end, abs=1e-9)


def test_commands_are_delayed_and_stale_ones_are_refused(model, hand):
    world = KinematicWorld(model, "robot", hand, delay=0.03, timeout=0.1)
    for _ in range(5):
        world.apply({"robot/x:velocity": 0.5}, 0.02, stamp=world.time)
        assert world.state["robot/x"] == pytest.approx(0.5 * max(0.0, world.time - 0.03))
        assert world.state.stamp == world.time
    # What acts already goes on for the delay, and then the robot stops.
    world.apply({"robot/x:velocity": 0.5}, 0.1, stamp=world.time - 0.11)
    assert world.refused == 1
    assert "refused" in world.events[-1].text
    assert world.state["robot/x"] == pytest.approx(0.5 * 0.1)
    world.reset(model.default_state())
    assert (world.refused, world.time, world.events) == (0, 0.0, ())
    world.apply({"robot/x:velocity": 0.5}, 1.0, stamp=0.0)  # silence: it acts for the time-out
    assert world.state["robot/x"] == pytest.approx(0.5 * 0.1)


def test_fingers_keep_their_speed_until_their_limit(world):
    start(world, x=0.0)
    world.apply({"robot/finger:velocity": -0.02}, 0.1)
    world.apply({}, 0.5)
    assert world.state["robot/finger"] == pytest.approx(0.05 - 0.012)
    world.apply({"robot/x:velocity": 0.0}, 5.0)
    assert world.state["robot/finger"] == pytest.approx(0.006, abs=1e-15)


def test_fingers_stop_once_no_command_has_come_for_the_time_out(model, hand):
    world, close = KinematicWorld(model, "robot", hand, timeout=0.1), {"robot/finger:velocity": -0.02}
    start(world, x=0.0)
    world.apply(close, 0.02, stamp=world.time)
    world.apply({}, 0.02, stamp=world.time)  # a stop, after which the fingers have a speed
    for _ in range(10):
        world.apply(close, 0.02, stamp=-1.0)  # refused, as if none had come
    assert world.state["robot/finger"] == pytest.approx(0.05 - 0.02 * 0.12)
    world.apply({}, 0.5)  # nobody remembers the speed
    assert world.state["robot/finger"] == pytest.approx(0.05 - 0.02 * 0.12)
    start(world, x=0.0)
    world.apply(close, 1.0, stamp=0.0)  # silence
    assert world.state["robot/finger"] == pytest.approx(0.05 - 0.02 * 0.1)
    # What is held stays so, and fingers that are opened still let go.
    start(world, x=0.88, y=0.7)
    for _ in range(150):
        world.apply(close, 0.02, stamp=world.time)
    assert world.held == "room/door_handle"
    world.apply({}, 1.0, stamp=world.time - 1.0)
    world.apply({}, 1.0)
    assert world.held == "room/door_handle"
    world.apply({"robot/finger:velocity": 0.02}, 0.02, stamp=world.time)
    assert world.held is None


def test_bad_input_is_refused_and_changes_nothing(world, model):
    start(world, x=0.2)
    before = world.state
    for speeds, duration, stamp in (
        ({"robot/x:velocity": math.nan}, 0.02, None),
        ({"robot/x:velocity": math.inf}, 0.02, None),
        ({}, 0.0, None),
        ({}, math.nan, None),
        ({}, 0.02, math.nan),
    ):
        with pytest.raises(InvalidValueError):
            world.apply(speeds, duration, stamp=stamp)
    with pytest.raises(UnknownNameError, match="robot/x:velocity"):
        world.apply({"robot/xx:velocity": 0.1}, 0.02)
    assert world.state is before
    assert world.time == 0.0
    with pytest.raises(UnknownNameError, match=r"no robot 'rooom'.*'room'"):
        KinematicWorld(model, "rooom")
    with pytest.raises(UnknownNameError, match="room/door/range"):
        KinematicWorld(model, "robot", leave_out=["room/door/ranges"])
    with pytest.raises(InvalidValueError, match="timeout"):
        KinematicWorld(model, "robot", timeout=0.0)


def test_constraints_that_are_left_out_limit_nothing(model, hand):
    world = KinematicWorld(model, "robot", hand, leave_out=["room/drawer/range"])
    start(world, x=1.0 - 0.01 - BALL, y=0.1, z=1.5)
    move(world, 0.5, x=0.1)
    assert world.state["room/drawer"] == pytest.approx(-0.05, abs=1e-5)
    assert any("room/drawer/range" in remark for remark in world.remarks)


def test_observations_are_exact_by_default(world, model):
    start(world, x=0.3)
    seen = world.observe()
    assert seen.joints[model.symbol("robot/x")] == 0.3
    np.testing.assert_allclose(seen.poses["room/panel"], model.fk("room/panel")(world.state))
    noisy = KinematicWorld(model, "robot", world._grip.gripper, sensors=Sensors(position=0.01))
    noisy.reset(world.state)
    assert not np.allclose(noisy.observe().poses["room/panel"], seen.poses["room/panel"], atol=1e-4)


def test_fetch_drives_by_its_wheels_and_closes_a_door():
    model = load("fetch")
    with model.edit() as edit:
        edit.include("kitchen", "kitchen")
    world = KinematicWorld(model, "fetch")
    begin = model.default_state().updated(
        {"kitchen/fridge_door": 0.6, "fetch/base/x": -0.72, "fetch/base/y": -1.4}
    )
    world.reset(begin)
    metrics = RunMetrics(world)
    speeds = {"fetch/l_wheel_joint:velocity": 5.0, "fetch/r_wheel_joint:velocity": 4.9}
    wheels = {v: speeds[str(v)] for v in model.speeds if str(v) in speeds}
    for _ in range(80):
        world.apply(wheels, 0.02, stamp=world.time)
        metrics(Step(wheels, world.state))
    alone = model.integrate(begin, wheels, 1.6)
    for name in ("x", "y", "angle"):
        assert world.state[f"fetch/base/{name}"] == pytest.approx(alone[f"fetch/base/{name}"], abs=1e-9)
    moved = {str(s) for s, v in world.state.items() if v != begin[s] and str(s).startswith("kitchen")}
    assert moved == {"kitchen/fridge_door"}
    assert 0.1 < world.state["kitchen/fridge_door"] < 0.55
    assert metrics.measures["penetration"] < 1e-6
    assert metrics.measures["limit_violation"] < 1e-9
    assert metrics.measures["distance"] == pytest.approx(4.95 * 0.06 * 1.6, rel=1e-3)


@pytest.mark.parametrize("scene", ["ball", "folding_door", "ratchet", "four_bar"])
@pytest.mark.sampled(2)
def test_mechanisms_of_all_kinds_keep_their_limits(scene):
    """A ball flies at each body: quaternions within a cone, a four-bar in closed form, a loop, a lock."""
    model = kv.Model()
    x, y, z = (kv.position(f"robot/{name}") for name in "xyz")
    with model.edit() as edit:
        edit.add_frame("robot/ball", "world", kv.translation(x, y, z), solid(Sphere(BALL)))
        edit.include(f"articulations/{scene}", prefix="thing")
    world = KinematicWorld(model, "robot")
    metrics = RunMetrics(world)
    rng, moved = np.random.default_rng(0), 0
    objects = [s for s in model.symbols if s.path.startswith("thing")]
    ranges = {s: np.array(model.limits(s)) for s in objects}
    home = model.default_state().updated(
        {s: float(r.mean()) for s, r in ranges.items() if np.isfinite(r).all()}
    )
    for body in [name for name in model.bodies if name.startswith("thing")][-3:]:
        middle, way = model.fk(body)(home)[:3, 3], rng.normal(size=3)
        way *= 0.25 / np.linalg.norm(way)
        world.reset(home.updated(dict(zip((x, y, z), middle - way, strict=True))))
        metrics.reset()
        speeds = dict(zip((x.derivative(), y.derivative(), z.derivative()), way, strict=True))
        for _ in range(60):
            before, near = world.state.vector(objects), bool(world.contacts())
            world.apply(speeds, 0.02)
            metrics(Step(speeds, world.state))
            still = np.allclose(world.state.vector(objects), before, atol=1e-12)
            assert still or near or world.contacts()
            moved += not still
        assert metrics.measures["limit_violation"] < 1e-7
    assert moved
