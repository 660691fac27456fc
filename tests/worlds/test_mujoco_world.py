"""The world with physics, alone: what speeds by hand do in it."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.grasping import Gripper, find_gripper
from kineverse.lie import Array
from kineverse.model import Body, Box, Inertia, Shape
from kineverse.model.basic_operations import SetBody
from kineverse.worlds import MujocoWorld, Sensors, SimulatedWorld

mujoco = pytest.importorskip("mujoco")

ROBOTS = ("pr2", "fetch", "hsr")
ON_WHEELS = (
    "fetch",
    pytest.param("pr2", marks=pytest.mark.long),
    pytest.param("hsr", marks=pytest.mark.long),
)
"""The robot with the least degrees of freedom and a base that cannot slip sideways; the others take long."""
HANDS = ("fetch", "hsr", pytest.param("pr2", marks=pytest.mark.long))
FORWARD = {
    "pr2": {"pr2/base/x:velocity": 1.0},
    "hsr": {"hsr/base/x:velocity": 1.0},
    "fetch": {"fetch/l_wheel_joint:velocity": 1 / 0.06, "fetch/r_wheel_joint:velocity": 1 / 0.06},
}
FLAT = {"hsr/arm_flex_joint": -math.pi / 2, "hsr/arm_lift_joint": 0.3}
"""The hand of the HSR points forwards."""
OVEN, DISHWASHER, FRIDGE = (f"kitchen/{name}_door" for name in ("oven", "dishwasher", "fridge"))


@cache
def gripper(robot: str) -> Gripper:
    return find_gripper(kv.load(robot), robot)


@cache
def kitchen_world(robot: str) -> MujocoWorld:
    model = kv.load("kitchen")
    model.include(robot)
    return MujocoWorld(model, robot, gripper(robot))


def cube(mass: float, size: tuple[float, float, float]) -> Body:
    moment = mass * max(size) ** 2 / 6
    return Body(collisions=(Shape(Box(size)),), inertia=Inertia(mass, (moment, 0, 0, moment, 0, moment)))


def world_with_bar(robot: str = "fetch", **options: Any) -> MujocoWorld:
    """Return a world with a bar in the open hand, which slides to and from it."""
    model, hand = kv.load(robot), gripper(robot)
    start = model.default_state() | hand.opened | (FLAT if robot == "hsr" else {})
    place = np.asarray(model.fk(hand.hand)(start)) @ hand.grasp_pose
    with model.edit() as edit:
        edit.add_frame("thing", parent="world", transform=place)
        edit.apply(kv.Prismatic(name="thing/way", parent="thing", child="thing/bar", lower=-0.5, upper=0.5))
        edit.apply(SetBody("thing/bar", cube(1.0, (0.02, 0.02, 0.2))))
    world = MujocoWorld(model, robot, hand, **options)
    world.reset(start)
    return world


def closing(robot: str, speed: float = 0.05) -> dict[str, float]:
    hand = gripper(robot)
    return {str(q.derivative()): math.copysign(speed, hand.closed[q] - hand.opened[q]) for q in hand.joints}


def finger_forces(world: MujocoWorld) -> list[float]:
    return [c.force for c in world.contacts() if c.b == "thing/bar"]


def joint_speeds(world: MujocoWorld) -> Array:
    """Return how fast the robot's coordinates move, from two states."""
    before = world.state
    world.apply({}, 0.002)
    names = [s for s in before if world.robot.moves(s)]
    return (world.state.vector(names) - before.vector(names)) / 0.002


@pytest.mark.parametrize("robot", ON_WHEELS)
def test_gravity_moves_neither_robot_nor_doors(robot: str) -> None:
    world = kitchen_world(robot)
    ajar = {OVEN: 0.4, DISHWASHER: 0.9}
    world.reset(world.model.default_state() | ajar)
    before = world.state
    checked: SimulatedWorld = world
    checked.apply({}, 1.5)
    after = checked.state
    moved = {str(s): abs(after[s] - before[s]) for s in before if abs(after[s] - before[s]) > 1e-5}
    assert set(moved) <= {OVEN, DISHWASHER}
    assert all(x < 1e-3 for x in moved.values())
    assert after.stamp == checked.time == pytest.approx(1.5)
    assert checked.contacts() == ()
    assert checked.held is None


@pytest.mark.parametrize("robot", ON_WHEELS)
def test_robot_moves_as_the_model_integrates(robot: str) -> None:
    world = kitchen_world(robot)
    model = world.model
    start = {s: model.default_state()[s] for s in model.degrees_of_freedom if s.path.startswith(robot)}
    for symbol in start:
        lower, upper = model.limits(symbol)
        if math.isfinite(upper - lower):
            start[symbol] = lower + 0.4 * (upper - lower)
    world.reset(model.default_state() | start)
    random = np.random.default_rng(1)
    fingers = {str(s) for s in closing(robot)}
    own = [v for v in model.speeds if v.path.startswith(robot) and str(v) not in fingers]
    speeds = {v: float(random.uniform(-0.1, 0.1)) for v in own}
    if robot == "fetch":
        speeds |= {"fetch/l_wheel_joint:velocity": 1.0, "fetch/r_wheel_joint:velocity": 4.0}
        speeds = {str(v): x for v, x in speeds.items()}
    world.apply(speeds, 0.2)
    before = world.state
    for _ in range(20):
        world.apply(speeds, 0.02)
    expected = model.integrate(before, speeds, 0.4)
    off = {str(s): world.state[s] - expected[s] for s in start}
    assert max(map(abs, off.values())) < 2e-3, off
    assert world.contacts() == ()
    if robot == "fetch":  # an arc, without a sideways slip: the chord has the direction of its middle
        x, y, angle = (
            world.state[f"fetch/base/{c}"] - before[f"fetch/base/{c}"] for c in ("x", "y", "angle")
        )
        assert angle == pytest.approx(0.4 * 3 * 0.06 / 0.3748, rel=0.02)
        assert math.remainder(math.atan2(y, x) - before["fetch/base/angle"] - angle / 2, math.tau) == (
            pytest.approx(0, abs=2e-3)
        )


@pytest.mark.parametrize(
    ("base", "speeds", "seconds", "least", "most"),
    [
        ((-0.6, -1.6), {v: 0.15 * x for v, x in FORWARD["fetch"].items()}, 4.5, -1e-3, 0.1),
        ((-0.1, -1.25), {"fetch/shoulder_pan_joint:velocity": -0.4}, 1.5, 1.2, math.pi / 2),
    ],
)
def test_arm_that_sweeps_past_a_door_shuts_or_opens_it(
    base: tuple[float, float], speeds: dict[str, float], seconds: float, least: float, most: float
) -> None:
    world = kitchen_world("fetch")
    start = {FRIDGE: 0.8, "fetch/torso_lift_joint": 0.2, "fetch/base/x": base[0], "fetch/base/y": base[1]}
    world.reset(world.model.default_state() | start)
    assert world.contacts() == ()
    before, touched, peaks = world.state, [], []
    for _ in range(round(seconds / 0.01)):
        shut = world.state[FRIDGE] < 0.05
        world.apply({} if shut else speeds, 0.01)
        touched += world.contacts()
        peaks.append(world.peak_force)
    assert least < world.state[FRIDGE] < most
    assert touched
    assert all(c.a.startswith("fetch/") and "fridge_door" in c.b for c in touched)
    assert all(c.distance < 5e-3 and abs(np.linalg.norm(c.normal) - 1) < 1e-9 for c in touched)
    assert 0 < max(c.force for c in touched) < 500
    assert max(peaks) > 0.5 * max(c.force for c in touched)  # without friction, but in all steps
    others = [s for s in before if s.path.startswith("kitchen/") and str(s) != FRIDGE]
    assert np.abs(world.state.vector(others) - before.vector(others)).max() < 1e-3


@pytest.mark.parametrize("robot", HANDS)
def test_fingers_hold_a_bar_with_the_stated_force_until_they_open(robot: str) -> None:
    world = world_with_bar(robot, grip=40.0)
    forward = {v: -0.1 * x for v, x in FORWARD[robot].items()}
    close = closing(robot, 0.5 if robot == "hsr" else 0.05)
    for _ in range(300):
        world.apply(close, 0.01)
        if world.held is not None:
            break
    assert world.held == "thing/bar"
    world.apply(close, 0.3)
    assert finger_forces(world) == pytest.approx([40.0, 40.0], rel=0.02)
    for quiet in ({}, dict.fromkeys(close, 0.0)):  # neither silence nor a speed of zero lets go
        world.apply(quiet, 0.3)
        assert finger_forces(world) == pytest.approx([40.0, 40.0], rel=0.02)
    before = world.state
    for _ in range(5):
        world.apply(forward, 0.1)
    assert world.state["thing/way"] - before["thing/way"] == pytest.approx(-0.05, abs=2e-3)
    assert world.held == "thing/bar"
    world.apply({v: -x for v, x in close.items()}, 0.2)
    assert world.held is None
    assert finger_forces(world) == []
    assert sum(world.state[q] for q in gripper(robot).joints) > sum(before[q] for q in gripper(robot).joints)


def test_held_bar_does_not_creep_under_a_force() -> None:
    world = world_with_bar(door_friction={"thing/way": 20.0})
    world.apply(closing("fetch"), 1.2)
    place = world.model.fk("thing/bar", gripper("fetch").hand)
    back = {v: -0.1 * x for v, x in FORWARD["fetch"].items()}
    world.apply(back, 0.5)
    before, way = place(world.state)[:3, 3], world.state["thing/way"]
    world.apply(back, 2.0)
    assert world.state["thing/way"] - way == pytest.approx(-0.2, abs=1e-3)
    np.testing.assert_allclose(place(world.state)[:3, 3], before, atol=1e-4)


def test_tie_holds_what_friction_does_not_and_is_told() -> None:
    ways = {}
    for grasp in ("friction", "tie"):
        world = world_with_bar(grasp=grasp, friction=0.05, door_friction={"thing/way": 20.0})
        world.apply(closing("fetch"), 1.2)
        assert world.held == "thing/bar"
        for _ in range(5):
            world.apply({v: -0.1 * x for v, x in FORWARD["fetch"].items()}, 0.1)
        ways[grasp] = world.state["thing/way"]
        assert any("welded" in remark for remark in world.remarks) == (grasp == "tie")
        world.apply({v: -x for v, x in closing("fetch").items()}, 0.3)
        assert world.held is None
    assert ways["tie"] == pytest.approx(-0.05, abs=3e-3)
    assert abs(ways["friction"]) < 0.01


@pytest.mark.parametrize("robot", ROBOTS)
def test_robot_stops_within_100_ms_without_commands(robot: str) -> None:
    world = kitchen_world(robot)
    model, fingers = world.model, closing(robot)
    arm = [s for s in model.degrees_of_freedom if s.path.startswith(robot) and "base" not in s.path]
    start, speeds = {}, {v: 0.2 * x for v, x in FORWARD[robot].items()}
    for symbol in arm:
        lower, upper = model.limits(symbol)
        start[symbol] = lower + 0.4 * (upper - lower) if math.isfinite(upper - lower) else 0.0
        if str(symbol.derivative()) not in {*fingers, *speeds}:
            speeds[str(symbol.derivative())] = min(0.2, 0.5 * model.limits(symbol.derivative())[1])
    for silence in ("empty", "stamp"):
        world.reset(world.model.default_state() | start)
        world.apply(speeds, 0.1)
        assert np.abs(joint_speeds(world)).max() > 0.15
        world.apply(speeds, 0.1)
        if silence == "empty":
            world.apply({}, 0.098)
        else:  # one command that is not followed by another: its stamp gets old
            world.apply(speeds, 0.1, stamp=world.time)
        assert np.abs(joint_speeds(world)).max() < 0.05


def test_stale_commands_are_refused() -> None:
    world = kitchen_world("pr2")
    speeds = {"pr2/base/x:velocity": 0.2}
    for age, refused in ((0.03, 0), (0.05, 1), (-0.01, 1)):
        world.reset(world.model.default_state())
        world.apply({}, 0.2)
        world.apply(speeds, 0.02, stamp=world.time - age)
        assert world.refused == refused
        assert (world.state["pr2/base/x"] > 1e-4) == (not refused)


def test_fingers_stop_once_no_command_has_come_for_the_time_out_but_hold_what_they_press() -> None:
    world, hand = world_with_bar(grip=40.0), gripper("fetch")
    close, finger = closing("fetch"), hand.joints[0]
    world.apply(close, 0.1, stamp=0.0)  # nothing follows: it acts for the time-out of 40 ms
    after = world.state[finger]
    assert 0.5 * 0.05 * 0.04 < abs(after - hand.opened[finger]) < 1.5 * 0.05 * 0.04
    for _ in range(10):
        world.apply(close, 0.05, stamp=world.time - 1.0)
        world.apply({}, 0.05)
    assert world.refused == 10
    assert world.state[finger] == pytest.approx(after, abs=1e-4)
    assert world.held is None
    world.apply(close, 1.2)
    assert world.held == "thing/bar"
    for _ in range(5):
        world.apply(close, 0.1, stamp=world.time - 1.0)
    assert finger_forces(world) == pytest.approx([40.0, 40.0], rel=0.02)


def test_delay_postpones_commands() -> None:
    model = kv.load("fetch")
    world = MujocoWorld(model, "fetch", gripper("fetch"), delay=0.05, sensors=Sensors(rate=100.0))
    speed = {"fetch/torso_lift_joint:velocity": 0.1}
    world.reset(model.default_state() | {"fetch/torso_lift_joint": 0.1})
    torso = []
    for _ in range(30):
        torso.append(world.observe().joints[model.symbol("fetch/torso_lift_joint")])
        world.apply(speed if world.time < 0.095 else {}, 0.01, stamp=world.time)
    assert max(torso[:6]) < 0.1 + 1e-6 < torso[8]
    assert torso[-1] == pytest.approx(0.11, abs=5e-4)  # it acts as long as it was sent


def test_friction_of_a_coordinate_holds_up_to_its_force() -> None:
    # A mass of 2 kg on a slope of 30 degrees: gravity pulls with 9.81 N.
    slope = kv.translation(2, 0, 1) @ kv.rpy(0, math.pi / 6, 0)
    for friction, slides in ((9.0, True), (10.5, False)):
        model = kv.load("fetch")
        with model.edit() as edit:
            edit.apply(kv.Prismatic(name="box", parent="world", child="box", origin=slope, lower=-9, upper=9))
            edit.apply(SetBody("box", cube(2.0, (0.1, 0.1, 0.1))))
        world = MujocoWorld(model, "fetch", gripper("fetch"), door_friction={"box": friction})
        world.apply({}, 1.0)
        assert (world.state["box"] > 0.01) == slides
        if not slides:
            assert world.state["box"] < 1e-4


def test_loops_move_as_the_model_says() -> None:
    """A four-bar is tied by equalities, a folding door by a polynomial in place of its curve."""
    for name, coordinate, tolerance in (
        ("four_bar", "four_bar/crank", 1e-4),
        ("folding_door", "folding_door/door", 2e-3),
    ):
        model = kv.load(f"articulations/{name}")
        model.include("fetch")
        world = MujocoWorld(model, name)
        world.reset(model.default_state() | {"fetch/base/x": -3.0})
        for _ in range(10):
            world.apply({f"{coordinate}:velocity": 0.5}, 0.1)
            state = world.state
            for frame in (f for f in model.frames if f.startswith(name)):
                expected = np.asarray(model.fk(frame)(state))
                assert np.abs(expected - simulated_pose(world, frame)).max() < tolerance
        assert state[coordinate] == pytest.approx(0.5, abs=0.05)


def simulated_pose(world: MujocoWorld, frame: str) -> Array:
    data, engine = world._data, mujoco
    engine.mj_kinematics(world._compiled, data)
    body, pose = data.body(frame), np.eye(4)
    pose[:3, :3], pose[:3, 3] = body.xmat.reshape(3, 3), body.xpos
    return pose


def test_spring_that_tips_shuts_the_folding_door_or_opens_it() -> None:
    model = kv.load("articulations/folding_door")
    model.include("fetch")
    world = MujocoWorld(model, "fetch", gripper("fetch"))
    for start, end in ((0.3, 0.0), (0.6, 0.6), (1.0, 1.84)):
        world.reset(model.default_state() | {"folding_door/door": start, "fetch/base/x": -2.0})
        world.apply({}, 1.5)
        assert world.state["folding_door/door"] == pytest.approx(end, abs=0.02)


def test_free_and_turned_bodies_keep_their_state() -> None:
    model = kv.load("hsr")
    with model.edit() as edit:
        place = kv.translation(1, 2, 3) @ kv.rpy(0.3, -0.2, 1.0)
        edit.apply(kv.Floating(name="ball", parent="world", child="ball", origin=place))
        edit.apply(SetBody("ball", cube(1.0, (0.1, 0.1, 0.1))))
        edit.apply(kv.articulations.Ball(name="globe", parent="world", child="globe", origin=place))
        edit.apply(kv.Prismatic(name="ghost", parent="world", child="ghost", lower=0, upper=1))
        edit.apply(SetBody("globe", Body(collisions=cube(1.0, (0.1, 0.2, 0.1)).collisions)))
    world = MujocoWorld(model, "hsr", gripper("hsr"))
    state = model.default_state() | {"ball/x": 0.4, "ball/qx": 0.6, "ball/qw": 0.8}
    state |= {"globe/qz": -0.6, "globe/qw": 0.8, "hsr/arm_lift_joint": 0.2}
    world.reset(state)
    assert {str(s): world.state[s] for s in state} == pytest.approx(
        {str(s): x for s, x in state.items()}, abs=1e-12
    )
    for frame in ("ball", "globe", "hsr/hand_palm_link", "hsr/hand_l_distal_link"):
        assert np.abs(np.asarray(model.fk(frame)(state)) - simulated_pose(world, frame)).max() < 1e-9
    world.apply({}, 0.1)
    fall = model.fk("ball")(state)[2, 3] - model.fk("ball")(world.state)[2, 3]
    assert fall == pytest.approx(9.81 * 0.1**2 / 2, rel=0.05)
    assert "nothing can touch ghost: without collision shapes" in world.remarks
    assert any("globe" in remark and "no inertia" in remark for remark in world.remarks)


def test_bodies_without_collision_shapes_touch_with_what_is_seen_of_them() -> None:
    """The collision scene of a controller has these shapes, too."""
    model, ball = kv.load("hsr"), cube(1.0, (0.1, 0.1, 0.1))
    with model.edit() as edit:
        edit.apply(kv.Prismatic(name="seen", parent="world", child="seen", axis=(1, 0, 0), lower=0, upper=1))
        edit.apply(SetBody("seen", Body(visuals=ball.collisions, inertia=ball.inertia)))
    world = MujocoWorld(model, "hsr", gripper("hsr"), floor=False)
    assert not any("nothing can touch" in remark for remark in world.remarks)
    # The floor, which the model does not have, is not held by fingers that press it.
    assert world._drive is not None
    world._drive.pressed = lambda data: "floor"  # type: ignore[method-assign]
    assert world.held is None
    world._drive.pressed = lambda data: "seen"  # type: ignore[method-assign]
    assert world.held == "seen"


@pytest.mark.parametrize(("lowest", "floor"), [(0.0, True), (0.0, False), (-0.3, True)])
def test_a_box_falls_to_the_floor_unless_furniture_reaches_below_it(lowest: float, floor: bool) -> None:
    model = kv.load("fetch")
    with model.edit() as edit:
        edit.apply(kv.Floating(name="box", parent="world", child="box", origin=kv.translation(2, 0, 0.05)))
        edit.apply(SetBody("box", cube(1.0, (0.1, 0.1, 0.1))))
        place = kv.translation(3, 0, 0.2)
        edit.apply(
            kv.Prismatic(
                name="lift", parent="world", child="lift", origin=place, axis=(0, 0, 1), lower=lowest, upper=1
            )
        )
        edit.apply(SetBody("lift", cube(1.0, (0.1, 0.1, 0.1))))
    world = MujocoWorld(model, "fetch", gripper("fetch"), floor=floor)
    world.apply({}, 0.6)
    rests = floor and lowest == 0.0
    assert world.state["box/z"] == pytest.approx(0.0 if rests else -9.81 * 0.6**2 / 2, abs=0.03)
    assert any("lift reaches below z = 0" in remark for remark in world.remarks) == (lowest < 0.0)
    # Wheels that stand on it do not rub.
    assert not any("fetch" in contact.a for contact in world.contacts())


def test_remarks_tell_what_was_added_and_left_out() -> None:
    world = kitchen_world("pr2")
    text = "\n".join(world.remarks)
    for part in (
        "'pr2/base/speed' is left out",
        "gravity does not act on 'pr2'",
        "there is a floor at z = 0; these stand on it, without contact: pr2/base_link",
        "servos of bandwidth 80/s drive 21 coordinates",
        "no effort is stated; servos have [N], [N m]: pr2/base/angle",
        "friction 1 N m and damping 1 N m s are assumed, as the model states none: kitchen/fridge_door",
        "friction 3 N and damping 5 N s/m are assumed",
        "closes with 50 N for each finger by pr2/r_gripper_joint",
        "contacts have friction 1",
    ):
        assert part in text
    assert OVEN not in text  # it has its own friction
    asked = MujocoWorld(
        world.model, "pr2", gripper("pr2"), leave_out=["pr2/base/speed"], door_friction={FRIDGE: 60.0}
    )
    assert f"'{FRIDGE}' has the friction 60, as asked for" in asked.remarks
    assert "'pr2/base/speed' is left out, as asked for" in asked.remarks


@pytest.mark.parametrize(
    ("path", "still"),
    [
        ("fetch/fetch_description/robots/fetch.urdf", 1e-4),
        pytest.param("pr2/pr2_description/robots/pr2.urdf", 1e-4, marks=pytest.mark.long),
        pytest.param("hsrb/hsrb_description/robots/hsrb4s.urdf", 1e-4, marks=pytest.mark.long),
    ],
)
def test_descriptions_of_others_stand_still(path: str, still: float, published: Callable[..., Path]) -> None:
    world = MujocoWorld(kv.load(published(path), prefix="robot"), "robot")
    before = world.state
    world.apply({}, 0.5)
    assert max(abs(world.state[s] - before[s]) for s in before) < still
    assert world.contacts() == ()


def test_wrong_arguments_are_refused() -> None:
    model, hand = kv.load("fetch"), gripper("fetch")
    for options, words in (
        ({"step": 0.0}, "'step' of a world is a positive number"),
        ({"grip": -1.0}, "'grip'"),
        ({"press": 0.0}, "'press'"),
        ({"timeout": math.nan}, "'timeout'"),
        ({"delay": -0.1}, "'delay'"),
        ({"grasp": "glue"}, "'friction' or 'tie', not 'glue'"),
        ({"door_friction": {"fetch/torso_lift_joint": 1.0}}, "No furniture moves by"),
        ({"leave_out": ["fetch/bas"]}, "Did you mean 'fetch/base'"),
    ):
        with pytest.raises((InvalidValueError, UnknownNameError), match=words):
            MujocoWorld(model, "fetch", hand, **options)
    with pytest.raises(UnknownNameError, match=r"no robot 'fetsch'.*Did you mean 'fetch'"):
        MujocoWorld(model, "fetsch", hand)
    world = world_with_bar()
    with pytest.raises(UnknownNameError, match=r"no free speed 'fetch/torso_lift'.*torso_lift_joint"):
        world.apply({"fetch/torso_lift": 0.1}, 0.1)
    for value in (math.nan, math.inf):
        with pytest.raises(InvalidValueError, match="must be finite"):
            world.apply({"fetch/torso_lift_joint:velocity": value}, 0.1)
    for duration in (0.0, -1.0, math.nan):
        with pytest.raises(InvalidValueError, match="positive number of seconds"):
            world.apply({}, duration)
    with pytest.raises(InvalidValueError, match="stamp"):
        world.apply({}, 0.1, stamp=math.nan)
    with pytest.raises(UnknownNameError, match="thing/wai"):
        world.reset({"thing/wai": 0.1})
    assert world.time == 0.0
    world.apply({"thing/way:velocity": 1.0}, 0.1)  # speeds of furniture are not read
    assert abs(world.state["thing/way"]) < 1e-6
