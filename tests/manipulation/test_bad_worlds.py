"""Skills in worlds in which something is wrong: each result says what, and the robot stands within 100 ms."""

import math
import re
import sys
import threading
from pathlib import Path

import pytest

import kineverse as kv
from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError
from kineverse.manipulation import Session, SkillError, TrueBelief, open_object, push
from kineverse.worlds import KinematicWorld

sys.path.insert(0, str(Path(__file__).parents[1] / "worlds"))
from pusher import pusher
from test_pushing import PUSHER, opened, room

DRAWER = "room/drawer"
STOPPED = 0.1
"""Longest time from a fault to zero speeds [s]."""


class FaultyWorld(KinematicWorld):
    """World with a fault that begins when the robot or the drawer has moved by 2 cm; moves are counted from then on.

    Attributes
    ----------
    begin
        Time of the fault [s]; None before.
    moving
        Time since the fault after which the robot still moved [s].
    """

    fault, watched, drawer = "", DRAWER, DRAWER

    def reset(self, state):
        super().reset(state)
        self.begin, self.moving, self.first = None, 0.0, self.state.get(self.watched, 0.0)
        self.blocked = threading.Event()

    def apply(self, speeds, duration, *, stamp=None):
        if self.begin is None and abs(self.state[self.watched] - self.first) > 0.02:
            self.begin = self.time
        if self.begin is None or not self.fault:
            return super().apply(speeds, duration, stamp=stamp)
        if self.fault == "blocks":
            self.blocked.wait(20.0)
        if self.fault in ("blocks", "stands still"):
            return None
        before = self.state
        super().apply(speeds, duration, stamp=stamp)
        if any(abs(self.state[s] - before[s]) > 1e-6 for s in before if s.path.startswith("robot/")):
            self.moving = self.time - self.begin
        if self.fault == "moves away" and self.state[self.drawer] < 0.3:
            now = self.time
            super().reset(self.state.updated({self.drawer: self.state[self.drawer] + 0.01}))
            self._time = now
        return None


class StoppedBelief(TrueBelief):
    """Belief whose readings end with the fault of its world."""

    def update(self, world, commands=None):
        return super().update(world, commands) if world.begin is None else self._state


def before_drawer(model, **values):
    start = {"robot/finger": 0.05, "robot/z": 2.0, DRAWER: values.get("drawer", 0.0)}
    return model.default_state().updated(start)


@pytest.fixture(scope="module")
def world():
    return FaultyWorld(pusher(), "robot")


def start(world, fault, watched=DRAWER, **values):
    world.fault, world.watched = fault, watched
    world.reset(before_drawer(world.model, **values))


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("unobserved", "was observed last at 0.22"),
        ("stands still", "stands still at 0.22"),
        ("blocks", "has not answered for 0.05 s"),
    ],
)
def test_session_ends_when_its_world_stops_answering(world, fault, says):
    start(world, fault, "robot/x")
    belief = StoppedBelief() if fault == "unobserved" else None
    session = Session(world, belief=belief, timeout=0.05 if fault == "blocks" else None)
    with pytest.raises(SkillError, match=says):
        for _ in range(40):
            session.act({kv.velocity("robot/x"): 0.1})
    assert world.moving <= STOPPED + 1e-9
    session.stop()
    assert not session.commands
    assert session.answers == (fault != "blocks")
    world.blocked.set()


def test_steps_beyond_the_time_out_of_a_world_are_refused(world):
    with pytest.raises(InvalidValueError, match=r"timeout=0\.2"):
        Session(world, dt=0.2)
    assert Session(world, dt=world.timeout).dt == world.timeout


def test_open_ends_when_the_object_moves_away(world):
    start(world, "moves away")
    session = Session(world)
    outcome = open_object(session, DRAWER, target=0.2, seconds=8.0)
    assert not outcome
    assert "slipped" in outcome.reason
    assert not any(session.commands.values())
    assert world.held is None


@pytest.mark.parametrize(
    ("fault", "says"), [("unobserved", "was observed last at"), ("moves away", "Out of time")]
)
def test_push_ends_when_readings_end_or_the_object_moves_away(fault, says):
    world = FaultyWorld(room(), "robot")
    world.fault, world.drawer, world.watched = fault, "drawer", "drawer"
    world.reset(opened(drawer=0.2) | {"robot/base/y": -1.0})
    session = Session(world, belief=StoppedBelief() if fault == "unobserved" else None)
    outcome = push(session, "drawer", bodies=PUSHER, seconds=8.0)
    assert not outcome
    assert says in outcome.reason
    assert not any(session.commands.values())
    if fault == "unobserved":
        assert 0.0 < world.moving <= STOPPED + 1e-9


def change(edit, what):
    if what == "no gripper":
        edit.remove("frame robot/left_finger")
        edit.remove("frame robot/right_finger")
    elif what == "no handle":
        edit.remove("frame room/drawer_handle")
    elif what == "too high":
        edit.constrain("robot/height", 0, kv.position("robot/z"), 1)
    elif what == "too low":
        edit.constrain("robot/height", 2.6, kv.position("robot/z"), 3)


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("no gripper", "'robot' has no gripper"),
        ("no handle", "'room/drawer' moves no handle"),
        ("too high", "Too high: .* 'robot/palm' reaches 1.03 m at most"),
        ("too low", "arms of a robot .* goes through; failed: .* out of reach"),
    ],
)
def test_open_without_what_it_needs_says_what_is_missing_and_moves_nothing(what, says):
    model = pusher()
    with model.edit() as edit:
        change(edit, what)
    world = KinematicWorld(model, "robot")
    begin = before_drawer(model).updated({"robot/z": {"too high": 0.5, "too low": 2.8}.get(what, 2.0)})
    world.reset(begin)
    try:
        outcome = open_object(Session(world), DRAWER, target=0.3, placements=50)
        assert not outcome
        assert not outcome.measures["pushed"]
        reason = outcome.reason
    except KineverseError as error:
        reason = str(error)
    assert re.search(says, reason), reason
    assert dict(world.state) == dict(begin)


@pytest.mark.parametrize(
    ("upper", "says"),
    [
        (0, "'room/drawer' cannot move: its lower and its upper limit are 0."),
        (kv.position("robot/finger") - 0.05, "'room/drawer' is locked at 0 while 'robot/finger' is 0.05."),
    ],
)
def test_open_of_what_its_limits_hold_is_not_done_and_says_what_holds_it(upper, says):
    model = pusher()
    with model.edit() as edit:
        edit.constrain("room/lock", 0, kv.position(DRAWER), upper)
    world = KinematicWorld(model, "robot")
    world.reset(before_drawer(model))
    session = Session(world)
    for target in (None, 0.3):
        outcome = open_object(session, DRAWER, target=target)
        assert (bool(outcome), outcome.steps) == (False, 0)
        assert outcome.reason.startswith(says)
    assert push(session, DRAWER, bodies="robot/palm")


def test_beliefs_know_the_deviation_of_their_own_coordinates_only():
    model = pusher()
    world = KinematicWorld(model, "robot")
    world.reset(before_drawer(model))
    session = Session(world)
    assert session.deviation(DRAWER) == session.belief.deviation(model.symbol(DRAWER)) == 0.0
    for what in (kv.position("room/drawers"), 2.0 * kv.position("room/drawers")):
        with pytest.raises(UnknownNameError, match=f"'room/drawers'. Did you mean '{DRAWER}'"):
            session.deviation(what)


@pytest.mark.parametrize(
    ("speeds", "error", "says"),
    [
        ({"robot/x:velocty": 0.1}, UnknownNameError, "'robot/x:velocity'"),
        ({kv.position("robot/w").derivative(): 0.1}, UnknownNameError, "'robot/x:velocity'"),
        ({"robot/x": 0.1}, UnknownNameError, "Did you mean 'robot/x:velocity'"),
        ({"robot/x:velocity": math.nan}, InvalidValueError, "'robot/x:velocity' is nan; .* stops the robot"),
        ({"room/drawer:velocity": math.nan}, InvalidValueError, "'room/drawer:velocity' is nan"),
        ({"robot/x:velocity": "fast"}, InvalidValueError, "'robot/x:velocity' is 'fast'"),
        (None, InvalidValueError, "from symbols or names to numbers"),
    ],
)
def test_speeds_that_cannot_be_commanded_are_named(speeds, error, says):
    model = pusher()
    world = KinematicWorld(model, "robot")
    world.reset(before_drawer(model))
    session = Session(world)
    with pytest.raises(error, match=says):
        session.act(speeds)
    assert world.time == 0.0
    session.act({"robot/x:velocity": 0.1})
    assert session.state["robot/x"] > before_drawer(model)["robot/x"]
