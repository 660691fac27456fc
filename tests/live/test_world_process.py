"""World of a live system, tick by tick: which commands it obeys, what people ask of it, and what it keeps."""

import itertools
import math
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("zenoh")

import kineverse as kv
from kineverse.errors import DuplicateNameError, InvalidValueError, KineverseError
from kineverse.live import WorldProcess, world_process
from kineverse.live.streams import (
    CAMERA,
    COMMANDS,
    ROBOT,
    TICK,
    TRUTH,
    CameraNote,
    CommandNote,
    RobotNote,
    ask,
    decode,
    encode,
    read_note,
)
from kineverse.worlds import KinematicWorld, Sensors

sys.path.insert(0, str(Path(__file__).parents[1] / "worlds"))
from pusher import pusher

X, FINGER, DRAWER = "robot/x:velocity", "robot/finger:velocity", "room/drawer"


def until(is_so, seconds=20.0):
    """Wait for what another thread does, and return it."""
    end = time.monotonic() + seconds
    while not (found := is_so()):
        assert time.monotonic() < end
        time.sleep(0.001)
    return found


class Clock:
    """Clock that passes only by what a test does, and by pauses."""

    def __init__(self, now=100.0):
        self.now = now

    def monotonic(self):
        return self.now

    def time(self):
        return 1e9 + self.now

    def sleep(self, seconds):
        self.now += seconds


class Stand:
    """World process that is ticked by hand, and a client beside it."""

    def __init__(self, live, **options):
        self.live = live
        start = live.default_state().updated({"robot/finger": 0.05, "robot/z": 2.0, "robot/x": 0.2})
        self.process = WorldProcess(live, lambda model: KinematicWorld(model, "robot"), start, **options)
        self.reader = live.exchange.reader()
        self.publisher = live.exchange.publisher(COMMANDS, [X, FINGER])
        self.now, self.numbers = time.time(), itertools.count(1)

    def close(self):
        for one in (self.publisher, self.reader, self.process):
            one.close()

    @property
    def world(self):
        return self.process.world

    def command(self, x, finger=0.0, age=0.0, *, stamped=True, duration=0.02, kept=(), note=None):
        """Send a command whose state has an age [s], and wait until it is there."""
        number = next(self.numbers)
        data = encode(CommandNote(number, duration, stamped, list(kept), {})) if note is None else note
        stamp = self.now - age
        reader = self.process._reader

        def arrives():  # the first ones are lost until the reader has found the source
            self.publisher.put([x, finger], stamp, data)
            time.sleep(0.001)
            newest = reader.newest(COMMANDS)
            return newest and (newest.stamp, newest.note) == (stamp, data)

        until(arrives)

    def tick(self, count=1):
        """Tick some times, and return how far the robot went in x [m]."""
        before = self.world.state["robot/x"]
        for _ in range(count):
            self.now += TICK
            self.process.tick(self.now)
        return self.world.state["robot/x"] - before

    def note(self):
        """Return the note of the last tick, once it is here."""
        ticks = self.process._ticks
        return until(lambda: (n := read_note(self.reader, ROBOT, RobotNote)) and n.ticks == ticks and n)


@pytest.fixture
def stand(sockets):
    with kv.exchange.serve(pusher(), name="home"), kv.load("live:home") as live:
        stand = Stand(live)
        yield stand
        stand.close()


def test_a_command_acts_until_the_state_that_it_is_from_is_too_old(stand):
    assert stand.tick() == 0.0  # before there is any
    stand.command(0.1)
    assert stand.tick(3) == pytest.approx(0.003)
    assert stand.note().commanded == pytest.approx(0.1)
    assert stand.tick(5) == 0.0  # 40 ms after the stamp
    assert stand.note().commanded == 0.0
    stand.command(0.1, age=0.025)
    assert stand.tick(5) == pytest.approx(0.001)
    assert stand.note().refused == 0


def test_commands_that_are_old_early_or_nonsense_are_not_obeyed(stand):
    stand.command(0.1, age=0.9)  # such as of a process that was frozen
    assert stand.tick(2) == 0.0
    assert stand.note().refused == 1
    stand.command(0.1, age=-1.0)
    assert stand.tick(2) == 0.0
    stand.command(0.1, note=b"\xc1 of another version")
    assert stand.tick(2) == 0.0
    stand.command(0.1, age=1e300)
    assert stand.tick(2) == 0.0
    with pytest.raises(InvalidValueError, match="NaN or infinite"):
        stand.publisher.put([math.nan, 0.0], stand.now)
    stand.publisher.set_coordinates(["robot/nothing:velocity", FINGER])
    stand.command(0.1)
    assert stand.tick(2) == 0.0
    assert stand.process.stopped == ""


def test_a_command_without_a_state_acts_for_its_duration_from_its_arrival(stand, monkeypatch):
    clock = Clock(time.monotonic())
    monkeypatch.setattr(world_process, "time", clock)
    stand.command(0.1, age=5.0, stamped=False, duration=60.0)
    assert stand.tick() == pytest.approx(0.001)
    clock.now += 120.0
    assert stand.tick() == 0.0


def test_fingers_keep_their_speed_where_it_is_kept_and_their_hold_in_silence(stand):
    world = stand.world
    world.reset(world.state.updated({"robot/x": 0.88}))  # the hand is around the bar of the drawer
    for _ in range(200):
        stand.command(0.0, -0.05)
        stand.tick()
    assert world.held == "room/drawer_handle"
    stand.command(-0.1, kept=[1])
    stand.tick(3)
    assert stand.process._fingers[FINGER] == -0.05
    opened = world.state[DRAWER]
    assert opened > 0.0
    stand.tick(100)
    assert world.held == "room/drawer_handle"
    assert world.state[DRAWER] == pytest.approx(opened, abs=1e-3)


def test_people_stop_the_robot_and_change_the_world_while_it_runs(stand):
    over = threading.Event()

    def run():
        while not over.is_set():
            stand.tick()
            time.sleep(0.001)

    until(lambda: stand.tick() is not None and stand.reader.newest(ROBOT))
    thread = threading.Thread(target=run)
    thread.start()
    try:
        ask(stand.reader, ROBOT, "move", coordinate=DRAWER, value=0.2)
        ask(stand.reader, ROBOT, "noise", text="5mm,1deg,30Hz")
        ask(stand.reader, ROBOT, "hide", frames=["room/drawer"])
        for do, arguments, why in (
            ("move", {"coordinate": DRAWER, "value": 9.0}, "cannot be there"),
            ("move", {"coordinate": "room/lid", "value": 0.1}, "room/lid"),
            ("move", {"coordinate": "robot/x", "value": 0.1}, "the robot's"),
            ("move", {"value": 0.1}, "coordinate"),
            ("noise", {"text": "3furlongs"}, "3furlongs"),
            ("fly", {}, "not understood"),
        ):
            with pytest.raises(KineverseError, match=why):
                ask(stand.reader, ROBOT, do, **arguments)
        ask(stand.reader, ROBOT, "stop")
        until(lambda: read_note(stand.reader, ROBOT, RobotNote).stopped == world_process.EMERGENCY)
    finally:
        over.set()
        thread.join()
    assert stand.world.state[DRAWER] == 0.2
    sensors = stand.world.sensors
    assert (sensors.position, sensors.hidden) == (0.005, {"room/drawer"})
    stand.command(0.1)
    assert stand.tick(2) == 0.0
    ask(stand.reader, ROBOT, "release")
    assert stand.tick(1) == pytest.approx(0.001)


def test_what_the_camera_sees_and_the_truth_are_published(stand):
    stand.world.sensors = Sensors(rate=30.0)
    stand.tick(4)
    shown = until(lambda: read_note(stand.reader, CAMERA, CameraNote))
    assert shown.read()[DRAWER].shape == (4, 4)
    truth = until(lambda: (t := stand.reader.newest(TRUTH)) and t.stamp == pytest.approx(stand.now) and t)
    assert dict(zip(truth.names, truth.values, strict=True))[DRAWER] == 0.0


def test_a_force_above_the_limit_stops_the_robot_until_it_is_released(sockets, monkeypatch):
    with kv.exchange.serve(pusher(), name="home"), kv.load("live:home") as live:
        stand = Stand(live, force_limit=50.0)
        monkeypatch.setattr(KinematicWorld, "peak_force", property(lambda world: 80.0))
        stand.tick(4)
        assert stand.process.stopped == ""  # a blow does not count
        stand.tick(2)
        assert stand.process.stopped == "protective stop, 80 N of at most 50 N"
        monkeypatch.setattr(KinematicWorld, "peak_force", property(lambda world: 10.0))
        stand.process.release()
        stand.tick(10)
        assert stand.process.stopped == ""
        stand.close()


def test_a_world_that_was_held_up_leaves_ticks_out_and_does_not_hurry(stand, monkeypatch):
    clock, stamps = Clock(), []
    monkeypatch.setattr(world_process, "time", clock)
    process = stand.process
    process._first = process._epoch = clock.now
    process._wall = 1e9
    tick = process.tick

    def count(now):
        stamps.append((now - 1e9, clock.now))
        if len(stamps) == 5:
            clock.now += 0.955  # as by SIGSTOP
        tick(now)

    monkeypatch.setattr(process, "tick", count)
    process.run(lambda: clock.now >= 102.0)
    assert process._dropped in (94, 95)
    assert len(stamps) + process._dropped == pytest.approx(200, abs=1)
    assert all(-1e-6 < at - stamp < TICK for stamp, at in stamps)  # by the present time, and never ahead
    assert all(b[0] - a[0] > TICK - 1e-6 for a, b in itertools.pairwise(stamps))
    assert process._late == 1


def test_the_true_state_is_kept_with_what_the_hand_holds(sockets, tmp_path):
    kept = tmp_path / "world.state"
    with kv.exchange.serve(pusher(), name="home"), kv.load("live:home") as live:
        stand = Stand(live, kept=kept)
        stand.world.reset(stand.world.state.updated({"robot/x": 0.88}))
        for _ in range(200):
            stand.command(0.0, -0.05)
            stand.tick()
        stand.tick(10)
        state = dict(stand.world.state)
        stand.close()  # as if it was killed
        again = Stand(live, kept=kept)
        assert dict(again.world.state) == pytest.approx(state)
        assert again.world.held == "room/drawer_handle"
        again.process.stop()
        again.tick()
        again.close()
        again = Stand(live, kept=kept)
        assert again.process.stopped  # nobody has released it
        with pytest.raises(DuplicateNameError, match="'robot'"):
            Stand(live)
        again.close()
        kept.write_bytes(b"nonsense")
        with pytest.raises(KineverseError, match=r"world\.state holds no state"):
            Stand(live, kept=kept)


def test_an_edit_of_the_model_changes_the_world_where_everything_is(stand):
    stand.command(0.1)
    stand.tick(2)
    stand.world.displace({DRAWER: 0.1})
    state, before = dict(stand.world.state), stand.world.time
    door = stand.live.articulations
    assert "room/lid" not in door
    with stand.live.edit() as edit:
        hinge = {"axis": (0, 0, 1), "lower": 0.0, "upper": 1.0, "velocity": 1.0}
        edit.apply(kv.Revolute(name="room/lid", parent="world", child="room/lid", **hinge))
    until(lambda: stand.process._follower.version == stand.live.version)
    stand.tick()
    after = stand.world.state
    assert after[DRAWER] == 0.1
    assert after["room/lid"] == 0.0
    assert stand.world.time == pytest.approx(before + TICK)
    assert {name: after[name] for name in state if name in after} == pytest.approx(
        replace_x(state, after["robot/x"])
    )
    truth = until(lambda: (t := stand.reader.newest(TRUTH)) and "room/lid" in t.names and t)
    assert len(truth.names) == len(state) + 1


def replace_x(state, value):
    return {symbol: value if str(symbol) == "robot/x" else v for symbol, v in state.items()}


def test_a_world_with_a_truth_of_its_own_follows_no_edits(sockets):
    truth = pusher()
    with kv.exchange.serve(pusher(), name="home"), kv.load("live:home") as live:
        start = truth.default_state().updated({"robot/z": 2.0})
        process = WorldProcess(live, lambda _: KinematicWorld(truth, "robot"), start, follows=False)
        with live.edit() as edit:
            edit.add_frame("hook", "world", kv.translation(0, 0, 1))
        process.tick(time.time())
        assert "hook" not in process.world.model.frames
        process.close()


def test_notes_of_another_version_are_none():
    assert decode(b"", RobotNote) is None
    assert decode(encode(["kinematic"]), RobotNote) is None
    assert decode(encode(CommandNote(1, 0.1, True, [], {})), CameraNote) is None
