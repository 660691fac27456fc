"""Tracker of a live system: what it believes of readings and pictures, what it says is lost, and nonsense."""

import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("zenoh")

import kineverse as kv
from kineverse.live import LiveBelief, LiveRobot, TrackerProcess
from kineverse.live.streams import (
    CAMERA,
    ROBOT,
    TRACKER,
    CameraNote,
    RobotNote,
    TrackerNote,
    encode,
    read_note,
)
from kineverse.manipulation import Session
from kineverse.worlds import Sensors

sys.path.insert(0, str(Path(__file__).parents[1] / "worlds"))
from pusher import pusher

DRAWER, DOOR = "room/drawer", "room/door"
NOISE = Sensors.parse("3mm,0.5deg,30Hz")


def until(is_so, seconds=20.0):
    end = time.monotonic() + seconds
    while not (found := is_so()):
        assert time.monotonic() < end
        time.sleep(0.001)
    return found


class Scene:
    """Readings of a robot that stands, and pictures of a drawer, which a test makes up."""

    def __init__(self, live):
        self.live, self.model = live, live.snapshot()
        self.tracker = TrackerProcess(live, "robot", NOISE)
        coordinates = kv.manipulation.Robot.of(self.model, "robot").coordinates
        self.state = self.model.default_state().updated({"robot/finger": 0.05, "robot/z": 2.0})
        self.robot = live.exchange.publisher(ROBOT, coordinates)
        self.camera = live.exchange.publisher(CAMERA, ())
        self.reader = live.exchange.reader()
        self.values = self.state.vector(coordinates)
        self.now, self.picture = time.time(), 0

    def close(self):
        for one in (self.robot, self.camera, self.reader, self.tracker):
            one.close()

    def read(self, note=None):
        self.now += 0.01
        data = encode(RobotNote("kinematic", 0.04, [])) if note is None else note
        seen = self.tracker._reader

        def arrives():
            self.robot.put(self.values, self.now, data)
            time.sleep(0.001)
            newest = seen.newest(ROBOT)
            return newest and newest.stamp == self.now

        until(arrives)

    def see(self, drawer, **poses):
        """Send a picture of the drawer where it is, and of other things."""
        self.picture += 1
        state = self.state.updated({DRAWER: drawer})
        shown = {DRAWER: np.asarray(self.model.fk(DRAWER)(state))} | poses
        data = encode(CameraNote.make(self.picture, shown))

        def arrives():
            self.camera.put((), self.now, data)
            time.sleep(0.001)
            newest = self.tracker._reader.newest(CAMERA)
            return newest and newest.note == data

        until(arrives)

    def look(self, drawer, count=1):
        for _ in range(count):
            self.see(drawer)
            self.read()
            assert self.tracker.step()

    def belief(self):
        """Return the note of the newest estimate, and its values by name."""
        newest = until(lambda: (n := self.reader.newest(TRACKER)) and n.stamp == self.now and n)
        named = dict(zip(newest.names, newest.values.tolist(), strict=True))
        return read_note(self.reader, TRACKER, TrackerNote), named


@pytest.fixture
def scene(sockets):
    with kv.exchange.serve(pusher(), name="home"), kv.load("live:home") as live:
        scene = Scene(live)
        yield scene
        scene.close()


def test_what_is_seen_is_believed_and_what_is_not_is_named(scene):
    scene.look(0.2, 5)
    note, believed = scene.belief()
    assert believed[DRAWER] == pytest.approx(0.2, abs=5e-3)
    assert believed["robot/z"] == pytest.approx(2.0)
    assert note.seen[DRAWER] == pytest.approx(scene.now - 0.01)
    assert DOOR not in note.seen
    deviations = dict(zip(believed, np.frombuffer(note.deviations), strict=True))
    assert deviations[DRAWER] < 0.01 < deviations[DOOR]
    assert not scene.tracker.step()  # nothing is newer
    assert scene.tracker.find_problem() == ""


def test_nonsense_is_passed_over_and_named(scene):
    assert scene.tracker.find_problem() == "There are no readings: no world runs, or it is frozen."
    scene.look(0.2, 3)
    scene.see(0.2, nothing=np.eye(4), **{DOOR: np.full((4, 4), np.nan)})
    scene.camera.put((), scene.now, b"\xc1")
    scene.read()
    assert scene.tracker.step()
    assert scene.belief()[1][DRAWER] == pytest.approx(0.2, abs=5e-3)
    scene.read(note=b"of another version")
    assert not scene.tracker.step()
    assert "another version" in scene.tracker.find_problem()


def test_what_prevents_it_and_its_end_are_told_once(scene):
    told, problems = [], ["no world", "no world", "", "", "another version"]
    scene.tracker.find_problem = lambda: problems.pop(0)
    scene.tracker.run(lambda: not problems, told.append)
    assert told == ["no world", "There are readings.", "another version"]


def test_after_an_edit_it_goes_on_with_what_was_believed(scene):
    scene.look(0.2, 5)
    with scene.live.edit() as edit:
        hinge = {"axis": (0, 0, 1), "lower": 0.0, "upper": 1.0, "velocity": 1.0}
        edit.apply(kv.Revolute(name="room/lid", parent="world", child="room/lid", **hinge))
    until(lambda: scene.tracker._follower.version == scene.live.version)
    scene.read()
    assert scene.tracker.step()
    _, believed = scene.belief()
    assert believed[DRAWER] == pytest.approx(0.2, abs=5e-3)
    assert believed["room/lid"] == 0.0


def test_a_robot_and_a_belief_read_the_streams_and_say_what_is_wrong(scene):
    over = threading.Event()

    def run():
        while not over.is_set():
            scene.look(0.2)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        robot = LiveRobot(scene.model, "robot", scene.live.exchange)
        until(lambda: robot.reader.newest(TRACKER))
    finally:
        over.set()
        thread.join()
    belief = LiveBelief(robot)
    scene.look(0.2)
    until(lambda: belief.problem == robot.problem == "" and robot.observe().stamp == scene.now)
    state = belief.update(robot.observe(), robot.time)
    assert state[DRAWER] == pytest.approx(0.2, abs=5e-3)
    assert belief.deviation(scene.model.symbol(DRAWER)) < 0.01
    with pytest.raises(kv.errors.DuplicateNameError, match="commands the robot of 'live:home' already"):
        LiveRobot(scene.model, "robot", scene.live.exchange)
    stopped = encode(RobotNote("kinematic", 0.04, [], stopped="emergency stop"))
    scene.read(stopped)
    until(lambda: robot.problem == "The robot is stopped: emergency stop.")
    session = Session(robot, dt=0.01, belief=belief, patience=1.0)
    with pytest.raises(kv.manipulation.SkillError, match=r"^The robot is stopped: emergency stop\.$"):
        session.act({})
    scene.tracker._publisher.put(state.vector(scene.tracker._symbols), scene.now, b"\xc1")
    until(lambda: "another version" in belief.problem)
    robot.close()
