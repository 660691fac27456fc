"""What people do to a live system: furniture goes where it is put, processes are cut, refusals have reasons."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
from furnished_room import CUPBOARD, DRAWER, make_room

pytest.importorskip("zenoh")

import kineverse as kv
from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError
from kineverse.live import people
from kineverse.live.people import Errands, Place, cut_process, find_carried, list_furniture, move_furniture
from kineverse.live.streams import SUPERVISOR, ProcessRow, SupervisorNote, encode
from kineverse.worlds import Sensors


def pose(model, frame=CUPBOARD):
    return np.asarray(kv.compile(model.fk(frame))({}))


def test_furniture_is_what_stands_in_the_world():
    model = make_room()
    assert list_furniture(model) == {CUPBOARD: "room/stand"}
    assert list_furniture(model, {CUPBOARD}) == {}
    assert find_carried(model, kv.position(DRAWER)) == [DRAWER, "room/handle"]


@pytest.mark.parametrize("angle", [-3.0, 0.0, 1.3])
def test_furniture_goes_where_it_is_put_at_its_height_and_tilt(angle, sockets):
    before = pose(make_room())
    with kv.exchange.serve(make_room(), name="home"), kv.load("live:home") as live:
        place = Place(live, CUPBOARD)
        np.testing.assert_allclose((place.x, place.y), before[:2, 3])
        move_furniture(live, CUPBOARD, -1.0, 2.0, angle)
        after, moved = pose(live), Place(live, CUPBOARD)
    np.testing.assert_allclose((moved.x, moved.y, moved.angle), (-1.0, 2.0, angle), atol=1e-12)
    np.testing.assert_allclose(after[:3, 3], (-1.0, 2.0, before[2, 3]), atol=1e-12)
    np.testing.assert_allclose(after[2, :3], before[2, :3], atol=1e-12)  # the tilt


def test_what_is_no_furniture_is_refused_with_the_reason():
    model = make_room()
    with pytest.raises(UnknownNameError, match=CUPBOARD):
        Place(model, DRAWER)
    with pytest.raises(InvalidValueError, match="finite"):
        Place(model, CUPBOARD).move(math.nan, 0.0, 0.0)


def test_the_noises_are_settings_of_sensors():
    found = {name: Sensors.parse(text) for name, text in people.NOISES.items()}
    assert found["none"].position == 0.0
    assert found["usual"].position < found["10 mm, 2°"].position == 0.01
    assert found["outliers"].outliers > 0.0


class Supervised:
    """Reader of a supervisor that has told of one process."""

    def __init__(self, pid, age=0.1):
        self.age = {SUPERVISOR: age}
        self.note = encode(SupervisorNote([ProcessRow("track", pid, "running")]))

    def newest(self, source):
        assert source == SUPERVISOR
        return self


@pytest.mark.skipif(not hasattr(os, "WCONTINUED"), reason="processes are not stopped here")
def test_a_process_is_frozen_and_killed(monkeypatch):
    monkeypatch.setattr(people, "FREEZE", 0.02)
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        cut_process(Supervised(process.pid), "track", freeze=True)
        status = os.waitpid(process.pid, os.WUNTRACED)[1]
        assert os.WIFSTOPPED(status)
        assert os.WIFCONTINUED(os.waitpid(process.pid, os.WCONTINUED)[1])
        cut_process(Supervised(process.pid), "track")
        assert process.wait() == -signal.SIGKILL
    with pytest.raises(KineverseError, match="cannot be cut"):
        cut_process(Supervised(process.pid), "track")


@pytest.mark.parametrize("reader", [Supervised(4242, age=60.0), Supervised(0), Supervised(1)])
def test_nothing_is_cut_that_the_supervisor_does_not_tell_of_now(reader, monkeypatch):
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("a process was cut"))
    with pytest.raises(UnknownNameError, match="track"):
        cut_process(reader, "track")


def test_of_each_kind_of_errand_the_newest_is_done_and_refusals_are_told():
    told, begun, go, over = [], threading.Event(), threading.Event(), threading.Event()

    def refuse():
        raise KineverseError("It is held.")

    def hold():
        begun.set()
        assert go.wait(10.0)

    errands = Errands(
        lambda line, refused: (told.append((line[9:], refused)), line.endswith("end") and over.set())
    )
    errands.send("move", "first", hold)
    assert begun.wait(10.0)
    for number in range(5):
        errands.send("move", f"to {number}", refuse)
    errands.send("noise", "end", lambda: None)
    go.set()
    assert over.wait(10.0)
    errands.close()
    assert told == [("first", False), ("refused: to 4. It is held.", True), ("end", False)]
