"""Laws of the velocity controller at its edges: moving bounds, units and weights of goals, noise, contacts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from control_models import DT, follow, planar_arm

import kineverse as kv
from kineverse.control import Controller, Goal, Hold, Keep, Target, same_pose
from kineverse.errors import InfeasibleError, InvalidValueError, ShapeError
from kineverse.geometry import Scene
from kineverse.model.body import Body, Box, Pose, Shape, Sphere


def two_slides(*constraints: tuple) -> tuple[kv.Model, kv.Symbol, kv.Symbol]:
    """Two slides a and b of at most 1 m/s."""
    model, a, b = kv.Model(), kv.position("a"), kv.position("b")
    with model.edit() as edit:
        edit.add_frame("fa", "world", kv.translation(a, 0, 0))
        edit.add_frame("fb", "world", kv.translation(0, b, 0))
        for s in (a, b):
            edit.constrain(f"{s}/speed", -1, s.derivative(), 1)
        for k, (lower, expression, upper) in enumerate(constraints):
            edit.constrain(f"c{k}", lower(a, b), expression(a, b), upper(a, b))
    return model, a, b


def largest_change(commands: list) -> float:
    speeds = np.array([list(command.speeds.values()) for command in commands])
    return float(np.abs(np.diff(speeds, axis=0)).max())


@pytest.mark.parametrize("goal", ["a", "b"])
def test_coordinates_in_bounds_keep_their_limits(goal: str) -> None:
    """a >= b, and b has a range: no goal moves either out of it, whichever is in the bound."""
    model, a, b = two_slides(
        (lambda a, b: b, lambda a, b: a, lambda a, b: math.inf),
        (lambda a, b: -1, lambda a, b: b, lambda a, b: 1),
        (lambda a, b: -2, lambda a, b: a, lambda a, b: 0.5),
    )
    target, end = {"a": (-3.0, -1.0), "b": (2.0, 0.5)}[goal]
    controller = Controller(model, [Goal({"a": a, "b": b}[goal], target)], dt=DT)
    state, commands = follow(controller, model.default_state(), 6.0)
    assert not model.violations(state, tolerance=1e-9)
    assert state[goal] == pytest.approx(end, abs=1e-4)
    assert len(commands[0].speeds) == 2


def test_coordinate_in_the_bound_of_a_keep_keeps_its_limits() -> None:
    model = planar_arm()
    one, two = model.symbol("joint1"), model.symbol("joint2")
    controller = Controller(model, [Goal(one, -2.0, gain=5.0), Keep(two + 0.5, one, math.inf)], dt=DT)
    state, _ = follow(controller, model.default_state().updated({"joint1": 1.0}), 6.0)
    assert not model.violations(state)
    assert state[one] == pytest.approx(-1.5, abs=1e-4)


@pytest.mark.parametrize(
    ("expression", "lower", "upper", "reason"),
    [
        (lambda v, w: v**2, -1.0, 0.01, "affine"),
        (lambda v, w: kv.norm([v, w]), 0.1, math.inf, "from above"),
        (lambda v, w: kv.norm([v, w, v + w, v - w]), 0.0, 0.1, "more than three"),
        (lambda v, w: v.derivative(), -1.0, 1.0, "acceleration="),
    ],
)
def test_keeps_that_no_row_can_keep_are_refused(expression, lower, upper, reason) -> None:
    model = planar_arm()
    v, w = (model.symbol(f"joint{k}").derivative() for k in (1, 2))
    with pytest.raises(InvalidValueError, match=reason):
        Controller(model, [Goal(model.symbol("joint1"), 1), Keep(lower, expression(v, w), upper)], dt=DT)


@pytest.mark.parametrize("gain", [60.0, 1e4])
def test_gain_above_one_over_dt_is_that(gain: float) -> None:
    model = planar_arm(velocity=None)
    controller = Controller(model, [Goal(model.symbol("joint1"), 0.3, gain=gain)], dt=DT)
    state, commands = follow(controller, model.default_state(), 1.0)
    assert state["joint1"] == pytest.approx(0.3, abs=1e-6)
    assert largest_change(commands[25:]) < 1e-6


def test_goal_pauses_at_speed_zero() -> None:
    model, speed = planar_arm(), kv.parameter("speed", 0.2)
    controller = Controller(model, [Goal(model.symbol("joint1"), 0.0, speed=speed)], dt=DT)
    controller.set("speed", 0.0)
    assert controller.step(model.default_state()).speeds[model.symbol("joint1").derivative()] == 0.0
    with pytest.raises(ShapeError, match="speed"):
        controller.set(speed, [1.0, 2.0])


def test_residual_of_a_goal_about_speeds_is_what_is_missing() -> None:
    model = planar_arm(velocity=1.0)
    speed = model.symbol("joint1").derivative()
    tasks = [Goal(speed, 1.5, name="fast"), Goal(model.symbol("joint2").derivative(), 0.2, name="slow")]
    residuals = Controller(model, tasks, dt=DT, smooth=0).step(model.default_state()).residuals
    assert residuals["fast"] == pytest.approx(0.5, abs=1e-2)
    assert residuals["slow"] == pytest.approx(0.0, abs=1e-2)


def test_goals_about_speeds_refuse_what_is_of_positions() -> None:
    q = planar_arm().symbol("joint1")
    with pytest.raises(InvalidValueError, match="speed="):
        Goal(q.derivative(), 0.2, speed=0.1)
    with pytest.raises(InvalidValueError, match="two goals"):
        Goal(kv.array([q, q.derivative()]), [0.5, 0.0])


@pytest.mark.parametrize("unit", [0.01, 1.0, 1000.0])
def test_units_of_a_goal_do_not_matter(unit: float) -> None:
    """A start outside of the limits, a hold and a goal out of reach, in meters and in other units."""
    model = planar_arm()
    tip, start = model.fk("tip")[:2, 3], model.default_state().updated({"joint1": 2.2, "joint2": 0.4})
    ends = []
    for factor in (1.0, unit):
        tasks = [Goal(factor * tip, [factor * 1.0, factor * -4.0]), Hold(model.symbol("joint3"), 0.3)]
        ends.append(follow(Controller(model, tasks, dt=DT, posture=0), start, 2.0)[0])
    places = [tip(end) for end in ends]
    assert np.allclose(*places, atol=2e-2)
    assert all(end["joint1"] <= 2.0 + 1e-9 for end in ends)
    assert all(end["joint3"] == pytest.approx(0.3, abs=1e-6) for end in ends)


@pytest.mark.parametrize("weight", [1.0, 1e4, 1e8])
def test_weight_of_a_goal_does_not_keep_a_coordinate_outside(weight: float) -> None:
    model = planar_arm()
    goal = Goal(model.symbol("joint1"), 5.0, weight=weight)
    state, _ = follow(Controller(model, [goal], dt=DT), model.default_state().updated({"joint1": 2.5}), 3.0)
    assert 2.0 - 1e-3 < state["joint1"] < 2.0 + 5e-3


@pytest.mark.parametrize("options", [{"target": 1e4}, {"target": 2.1, "weight": 1e3}])
def test_goal_out_of_reach_does_not_slow_other_goals(options: dict) -> None:
    model = planar_arm()
    one, two = model.symbol("joint1"), model.symbol("joint2")
    other = Goal(two, 0.5)
    alone, _ = follow(Controller(model, [other], dt=DT), model.default_state(), 2.0)
    both, _ = follow(Controller(model, [other, Goal(one, **options)], dt=DT), model.default_state(), 2.0)
    assert both[two] == pytest.approx(alone[two], abs=2e-3)


@pytest.mark.parametrize(("size", "distance"), [(1.0, 1e6), (0.05, 1.0), (0.05, 1e3)])
def test_stretched_arm_of_any_size_rests(size: float, distance: float) -> None:
    model = kv.Model()
    with model.edit() as edit:
        for k in range(3):
            origin, limits = (
                kv.translation(size if k else 0, 0, 0),
                {"lower": -2.0, "upper": 2.0, "velocity": 1.0},
            )
            parent = f"l{k - 1}" if k else "world"
            edit.apply(
                kv.Revolute(
                    name=f"j{k}", parent=parent, child=f"l{k}", origin=origin, axis=(0, 0, 1), **limits
                )
            )
        edit.add_frame("tip", "l2", kv.translation(size, 0, 0))
    goal = Goal(model.fk("tip")[:2, 3], [distance, 0.0])
    start = model.default_state().updated({"j0": 0.6})
    _, commands = follow(Controller(model, [goal], dt=DT), start, 6.0)
    assert largest_change(commands[-50:]) < 1e-3


def test_noise_and_jumps_of_the_state_are_no_conflict_with_accelerations() -> None:
    """Limits on accelerations that the model states give way to limits on positions; the least one counts."""
    model, a, _ = two_slides(
        (lambda a, b: -1, lambda a, b: a, lambda a, b: 1),
        (lambda a, b: -1, lambda a, b: a.derivative().derivative(), lambda a, b: 1),
        (lambda a, b: -5, lambda a, b: a.derivative().derivative(), lambda a, b: 5),
        (lambda a, b: -math.inf, lambda a, b: b.derivative().derivative(), lambda a, b: math.inf),
    )
    controller = Controller(model, [Goal(a, 5.0, gain=10.0)], dt=DT, smooth=0)
    state, commands = follow(controller, model.default_state(), 0.8)
    assert largest_change(commands) <= 1.0 * DT + 1e-9
    assert controller.step(state.updated({a: 0.99})).speeds[a.derivative()] <= 0.01 / DT
    generator = np.random.default_rng(0)
    for _ in range(50):
        command = controller.step(state.updated({a: state[a] + generator.normal(scale=1e-3)}))
        state = model.integrate(state, command.speeds, DT)
    assert state[a] < 1.0 + 5e-3


def test_accelerations_take_no_part_in_conflicts() -> None:
    model = planar_arm(1)
    speed = model.symbol("joint1").derivative()
    keeps = [Keep(0.5, speed, 1, name="on"), Keep(-1, speed, 0.2, name="off")]
    with pytest.raises(InfeasibleError) as raised:
        Controller(model, keeps, dt=DT, acceleration=0.1).step(model.default_state())
    assert {conflict.name for conflict in raised.value.conflict} == {"on", "off"}


# -- contacts ----------------------------------------------------------------------------------------------------


def ball_and_wall() -> kv.Model:
    """A ball that slides in the plane, and a wall at x = 0.9."""
    model, x, y = kv.Model(), kv.position("x"), kv.position("y")
    with model.edit() as edit:
        for name, pose, geometry in (
            ("ball", kv.translation(x, y, 0), Sphere(0.1)),
            ("wall", kv.translation(1, 0, 0), Box((0.2, 1.0, 1.0))),
        ):
            edit.add_frame(name, "world", pose, Body(collisions=(Shape(geometry, Pose()),)))
        for s in (x, y):
            edit.constrain(f"{s}/speed", -1, s.derivative(), 1)
            edit.constrain(f"{s}/acceleration", -2, s.derivative().derivative(), 2)
    return model


def test_contact_gain_follows_the_step() -> None:
    model = ball_and_wall()
    x = model.symbol("x")
    controller = Controller(model, [Goal(x, 2.0)], dt=0.01, scene=Scene(model), radius=0.5)
    controller.dt = 0.2
    state, _ = follow(controller, model.default_state(), 4.0)
    assert state[x] <= 0.8 - 0.005 + 1e-6


def test_scene_whose_model_was_edited_is_refused() -> None:
    model = ball_and_wall()
    controller = Controller(model, [Goal(model.symbol("x"), 2.0)], dt=DT, scene=Scene(model))
    state = model.default_state()
    controller.step(state)
    with model.edit() as edit:
        edit.add_frame(
            "a", "world", kv.translation(0.5, 0, 0), Body(collisions=(Shape(Sphere(0.1), Pose()),))
        )
    with pytest.raises(InvalidValueError, match="edited"):
        controller.step(state)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"contacts": -1}, "contacts="),
        ({"contacts": 2.5}, "contacts="),
        ({"margin": 0.2}, "margin"),
        ({"radius": math.nan}, "margin"),
        ({"posture": "x"}, "posture"),
        ({"weights": {"x": -1.0}}, "weights="),
        ({"weights": {"x": 0.0}}, "weights="),
    ],
)
def test_numbers_without_sense_are_refused(options: dict, message: str) -> None:
    model = ball_and_wall()
    with pytest.raises(InvalidValueError, match=message):
        Controller(model, [Goal(model.symbol("x"), 2.0)], dt=DT, scene=Scene(model), **options)


def test_bodies_are_seen_in_time_at_long_steps() -> None:
    """1 m/s in steps of 0.25 s: further than the 5 cm from which pairs count at short steps."""
    model = ball_and_wall()
    x = model.symbol("x")
    controller = Controller(model, [Goal(x, 2.0, gain=20.0)], dt=0.02, scene=Scene(model))
    controller.dt = 0.25
    state, _ = follow(controller, model.default_state(), 4.0)
    assert state[x] <= 0.8 - 0.005 + 1e-6


def test_posture_does_not_keep_a_goal_from_being_reached() -> None:
    model = kv.load("fetch")
    pose, goal = model.fk("fetch/gripper_link"), Target("goal", np.eye(4))
    controller = Controller(
        model,
        [Goal(same_pose(pose, goal.expression), name="reach")],
        dt=DT,
        fixed=["fetch/l_wheel_joint", "fetch/r_wheel_joint", "fetch/torso_lift_joint"],
    )
    joints = [s.position for s in controller.speeds]
    limits = [np.clip(model.limits(s), -2.5, 2.5) for s in joints]
    for seed in (0, 8, 11):
        generator = np.random.default_rng(seed)
        ends = [np.array([0.9 * generator.uniform(*each) for each in limits]) for _ in range(2)]
        wanted = pose(model.default_state().updated(dict(zip(joints, ends[0], strict=True))))
        controller.set(goal, wanted)
        start = dict(zip(joints, 0.7 * ends[0] + 0.3 * ends[1], strict=True))
        controller.reset()
        _, commands = follow(controller, model.default_state().updated(start), 12.0)
        assert commands[-1].residuals["reach"] < 1e-3


def test_units_of_a_coordinate_do_not_matter() -> None:
    """A slide in meters and in millimeters, and an arm on it."""
    ends = []
    for unit in (1.0, 1000.0):
        model, slide, angle = kv.Model(), kv.position("slide"), kv.position("angle")
        with model.edit() as edit:
            pose = kv.translation(slide / unit, 0, 0) @ kv.rotation_z(angle) @ kv.translation(0.5, 0, 0)
            edit.add_frame("tip", "world", pose)
            edit.constrain("slide", -unit, slide, unit)
            edit.constrain("slide/speed", -0.5 * unit, slide.derivative(), 0.5 * unit)
            edit.constrain("angle/speed", -1, angle.derivative(), 1)
        goal = Goal(model.fk("tip")[:2, 3], [0.9, 0.3])
        start = model.default_state().updated({slide: -0.9 * unit, angle: 1.0})
        end, _ = follow(Controller(model, [goal], dt=DT), start, 1.0)
        ends.append([end[slide] / unit, end[angle]])
    assert np.allclose(*ends, atol=1e-3)
