"""The velocity controller: laws of its commands, and messages where it cannot serve."""

from __future__ import annotations

import math
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from control_models import DT, follow, garage, planar_arm

import kineverse as kv
from kineverse.control import Controller, Goal, Hold, Keep, look_at, same_pose
from kineverse.errors import (
    DuplicateNameError,
    ExpressionError,
    InfeasibleError,
    InvalidValueError,
    NotFiniteError,
    ShapeError,
    UnknownNameError,
)
from kineverse.model.body import Body, Inertia


def test_goal_decays_at_its_gain() -> None:
    model = planar_arm()
    q = model.symbol("joint1")
    controller = Controller(model, [Goal(q, 0.3, gain=2.0)], dt=DT, smooth=0, posture=0)
    assert [str(s) for s in controller.speeds] == ["joint1:velocity"]
    state, commands = follow(controller, model.default_state(), 1.0)
    assert 0.3 - state[q] == pytest.approx(0.3 * (1 - 2 * DT) ** 50, rel=2e-2)
    assert commands[0].residuals == {"goal joint1": pytest.approx(0.3)}


def test_goal_of_a_pose_converges_and_its_speed_is_limited() -> None:
    model = planar_arm()
    target = model.fk("tip")({"joint1": 0.5, "joint2": -1.0, "joint3": 0.7})
    goal = Goal(same_pose(model.fk("tip"), target), speed=0.2, gain=5.0, name="reach")
    controller = Controller(model, [goal], dt=DT)
    state = model.default_state().updated({"joint2": 0.4})
    before, command = model.fk("tip")(state), controller.step(state)
    after = model.fk("tip")(model.integrate(state, command.speeds, DT))
    assert np.linalg.norm(after[:3, 3] - before[:3, 3]) <= 0.2 * DT * 1.01
    state, commands = follow(controller, state, 20.0)
    assert commands[-1].residuals["reach"] < 1e-5
    assert np.allclose(model.fk("tip")(state), target, atol=1e-5)


def test_speeds_of_a_goal_without_a_conflict_are_those_of_least_squares() -> None:
    """Against numpy: damping alone, J⁺ with a small weight, inside of all limits."""
    model = planar_arm(velocity=None)
    p = model.fk("tip")[:2, 3]
    controller = Controller(model, [Goal(p, [2.5, 0.3], gain=0.1)], dt=DT, smooth=0, posture=0)
    state = model.default_state().updated({"joint1": 0.2, "joint2": 0.5, "joint3": -0.8})
    command = controller.step(state)
    J = p.jacobian(list(model.degrees_of_freedom))(state)
    wanted = 0.1 * (np.array([2.5, 0.3]) - p(state))
    assert np.allclose(J @ list(command.speeds.values()), wanted, atol=1e-3)
    assert not command.active


def test_nothing_moves_once_goals_are_reached() -> None:
    """Posture and smoothness are no tasks: they fade with the goals."""
    model = planar_arm()
    state = model.default_state().updated({"joint1": 1.9, "joint2": 0.5, "joint3": 0.2})
    target = model.fk("tip")(state)[:3, 3]
    _, commands = follow(Controller(model, [Goal(model.fk("tip")[:3, 3], target)], dt=DT), state, 1.0)
    assert max(abs(v) for c in commands for v in c.speeds.values()) < 1e-9


def test_posture_moves_joints_from_their_limits_on_the_way() -> None:
    model = planar_arm(4)
    state = model.default_state().updated({f"joint{k}": q for k, q in enumerate((1.9, -1.9, 1.8, 0.1), 1)})
    goal = [Goal(model.fk("tip")[:2, 3], [0.5, 1.5], gain=0.5)]
    ends = [follow(Controller(model, goal, dt=DT, posture=weight), state, 4.0)[0] for weight in (0.0, 1e-2)]
    sizes = [sum(end[s] ** 2 for s in model.degrees_of_freedom) for end in ends]
    assert sizes[1] < sizes[0] - 0.1


def test_hold_keeps_its_relation_while_a_goal_moves() -> None:
    model = planar_arm(4)
    tip = model.fk("tip")
    state = model.default_state().updated({"joint1": 0.3, "joint2": 0.9, "joint3": -1.2, "joint4": 0.5})
    held = Hold(tip[:2, 3], tip(state)[:2, 3], name="pin")
    end, commands = follow(Controller(model, [held, Goal(model.symbol("joint1"), 0.9)], dt=DT), state, 4.0)
    assert max(c.residuals["pin"] for c in commands) < 2e-3
    assert end["joint1"] == pytest.approx(0.9, abs=1e-2)
    assert all(c.progress > 0.99 for c in commands)


def test_hold_that_is_violated_is_approached_with_progress() -> None:
    model = planar_arm(3)
    state = model.default_state().updated({"joint2": 0.6, "joint3": 0.6})
    controller = Controller(model, [Hold(model.fk("tip")[:2, 3], [1.2, 1.5], name="pin")], dt=DT)
    end, commands = follow(controller, state, 6.0)
    residuals = [c.residuals["pin"] for c in commands]
    assert all(b <= a + 1e-9 for a, b in pairwise(residuals))
    assert residuals[-1] < 1e-6
    assert 0 < commands[0].progress < 1
    assert not model.violations(end)


def test_keep_bounds_positions_and_speeds() -> None:
    model = planar_arm()
    x, q = model.fk("tip")[0, 3], model.symbol("joint1")
    tasks = [Goal(q, 1.5, gain=10.0), Keep(1.8, x, math.inf, name="reach"), Keep(-1, q.derivative(), 0.3)]
    controller = Controller(model, tasks, dt=DT, fixed=["joint2", "joint3"])
    state, commands = follow(controller, model.default_state(), 10.0)
    assert max(c.speeds[q.derivative()] for c in commands) <= 0.3 + 1e-9
    assert float(x(state)) == pytest.approx(1.8, abs=1e-4)
    assert any("reach" in command.active for command in commands[-5:])
    assert commands[-1].residuals["reach"] < 1e-4


def test_keep_with_equal_bounds_is_a_hold() -> None:
    model = planar_arm()
    one, two = model.symbol("joint1"), model.symbol("joint2")
    tasks = [Goal(one, 1.0), Keep(0.0, two + 0.5 * one, 0.0, name="coupled")]
    state, _ = follow(Controller(model, tasks, dt=DT), model.default_state(), 4.0)
    assert state[two] == pytest.approx(-0.5 * state[one], abs=1e-8)
    assert state[one] > 0.95


def test_look_at_turns_the_axis_to_the_point() -> None:
    model, point = planar_arm(2), np.array([1.0, -2.5, 0.0])
    e = look_at(model.fk("tip"), point)
    controller = Controller(model, [Goal(e, name="look")], dt=DT)
    state, _ = follow(controller, model.default_state().updated({"joint1": 0.4}), 6.0)
    pose = model.fk("tip")(state)
    ray = point - pose[:3, 3]
    assert pose[:3, 0] @ ray == pytest.approx(np.linalg.norm(ray), abs=1e-6)
    # The gradient does not vanish where the axis points at the target.
    assert np.linalg.norm(e.jacobian(list(model.degrees_of_freedom))(state)) > 0.5


def test_goal_on_speeds() -> None:
    model = planar_arm()
    speed = model.symbol("joint1").derivative()
    controller = Controller(model, [Goal(speed, 0.25)], dt=DT, smooth=0)
    assert controller.step(model.default_state()).speeds[speed] == pytest.approx(0.25, rel=1e-2)


def test_goals_on_speeds_have_residuals_of_their_own() -> None:
    model = planar_arm()
    q, (a, b, c) = model.symbol("joint1"), [model.symbol(f"joint{k}").derivative() for k in (1, 2, 3)]
    goals = [
        Goal(a + b, 0.1, name="sum"),
        Goal(kv.array([b - c, (1 + q) * c]), [0.05, 0.4], name="pair", weight=0.5),
        Goal(q * a - c, name="last"),
    ]
    controller = Controller(model, goals, dt=DT, tier="interpreter")
    command = controller.step({"joint1": 0.5, "joint2": 0.0, "joint3": 0.0})
    first, second, third = (command.speeds[s] for s in (a, b, c))
    assert command.residuals["sum"] == pytest.approx(abs(first + second - 0.1))
    pair = math.hypot(second - third - 0.05, 1.5 * third - 0.4)
    assert command.residuals["pair"] == pytest.approx(pair)
    assert command.residuals["last"] == pytest.approx(abs(0.5 * first - third))
    assert not controller.wait()
    assert controller.tier == "interpreter"


def test_targets_gains_and_weights_are_parameters() -> None:
    model = planar_arm()
    q = model.symbol("joint1")
    target, weight = kv.parameter("target", 0.5), kv.parameter("weight", 1.0)
    controller = Controller(model, [Goal(q, target, weight=weight)], dt=DT, smooth=0)
    state = model.default_state()
    assert controller.step(state).speeds[q.derivative()] > 0.5
    assert controller.step(state.extended({target: -0.5})).speeds[q.derivative()] < -0.5
    assert controller.step(state.extended({weight: 0.0})).speeds[q.derivative()] == 0.0


def test_command_at_rate_of_a_moving_target_has_no_lag() -> None:
    model = planar_arm(velocity=None)
    q, time = model.symbol("joint1"), kv.parameter("time", 0.0)
    controller = Controller(model, [Goal(q, np.sin(time), rate=np.cos(time), gain=5.0)], dt=DT, smooth=0)
    state, errors = model.default_state(), []
    for k in range(100):
        command = controller.step(state.extended({time: k * DT}))
        state = model.integrate(state, command.speeds, DT)
        errors.append(abs(state[q] - math.sin((k + 1) * DT)))
    # What is left is the error of Euler's steps, Δt/2/gain; without the rate the lag is 1/gain.
    assert max(errors) < 2.1e-3


@pytest.mark.parametrize("name", ["fetch", "pr2", "hsr"])
def test_wheels_are_found_from_gradients(name: str) -> None:
    model = kv.load(name)
    frame = {"fetch": "fetch/gripper_link", "pr2": "pr2/r_gripper_tool_frame", "hsr": "hsr/hand_palm_link"}[
        name
    ]
    p, start = model.fk(frame)[:3, 3], model.default_state()
    controller = Controller(model, [Goal(p, p(start) + np.array([0.5, 0.0, 0.0]))], dt=DT)
    assert set(controller.speeds) <= set(model.speeds)
    assert any("base" in str(s) or "wheel" in str(s) for s in controller.speeds)
    end, commands = follow(controller, start, 8.0)
    assert commands[-1].residuals["goal 1"] < 1e-3
    assert not model.violations(end)


def test_loop_kept_as_a_constraint_is_held() -> None:
    model = kv.load("four_bar", loops="constraint") if "four_bar" in kv.shipped_models() else None
    if model is None:
        model = planar_arm(4)
        with model.edit() as edit:
            tip = model.fk("tip")[:2, 3]
            edit.constrain("closure/x", 2.0, tip[0], 2.0)
            edit.constrain("closure/y", 1.0, tip[1], 1.0)
    start = model.project(model.default_state().updated({"joint1": 0.4, "joint2": 0.9, "joint3": -1.0}))
    controller = Controller(model, [Goal(model.symbol("joint1"), -0.2)], dt=DT)
    assert len(controller.speeds) == 4
    end, commands = follow(controller, start, 5.0)
    assert end["joint1"] == pytest.approx(-0.2, abs=1e-2)
    assert max(c.residuals["closure/x"] for c in commands) < 2e-3


def test_accelerations_are_limited() -> None:
    model = planar_arm()
    speed = model.symbol("joint1").derivative()
    controller = Controller(
        model, [Goal(model.symbol("joint1"), 1.9, gain=10.0)], dt=DT, acceleration=2.0, smooth=0
    )
    _, commands = follow(controller, model.default_state(), 3.0)
    speeds = np.array([0.0, *(c.speeds[speed] for c in commands)])
    assert np.abs(np.diff(speeds)).max() <= 2.0 * DT + 1e-5
    assert speeds.max() > 0.9


def test_jerk_and_smoothness_reduce_differences_of_commands() -> None:
    model = planar_arm()
    speed, sizes = model.symbol("joint1").derivative(), []
    for options in ({"smooth": 0.0}, {"smooth": 1.0}, {"smooth": 0.0, "jerk": 1.0}):
        controller = Controller(model, [Goal(model.symbol("joint1"), 0.5)], dt=DT, **options)
        _, commands = follow(controller, model.default_state(), 0.2)
        sizes.append(commands[0].speeds[speed])
    assert sizes[1] < 0.7 * sizes[0]
    assert sizes[2] < 0.7 * sizes[0]


def test_weights_choose_among_redundant_joints() -> None:
    model = planar_arm()
    state = model.default_state().updated({"joint2": 0.8, "joint3": 0.8})
    x, speeds = model.fk("tip")[0, 3], []
    for weights in ({"joint3": 1e-3}, {"joint3": 1e3}):
        controller = Controller(model, [Goal(x, 1.0, gain=0.1)], dt=DT, weights=weights, posture=0)
        command = controller.step(state)
        speeds.append({str(s): abs(v) for s, v in command.speeds.items()})
    assert speeds[0]["joint3:velocity"] > 3 * speeds[0]["joint2:velocity"]
    assert speeds[1]["joint3:velocity"] < 0.1 * speeds[1]["joint2:velocity"]


@pytest.mark.parametrize("tasks", ["goal", "hold", "keep"])
def test_standing_still_is_feasible_everywhere_and_violations_vanish(tasks: str) -> None:
    """Random states far outside of the limits; the long form is `python tools/feasible_states.py`."""
    model = planar_arm(4)
    tip, generator = model.fk("tip"), np.random.default_rng(3)
    chosen = {
        "goal": [Goal(tip[:2, 3], [1.0, 1.0])],
        "hold": [Hold(tip[0, 3], 1.0), Goal(model.symbol("joint1"), 0.5)],
        "keep": [Keep(-1.0, tip[0, 3], 2.0), Goal(model.symbol("joint1"), 0.5)],
    }[tasks]
    controller = Controller(model, chosen, dt=DT)
    for trial in range(40):
        q = generator.uniform(-4, 4, 4)
        state = model.default_state().updated({f"joint{k + 1}": float(v) for k, v in enumerate(q)})
        controller.reset()
        if trial >= 4:
            controller.step(state)
            continue
        end, _ = follow(controller, state, 5.0)
        assert not model.violations(end, tolerance=1e-6)


def test_coordinate_outside_of_its_limits_comes_back() -> None:
    model = planar_arm()
    controller = Controller(model, [Goal(model.symbol("joint1"), 3.0)], dt=DT)
    state, commands = follow(controller, model.default_state().updated({"joint1": 2.8}), 4.0)
    assert 2.0 - 1e-3 < state["joint1"] <= 2.0 + 1e-9
    assert "joint1/position" in commands[-1].active


# -- bad input -------------------------------------------------------------------------------------------------


def test_unreachable_goal_ends_as_near_as_possible() -> None:
    model = planar_arm(2)
    controller = Controller(model, [Goal(model.fk("tip")[:2, 3], [5.0, 0.0], name="far")], dt=DT)
    _, commands = follow(controller, model.default_state().updated({"joint1": 0.6, "joint2": -0.9}), 15.0)
    assert commands[-1].residuals["far"] == pytest.approx(3.0, abs=1e-2)
    assert max(abs(v) for v in commands[-1].speeds.values()) < 0.05


def test_contradictory_keeps_are_named() -> None:
    model = planar_arm(1)
    speed = model.symbol("joint1").derivative()
    controller = Controller(
        model, [Keep(0.3, speed, 1, name="on"), Keep(-1, speed, -0.3, name="back")], dt=DT
    )
    with pytest.raises(InfeasibleError, match="contradict") as raised:
        controller.step(model.default_state())
    assert {c.name for c in raised.value.conflict} == {"on", "back"}
    assert all(math.isfinite(v) for v in raised.value.command.speeds.values())


def test_conflict_names_the_operation_of_a_constraint() -> None:
    model = planar_arm(1)
    speed = model.symbol("joint1").derivative()
    controller = Controller(model, [Keep(3.0, speed, 9.0, name="fast")], dt=DT)
    with pytest.raises(InfeasibleError) as raised:
        controller.step(model.default_state())
    found = {c.name: c.operations for c in raised.value.conflict}
    assert set(found) == {"fast", "joint1/velocity"}
    assert found["joint1/velocity"] == tuple(model.history.writers("constraints/joint1/velocity"))
    # The least-violating command stays within the limits of the joint.
    assert raised.value.command.speeds[speed] == pytest.approx(1.0, abs=1e-6)


def test_contradictory_holds_stop_without_progress() -> None:
    model = planar_arm(1)
    q = model.symbol("joint1")
    controller = Controller(model, [Hold(q, 0.5, name="one"), Hold(q, -0.5, name="other")], dt=DT)
    _, commands = follow(controller, model.default_state(), 1.0)
    assert commands[-1].progress == pytest.approx(0.0, abs=1e-6)
    assert commands[-1].residuals == {"one": pytest.approx(0.5), "other": pytest.approx(0.5)}


def test_singular_pose_is_named_and_never_commanded() -> None:
    model = garage()
    controller = Controller(model, [Goal(model.fk("door")[:3, 0], [1, 0, 0], name="pose")], dt=DT)
    with pytest.raises(NotFiniteError, match="'pose'") as raised:
        controller.step(model.default_state().updated({"door": 2.0}))
    assert "pose" in raised.value.names
    command = controller.step(model.default_state().updated({"door": 1.0}))
    assert all(math.isfinite(v) for v in command.speeds.values())


def test_states_without_a_value_or_with_nan_are_refused() -> None:
    model = planar_arm(2)
    controller = Controller(model, [Goal(model.symbol("joint1"), 0.5)], dt=DT)
    with pytest.raises(UnknownNameError, match="joint1"):
        controller.step(kv.State({"joint2": 0.1}))
    with pytest.raises(UnknownNameError, match="jiont1"):
        controller.step({"jiont1": 0.1})
    with pytest.raises(NotFiniteError, match="joint1"):
        controller.step([math.nan])
    with pytest.raises(ShapeError):
        controller.step([0.1, 0.2])


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda m: Goal("joint1", 1.0), ExpressionError, "model.symbol"),
        (lambda m: Goal(m.fk("tip"), np.eye(4)), ShapeError, "same_pose"),
        (lambda m: Goal(m.fk("tip")[:3, 3], [1.0, 2.0]), ShapeError, "target"),
        (lambda m: Goal(m.symbol("joint1"), math.nan), InvalidValueError, "NaN"),
        (lambda m: Goal(m.symbol("joint1"), 1.0, gain=0.0), InvalidValueError, "gain"),
        (lambda m: Goal(m.symbol("joint1"), 1.0, weight=-1.0), InvalidValueError, "weight"),
        (lambda m: Goal(kv.array([1.0, 2.0]), 1.0), InvalidValueError, "nothing that moves"),
        (lambda m: Hold(m.symbol("joint1").derivative()), InvalidValueError, "Keep"),
        (lambda m: Keep(1.0, m.symbol("joint1"), 0.0), InvalidValueError, "between"),
        (lambda m: Keep(0.0, "joint1", 1.0), ExpressionError, "model.symbol"),
    ],
)
def test_wrong_tasks_are_refused(build, error, message) -> None:
    with pytest.raises(error, match=message):
        build(planar_arm(2))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"tasks": []}, InvalidValueError, "Without a task"),
        ({"tasks": [3]}, ExpressionError, "Goal, a Hold or a Keep"),
        ({"dt": 0.0}, InvalidValueError, "dt"),
        ({"dt": math.nan}, InvalidValueError, "dt"),
        ({"fixed": ["jiont1"]}, UnknownNameError, "joint1"),
        ({"fixed": ["joint1", "joint2"]}, InvalidValueError, "fixed= keeps in place"),
        ({"weights": {"jiont1": 2.0}}, UnknownNameError, "joint1"),
        ({"acceleration": -1.0}, InvalidValueError, "positive"),
    ],
)
def test_wrong_arguments_are_refused(arguments, error, message) -> None:
    model = planar_arm(2)
    given = {"tasks": [Goal(model.fk("tip")[:2, 3], [1, 1])], "dt": DT, **arguments}
    with pytest.raises(error, match=message):
        Controller(model, **given)


def test_tasks_about_foreign_symbols_and_double_names_are_refused() -> None:
    model = planar_arm(2)
    with pytest.raises(UnknownNameError, match="joint1"):
        Controller(model, [Goal(kv.position("jiont1"), 1.0)], dt=DT)
    q = model.symbol("joint1")
    with pytest.raises(DuplicateNameError):
        Controller(model, [Goal(q, 1.0), Goal(q, 0.0)], dt=DT)
    with pytest.raises(DuplicateNameError):
        Controller(model, [Keep(0.0, q, 1.0, name="joint1/position")], dt=DT)


def test_run_takes_states_and_gives_commands_until_a_condition() -> None:
    model = planar_arm()
    q = model.symbol("joint1")
    controller = Controller(model, [Goal(q, 0.3)], dt=0.1)
    now, state = [0.0], model.default_state()

    def source() -> kv.State:
        return kv.State(state, stamp=now[0])

    def sink(speeds: dict) -> None:
        nonlocal state
        state = model.integrate(state, speeds, controller.dt)

    def sleep(seconds: float) -> None:
        now[0] += seconds

    report = controller.run(
        rate=50, source=source, sink=sink, until=lambda s: s[q] > 0.29, clock=lambda: now[0], sleep=sleep
    )
    assert controller.dt == 0.02
    assert report.missed_deadlines == 0
    assert report.cycles > 50
    assert state[q] == pytest.approx(0.29, abs=0.01)
    with pytest.raises(InvalidValueError, match="rate"):
        controller.run(rate=0, source=source, sink=sink)
    with pytest.raises(InvalidValueError, match="dt"):
        controller.dt = -1.0


def test_floating_base_reaches_a_pose() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="body", parent="world", child="body"))
    target = kv.translation(0.5, -0.2, 0.3)() @ kv.axis_angle([1, 2, 3], 2.0)()
    goal = Goal(same_pose(model.fk("body"), target), gain=3.0, name="pose")
    controller = Controller(model, [goal], dt=DT)
    assert len(controller.speeds) == 6
    end, commands = follow(controller, model.default_state(), 5.0)
    assert commands[-1].residuals["pose"] < 1e-5
    assert sum(end[s] ** 2 for s in model.symbols if "/q" in str(s)) == pytest.approx(1.0, abs=1e-12)


def test_center_of_mass_stays_while_a_limb_moves() -> None:
    model = planar_arm(3)
    with model.edit() as edit:
        for k in (1, 2, 3):
            body = Body(inertia=Inertia(1.0, (1, 0, 0, 1, 0, 1)))
            edit.add_frame(f"middle{k}", f"link{k}", kv.translation(0.5, 0, 0), body)
    com, q = model.center_of_mass()[:2], model.symbol("joint3")
    state = model.default_state().updated({"joint1": 0.4, "joint2": 0.9, "joint3": -0.7})
    controller = Controller(model, [Hold(com[0], float(com[0](state)), name="balance"), Goal(q, 0.2)], dt=DT)
    end, commands = follow(controller, state, 5.0)
    assert end[q] == pytest.approx(0.2, abs=1e-2)
    assert max(c.residuals["balance"] for c in commands) < 1e-3


def test_acceleration_that_the_model_states_is_hard() -> None:
    model = planar_arm(2)
    q = model.symbol("joint1")
    with model.edit() as edit:
        edit.constrain("joint1/acceleration", -1.5, q.derivative().derivative(), 1.5)
    controller = Controller(model, [Goal(q, 1.5, gain=10.0)], dt=DT, smooth=0)
    _, commands = follow(controller, model.default_state(), 3.0)
    speeds = np.array([0.0, *(c.speeds[q.derivative()] for c in commands)])
    assert np.abs(np.diff(speeds)).max() <= 1.5 * DT + 1e-8
    assert commands[-1].residuals["goal joint1"] < 1e-2


def test_bound_that_moves_is_respected() -> None:
    """A drawer that must stay behind a door, both moving."""
    model = planar_arm(2)
    one, two = model.symbol("joint1"), model.symbol("joint2")
    with model.edit() as edit:
        edit.constrain("behind", -math.inf, two, 0.5 * one)
    controller = Controller(model, [Goal(two, 1.0), Goal(one, 1.0, gain=0.5)], dt=DT)
    state, worst = model.default_state(), -math.inf
    for _ in range(200):
        state = model.integrate(state, controller.step(state).speeds, DT)
        worst = max(worst, state[two] - 0.5 * state[one])
    assert worst < 1e-9
    assert state[two] > 0.3


def test_hold_that_cannot_be_corrected_stops_no_other() -> None:
    model = planar_arm(2)
    one, two = model.symbol("joint1"), model.symbol("joint2")
    stuck = Hold(1e-8 * two + 1e-6, name="stuck")
    controller = Controller(model, [Hold(one, 1.0, name="free"), stuck], dt=DT)
    _, commands = follow(controller, model.default_state(), 4.0)
    assert commands[-1].residuals["free"] < 1e-6
    assert commands[-1].residuals["stuck"] == pytest.approx(1e-6, rel=0.05)
    assert commands[-1].progress < 0.1


def test_articulation_stands_for_its_coordinates() -> None:
    model = kv.load("fetch")
    goal = Goal(model.fk("fetch/gripper_link")[:3, 3], [0.8, 0.2, 0.9])
    arm = Controller(model, [goal], dt=DT, fixed=["fetch/base"])
    assert not [s for s in arm.speeds if s.path.startswith("fetch/base")]
    free = Controller(model, [goal], dt=DT, fixed="fetch/torso_lift_joint")
    assert {*map(str, free.speeds)} - {*map(str, arm.speeds)}


def test_a_controller_and_inverse_kinematics_without_a_scene_import_no_geometry() -> None:
    program = """
import sys
import kineverse as kv
model = kv.Model()
with model.edit() as edit:
    joint = {"name": "joint", "parent": "world", "child": "link", "axis": (0, 0, 1)}
    edit.apply(kv.Revolute(**joint, lower=-1, upper=1, velocity=1))
goal = kv.control.Goal(model.fk("link")[0, 0], 0.9)
kv.control.Controller(model, [goal], dt=0.02).step(model.default_state())
assert kv.control.inverse_kinematics(model, [goal]).solved
print(*(name for name in sys.modules if name.startswith("kineverse.geometry")))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.stdout.strip(), done.stderr) == ("", "")
