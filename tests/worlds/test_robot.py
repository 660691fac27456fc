"""Robots in models: what of them moves, stands, grasps and sees; and worlds that hide the truth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pusher import pusher

import kineverse as kv
from cupboards import cupboard
from kineverse.articulations import OmniBase
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.formats.srdf import parse_srdf
from kineverse.model.model import Model
from kineverse.worlds import KinematicWorld, MechanismWorld, Robot
from robot_interface_proxy import NAMES, InterfaceOnly

HANDS = {
    "pr2": ("pr2/r_gripper_palm_link", "pr2/l_gripper_palm_link"),
    "hsr": ("hsr/hand_palm_link",),
    "fetch": ("fetch/gripper_link",),
}


@pytest.fixture(scope="module", params=HANDS)
def robot(request: pytest.FixtureRequest) -> Robot:
    model = kv.load(request.param)
    model.include("kitchen", prefix="kitchen")
    return Robot.of(model, request.param)


def test_shipped_robots_have_what_skills_need(robot: Robot) -> None:
    name, model = robot.name, robot.model
    base = robot.base
    assert base is not None
    assert (base.parent, base.child, base.is_planar) == ("world", f"{name}/base", True)
    assert [str(s) for s in base.coordinates] == [f"{name}/base/{key}" for key in ("x", "y", "angle")]
    assert robot.planar_base == base.coordinates
    assert tuple(gripper.hand for gripper in robot.grippers) == HANDS[name]
    assert robot.gripper() is robot.grippers[0]
    assert robot.gripper(HANDS[name][-1]) is robot.grippers[-1]
    assert robot.camera == f"{name}/head_tilt_link"
    own = [frame for frame in model.frames if frame.split("/")[0] == name]
    assert [*robot.frames] == own
    assert set(robot.bodies) == {frame for frame in own if frame in model.bodies}
    assert [*robot.coordinates] == [s for s in model.degrees_of_freedom if str(s).startswith(f"{name}/")]
    assert [*robot.speeds] == [v for v in model.speeds if str(v).startswith(f"{name}/")]
    assert robot.owns(f"{name}/base")
    assert not robot.owns("kitchen/fridge")
    assert not robot.moves(model.symbol("kitchen/fridge_door"))
    assert robot.moves(kv.velocity(f"{name}/unknown"))


def test_markers_are_articulated_objects_and_what_carries_them(robot: Robot) -> None:
    kitchen = robot.model
    moved = {frame for frame in kitchen.bodies if kitchen.symbols_of(frame) and not robot.owns(frame)}
    carriers = {
        one.parent
        for one in kitchen.articulations.values()
        if one.child.startswith("kitchen/") and one.parent in kitchen.bodies
    }
    assert set(robot.markers) == moved | carriers
    assert {"kitchen/fridge", "kitchen/fridge_door", "kitchen/fridge_door_handle"} <= set(robot.markers)
    assert not {"kitchen/wall", "kitchen/hood", "kitchen/stools"} & set(robot.markers)


def test_a_robot_is_made_once_for_each_version_of_its_model() -> None:
    model = pusher()
    first = Robot.of(model, "robot")
    assert Robot.of(model, "robot") is Robot.of(model, first) is first
    assert first.base is None  # it floats by a frame of its own, which is no joint
    with model.edit() as edit:
        edit.add_frame("robot/camera", "robot/ball", kv.translation(kv.position("robot/zoom"), 0, 0))
    second = Robot.of(model, first)
    assert (first.camera, second.camera) == (None, "robot/camera")
    assert {*second.coordinates} - {*first.coordinates} == {model.symbol("robot/zoom")}
    other = pusher()
    assert Robot.of(other, first).model is other


def test_prefix_without_a_robot_is_refused_with_those_that_move() -> None:
    model = cupboard()
    for name in ("robto", "wall"):
        with pytest.raises(UnknownNameError, match=rf"no robot '{name}'.*robot"):
            Robot.of(model, name)
    with pytest.raises(UnknownNameError, match="no robot ''"):
        Robot.of(Model(), "")
    with pytest.raises(InvalidValueError, match="prefix of its names"):
        Robot.of(model, None)  # type: ignore[arg-type]


def test_end_effectors_of_a_semantic_description_come_first() -> None:
    model = kv.load("pr2")
    srdf = parse_srdf(
        '<robot name="pr2"><group name="left"><link name="l_gripper_l_finger_link"/></group>'
        '<end_effector name="left" parent_link="l_wrist_roll_link" group="left"/></robot>',
        model,
        "pr2",
    )
    robot = Robot.of(model, "pr2", srdf=srdf)
    assert robot.grippers[0].hand == robot.gripper().hand == "pr2/l_gripper_palm_link"
    assert Robot.of(model, "pr2").grippers[0].hand == "pr2/r_gripper_palm_link"
    # A world takes the robot with its description, and another version keeps it.
    world = KinematicWorld(model, robot)
    assert world.robot is robot
    assert any("'pr2/l_gripper_palm_link' holds things" in remark for remark in world.remarks)
    model.include("kitchen", prefix="kitchen")
    assert Robot.of(model, robot).gripper().hand == "pr2/l_gripper_palm_link"


def test_a_model_may_be_the_robot() -> None:
    model = Model()
    with model.edit() as edit:
        edit.apply(OmniBase(name="base", parent="world", child="base"))
        edit.add_frame("head", "base", kv.rotation_z(kv.position("pan")))
    robot = Robot.of(model, "")
    assert robot.frames == tuple(model.frames)
    assert robot.coordinates == model.degrees_of_freedom
    assert (robot.camera, robot.markers, robot.grippers) == ("head", (), ())
    assert [s.path for s in robot.planar_base] == ["base/x", "base/y", "base/angle"]
    with pytest.raises(UnknownNameError, match="no gripper"):
        robot.gripper()


def test_a_mechanism_is_driven_and_has_no_robot() -> None:
    model = kv.load("lockboxes/thesis")
    robot = MechanismWorld(model).robot
    assert robot is Robot.of_mechanism(model) is Robot.of(model, robot)
    assert (robot.coordinates, robot.speeds) == (tuple(model.degrees_of_freedom), tuple(model.speeds))
    assert robot.is_mechanism
    assert (robot.frames, robot.bodies, robot.grippers, robot.base, robot.camera) == ((), (), (), None, None)
    assert not any(robot.owns(frame) for frame in model.frames)


def test_a_base_is_planar_if_it_slides_and_turns_in_a_plane() -> None:
    model, rail = Model(), Model()
    leaning = kv.translation(1, 0, 2) @ kv.rotation_x(0.3)
    with model.edit() as edit:
        edit.add_frame("stand", "world", kv.translation(1, 0, 0))
        edit.apply(OmniBase(name="robot/base", parent="stand", child="robot/base", origin=leaning))
    base = Robot.of(model, "robot").base
    assert base is not None
    assert (base.parent, base.child, base.is_planar, len(base.coordinates)) == (
        "stand",
        "robot/base",
        True,
        3,
    )
    with rail.edit() as edit:
        edit.apply(kv.Prismatic(name="robot/rail", parent="world", child="robot/base", lower=0, upper=1))
    robot = Robot.of(rail, "robot")
    assert robot.base is not None
    assert (robot.base.coordinates, robot.planar_base) == ((kv.position("robot/rail"),), ())


def test_interface_hides_the_truth_of_a_world() -> None:
    world = KinematicWorld(pusher(), "robot")
    interface = InterfaceOnly(world)
    assert {"name", "model", "robot", "remarks", "timeout", "time", "apply", "observe"} == NAMES
    interface.apply({"robot/x:velocity": 0.5}, 0.1, stamp=interface.time)
    assert interface.observe().joints[kv.position("robot/x")] == pytest.approx(0.05)
    assert (interface.name, interface.time, interface.robot.name) == ("kinematic", 0.1, "robot")
    for name in ("state", "reset", "held", "contacts", "peak_force", "events", "refused", "_world", "_state"):
        with pytest.raises(AssertionError, match=f"'{name}' is not in the interface"):
            getattr(interface, name)
    with pytest.raises(AssertionError, match="set by nobody"):
        interface.timeout = math.inf
    assert np.isnan(world.peak_force)
