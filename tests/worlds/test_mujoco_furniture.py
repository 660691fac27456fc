"""Furniture in the world with physics: it collides with all other furniture, and nothing is blown up."""

from __future__ import annotations

import math

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import SimulationError
from kineverse.geometry import Rule, Scene
from kineverse.geometry.collision_filter import RULES, rules_as_data
from kineverse.manipulation import SkillError
from kineverse.manipulation.session import Session
from kineverse.model.basic_operations import SetBody
from kineverse.model.body import Body, Box, Inertia, Pose, Shape
from kineverse.worlds import MujocoWorld, TrueBelief
from robot_interface_proxy import InterfaceOnly

pytest.importorskip("mujoco")

EFFORT = 60.0


def solid(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]], mass: float = 0.0) -> Body:
    """Return boxes by size and place, whose centre of mass is at the origin of their frame."""
    shapes = tuple(Shape(Box(size), Pose.from_matrix(np.array(kv.translation(*at)()))) for size, at in boxes)
    return Body(collisions=shapes, inertia=Inertia(mass, (0.4, 0, 0, 0.4, 0, 0.4)) if mass else None)


def room(*, limited: bool = True, sunk: float = 0.0) -> kv.Model:
    """A block that moves in x before a door of 60 cm, which opens away from it about z, and a post behind.

    The centre of mass of the door lies on its hinge, as where a description states none. The frame of the
    door lies behind it, and reaches into it by some way.
    """
    model = kv.Model()
    frame = solid(((0.3, 0.04, 0.6), (0.16, -0.03, 1.0)), ((0.1, 0.02, 0.1), (sunk - 0.06, 0.02, 1.0)))
    limits = {"lower": -1.5, "upper": 1.5} if limited else {}
    door = kv.Revolute if limited else kv.articulations.Continuous
    with model.edit() as edit:
        edit.apply(
            kv.Prismatic(
                name="robot/x", parent="world", child="robot/block", lower=-1, upper=2, velocity=0.5,
                origin=kv.translation(-0.3, 0.5, 1.0), dynamics=(("effort", EFFORT),),
            )
        )  # fmt: skip
        edit.apply(SetBody("robot/block", solid(((0.1, 0.1, 0.1), (0, 0, 0)), mass=20.0)))
        edit.add_frame("room/frame", "world", np.eye(4), frame)
        at = kv.translation(0, 0, 1.0)
        edit.apply(
            door(
                name="room/door",
                parent="room/frame",
                child="room/panel",
                axis=(0, 0, -1),
                origin=at,
                **limits,
            )
        )
        edit.apply(SetBody("room/panel", solid(((0.02, 0.6, 0.5), (0, 0.3, 0)), mass=8.0)))
        edit.add_frame("room/post", "world", np.eye(4), solid(((0.06, 0.06, 1.0), (0.2, 0.3, 1.0))))
    return model


def depth(world: MujocoWorld, one: str, other: str) -> float:
    """Return the depth of two bodies at the state of a world [m]."""
    scene = Scene(world.model)
    scene.update(world.state)
    return -scene.distance(one, other).distance


def test_a_door_pressed_against_a_post_stops_there_and_does_not_blow_up():
    world = MujocoWorld(room(), "robot")
    forces, depths = [], []
    for _ in range(150):
        world.apply({"robot/x:velocity": 0.3}, 0.02)
        forces.append(world.peak_force)
        depths.append(depth(world, "room/panel", "room/post"))
    assert 0.3 < world.state["room/door"] < 0.7
    # The block of 20 kg hits with 0.3 m/s, and then presses with its effort.
    assert max(forces) == pytest.approx(850.0, rel=0.1)
    assert max(forces[-50:]) == pytest.approx(EFFORT, rel=0.3)
    assert max(depths) < 2e-3
    assert 0.0 < max(depths[-50:]) < 5e-4


def heavy(kind: str) -> tuple[kv.Model, dict[str, float]]:
    """A strong robot before a wall, and its speeds towards it.

    A slide of 200 kg; a base of 100 kg before an oblique wall, which both of its axes meet; a head on a lever of 1 m.
    """
    model = kv.Model()
    at, turn = kv.translation(0.3, 0.0, 0.5), kv.rotation_z(math.pi / 4)
    frames = {"parent": "world", "child": "robot/block"}
    joint = {**frames, "lower": -1, "upper": 2, "dynamics": (("effort", 1000.0),)}
    with model.edit() as edit:
        if kind == "slide":
            edit.apply(kv.Prismatic(name="robot/x", **joint))
            speeds = {"robot/x:velocity": 0.3}
        elif kind == "base":
            edit.apply(kv.articulations.OmniBase(name="robot/base", **frames))
            at, speeds = turn @ at, {"robot/base/x:velocity": 0.2, "robot/base/y:velocity": 0.2}
        else:
            edit.apply(kv.Revolute(name="robot/q", axis=(0, 0, 1), **joint))
            at, speeds = kv.translation(0.95, 0.35, 0.5), {"robot/q:velocity": 0.3}
        centre, mass = (0.95 if kind == "hinge" else 0.0, 0, 0.5), 100.0 if kind == "base" else 200.0
        edit.apply(SetBody("robot/block", solid(((0.1, 0.1, 0.1), centre), mass=mass)))
        edit.add_frame("room/wall", "world", at, solid(((0.1, 0.5, 0.5), (0, 0, 0))))
    return model, speeds


@pytest.mark.parametrize("kind", ["slide", "base", "hinge"])
def test_what_stops_a_robot_is_pressed_with_the_stated_force(kind: str) -> None:
    """At rest, however strong its servos are; and the robot leaves at once, since nothing has wound up."""
    model, speeds = heavy(kind)
    for press in (100.0, 40.0):
        world, forces = MujocoWorld(model, "robot", press=press, friction=0.3, floor=False), []
        for _ in range(120):
            world.apply(speeds, 0.02)
            forces.append(world.peak_force)
        assert max(world._servos.efforts.values()) > 3 * press
        assert np.median(forces[-50:]) == pytest.approx(press, rel=0.2)
        stopped = world.state
        world.apply({name: -speed for name, speed in speeds.items()}, 0.3)
        assert world.contacts() == ()
        for name, speed in speeds.items():
            symbol = model.symbol(name.removesuffix(":velocity"))
            assert world.state[symbol] < stopped[symbol] - 0.5 * 0.3 * speed


def test_a_light_wrist_turns_a_lever_against_its_spring():
    """1.5 N m at 0.5 rad, by a joint that moves as much as 50 g at 10 cm."""
    model = kv.Model()
    joint = {"parent": "world", "axis": (0, 0, 1), "lower": -0.2, "upper": 1.0}
    effort, spring = (("effort", 10.0),), (("spring_stiffness", 3.0), ("spring_reference", 0.0))
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="robot/q", child="robot/tip", velocity=1.0, dynamics=effort, **joint))
        light = Inertia(0.05, (5e-4, 0, 0, 5e-4, 0, 5e-4))
        shapes = solid(((0.02, 0.02, 0.02), (0.1, 0, 0))).collisions
        edit.apply(SetBody("robot/tip", Body(collisions=shapes, inertia=light)))
        edit.apply(kv.Revolute(name="room/lever", child="room/lever", dynamics=spring, **joint))
        edit.apply(SetBody("room/lever", solid(((0.1, 0.02, 0.02), (0.08, 0.021, 0)), mass=0.1)))
    world = MujocoWorld(model, "robot", floor=False)
    for _ in range(100):
        world.apply({"robot/q:velocity": 0.5}, 0.01)
    assert world.state["room/lever"] == pytest.approx(0.5, abs=0.05)
    assert world.state["robot/q"] == pytest.approx(0.5, abs=0.05)


def test_a_door_without_limits_does_not_turn_through_its_frame():
    for model, stops in ((room(limited=False), True), (room(limited=False, sunk=0.05), True)):
        world = MujocoWorld(model, "robot", door_friction={"room/door": 0.0})
        world.reset({"room/door": 1.3, "robot/x": -0.5})
        world._data.joint("room/door").qvel[:] = 2.0
        world.apply({}, 1.0)
        assert (world.state["room/door"] < 1.7) == stops
        assert depth(world, "room/panel", "room/frame") < 0.051
    with model.edit() as edit:
        edit.write(RULES, rules_as_data([Rule("room/panel", "room/frame", False, "never mind")]))
    world = MujocoWorld(model, "robot", door_friction={"room/door": 0.0})
    world.reset({"room/door": 1.3, "robot/x": -0.5})
    world._data.joint("room/door").qvel[:] = 2.0
    world.apply({}, 1.0)
    assert world.state["room/door"] > 1.7


def test_speeds_and_forces_beyond_reason_end_a_run():
    world = MujocoWorld(room(), "robot")
    for speed in (1e3, 1e30, math.nan):
        world.reset(world.model.default_state())
        session = Session(InterfaceOnly(world), belief=TrueBelief(world))
        session.act({"robot/x:velocity": 0.1})
        before = world.state["room/door"]
        world._data.joint("room/door").qvel[:] = speed
        with pytest.raises(SkillError, match="not to be trusted"):
            session.act({"robot/x:velocity": 0.1})
        assert "not to be trusted" in session.broken
        assert world.state["room/door"] == before
        # It does not go on before a reset.
        with pytest.raises(SimulationError, match="not to be trusted"):
            world.apply({}, 0.02)
    world.reset(world.model.default_state())
    session = Session(InterfaceOnly(world), belief=TrueBelief(world))
    session.act({"robot/x:velocity": 0.1})
    assert not session.broken
    assert world._bounds.force > 10 * EFFORT
    assert world._bounds.find_problem(world._data, 1e9).startswith("a force is 1e+09 N")
