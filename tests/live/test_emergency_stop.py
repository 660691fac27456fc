"""The emergency stop: it goes on asking until the world has stopped, also when that was started anew."""

from __future__ import annotations

import json
import time

import pytest

pytest.importorskip("zenoh")

from kineverse.errors import OfflineError
from kineverse.exchange.state import Newest
from kineverse.live import emergency_stop
from kineverse.live.emergency_stop import RELEASE_PATH, STATE_PATH, STOP_PATH, EmergencyStop
from kineverse.live.streams import Answer, Ask, RobotNote, decode, encode


class Robot:
    """Reader of a robot that answers, or not."""

    def __init__(self):
        self.asked, self.stopped, self.ticks = [], "", 100
        self.is_there, self.answers, self.age = True, True, 0.0

    def newest(self, source):
        if not self.is_there:
            return None
        note = RobotNote("kinematic", 0.04, [], self.stopped, ticks=self.ticks)
        return Newest((), (), 0.0, encode(note), time.monotonic() - self.age)

    def ask(self, source, question, timeout):
        do = decode(question, Ask).do
        self.asked.append(do)
        if not self.answers:
            raise OfflineError("'robot' does not answer.")
        self.stopped = "emergency stop" if do == "stop" else ""
        return encode(Answer())

    def wait(self, timeout):
        return True


@pytest.fixture
def robot(monkeypatch):
    monkeypatch.setattr(emergency_stop, "_ANSWER", 0.0)  # no pause between two questions
    return Robot()


def test_a_robot_is_stopped_and_released(robot):
    stop = EmergencyStop(robot)
    assert not stop.state.stopped
    state = stop.stop()
    assert (state.robot, state.stopped, state.problem) == (True, "emergency stop", "")
    stop.watch()
    assert not stop.release().stopped
    stop.watch()
    assert robot.asked == ["stop", "release"]


def test_a_stop_that_the_world_has_not_confirmed_is_asked_for_again(robot):
    stop, robot.answers = EmergencyStop(robot), False
    assert "does not answer" in stop.stop().problem
    stop.watch()
    robot.answers = True
    stop.watch()
    assert robot.stopped
    assert stop.state.problem == ""
    stop.watch()
    assert robot.asked == 3 * ["stop"]


def test_a_world_that_was_started_anew_is_stopped_again(robot):
    stop = EmergencyStop(robot)
    stop.stop()
    stop.watch()
    robot.is_there = False
    stop.watch()
    assert stop.state.problem == "No robot is there."
    robot.is_there, robot.stopped, robot.ticks = True, "", 3
    stop.watch()
    assert robot.stopped


def test_a_stop_that_somebody_else_has_released_stays_released(robot):
    stop = EmergencyStop(robot)
    stop.stop()
    stop.watch()
    robot.stopped, robot.ticks = "", robot.ticks + 10
    for _ in range(3):
        stop.watch()
    assert robot.asked == ["stop"]
    assert not stop.wanted


def test_browsers_are_answered_and_tell_how_fast_they_draw(robot):
    stop, robot.age = EmergencyStop(robot), 3.0
    answers = stop.answers()
    assert stop.slowest_rate == 0.0
    assert "silent for 3 s" in json.loads(answers[STATE_PATH]("-"))["problem"]
    assert stop.slowest_rate == 0.0
    assert json.loads(answers[STOP_PATH]("25.5"))["stopped"]
    assert not json.loads(answers[RELEASE_PATH]("60"))["stopped"]
    assert stop.slowest_rate == 25.5
    answers[STATE_PATH]("0.0")  # a browser that has not drawn since it was asked last
    assert stop.slowest_rate == 1.0


def test_without_a_robot_there_is_no_button():
    robot = Robot()
    robot.is_there = False
    assert not EmergencyStop(robot).state.robot
