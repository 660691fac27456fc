"""Law: metrics measure what a state shows, whatever the world says about it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from pusher import BALL, gripper, pusher
from scripted_world import ScriptedWorld, Step

import kineverse as kv
from cupboards import box
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.grasping import Gripper
from kineverse.model.model import Model
from kineverse.worlds import PlannedContact, RunMetrics

DT = 0.02


@pytest.fixture(scope="module")
def model() -> Model:
    return pusher()


@pytest.fixture(scope="module")
def hand(model: Model) -> Gripper:
    return gripper(model)


@pytest.fixture(scope="module")
def world(model: Model) -> ScriptedWorld:
    return ScriptedWorld(model, "robot", robot__finger=0.05)


@pytest.fixture(scope="module")
def metrics(world: ScriptedWorld, hand: Gripper) -> RunMetrics:
    return RunMetrics(world, gripper=hand, handle="room/door_handle")


def run(
    metrics: RunMetrics,
    rows: Sequence[dict[str, float]],
    speeds: Sequence[dict[str, float]] = (),
    held: Sequence[str | None] = (),
    contacts: Sequence[PlannedContact | None] = (),
) -> dict:
    """Return the measures of states, one each 20 ms, with what belongs to each, or to each but the first."""
    world = metrics._world
    for k, row in enumerate(rows):
        world.show(row, k * DT, held[k] if held else None)
        if k == 0:
            metrics.reset()
        else:
            metrics(world.step(speeds[k - 1] if speeds else None, contacts[k] if contacts else None))
    return metrics.measures


def test_limits_of_positions_and_of_true_speeds(metrics):
    fine = run(metrics, [{"room/drawer": 0.0}, {"room/drawer": 0.004}, {"room/drawer": 0.4}][:2])
    assert (fine["limit_violation"], fine["limit"]) == (0.0, "")
    beyond = run(metrics, [{"room/drawer": 0.402}, {"room/drawer": 0.4}])
    assert beyond["limit"] == "room/drawer/range"
    assert beyond["limit_violation"] == pytest.approx(0.002)
    # 0.006 m in 20 ms are 0.3 m/s, beyond 0.2 m/s, though nobody commanded it.
    fast = run(metrics, [{"room/drawer": 0.1}, {"room/drawer": 0.106}])
    assert fast["limit"] == "room/drawer/speed"
    assert fast["limit_violation"] == pytest.approx(0.1)


def test_locks_hold_if_they_are_closed_during_a_step() -> None:
    metrics = RunMetrics(ScriptedWorld(pusher(locked=True), "robot"))
    opens = run(metrics, [{"room/bolt": 0.6}, {"room/bolt": 0.4, "room/drawer": 0.002}])
    assert opens["limit_violation"] == 0.0
    shuts = run(metrics, [{"room/bolt": 0.4}, {"room/bolt": 0.6, "room/drawer": 0.002}])
    assert shuts["limit_violation"] == 0.0
    locked = run(metrics, [{"room/bolt": 0.4}, {"room/bolt": 0.45, "room/drawer": 0.002}])
    assert locked["limit"] == "room/drawer/lock"
    assert locked["limit_violation"] == pytest.approx(0.1)


def test_penetration_of_all_pairs_but_the_excepted_ones(metrics):
    ball = 1.0 - 0.01 - BALL
    assert run(metrics, [{"robot/x": ball - 0.001, "robot/y": 0.3, "robot/z": -0.2}])["penetration"] == 0.0
    deep = run(metrics, [{"robot/x": ball + d, "robot/y": 0.3, "robot/z": -0.2} for d in (0.0, 0.004, 0.002)])
    assert deep["penetration"] == pytest.approx(0.004, abs=1e-6)
    assert set(deep["penetrating"]) == {"robot/ball", "room/panel"}
    # The palm in the handle does not count, and the list says so. In the bar of the drawer it does.
    inside = run(metrics, [{"robot/x": 0.915, "robot/y": 0.7, "robot/finger": 0.05}])
    assert ("robot/palm", "room/door_handle") in inside["excepted"]
    assert inside["penetration"] == 0.0
    other = run(metrics, [{"robot/x": 0.875, "robot/z": 2.0, "robot/turn": math.pi / 2}])
    assert other["penetrating"] == ("robot/palm", "room/drawer_handle")
    assert other["penetration"] == pytest.approx(0.005, abs=1e-5)


def test_contacts_that_end_while_they_are_planned_are_losses(metrics, world):
    gaps = (0.0005, 0.002, 0.0005, 0.0, 0.003, 0.0005)
    rows = [{"robot/x": 1.0 - 0.01 - BALL - gap, "robot/y": 0.3} for gap in gaps]
    push = PlannedContact(("robot/ball",), ("room/panel",), True)
    near = push._replace(touching=False)
    for planned, losses in (
        ([push] * 4 + [near, push], 1),
        ([push] * 6, 2),
        ([near] * 6, 0),
        ([None] * 6, 0),
    ):
        assert run(metrics, rows, contacts=planned)["contact_losses"] == losses
    # Without a handle, those with what is pushed count, from the first planned contact on.
    assert run(RunMetrics(world), rows, contacts=[push] * 6)["contact_losses"] == 1


def test_depth_of_a_planned_contact_is_pressed_and_no_overlap(world):
    metrics, ball = RunMetrics(world), 1.0 - 0.01 - BALL
    rows = [{"robot/x": ball + depth, "robot/y": 0.3} for depth in (-0.001, 0.003, 0.001)]
    push = PlannedContact(("robot/ball", "robot/unknown"), ("room/panel",), True)
    found = run(metrics, rows, contacts=[push] * 3)
    assert found["pressed"] == pytest.approx(0.003, abs=1e-6)
    assert (found["penetration"], metrics.overlap) == (0.0, None)
    assert ("robot/ball", "room/panel") in found["excepted"]
    other = PlannedContact(("robot/palm",), ("room/panel",), True)
    assert run(metrics, rows, contacts=[other] * 3)["penetration"] == pytest.approx(0.003, abs=1e-6)
    found = run(metrics, rows)
    assert found["penetrating"] == ("robot/ball", "room/panel")
    assert "pressed" not in found


def test_grasp_error_is_the_motion_in_the_hand_since_the_hold_began(metrics):
    held = [None, "room/door_handle", "room/door_handle", None, "room/door_handle", "room/door_handle"]
    rows = [
        {"robot/x": x, "robot/y": 0.7, "robot/turn": turn}
        for x, turn in ((0.7, 0), (0.88, 0), (0.882, 0.03), (0.5, 0), (0.881, 0), (0.8805, 0))
    ]
    found = run(metrics, rows, held=held)
    middle = 0.06  # from the base to between the fingers
    # The middle is fixed in the handle: the hand is 2 mm further, and turned about its base.
    moved = np.array([0.94, 0.7]) - np.array([0.882, 0.7])
    back = np.array([[math.cos(0.03), math.sin(0.03)], [-math.sin(0.03), math.cos(0.03)]]) @ moved
    assert found["grasp_error"] == pytest.approx(float(np.hypot(back[0] - middle, back[1])), abs=1e-9)
    assert found["grasp_rotation"] == pytest.approx(0.03)
    assert math.isnan(run(metrics, rows)["grasp_error"])


def test_jitter_reversals_and_ways(metrics):
    signs = [1.0, -1.0, 1.0, -1.0, 1.0]
    rows = [{"robot/x": 0.1 * k, "robot/y": -0.1 * (k % 2)} for k in range(6)]
    found = run(metrics, rows, [{"robot/x:velocity": 0.1, "robot/y:velocity": 0.02 * s} for s in signs])
    assert found["jitter"] == pytest.approx(0.08)
    assert found["reversals"] == pytest.approx(4 / (5 * DT))
    assert found["distance"] == pytest.approx(5 * math.hypot(0.1, 0.1))
    assert found["hand_distance"] == pytest.approx(found["distance"])
    ramp = run(
        metrics, rows, [{"robot/x:velocity": 0.1 * k, "room/door:velocity": (-1.0) ** k} for k in range(5)]
    )
    assert ramp["jitter"] == pytest.approx(0.0, abs=1e-12)
    assert ramp["reversals"] == 0.0


def test_steps_in_which_the_time_stands_still_are_skipped(metrics, world):
    run(metrics, [{"room/drawer": 0.1}, {"room/drawer": 0.102}])
    before = metrics.measures
    world.show({"room/drawer": 0.3, "robot/x": 0.1}, DT)
    metrics(world.step({"robot/x:velocity": 9.0}))
    assert str(metrics.measures) == str(before)


def test_metrics_of_a_world_that_was_reset_begin_again_or_say_so(metrics, world):
    run(metrics, [{"room/drawer": 0.1}, {"room/drawer": 0.1}])
    world.show({"room/drawer": 0.1}, 0.0)
    with pytest.raises(InvalidValueError, match=r"at 0\.02 s, and now at 0 s"):
        metrics(world.step())
    metrics.reset()
    metrics(world.step())


def test_belief_and_force_are_compared_with_those_of_the_world(world):
    drawer = world.model.symbol("room/drawer")
    metrics = RunMetrics(world, drawer)
    assert run(metrics, [{}, {"room/drawer": 0.2}]).keys().isdisjoint({"peak_force", "pressed"})
    assert (metrics.value, metrics.measures["estimate_largest"]) == (0.2, 0.0)
    world.show({"room/drawer": 0.1}, 0.0)
    metrics.reset()
    assert "estimate_mean" not in metrics.measures
    for k, error in enumerate((0.01, -0.03, math.nan), 1):
        world.show({"room/drawer": 0.1}, k * DT)
        believed = {} if math.isnan(error) else {drawer: 0.1 + error}
        metrics(Step({}, kv.State(believed)))
    found = metrics.measures
    assert (found["estimate_mean"], found["estimate_largest"]) == pytest.approx((0.02, 0.03))
    forceful = ScriptedWorld(world.model, "robot")
    forceful.peak_force = 0.0
    metrics = RunMetrics(forceful)
    assert metrics.measures["peak_force"] == 0.0
    for k, force in enumerate((3.0, 7.0, 5.0), 1):
        forceful.show({}, k * DT)
        forceful.peak_force = force
        metrics(forceful.step())
    assert metrics.measures["peak_force"] == 7.0


def test_motion_of_a_part_is_that_of_its_point_since_the_begin(world):
    metrics = RunMetrics(world, part="room/door", point=(0.0, 0.8, 0.0))
    found = run(metrics, [{"room/door": 0.1}, {"room/door": 1.2}, {"room/door": 0.6}])
    assert (found["way"], found["turn"]) == pytest.approx((2 * 0.8 * math.sin(0.25), 0.5))
    assert (metrics.way, metrics.turn) == (found["way"], found["turn"])
    assert math.isnan(RunMetrics(world).way)


def test_bad_arguments_are_refused(world):
    with pytest.raises(UnknownNameError, match="room/door_handle"):
        RunMetrics(world, handle="room/door_handel")
    with pytest.raises(UnknownNameError, match="room/door"):
        RunMetrics(world, part="room/dor")
    with pytest.raises(InvalidValueError, match="point="):
        RunMetrics(world, part="room/door", point=(0.0, math.nan, 0.0))
    with pytest.raises(InvalidValueError, match="every="):
        RunMetrics(world, every=0)


def test_what_overlaps_at_the_begin_is_listed_and_not_counted():
    """A drawer is shut inside of a solid box, and a link folds into its neighbour at the begin of a run."""
    model = kv.Model()
    slide, drawer, fold = (kv.position(name) for name in ("robot/x", "room/drawer", "robot/fold"))
    with model.edit() as edit:
        edit.add_frame("room/case", "world", kv.translation(0, 0, 0), body=box(0.4, 0.4, 0.4))
        edit.add_frame("room/front", "world", kv.translation(drawer, 0, 0), body=box(0.2, 0.2, 0.2))
        edit.add_frame("robot/link", "world", kv.translation(slide + 3, 0, 0), body=box(0.2, 0.2, 0.2))
        edit.add_frame(
            "robot/tip", "world", kv.translation(slide + 3.05 + fold, 0, 0), body=box(0.2, 0.2, 0.2)
        )
        for s, lower, upper in ((slide, -5, 0), (drawer, 0, 0.9), (fold, 0, 0.9)):
            edit.constrain(f"{s}/range", lower, s, upper)
    metrics = RunMetrics(ScriptedWorld(model, "robot"), drawer)
    shut, out = {"room/drawer": 0.0, "robot/fold": 0.0}, {"room/drawer": 0.5, "robot/fold": 0.1}
    found = run(metrics, [shut, out, shut])
    assert {frozenset(pair) for pair in found["excepted"]} == {
        frozenset({"room/case", "room/front"}),
        frozenset({"robot/link", "robot/tip"}),
    }
    assert found["penetration"] == 0.0
    assert metrics.overlap is None
    # What comes on the way counts, though the drawer is there by default; so does the robot in furniture.
    inside = [out | {"room/drawer": x} for x in (0.5, 0.28, 0.1)]
    found = run(metrics, inside)
    assert found["penetration"] == pytest.approx(0.2, abs=1e-6)
    assert (set(found["penetrating"]), found["penetration_from"]) == ({"room/case", "room/front"}, 0.28)
    assert "from 0.280 on" in str(metrics.overlap)
    assert run(metrics, inside[:2])["penetration"] == pytest.approx(0.02, abs=1e-6)
    before = RunMetrics(metrics._world, start=model.default_state().updated(shut))
    assert run(before, inside)["penetration"] == 0.0
    folds = run(metrics, [{"robot/fold": 0.5}, {"robot/fold": 0.1}])
    assert [{*pair} for pair in folds["excepted"]] == [{"room/case", "room/front"}]
    assert folds["penetrating"] == ("robot/link", "robot/tip")
    assert folds["penetration"] == pytest.approx(0.05, abs=1e-6)
    assert run(metrics, [{"robot/x": -3.0, "robot/fold": 0.5}])["penetration"] == pytest.approx(0.3, abs=1e-6)


# -- violations of limits in successive states, with speeds that are differences of states

A, B = kv.position("a"), kv.position("b")


def measured(*states: tuple[float, float], dt: float = 0.5) -> RunMetrics:
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("range", 0, A, 1)
        edit.constrain("lock", -1, A.derivative(), 2 * (B > 0.5))
        edit.constrain("root", 0, np.sqrt(2 + A), 9)
    world = ScriptedWorld(model)
    metrics = RunMetrics(world)
    for n, (a, b) in enumerate(states):
        world.show({A: a, B: b}, n * dt)
        metrics(world.step()) if n else metrics.reset()
    return metrics


def test_motion_within_limits_violates_nothing():
    metrics = measured((0.0, 0.0), (0.0, 1.0), (1.0, 1.0))
    assert (metrics.violation, metrics.limit) == (0.0, "")


def test_motion_through_a_lock_is_measured_by_its_speed():
    metrics = measured((0.0, 0.0), (0.2, 0.0))
    assert metrics.violation == pytest.approx(0.4)
    assert metrics.limit == "lock"


def test_lock_that_opens_or_closes_within_a_step_may_have_been_open():
    assert measured((0.0, 0.0), (0.5, 1.0)).limit == ""
    assert measured((0.0, 1.0), (0.5, 0.0)).limit == ""


def test_position_beyond_its_limit_is_the_largest_violation():
    metrics = measured((0.0, 1.0), (1.0, 1.0), (1.3, 1.0), (1.0, 1.0))
    assert metrics.violation == pytest.approx(0.3)
    assert metrics.limit == "range"
    world = metrics._world
    world.show({A: -3.0, B: 1.0}, 9.0)
    metrics(world.step())
    assert (metrics.violation, metrics.limit) == (math.inf, "root")  # which has no value there
    world.show({A: 0.5, B: 1.0}, 0.0)
    metrics.reset()
    assert (metrics.violation, metrics.limit) == (0.0, "")


def test_mechanism_without_a_robot_has_limits_and_overlaps_of_parts_alone():
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("slider", "world", kv.translation(A, 0, 0), body=box(0.2, 0.2, 0.2))
        edit.add_frame("post", "world", kv.translation(1, 0, 0), body=box(0.2, 0.2, 0.2))
        edit.constrain("range", 0, A, 0.95)
    metrics = RunMetrics(ScriptedWorld(model), A)
    found = run(metrics, [{"a": 0.0}, {"a": 0.85}, {"a": 0.5}], [{"a:velocity": 1.0}] * 2)
    assert found["penetration"] == pytest.approx(0.05, abs=1e-6)
    assert (set(found["penetrating"]), found["penetration_from"]) == ({"slider", "post"}, 0.85)
    assert metrics.overlap is not None
    assert (found["limit"], found["contact_losses"]) == ("", 0)
    assert math.isnan(found["distance"])
    assert math.isnan(found["hand_distance"])
    assert math.isnan(found["grasp_error"])
