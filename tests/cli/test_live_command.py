"""Commands of a live system: mistakes, in one line each, and the whole of it over processes."""

import json
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

pytest.importorskip("zenoh")
pytest.importorskip("coal")
pytest.importorskip("daqp")

import kineverse as kv
from kineverse.cli.live import find_start, parse_time
from kineverse.cli.live_system import run_folder
from kineverse.errors import InvalidValueError
from kineverse.live.streams import COMMANDS, ROBOT, SUPERVISOR, SupervisorNote, read_note
from kineverse.manipulation import place_robot

DRAWER = "shelf_drawers/upper_drawer"


def furniture():
    model = kv.Model()
    with model.edit() as edit:
        edit.include("shelf_drawers")
        edit.attach("shelf_drawers/shelf", parent="world", transform=kv.translation(1, 0, 0.7))
    return model


@pytest.fixture
def home(sockets):
    model = furniture()
    place_robot(model, "hsr")
    with kv.exchange.serve(model, name="home"):
        yield "live:home"


@pytest.mark.parametrize("text", ["", "fast", "-40ms", "0", "nan"])
def test_times_are_positive(text):
    assert (parse_time("40ms", "--timeout"), parse_time("0.04", "--timeout"), parse_time("2 s", "-t")) == (
        0.04,
        0.04,
        2,
    )
    with pytest.raises(InvalidValueError, match="--timeout is a time, such as 40ms"):
        parse_time(text, "--timeout")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["world", "nowhere"], "There is no model server 'nowhere'"),
        (["track", "live:nowhere"], "There is no model server 'nowhere'"),
        (["world", "home", "--robot", "pr2"], "--robot pr2: the served model has none. Available: hsr"),
        (["world", "home", "--noise", "3furlongs"], "3furlongs"),
        (["world", "home", "--timeout", "soon"], "--timeout is a time"),
        (["world", "home", "--force-limit", "-1"], "--force-limit is a positive number"),
        (["world", "home", "--record", "run.txt"], "run.mcap"),
        (["world", "home", "--robot", "hsr@0,0,0,0"], "a place of a robot on a planar base is X,Y,ANGLE"),
        (["behave", "home", "--do", "open"], "--do open is about objects by name: --what"),
        (["behave", "home", "--rounds", "2"], "'closer' has no rounds"),
        (["behave", "home", "--far", "2"], "--far is a share of the way between 0.1 and 1"),
        (
            ["open", "kitchen", "--robot", "hsr", "--what", DRAWER, "--world", "live"],
            "served model, live:NAME",
        ),
        (["live", "live:home"], "is served already"),
        (["live", "--rounds", "0"], "--rounds is a number from 1 on"),
        (["live", "--seconds", "-1"], "--seconds is a positive number"),
        (["serve", "shelf_drawers", "--robot", "hsr@1,0,0"], "stands where its world puts it"),
    ],
    ids=lambda value: "" if isinstance(value, str) else " ".join(value),
)
def test_mistakes_are_reported_in_one_line(run, home, words, message):
    status, out, err = run(*words)
    assert (status, out) == (2, "")
    assert message in err
    assert "Error" not in err
    assert len(err.splitlines()) == 1


def test_a_second_process_of_a_kind_is_refused(run, home):
    with kv.load(home) as live, live.exchange.publisher(ROBOT, ()), live.exchange.publisher(COMMANDS, ()):
        status, _, err = run("world", home)
        assert status == 2
        assert "Another process is the world of live:home already: end that one first" in err


def test_a_server_without_a_robot_says_how_to_get_one(run, sockets):
    with kv.exchange.serve("shelf_drawers", name="home"):
        _, _, err = run("track", "home")
    assert "The served model has no robot. 'kineverse serve MODEL --robot ROBOT' puts one into it." in err


def test_a_robot_begins_where_it_touches_nothing():
    model = furniture()
    place_robot(model, "hsr")
    assert find_start(model, "hsr", (-2.0, 0.5, 0.1))["hsr/base/x"] == -2.0
    with pytest.raises(InvalidValueError, match="begins in contact"):
        find_start(model, "hsr", (1.0, 0.0, 0.0))


def test_folders_that_killed_supervisors_left_are_removed(monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    left, mine = tmp_path / f"kineverse-live-{gone.pid}-x", tmp_path / f"kineverse-live-{os.getppid()}-x"
    for folder in (left, mine):
        folder.mkdir()
    with run_folder() as folder:
        assert folder.is_dir()
        assert (left.exists(), mine.exists()) == (False, True)
    assert not folder.exists()


@pytest.mark.long
def test_a_live_system_opens_and_closes_a_drawer_though_each_of_its_processes_is_killed(sockets, tmp_path):
    model = tmp_path / "shelf.kv.json"
    furniture().save(model)
    words = [sys.executable, "-m", "kineverse", "live", str(model), "--headless", "--json", "--name", "home"]
    words += ["--what", DRAWER, "--seconds", "300", "--record", str(tmp_path / "run.mcap")]
    words += ["--picture", str(tmp_path / "x.png")]
    killed = []

    def kill():
        """Kill each process once, when all of them run."""
        while not killed or len(killed) < 4:
            time.sleep(3.0)
            try:
                with kv.load("live:home") as live, live.exchange.reader() as reader:
                    time.sleep(1.0)
                    note = read_note(reader, SUPERVISOR, SupervisorNote)
            except kv.errors.KineverseError:
                continue
            if note is None or any(row.state != "running" for row in note.rows):
                continue
            row = next((row for row in note.rows if row.name not in killed), None)
            if row is not None:
                killed.append(row.name)
                os.kill(row.pid, signal.SIGKILL)

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    done = subprocess.run(words, capture_output=True, encoding="utf-8", timeout=400, check=False)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    (drawer,) = answer["objects"]
    assert (drawer["what"], drawer["robot"], drawer["done"]) == (DRAWER, "hsr", True)
    assert {name: answer["restarts"][name] for name in killed if name in answer["restarts"]}
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")
    assert kv.worlds.read_run_recording(tmp_path / "run.mcap").complete
    assert kv.exchange.address.list_servers() == []
