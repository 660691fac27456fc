"""Locks and springs of furniture are the same laws in both worlds."""

from __future__ import annotations

import numpy as np
import pytest
from pusher import gripper, pusher

import kineverse as kv
from kineverse.model.basic_operations import SetBody
from kineverse.model.body import Body, Inertia, Shape, Sphere
from kineverse.worlds import KinematicWorld, MujocoWorld

pytest.importorskip("mujoco")

World = KinematicWorld | MujocoWorld
both = pytest.mark.parametrize("kind", [KinematicWorld, MujocoWorld])


def finger_before(mechanism: kv.articulations.Mechanism, at: tuple[float, float, float]) -> kv.Model:
    """A ball of 1 cm that moves along x, at first at some place before a mechanism."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.Prismatic(
                name="robot/x", parent="world", child="robot/tip", lower=-0.5, upper=0.5, velocity=0.2,
                origin=kv.translation(*at), dynamics=(("effort", 50.0),),
            )
        )  # fmt: skip
        edit.apply(
            SetBody(
                "robot/tip",
                Body(collisions=(Shape(Sphere(0.01)),), inertia=Inertia(2.0, (0.01, 0, 0, 0.01, 0, 0.01))),
            )
        )
        edit.apply(mechanism)
    return model


def run(world: World, seconds: float, **speeds: float) -> None:
    for _ in range(round(seconds / 0.01)):
        world.apply({f"robot/{name}:velocity": v for name, v in speeds.items()}, 0.01, stamp=world.time)


@both
def test_a_locked_drawer_is_not_pulled_open_and_an_unlocked_one_is(kind: type[World]) -> None:
    model = pusher(locked=True, mass=20.0)
    world = kind(model, "robot", gripper(model))
    assert not any("room/drawer/lock" in remark for remark in world.remarks)
    before = {"robot/x": 0.88, "robot/z": 2.0, "robot/finger": 0.05}
    for bolt, opened in ((0.0, 0.0), (0.8, 0.03)):
        world.reset(before | {"room/bolt": bolt})
        run(world, 1.5, finger=-0.03)
        assert world.held
        run(world, 1.0, x=-0.03)
        assert world.state["room/drawer"] == pytest.approx(opened, abs=1e-4)
        assert bool(world.held) == bool(opened)


@both
def test_a_lever_snaps_back_and_then_the_door_can_be_shut_alone(kind: type[World]) -> None:
    mechanism = kv.articulations.DoorWithHandle(name="room", parent="world")
    model = finger_before(mechanism, (0.0, 0.5, 1.5))
    world = kind(model, "robot", None)
    ajar = {"room/door": 0.1, "room/handle": 0.7, "robot/x": -0.2}
    world.reset(ajar)
    run(world, 0.5)
    assert world.state["room/handle"] == pytest.approx(0.0, abs=1e-3)
    assert world.state["room/door"] == pytest.approx(0.1, abs=1e-3)
    # A finger shuts it from the front. Then it is locked: one behind it does not push it open.
    run(world, 2.6, x=0.1)
    assert world.state["room/door"] == pytest.approx(0.0, abs=1e-3)
    world.reset({"room/handle": 0.7, "robot/x": 0.05})
    run(world, 0.5)
    run(world, 1.0, x=-0.05)
    assert world.state["room/door"] == pytest.approx(0.0, abs=1e-3)


@both
def test_a_pressed_button_lets_the_door_spring_ajar(kind: type[World]) -> None:
    oven = kv.articulations.Microwave(name="oven", parent="world")
    model = finger_before(oven, (-0.04, 0.414, 0.056))
    world = kind(model, "robot", None)
    door, button = model.symbol("oven/door"), model.symbol("oven/button")
    run(world, 0.5)
    assert world.state[door] == pytest.approx(0.0, abs=1e-4)
    run(world, 0.21, x=0.05)
    assert world.state[button] > oven.catch
    run(world, 0.3)
    run(world, 1.5, x=-0.05)
    assert world.state[button] == pytest.approx(0.0, abs=1e-4)
    assert 0.05 < world.state[door] < 0.15


def test_springs_that_carry_a_weight_are_left_out_with_it() -> None:
    model = kv.Model()
    spring = (("spring_stiffness", 10.0), ("spring_reference", 1.0))
    with model.edit() as edit:
        for name, axis in (("flap", (0, 1, 0)), ("gate", (0, 0, 1))):
            edit.apply(
                kv.Revolute(
                    name=f"room/{name}", parent="world", child=f"room/{name}", axis=axis, lower=0, upper=1.5,
                    velocity=1.0, dynamics=spring, origin=kv.translation(0, 2, 1),
                )
            )  # fmt: skip
            edit.apply(SetBody(f"room/{name}", Body(inertia=Inertia(2.0, (0.1, 0, 0, 0.1, 0, 0.1)))))
        edit.apply(kv.Prismatic(name="robot/x", parent="world", child="robot/tip", lower=-1, upper=1))
        edit.apply(SetBody("robot/tip", Body(collisions=(Shape(Sphere(0.01)),))))
    world = KinematicWorld(model, "robot")
    run(world, 0.5)
    np.testing.assert_allclose([world.state[f"room/{name}"] for name in ("flap", "gate")], (0, 0.5))
    run(world, 1.0)
    np.testing.assert_allclose([world.state[f"room/{name}"] for name in ("flap", "gate")], (0, 1))
    assert [r for r in world.remarks if "room/flap" in r and "carries a weight" in r]
    assert not any("room/gate" in remark for remark in world.remarks)
