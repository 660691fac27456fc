"""``kineverse live``: what cannot work is said before anything starts, and its table fits a terminal."""

from __future__ import annotations

import io
import os
import shutil
import socket
from types import SimpleNamespace

import pytest

from kineverse.cli import live_system
from kineverse.live import live_status

pytestmark = pytest.mark.compiler  # without one, the command refuses before all else


@pytest.fixture
def extras() -> None:
    """Skip without the extras of the command."""
    for module in ("coal", "daqp", "zenoh", "viser", "mcap"):
        pytest.importorskip(module)


@pytest.mark.usefixtures("extras")
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--record", "no_folder/run.mcap"], "no_folder/run.mcap: No such file or directory"),
        (["--record", "run.txt"], "Recordings are written as .mcap: 'run.mcap'."),
        (["--name", ""], "'' is no name of a model server"),
        (["--name", "a b/c"], "'a b/c' is no name of a model server"),
        (["--port", "99999"], "99999 is not a port"),
        (["--host", "1.2.3.4.5"], "there is no host '1.2.3.4.5'"),
        (["--force-limit", "-3"], "--force-limit is a positive number of newtons, not -3."),
        (["--force-limit", "80"], "the kinematic world has no forces; --world mujoco has."),
    ],
)
def test_what_cannot_work_is_said_in_one_line_before_anything_starts(
    run, tmp_path, monkeypatch, words: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("kineverse.live.supervisor.Supervisor.start", lambda _: pytest.fail("it has started"))
    status, out, err = run("live", "kitchen", *words)
    assert (status, out) == (2, "")
    assert said in err
    assert err.count("\n") == 1
    assert not [*tmp_path.iterdir()]


@pytest.mark.usefixtures("extras")
def test_a_port_that_is_taken_is_said(run) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        status, _, err = run("live", "kitchen", "--port", port)
    assert status == 2
    assert f"port {port} is taken" in err


@pytest.mark.usefixtures("extras")
def test_a_server_of_somebody_else_is_left_alone(run, monkeypatch) -> None:
    monkeypatch.setattr(live_system, "list_servers", lambda: ["home", "live"])
    monkeypatch.setattr("kineverse.live.supervisor.Supervisor.start", lambda _: pytest.fail("it has started"))
    status, _, err = run("live", "--name", "home", "--headless")
    assert status == 2
    assert "home: a model server of that name is running already" in err


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def _make_screen(monkeypatch, height: int):
    """Return a screen of a terminal of that height, what it shows, and the processes that it kills."""
    killed: list[str] = []
    children = {
        name: SimpleNamespace(name=name, kill=lambda name=name: killed.append(name))
        for name in ("serve", "world")
    }
    supervisor = SimpleNamespace(children=children, reader=SimpleNamespace(age={}), is_online=True)
    monkeypatch.setattr(shutil, "get_terminal_size", lambda *_, **__: os.terminal_size((80, height)))
    monkeypatch.setattr(live_status, "describe_all", lambda _: [f"line {k}" for k in range(30)])
    out = _Terminal()
    screen = live_system.Screen(SimpleNamespace(name="home", supervisor=supervisor), out)
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True, fileno=lambda: 0))
    return screen, out, killed


def test_the_table_is_no_higher_than_the_terminal_and_keeps_its_keys(monkeypatch) -> None:
    screen, out, _ = _make_screen(monkeypatch, 12)
    status = SimpleNamespace(rows=[], activity=None)
    screen._draw(status)
    assert out.getvalue().count("\n") < 12  # with a last line for the cursor
    assert "q: quit" in out.getvalue().splitlines()[-2]
    screen._draw(status)
    assert "\033[11A" in out.getvalue()


@pytest.mark.parametrize(
    ("number", "said", "dead"), [("2", "killed: world", ["world"]), ("9", "no process 9", [])]
)
def test_a_number_kills_that_process_or_is_said_to_be_none(
    monkeypatch, number: str, said: str, dead: list[str]
) -> None:
    screen, _, killed = _make_screen(monkeypatch, 24)
    monkeypatch.setattr(live_system.select, "select", lambda *_: ([1] if keys else [], [], []))
    keys = list(f"k{number}")
    monkeypatch.setattr(live_system.os, "read", lambda *_: keys.pop(0).encode())
    assert not screen._read_keys(SimpleNamespace(rows=[]))
    assert said in screen._answer
    assert killed == dead
