"""Worlds that people change while they run: furniture moves, sensors change, models are edited."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from pusher import gripper, pusher

import kineverse as kv
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.worlds import ChangeableWorld, ForceLimit, KinematicWorld, MujocoWorld, Sensors

pytest.importorskip("mujoco")

World = KinematicWorld | MujocoWorld
both = pytest.mark.parametrize("kind", [KinematicWorld, MujocoWorld])
BEFORE_DRAWER = {"robot/x": 0.88, "robot/z": 2.0, "robot/finger": 0.05}


def make(kind: type[World], model: kv.Model | None = None) -> World:
    model = model or pusher(mass=20.0)
    world = kind(model, "robot", gripper(model), sensors=Sensors(marked=("room/drawer", "room/door")))
    checked: ChangeableWorld = world
    assert checked is world
    return world


def run(world: World, seconds: float, **speeds: float) -> None:
    for _ in range(round(seconds / 0.01)):
        world.apply({f"robot/{name}:velocity": v for name, v in speeds.items()}, 0.01, stamp=world.time)


def pulling(world: World) -> None:
    """Take the drawer's handle, and open it a bit."""
    world.reset(BEFORE_DRAWER)
    run(world, 1.5, finger=-0.03)
    run(world, 1.0, x=-0.03)
    assert world.held == "room/drawer_handle"


def others(world: World, *moved: str) -> list[float]:
    return [value for symbol, value in world.state.items() if str(symbol) not in moved]


@both
def test_furniture_is_moved_while_the_robot_stays_and_time_goes_on(kind: type[World]) -> None:
    world = make(kind)
    world.reset(BEFORE_DRAWER | {"robot/x": 0.5})
    run(world, 0.2, x=0.1)
    before = others(world, "room/drawer", "room/door")
    world.displace({"room/drawer": 0.2, "room/door": -0.4})
    assert world.time == pytest.approx(0.2)
    assert others(world, "room/drawer", "room/door") == before
    run(world, 0.2, x=0.1)
    assert world.state["room/drawer"] == pytest.approx(0.2, abs=1e-4)
    assert world.state["room/door"] == pytest.approx(-0.4, abs=1e-4)
    assert world.state["robot/x"] == pytest.approx(0.54, abs=2e-3)


@both
def test_furniture_is_not_moved_out_of_a_hand_beyond_limits_or_into_something(kind: type[World]) -> None:
    world = make(kind)
    pulling(world)
    refused: list[tuple[dict[str, float], str]] = [
        ({"robot/x": 0.0}, "'robot/x' is the robot's"),
        ({"room/drawer": 0.2}, "The robot holds 'room/drawer_handle', which room/drawer would move"),
        ({"room/door": 2.0}, "room/door cannot be there: 'room/door/range' is exceeded by 0.5"),
        ({"room/door": math.nan}, "'room/door' is moved to a finite number, not to nan"),
        ({"room/right": 0.5}, "'room/linked' is exceeded by 0.5"),
    ]
    for values, words in refused:
        before = world.state
        with pytest.raises(InvalidValueError) as caught:
            world.displace(values)
        assert words in str(caught.value)
        assert world.state == before
    with pytest.raises(UnknownNameError, match="room/drawr"):
        world.displace({"room/drawr": 0.1})
    world.reset({"robot/x": 0.7, "robot/y": 0.36, "robot/finger": 0.05})
    with pytest.raises(InvalidValueError, match=r"door cannot be there: 'r.*' would be in 'r.*'") as caught:
        world.displace({"room/door": -0.7})
    assert "robot/ball" in str(caught.value)
    assert world.state["room/door"] == 0.0
    with pytest.raises(InvalidValueError, match=r"room/second cannot be there: .* would be in"):
        world.displace({"room/first": 0.0, "room/second": 1.0})


@both
def test_sensors_change_and_markers_are_hidden_while_it_runs(kind: type[World]) -> None:
    world = make(kind)
    world.reset(BEFORE_DRAWER)

    def look() -> dict[str, np.ndarray]:
        poses: dict[str, np.ndarray] = {}
        for _ in range(20):
            run(world, 0.01)
            poses |= world.observe().poses
        return poses

    drawer = world.model.fk("room/drawer")
    exact = look()
    assert set(exact) == {"room/drawer", "room/door"}
    np.testing.assert_allclose(exact["room/drawer"], drawer(world.state), atol=1e-9)
    world.sensors = replace(world.sensors, position=0.05, hidden={"room/door"}, rate=20.0)
    noisy = look()
    assert set(noisy) == {"room/drawer"}
    assert np.abs(noisy["room/drawer"] - drawer(world.state)).max() > 1e-3
    with pytest.raises(UnknownNameError, match="room/dor"):
        world.sensors = replace(world.sensors, hidden=("room/dor",))
    assert world.sensors.hidden == {"room/door"}
    world.sensors = Sensors(marked=("room/puck",))
    assert set(look()) == {"room/puck"}


def test_drift_of_the_odometry_stays_when_its_noise_ends() -> None:
    world = KinematicWorld(kv.load("hsr"), "hsr", sensors=Sensors(odometry=0.05))
    x, forward = world.model.symbol("hsr/base/x"), {"hsr/base/x:velocity": 0.5}
    for _ in range(50):
        world.apply(forward, 0.02)
        reading = world.observe()
    drift = reading.joints[x] - world.state[x]
    assert abs(drift) > 1e-4
    world.sensors = Sensors()
    for _ in range(5):
        world.apply(forward, 0.02)
        assert world.observe().joints[x] - world.state[x] == pytest.approx(drift, abs=1e-9)


@both
def test_a_saved_state_goes_on_with_the_body_in_the_hand(kind: type[World]) -> None:
    world = make(kind)
    pulling(world)
    saved, held = world.state, world.held
    again = make(kind, world.model)
    again.resume(saved, held)
    assert again.time == pytest.approx(world.time)
    assert again.held == held
    run(again, 1.0, x=-0.03)
    assert again.held == held
    assert again.state["room/drawer"] == pytest.approx(saved["room/drawer"] + 0.03, abs=5e-4)
    # What no finger is near is not held.
    again.resume(saved.updated({"robot/x": 0.5}), held)
    assert again.held is None


@both
def test_an_edited_model_goes_on_in_the_present_state(kind: type[World]) -> None:
    world = make(kind)
    pulling(world)
    run(world, 0.2, x=-0.03)
    world.sensors = replace(world.sensors, hidden={"room/door"})
    model = pusher(mass=20.0)
    with model.edit() as edit:
        edit.add_frame("room/lamp", "world", kv.translation(0, 0, 3 + kv.position("room/height")))
    same = world.rebuild(model)
    assert (same.time, same.held) == (world.time, world.held)
    for symbol, value in world.state.items():
        assert same.state[symbol] == pytest.approx(value, abs=1e-12)
    assert same.state["room/height"] == 0.0
    assert same.sensors == world.sensors
    run(same, 1.0, x=-0.03)
    assert same.held
    assert same.state["room/drawer"] == pytest.approx(world.state["room/drawer"] + 0.03, abs=5e-4)
    # The drawer was moved aside, out of the hand, and its travel is shorter.
    moved = world.rebuild(pusher(mass=20.0, aside=0.3))
    assert moved.held is None
    assert moved.state["room/drawer"] == pytest.approx(world.state["room/drawer"])
    shut = world.rebuild(pusher(mass=20.0, aside=0.3, closed_at=0.1))
    assert shut.state["room/drawer"] == pytest.approx(0.1)


@both
def test_commands_that_act_go_on_in_an_edited_model_until_their_time_out(kind: type[World]) -> None:
    world = make(kind)
    world.reset(BEFORE_DRAWER | {"robot/x": 0.2})
    run(world, 0.3, x=0.2)
    stamp = world.time
    world.apply({"robot/x:velocity": 0.2}, 0.01, stamp=stamp)
    after = world.rebuild(pusher(mass=20.0))
    late = stamp - 1.0
    before = after.state["robot/x"]
    after.apply({}, 0.3, stamp=late)
    assert after.refused == world.refused + 1
    # It brakes, from its speed in a world with inertia, and is at rest then.
    assert 0.0 <= after.state["robot/x"] - before < 0.02
    stopped = after.state["robot/x"]
    after.apply({}, 0.3, stamp=late)
    assert after.state["robot/x"] == pytest.approx(stopped, abs=1e-4)


def test_a_limit_of_force_trips_on_a_lasting_force_and_not_on_a_blow() -> None:
    guard = ForceLimit(60.0, 0.05)
    assert not any(guard.watch(force, 0.01) for force in (500.0, 500.0, 20.0, 500.0, math.nan, 500.0))
    assert guard.peak == 500.0
    assert [guard.watch(61.0, 0.01) for _ in range(5)] == [False, False, False, True, True]
    assert guard.watch(0.0, 0.01)
    guard.release()
    assert not guard.tripped
    assert not any(guard.watch(math.nan, 1.0) for _ in range(3))
    for wrong in (0.0, -1.0, math.nan):
        with pytest.raises(InvalidValueError, match="limit of force"):
            ForceLimit(wrong)


@both
def test_only_a_world_with_forces_stops_a_robot_that_presses(kind: type[World]) -> None:
    """The ball presses the panel at its hinge, where it does not turn."""
    world, guard = make(kind), ForceLimit(30.0)
    world.reset({"robot/x": 0.9, "robot/y": 0.0, "robot/finger": 0.05})
    stops = 0
    for _ in range(100):
        run(world, 0.01, x=0.1)
        stops += guard.watch(world.peak_force, 0.01)
    assert bool(stops) == (kind is MujocoWorld)


def test_silence_stops_a_robot_with_soft_servos_within_150_ms() -> None:
    world = MujocoWorld(kv.load("hsr"), "hsr", bandwidth=40.0)
    speeds = {"hsr/arm_roll_joint:velocity": 1.0, "hsr/base/x:velocity": 0.3}
    for _ in range(50):
        world.apply(speeds, 0.01, stamp=world.time)
    stamp, before = world.time - 0.01, world.state
    fastest = []
    for _ in range(20):
        world.apply(speeds, 0.01, stamp=stamp)  # it gets old
        fastest.append(max(abs(world.state[s] - before[s]) for s in world.robot.coordinates) / 0.01)
        before = world.state
    assert fastest[2] > 0.9
    assert max(fastest[14:]) < 0.05
