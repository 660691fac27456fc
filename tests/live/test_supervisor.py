"""Supervisor: what dies is started again, what dies again and again is given up, and nothing outlives it."""

import math
import os
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip("zenoh")

from kineverse.live import children
from kineverse.live.children import Child, GivenUpError, stop_all
from kineverse.live.streams import ActivityNote, SkillResult
from kineverse.live.supervisor import LiveStatus, Supervisor

SLEEP = "import sys, time; print('begins', flush=True); time.sleep(600)"


def until(is_so, seconds=30.0):
    end = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.01)


def is_alive(pid):
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.fixture
def make(monkeypatch, tmp_path):
    """Function that returns a child that runs a program in place of a command."""
    made = []

    def make(program, **options):
        monkeypatch.setattr(children, "_START", program)
        made.append(Child("world", ["world", "live:home"], tmp_path, **options))
        return made[-1]

    yield make
    stop_all(made)


def test_what_is_killed_is_started_again_after_a_pause(make, monkeypatch):
    monkeypatch.setattr(children, "_PAUSE", 0.05)
    child = make(SLEEP)
    prepared = []
    child.prepare = lambda: prepared.append(child.ends)
    child.start()
    assert not child.watch()
    first = child.pid
    child.kill()
    until(lambda: child.watch())
    assert child.pid not in (0, first)
    assert (child.ends, prepared) == (1, [1])
    assert child.describe_end() == "killed by SIGKILL"


def test_what_ends_again_and_again_is_given_up_with_what_it_said(make, monkeypatch):
    monkeypatch.setattr(children, "_PAUSE", 0.0)
    child = make("import sys; print('kineverse: no such robot.', file=sys.stderr); sys.exit(2)")
    child.start()
    with pytest.raises(
        GivenUpError, match=r"'world' has ended 5 times within 20 s of its start: no such robot\.$"
    ):
        until(lambda: child.watch() and False)
    assert child.ends == 5


@pytest.mark.parametrize(("status", "is_done"), [(0, True), (1, True), (2, False)])
def test_a_behaviour_may_come_to_an_end_by_itself(make, status, is_done):
    child = make(f"raise SystemExit({status})", may_end=True)
    child.start()
    until(lambda: child.watch() or not child.pid)
    assert (child.is_done, child.ends) == (is_done, int(not is_done))


@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_a_frozen_process_is_seen_and_ended(make):
    child = make(SLEEP)
    child.start()
    until(lambda: child.read_last_line() == "begins")
    os.kill(child.pid, signal.SIGSTOP)
    until(lambda: not math.isnan(child.measure_cpu()) and child.is_frozen)
    pid = child.pid
    stop_all([child])
    assert not is_alive(pid)
    assert child.pid == 0


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a child looks for its parent twice a second")
@pytest.mark.parametrize("frozen", [False, True])
def test_nothing_outlives_a_supervisor_that_is_killed(tmp_path, frozen):
    program = (
        "import sys, time\n"
        "from kineverse.live import children\n"
        "children._START = 'import sys, time; from kineverse.live.children import follow_parent; '"
        " 'follow_parent(int(sys.argv[1])); print(1, flush=True); time.sleep(600)'\n"
        f"child = children.Child('world', [], {str(tmp_path)!r})\n"
        "child.start()\n"
        "print(child.pid, flush=True)\n"
        "time.sleep(600)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, encoding="utf-8"
    ) as parent:
        try:
            assert parent.stdout is not None
            pid = int(parent.stdout.readline())
            until(lambda: (tmp_path / "world.log").read_text() == "1\n")
            if frozen:
                os.kill(pid, signal.SIGSTOP)
        finally:
            parent.kill()
    until(lambda: not is_alive(pid))


def test_results_of_behaviours_are_counted_over_restarts(tmp_path, monkeypatch):
    supervisor = Supervisor("home", {"serve": ["serve"], "behave": ["behave"]}, tmp_path)
    status = supervisor.status
    notes = []
    monkeypatch.setattr(
        "kineverse.live.supervisor.read_note",
        lambda reader, source, kind: notes[-1] if kind is ActivityNote else None,
    )
    monkeypatch.setattr(Supervisor, "reader", None)

    def tell(*skills, steps, late=0):
        results = [SkillResult("room/drawer", skill, True, "") for skill in skills]
        notes.append(ActivityNote("tour", steps=steps, late=late, done=len(results), results=results))
        supervisor._read(status)

    tell("open", steps=100, late=3)
    tell("open", steps=100, late=3)
    tell("open", "close", steps=200, late=3)
    tell(steps=1)  # another process
    tell("open", steps=50, late=1)
    assert [one.skill for one in status.results] == ["open", "close", "open"]
    assert (status.steps, status.late_steps) == (250, 4)
    assert len(status.list_results("room/drawer", "open")) == 2
    assert LiveStatus().restarts == {}
