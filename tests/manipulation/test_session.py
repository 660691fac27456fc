"""Sessions with a robot, and what all runs of skills have in common: time, stops, outcomes, and references that wait."""

import gc
import math
import threading
import time

import pytest

import kineverse as kv
from kineverse.errors import InfeasibleError, InvalidValueError
from kineverse.manipulation import Robot, Session, SkillError
from kineverse.manipulation.session import EncoderBelief
from kineverse.manipulation.skill_run import Pace, SkillRun
from kineverse.state import State
from kineverse.worlds import Observation

X = kv.position("cart/x")


class Cart:
    """A cart on a rail, whose clock, latency and readings tests decide."""

    def __init__(self):
        self.model = kv.Model()
        with self.model.edit() as edit:
            edit.add_frame("cart/box", "world", kv.translation(X, 0, 0))
            edit.add_frame("post", "world", kv.translation(2, 0, 0))
        self.name, self.robot, self.remarks, self.timeout = "rail", Robot.of(self.model, "cart"), (), 0.1
        self.time, self.x, self.extra, self.sent = 0.0, 0.0, 0.0, []
        self.joints, self.poses = lambda: {X: self.x}, {}

    def apply(self, speeds, duration, *, stamp=None):
        self.sent.append((dict(speeds), stamp))
        self.x += min(duration, self.timeout) * speeds.get(X.derivative(), 0.0)
        self.time += duration + self.extra
        self.extra = 0.0

    def observe(self):
        return Observation(self.time, self.joints(), self.poses)


@pytest.fixture
def cart():
    return Cart()


def test_session_reads_moves_and_stops_the_robot(cart):
    steps = []
    session = Session(cart, on_step=lambda session: steps.append(session.time))
    assert (session.model, session.robot, session.time, session.steps) == (cart.model, cart.robot, 0.0, 0)
    assert isinstance(session.belief, EncoderBelief)
    session.act({"cart/x:velocity": 0.5})
    assert session.state[X] == cart.x == pytest.approx(0.01)
    assert session.state.stamp == session.observation.stamp == session.time == 0.02
    assert session.start[X] == 0.0
    session.stop()
    assert cart.sent == [({X.derivative(): 0.5}, 0.0), ({}, None)]  # a stop is never too old
    assert (session.steps, len(steps)) == (2, 2)
    cart.x = 0.7
    session.refresh()
    assert session.state[X] == 0.7
    assert session.steps == 2


def test_speeds_of_objects_are_not_sent(cart):
    with cart.model.edit() as edit:
        edit.add_frame("door", "world", kv.rotation_z(kv.position("door")))
    session = Session(cart)
    session.act({"door:velocity": 1.0, kv.velocity("learned/joint"): 1.0, "cart/x:velocity": 0.1})
    assert cart.sent[-1][0] == session.commands == {X.derivative(): 0.1}


class Elsewhere(EncoderBelief):
    """Belief that the cart is at 9 m."""

    def update(self, observation, time, commands=None):
        state = super().update(observation, time, commands)
        return State({**state, X: 9.0}, stamp=state.stamp)


def test_another_belief_counts_for_a_while(cart):
    session = Session(cart)
    before, other = session.belief, Elsewhere(cart.model, cart.robot)
    with session.believing(other):
        assert session.belief is other
        session.act({"cart/x:velocity": 0.5})
        assert session.state[X] == 9.0
    assert session.belief is before
    assert session.state[X] == cart.x
    assert session.state.stamp == cart.time


def test_a_session_ends_with_an_edit_of_its_model(cart):
    session = Session(cart)
    with cart.model.edit() as edit:
        edit.add_frame("door", "world", kv.rotation_z(kv.position("door")))
    for use in (lambda: session.act({}), session.refresh, lambda: SkillRun(session, X, 10.0)):
        with pytest.raises(InvalidValueError, match="was edited"):
            use()
    session.stop()
    assert cart.sent == [({}, None)]


def test_a_search_that_takes_long_is_followed_by_new_readings(cart):
    texts = []
    session = Session(cart, on_search=texts.append)
    for pause, expected in ((0.0, 0.0), (0.12, 0.3)):
        with session.search("a way"):
            cart.x, cart.time = 0.3, cart.time + pause
            time.sleep(pause)
        assert session.state[X] == expected
    assert texts == ["a way", "a way"]


def test_computations_of_a_step_are_timed(cart):
    session = Session(cart)
    with session.timed("think"):
        time.sleep(0.02)
    assert session.wall["think"][0] >= 0.02 > session.cpu["think"][0]


def test_the_robot_waits_for_readings_that_are_missing(cart):
    session = Session(cart)
    cart.joints = lambda: {X: cart.x} if cart.time > 0.5 else {}
    session.act({"cart/x:velocity": 0.5})
    assert cart.time == pytest.approx(0.51, abs=0.011)
    assert session.state[X] == cart.x == pytest.approx(0.01)
    assert not any(any(speeds.values()) for speeds, _ in cart.sent[1:])


@pytest.mark.parametrize(
    ("joints", "says"),
    [
        ({}, "The robot's readings lack 'cart/x'."),
        ({X: math.nan}, "The robot's readings of 'cart/x' are no finite numbers."),
        ({X: None}, "The robot's readings of 'cart/x' are no finite numbers."),
    ],
)
def test_patience_ends(cart, joints, says):
    session = Session(cart, patience=0.3)
    cart.joints = lambda: joints
    with pytest.raises(SkillError, match=says) as caught:
        session.act({})
    assert "has waited for 0.32 s" in str(caught.value)
    assert session.state[X] == 0.0
    assert not session.broken


def test_a_session_begins_with_the_first_look_that_succeeds(cart):
    cart.joints, cart.x = dict, 0.7
    session = Session(cart)
    assert session.start.stamp is None
    cart.joints = lambda: {X: cart.x}
    session.act({})
    assert session.start[X] == 0.7
    session.act({"cart/x:velocity": 0.5})
    assert session.start[X] == 0.7 < session.state[X]


def test_a_robot_whose_clock_stands_still_is_waited_for_by_ours(cart):
    session = Session(cart, patience=0.1)
    cart.apply = lambda speeds, duration, stamp=None: None
    begin = time.monotonic()
    with pytest.raises(SkillError, match="time 'rail' stands still at 0 s"):
        session.act({})
    assert 0.1 < time.monotonic() - begin < 5.0


def test_frames_that_the_model_does_not_have_are_remarked(cart):
    cart.poses = {"lamp": kv.translation(0, 0, 0)({}), "post": kv.translation(2, 0, 0)({})}
    session = Session(cart)
    assert {*session.observation.poses} == {"post"}
    assert session.remarks == ("Poses are observed of frames that the model does not have: 'lamp'.",)


@pytest.mark.parametrize("timeout", [None, math.nan, 0.0, "0.1"])
def test_the_time_out_of_a_robot_is_positive(cart, timeout):
    cart.timeout = timeout
    with pytest.raises(InvalidValueError, match="timeout of a robot's interface is a positive time"):
        Session(cart)


def test_the_thread_of_a_session_ends_with_it(cart):
    before = {*threading.enumerate()}
    session = Session(cart)
    session.act({})
    (thread,) = {*threading.enumerate()} - before
    del session
    gc.collect()
    thread.join(5.0)
    assert not thread.is_alive()


@pytest.mark.parametrize("options", [{"dt": 0.0}, {"timeout": -1.0}, {"patience": math.nan}])
def test_times_of_a_session_are_positive(cart, options):
    with pytest.raises(InvalidValueError, match="positive time"):
        Session(cart, **options)


def drive(run, steps, error=None):
    def skill():
        run.session.phase = "drive"
        for _ in range(steps):
            run.act({X.derivative(): 0.5})
        if error is not None:
            raise error
        return "It is there."

    return skill


def test_run_returns_what_the_skill_believes(cart):
    run = SkillRun(Session(cart), X, 10.0)
    run.measures["grasps"] = 2
    outcome = run.perform(drive(run, 5))
    assert (outcome.done, outcome.reason, outcome.world, outcome.steps) == (True, "It is there.", "rail", 6)
    assert outcome.value == pytest.approx(0.05)
    assert outcome.seconds == pytest.approx(0.12)
    assert outcome.measures == {"grasps": 2}
    assert (run.session.phase, run.session.commands) == ("", {})


@pytest.mark.parametrize(
    ("error", "reason", "kind"),
    [
        (SkillError("reach", "Too far.", {"free": 0.1}), "Too far.", "reach"),
        (InfeasibleError("No way."), "The controller has no command: No way.", "other"),
    ],
)
def test_run_that_fails_stops_the_robot_and_says_why(cart, error, reason, kind):
    run = SkillRun(Session(cart), X, 10.0)
    outcome = run.perform(drive(run, 3, error))
    assert not outcome
    assert outcome.reason.startswith(reason)
    assert outcome.measures["failure"] == kind
    assert ("free" in outcome.measures) == (kind == "reach")
    assert cart.sent[-1][0] == {}


@pytest.mark.parametrize("error", [KeyboardInterrupt(), InvalidValueError("No such thing.")])
def test_what_ends_a_run_from_outside_stops_the_robot_and_goes_on(cart, error):
    run = SkillRun(Session(cart), X, 10.0)
    with pytest.raises(type(error)):
        run.perform(drive(run, 3, error))
    assert cart.sent[-1][0] == {}
    assert run.session.phase == ""


def test_what_does_not_stop_is_not_done(cart):
    run, apply = SkillRun(Session(cart), X, 10.0), cart.apply

    def fail(speeds, duration, *, stamp=None):
        if not speeds:
            raise OSError("the cable is out")
        apply(speeds, duration, stamp=stamp)

    cart.apply = fail
    outcome = run.perform(drive(run, 3))
    assert (outcome.done, outcome.measures) == (False, {"failure": "other"})
    assert outcome.reason.startswith("It is there. The interface of the robot 'rail' raised OSError")


@pytest.mark.parametrize(
    ("seen", "deviation", "says"),
    [
        ({}, 0.01, "no marker of it has been seen."),
        ({X: -2.0}, 0.01, "no marker of it has been seen for 4 s."),
        ({X: math.inf}, math.inf, "its track is lost."),
        ({X: math.inf}, 0.01, "It is there."),
    ],
)
def test_what_is_not_seen_is_not_done(cart, seen, deviation, says):
    session = Session(cart)
    session.belief.seen, session.belief.deviation = seen, lambda _: deviation
    outcome = SkillRun(session, X, 10.0).perform(lambda: "It is there.")
    assert outcome.done == (says == "It is there.")
    assert says in outcome.reason


def test_run_that_moves_nothing_takes_no_step(cart):
    run = SkillRun(Session(cart), X, 10.0)
    assert run.perform(lambda: "It is there.").steps == 0
    assert not cart.sent


def test_time_of_a_run_is_up(cart):
    run = SkillRun(Session(cart), X, 0.1)
    outcome = run.perform(drive(run, 100))
    assert outcome.measures["failure"] == "time"
    assert outcome.reason == "The time is up in 'drive'."
    assert outcome.seconds < 0.2
    run.stand(0.1)  # is no matter of time
    assert run.left == pytest.approx(0.1 - cart.time)


def test_references_wait_for_a_robot_that_is_late(cart):
    session = Session(cart)
    pace = Pace(session, 0.1, speed=1.0)
    session.act({})
    assert pace.advance(0.02) == pytest.approx(0.02)
    session.act({})
    assert 0.0 < pace.advance(0.1) < 0.02
    session.act({})
    assert pace.advance(0.2) == 0.0
    session.act({})
    assert pace.advance(0.0) == pytest.approx(0.02 * 0.02 / 0.5)  # from rest
    with pytest.raises(SkillError, match=r"for 4 s it has been 0\.3"):
        for _ in range(300):
            session.act({})
            pace.advance(0.3)


@pytest.mark.parametrize("timeout", [0.05, 0.1, 5.0])
def test_references_begin_at_rest_after_a_pause_of_the_robot(cart, timeout):
    """Also where a command would have acted for longer: nobody knows how far it led."""
    cart.timeout = timeout
    session = Session(cart)
    pace, passed = Pace(session, 0.1, speed=1.0), []
    for k in range(60):
        cart.extra = 1.0 if k == 10 else 0.0
        session.act({})
        passed.append(pace.advance(0.0))
    assert passed[:10] == pytest.approx([0.02] * 10)
    assert passed[10] <= 0.02 + 1e-9  # and not the second that has passed
    assert passed[11] < 0.005
    assert max(passed) == pytest.approx(0.02)
    assert passed[-1] == pytest.approx(0.02)
