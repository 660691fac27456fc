"""Law: the judge measures what a state shows, whatever the world says about it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pusher import BALL, gripper, pusher

import kineverse as kv
from cupboards import box
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.grasping import Gripper
from kineverse.model.model import Model
from kineverse.state import State
from kineverse.worlds import Judge
from kineverse.worlds.run_metrics import LimitJudge

DT = 0.02


@pytest.fixture(scope="module")
def model() -> Model:
    return pusher()


@pytest.fixture(scope="module")
def hand(model: Model) -> Gripper:
    return gripper(model)


@pytest.fixture(scope="module")
def judge(model: Model, hand: Gripper) -> Judge:
    return Judge(model, "robot", hand, "room/door_handle")


def run(judge: Judge, rows: list[dict[str, float]], speeds=None, **given) -> dict:
    """Return the measures of states, one each 20 ms, with commanded speeds by state from the second on."""
    home = judge.model.default_state()
    if "robot/finger" in home:
        home = home.updated({"robot/finger": 0.05})
    judge.reset()
    for k, row in enumerate(rows):
        commanded = None if speeds is None or k == 0 else speeds[k - 1]
        options = {name: value[k] for name, value in given.items()}
        judge.update(home.updated(row, stamp=k * DT), commanded, **options)
    return judge.measures


def test_limits_of_positions_and_of_true_speeds(judge):
    fine = run(judge, [{"room/drawer": 0.0}, {"room/drawer": 0.004}, {"room/drawer": 0.4}][:2])
    assert (fine["limit_violation"], fine["limit"]) == (0.0, "")
    beyond = run(judge, [{"room/drawer": 0.402}, {"room/drawer": 0.4}])
    assert beyond["limit"] == "room/drawer/range"
    assert beyond["limit_violation"] == pytest.approx(0.002)
    # 0.006 m in 20 ms are 0.3 m/s, beyond 0.2 m/s, though nobody commanded it.
    fast = run(judge, [{"room/drawer": 0.1}, {"room/drawer": 0.106}])
    assert fast["limit"] == "room/drawer/speed"
    assert fast["limit_violation"] == pytest.approx(0.1)


def test_locks_hold_if_they_are_closed_during_a_step():
    judge = Judge(pusher(locked=True), "robot")
    opens = run(judge, [{"room/bolt": 0.6}, {"room/bolt": 0.4, "room/drawer": 0.002}])
    assert opens["limit_violation"] == 0.0
    shuts = run(judge, [{"room/bolt": 0.4}, {"room/bolt": 0.6, "room/drawer": 0.002}])
    assert shuts["limit_violation"] == 0.0
    locked = run(judge, [{"room/bolt": 0.4}, {"room/bolt": 0.45, "room/drawer": 0.002}])
    assert locked["limit"] == "room/drawer/lock"
    assert locked["limit_violation"] == pytest.approx(0.1)


def test_penetration_of_all_pairs_but_the_excepted_ones(judge):
    ball = 1.0 - 0.01 - BALL
    assert run(judge, [{"robot/x": ball - 0.001, "robot/y": 0.3, "robot/z": -0.2}])["penetration"] == 0.0
    deep = run(judge, [{"robot/x": ball + d, "robot/y": 0.3, "robot/z": -0.2} for d in (0.0, 0.004, 0.002)])
    assert deep["penetration"] == pytest.approx(0.004, abs=1e-6)
    assert set(deep["penetrating"]) == {"robot/ball", "room/panel"}
    # The palm in the handle does not count, and the list says so. In the bar of the drawer it does.
    inside = run(judge, [{"robot/x": 0.915, "robot/y": 0.7, "robot/finger": 0.05}])
    assert ("robot/palm", "room/door_handle") in inside["excepted"]
    assert inside["penetration"] == 0.0
    other = run(judge, [{"robot/x": 0.875, "robot/z": 2.0, "robot/turn": math.pi / 2}])
    assert other["penetrating"] == ("robot/palm", "room/drawer_handle")
    assert other["penetration"] == pytest.approx(0.005, abs=1e-5)


def test_contacts_that_end_while_pushing_are_losses(judge):
    gaps = (0.0005, 0.002, 0.0005, 0.0, 0.003, 0.0005)
    rows = [{"robot/x": 1.0 - 0.01 - BALL - gap, "robot/y": 0.3} for gap in gaps]
    assert run(judge, rows, pushing=[True, True, True, True, False, True])["contact_losses"] == 1
    assert run(judge, rows, pushing=[True] * 6)["contact_losses"] == 2
    assert run(judge, rows)["contact_losses"] == 0


def test_grasp_error_is_the_motion_in_the_hand_since_the_hold_began(judge):
    held = [None, "room/door_handle", "room/door_handle", None, "room/door_handle", "room/door_handle"]
    rows = [
        {"robot/x": x, "robot/y": 0.7, "robot/turn": turn}
        for x, turn in ((0.7, 0), (0.88, 0), (0.882, 0.03), (0.5, 0), (0.881, 0), (0.8805, 0))
    ]
    found = run(judge, rows, held=held)
    middle = 0.06  # from the base to between the fingers
    # The middle is fixed in the handle: the hand is 2 mm further, and turned about its base.
    moved = np.array([0.94, 0.7]) - np.array([0.882, 0.7])
    back = np.array([[math.cos(0.03), math.sin(0.03)], [-math.sin(0.03), math.cos(0.03)]]) @ moved
    assert found["grasp_error"] == pytest.approx(float(np.hypot(back[0] - middle, back[1])), abs=1e-9)
    assert found["grasp_rotation"] == pytest.approx(0.03)
    assert math.isnan(run(judge, rows)["grasp_error"])


def test_jitter_reversals_and_ways(judge):
    signs = [1.0, -1.0, 1.0, -1.0, 1.0]
    rows = [{"robot/x": 0.1 * k, "robot/y": -0.1 * (k % 2)} for k in range(6)]
    found = run(judge, rows, [{"robot/x:velocity": 0.1, "robot/y:velocity": 0.02 * s} for s in signs])
    assert found["jitter"] == pytest.approx(0.08)
    assert found["reversals"] == pytest.approx(4 / (5 * DT))
    assert found["distance"] == pytest.approx(5 * math.hypot(0.1, 0.1))
    assert found["hand_distance"] == pytest.approx(found["distance"])
    ramp = run(
        judge, rows, [{"robot/x:velocity": 0.1 * k, "room/door:velocity": (-1.0) ** k} for k in range(5)]
    )
    assert ramp["jitter"] == pytest.approx(0.0, abs=1e-12)
    assert ramp["reversals"] == 0.0


def test_bad_input_is_refused(judge, model):
    judge.reset()
    with pytest.raises(InvalidValueError, match="stamps"):
        judge.update(model.default_state())
    judge.update(State(model.default_state(), stamp=1.0))
    with pytest.raises(InvalidValueError, match="reset"):
        judge.update(State(model.default_state(), stamp=1.0))
    with pytest.raises(UnknownNameError, match="room/door_handle"):
        Judge(model, "robot", handle="room/door_handel")
    with pytest.raises(UnknownNameError, match="robot"):
        Judge(model, "robto")


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
    judge = Judge(model, "robot", coordinate=drawer)
    shut, out = {"room/drawer": 0.0, "robot/fold": 0.0}, {"room/drawer": 0.5, "robot/fold": 0.1}
    found = run(judge, [shut, out, shut])
    assert {frozenset(pair) for pair in found["excepted"]} == {
        frozenset({"room/case", "room/front"}),
        frozenset({"robot/link", "robot/tip"}),
    }
    assert found["penetration"] == 0.0
    assert judge.overlap is None
    # What comes on the way counts, though the drawer is there by default; so does the robot in furniture.
    inside = [out | {"room/drawer": x} for x in (0.5, 0.28, 0.1)]
    found = run(judge, inside)
    assert found["penetration"] == pytest.approx(0.2, abs=1e-6)
    assert (set(found["penetrating"]), found["penetration_from"]) == ({"room/case", "room/front"}, 0.28)
    assert "from 0.280 on" in str(judge.overlap)
    assert run(judge, inside[:2])["penetration"] == pytest.approx(0.02, abs=1e-6)
    before = Judge(model, "robot", start=model.default_state().updated(shut))
    assert run(before, inside)["penetration"] == 0.0
    folds = run(judge, [{"robot/fold": 0.5}, {"robot/fold": 0.1}])
    assert [{*pair} for pair in folds["excepted"]] == [{"room/case", "room/front"}]
    assert folds["penetrating"] == ("robot/link", "robot/tip")
    assert folds["penetration"] == pytest.approx(0.05, abs=1e-6)
    assert run(judge, [{"robot/x": -3.0, "robot/fold": 0.5}])["penetration"] == pytest.approx(0.3, abs=1e-6)


# -- violations of limits in successive states, with speeds that are differences of states

A, B = kv.position("a"), kv.position("b")


def judged(*states, dt=0.5):
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("range", 0, A, 1)
        edit.constrain("lock", -1, A.derivative(), 2 * (B > 0.5))
        edit.constrain("root", 0, np.sqrt(2 + A), 9)
    judge = LimitJudge(model)
    assert judge.symbols == (A, B)
    for n, state in enumerate(states):
        judge.update(np.array(state), n * dt)
    return judge


def test_motion_within_limits_violates_nothing():
    judge = judged((0.0, 0.0), (0.0, 1.0), (1.0, 1.0))
    assert (judge.violation, judge.limit) == (0.0, "")


def test_motion_through_a_lock_is_measured_by_its_speed():
    judge = judged((0.0, 0.0), (0.2, 0.0))
    assert judge.violation == pytest.approx(0.4)
    assert judge.limit == "lock"


def test_lock_that_opens_or_closes_within_a_step_may_have_been_open():
    assert judged((0.0, 0.0), (0.5, 1.0)).limit == ""
    assert judged((0.0, 1.0), (0.5, 0.0)).limit == ""


def test_position_beyond_its_limit_is_the_largest_violation():
    judge = judged((0.0, 1.0), (1.0, 1.0), (1.3, 1.0), (1.0, 1.0))
    assert judge.violation == pytest.approx(0.3)
    assert judge.limit == "range"
    judge.update(np.array([-3.0, 1.0]), 9.0)
    assert (judge.violation, judge.limit) == (math.inf, "root")  # which has no value there
    judge.reset()
    assert (judge.violation, judge.limit) == (0.0, "")
