"""Law: furniture that a robot moves stops at other furniture, and overlaps only where it did at the start."""

from __future__ import annotations

import numpy as np
import pytest
from pusher import gripper, pusher, solid
from scripted_world import Step

import kineverse as kv
from kineverse.geometry import Rule, Scene
from kineverse.manipulation.swept_volume import find_obstacle
from kineverse.model.body import Box, Cylinder
from kineverse.worlds import KinematicWorld, Robot, RunMetrics
from kineverse.worlds.furniture_overlaps import OVERLAP, FurnitureOverlaps


def cupboard(lower: float | None = 0.0, upper: float | None = 1.5, hinge: float = 0.0) -> kv.Model:
    """Build a solid box with a door before it that turns about z at y = 0, and reaches into it by some way."""
    model, q = kv.Model(), kv.position("door")
    with model.edit() as edit:
        edit.add_frame(
            "robot/base", "world", kv.translation(kv.position("robot/x"), 0, 9), solid(Box((0.1,) * 3))
        )
        edit.add_frame("box", "world", np.eye(4), solid(Box((0.4, 0.6, 0.6)), (0.2 - hinge, 0.3, 0)))
        door = kv.translation(-0.01, 0, 0) @ kv.rotation_z(q)
        edit.add_frame("panel", "box", door, solid(Box((0.02, 0.6, 0.6)), (0, 0.3, 0)))
        if lower is not None:
            edit.constrain("door/range", lower, q, upper)
    return model


def furniture(model: kv.Model, *rules: Rule) -> FurnitureOverlaps:
    robot = Robot.of(model, "robot") if "robot/base" in model.frames else None
    return FurnitureOverlaps(Scene(model, rules=rules), robot)


def excess(overlaps: FurnitureOverlaps, **values: float) -> float:
    """Return the largest excess at a state [m]."""
    overlaps.scene.update(overlaps.scene.model.default_state() | values)
    return max((one.excess for one in overlaps.find()), default=0.0)


def test_a_door_may_not_turn_into_its_own_box():
    overlaps = furniture(cupboard(None))
    assert excess(overlaps, door=1.0) == excess(overlaps, door=0.0) == 0.0
    assert excess(overlaps, door=-0.5) > 0.1
    # Nor where it overlaps the box at its hinge wherever it is.
    overlaps = furniture(cupboard(None, hinge=0.003))
    assert excess(overlaps, door=0.0) == 0.0
    assert excess(overlaps, door=-0.5) > 0.1


def test_bodies_that_overlap_in_all_of_their_range_are_made_so():
    model = cupboard(0.0, 1.0)
    with model.edit() as edit:
        edit.add_frame("knob", "panel", np.eye(4), solid(Box((0.05, 0.05, 0.05)), (0.0, 0.005, 0)))
    overlaps, values = furniture(model), np.linspace(0.0, 1.0, 7)
    depths = [-distance(model, "box", "knob", q) for q in values]
    assert max(depths) > depths[0] + 0.001
    assert all(excess(overlaps, door=q) == 0.0 for q in values)


def distance(model: kv.Model, one: str, other: str, q: float) -> float:
    scene = Scene(model)
    scene.update(model.default_state() | {"door": q})
    return scene.distance(one, other).distance


def chest(lower: float | None, upper: float | None, *, carried: bool = True) -> kv.Model:
    """Build a solid box of 0.4 m with a solid drawer of 0.4 m in it that is pulled out along x."""
    model, q = kv.Model(), kv.position("drawer")
    with model.edit() as edit:
        edit.add_frame(
            "robot/base", "world", kv.translation(kv.position("robot/x"), 0, 9), solid(Box((0.1,) * 3))
        )
        edit.add_frame("box", "world", np.eye(4), solid(Box((0.4, 0.5, 0.3))))
        parent = "box" if carried else "world"
        edit.add_frame("drawer", parent, kv.translation(q, 0, 0), solid(Box((0.4, 0.4, 0.2)), (-0.01, 0, 0)))
        if lower is not None:
            edit.constrain("drawer/range", lower, q, upper)
    return model


def begin(model: kv.Model, **values: float) -> FurnitureOverlaps:
    overlaps = furniture(model)
    overlaps.scene.update(model.default_state() | values)
    overlaps.begin()
    return overlaps


@pytest.mark.parametrize(("upper", "carried"), [(0.4, True), (0.4, False), (0.45, True)])
def test_a_drawer_goes_back_into_a_solid_box_that_it_is_partly_in(upper, carried):
    overlaps = begin(chest(0.0, upper, carried=carried), drawer=0.3)
    assert all(excess(overlaps, drawer=q) == 0.0 for q in np.linspace(0.3, 0.0, 7))
    assert overlaps.excepted == (("box", "drawer"),)


def test_what_is_apart_at_the_start_may_not_overlap_though_it_does_by_default():
    overlaps = begin(chest(0.0, 0.45), drawer=0.42)
    assert overlaps.excepted == ()
    assert excess(overlaps, drawer=0.40) == pytest.approx(0.01)
    # Nor does a touch of less than what counts excuse anything.
    overlaps = begin(chest(0.0, 0.45), drawer=0.41 - 0.9 * OVERLAP)
    assert excess(overlaps, drawer=0.40) == pytest.approx(0.01)
    # An earlier start, as before it was opened, does.
    overlaps.scene.update(overlaps.scene.model.default_state() | {"drawer": 0.42})
    overlaps.begin(overlaps.scene.model.default_state())
    assert excess(overlaps, drawer=0.40) == 0.0


def test_without_limits_the_depth_at_the_start_is_allowed():
    overlaps = begin(chest(None, None), drawer=0.35)
    assert excess(overlaps, drawer=0.35 - 0.9 * OVERLAP) == 0.0
    assert excess(overlaps, drawer=0.33) == pytest.approx(0.02)


def test_what_is_made_to_overlap_does_not_count_and_a_rod_may_turn_in_its_sleeve():
    model, slide, turn = kv.Model(), kv.position("slide"), kv.position("turn")
    with model.edit() as edit:
        edit.add_frame("sleeve", "world", np.eye(4), solid(Cylinder(0.05, 0.2)))
        moved = kv.translation(0, 0, slide) @ kv.rotation_z(turn)
        edit.add_frame("rod", "sleeve", moved, solid(Cylinder(0.03, 0.9)))
        edit.constrain("slide/range", -0.2, slide, 0.2)
    overlaps = begin(model)
    number = [overlaps.scene.bodies.index(name) for name in ("sleeve", "rod")]
    assert not overlaps.counting[*number]
    assert not len(overlaps.watch(model.speeds).pairs)
    assert excess(overlaps, slide=0.2, turn=9.0) == 0.0


def test_pairs_that_a_rule_excepts_do_not_overlap():
    overlaps = furniture(cupboard(None), Rule("box", "panel"))
    assert excess(overlaps, door=-0.5) == 0.0


# -- in the kinematic world --------------------------------------------------------------------------------


def room(**solids: tuple[tuple[float, float, float], tuple[float, float, float]]) -> kv.Model:
    """The furniture of the pusher with fixed boxes by name, each with its size and place."""
    model = pusher()
    with model.edit() as edit:
        for name, (size, at) in solids.items():
            edit.add_frame(f"room/{name}", "world", np.eye(4), solid(Box(size), at))
    return model


def deepest(model: kv.Model, states: list[kv.State], one: str, other: str) -> float:
    """Return the largest depth of two bodies [m]."""
    scene, found = Scene(model), []
    for state in states:
        scene.update(state)
        found.append(-scene.distance(one, other).distance)
    return max(found)


def run(world: KinematicWorld, seconds: float, dt: float = 0.02, **speeds: float) -> list[kv.State]:
    states = [world.state]
    for _ in range(round(seconds / dt)):
        world.apply({f"robot/{name}:velocity": v for name, v in speeds.items()}, dt, stamp=world.time)
        states.append(world.state)
    return states


@pytest.mark.parametrize("thickness", [0.06, 0.004])
def test_a_pushed_door_stops_at_a_post(thickness):
    model = room(post=((thickness, 0.06, 0.6), (1.2, 0.5, 0.5)))
    world = KinematicWorld(model, "robot", gripper(model))
    world.reset({"robot/x": 0.9, "robot/y": 0.3, "robot/finger": 0.05})
    states = run(world, 0.6, x=0.3)
    assert states[-1]["room/door"] > 0.2
    assert states[-1]["room/door"] == pytest.approx(states[-3]["room/door"], abs=1e-6)
    assert deepest(model, states, "room/panel", "room/post") < OVERLAP
    # The robot goes on where the door cannot, and the world says both.
    assert deepest(model, states, "room/panel", "robot/ball") > 0.005
    assert {frozenset((c.a, c.b)) for c in world.contacts()} >= {
        frozenset(("room/panel", "room/post")),
        frozenset(("robot/ball", "room/panel")),
    }
    # It comes free when the ball pushes it back from the other side.
    world.reset({"robot/x": 1.3, "robot/y": 0.3, "robot/finger": 0.05, "room/door": states[-1]["room/door"]})
    assert run(world, 1.0, x=-0.3)[-1]["room/door"] < 0.0


def test_a_held_drawer_stops_at_a_post_and_is_lost():
    model = room(post=((0.04, 0.04, 0.3), (0.8, 0.15, 2.0)))
    world = KinematicWorld(model, "robot", gripper(model))
    world.reset({"robot/x": 0.88, "robot/z": 2.0, "robot/finger": 0.05})
    run(world, 0.5, finger=-0.1)
    states = run(world, 1.76, x=-0.1)
    assert world.held
    assert states[-1]["room/drawer"] == pytest.approx(0.17, abs=OVERLAP)
    states += run(world, 0.2, x=-0.1)
    assert states[-1]["room/drawer"] == pytest.approx(0.17, abs=OVERLAP)
    assert world.held is None
    assert "is lost" in world.events[-1].text
    assert deepest(model, states, "room/drawer", "room/post") < OVERLAP
    # Nor does it jump over the post in one long step.
    world.reset({"robot/x": 0.88, "robot/z": 2.0, "robot/finger": 0.05})
    run(world, 0.5, finger=-0.1)
    world.apply({"robot/x:velocity": -0.1}, 1.76)
    assert world.state["room/drawer"] == pytest.approx(0.17, abs=OVERLAP)


def test_furniture_pushes_other_furniture_as_far_as_that_can_move():
    model = pusher()
    board, flap = kv.position("room/board"), kv.position("room/flap")
    with model.edit() as edit:
        place = kv.translation(0.8 - board, 0.15, 2.0)
        edit.add_frame("room/board", "world", place, solid(Box((0.04, 0.04, 0.3))))
        edit.constrain("room/board/range", 0.0, board, 0.05)
        # Another one moves across the drawer's way, and is not moved by it.
        edit.add_frame(
            "room/flap", "world", kv.translation(0.6, -0.15 - flap, 2.0), solid(Box((0.04, 0.04, 0.3)))
        )
    world = KinematicWorld(model, "robot", gripper(model))
    world.reset({"robot/x": 0.88, "robot/z": 2.0, "robot/finger": 0.05})
    run(world, 0.5, finger=-0.1)
    states = run(world, 2.0, x=-0.1) + run(world, 0.5, x=-0.1)
    assert (states[-1]["room/drawer"], states[-1]["room/board"]) == pytest.approx((0.22, 0.05), abs=OVERLAP)
    assert deepest(model, states, "room/drawer", "room/board") < OVERLAP
    with model.edit() as edit:
        edit.remove("constraint room/board/range")
    world = KinematicWorld(model, "robot", gripper(model))
    world.reset({"robot/x": 0.88, "robot/z": 2.0, "robot/finger": 0.05})
    run(world, 0.5, finger=-0.1)
    states = run(world, 4.5, x=-0.1)
    assert states[-1]["room/drawer"] == pytest.approx(0.37, abs=OVERLAP)
    assert states[-1]["room/flap"] == 0.0
    assert deepest(model, states, "room/drawer", "room/flap") < OVERLAP


def test_a_pushed_drawer_goes_back_into_a_solid_box_only_if_it_is_partly_in_it():
    """The world holds what the check before a motion allows, and the metrics see what the world does."""
    for start, end in ((0.3, 0.0), (0.44, 0.41)):
        model = chest(0.0, 0.45)
        with model.edit() as edit:
            base = np.eye(4)
            edit.add_frame("robot/ball", "robot/base", base, solid(Box((0.02, 0.02, 0.02)), (0, 0, -9)))
        state = model.default_state() | {"robot/x": 0.24 + start, "drawer": start}
        world = KinematicWorld(model, "robot")
        world.reset(state)
        metrics, push = RunMetrics(world), {kv.velocity("robot/x"): -0.5}
        for _ in range(40):
            world.apply(push, 0.02, stamp=world.time)
            metrics(Step(push, world.state))
        assert world.state["drawer"] == pytest.approx(end, abs=2 * OVERLAP)
        obstacle = find_obstacle(model, model.symbol("drawer"), state, 0.0, robot=world.robot)
        assert (obstacle is None) == (end == 0)
        overlap = metrics.overlap
        assert overlap is None or "robot/ball" in (overlap.a, overlap.b)


def test_a_ball_that_pushes_near_the_hinge_does_not_throw_the_door_through_a_board():
    model = room(board=((0.01, 0.06, 0.6), (1.2, 0.7, 0.5)))
    world = KinematicWorld(model, "robot", gripper(model), leave_out=["room/door/speed"])
    world.reset({"robot/x": 0.9, "robot/y": 0.06, "robot/finger": 0.05})
    states = run(world, 0.5, x=0.5)
    assert states[-1]["room/door"] > 0.1
    assert deepest(model, states, "room/panel", "room/board") < OVERLAP


def test_without_a_robot_all_bodies_are_furniture():
    model = cupboard(None)
    for robot in (None, Robot.of_mechanism(model)):
        overlaps = FurnitureOverlaps(Scene(model), robot)
        overlaps.scene.update(model.default_state() | {"door": -0.5})
        assert [{one.a, one.b} for one in overlaps.find()] == [{"box", "panel"}]
