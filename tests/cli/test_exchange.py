"""Commands of model servers: what they print and change, live addresses in all others, and bad input."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator
from pathlib import Path

import pytest

import kineverse as kv
from cupboards import hinged_door
from kineverse.cli import arguments, exchange, output
from kineverse.exchange import LiveModel, Server, list_servers, serve
from kineverse.formats import document_hash
from kineverse.model import AddFrame, Frame

pytest.importorskip("zenoh")

LONG = 10.0  # longest time that anything is waited for [s]

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(autouse=True)
def own_sockets(sockets: Path) -> None:
    """All servers of these tests are in a folder of their own."""


@pytest.fixture
def server() -> Generator[Server]:
    with serve(hinged_door(), name="home") as running:
        yield running


@pytest.fixture
def live(server: Server) -> Generator[LiveModel]:
    with kv.load(server.address) as model:  # type: ignore[attr-defined]
        yield model


def place(model: kv.Model, name: str, x: float) -> None:
    """Add a frame, or move it."""
    operation = AddFrame(name, Frame.from_transform("world", kv.translation(x, 0, 0)))
    with model.edit() as edit:
        if name in model.frames:
            edit.replace(f"frame {name}", operation)
        else:
            edit.apply(operation, f"frame {name}")


def fail(run: Run, *words: object) -> str:
    """Return the one line of a command that fails."""
    status, out, err = run(*words)
    assert (status, out) == (2, ""), err
    assert err.startswith("kineverse: ")
    assert err.count("\n") == 1
    assert "Error" not in err
    return err


# -- what is there -------------------------------------------------------------------------------------------


def test_ls_lists_the_servers_of_the_user(run: Run) -> None:
    status, out, _ = run("ls")
    assert status == 0
    assert "kineverse serve kitchen" in out
    assert run("ls", "--json") == (0, "[]\n", "")
    with serve(hinged_door(), name="home") as home, serve(name="empty"):
        with kv.load("live:home") as model:  # type: ignore[attr-defined]
            place(model, "shelf", 1.0)
        status, out, err = run("ls")
        assert (status, err) == (0, "")
        rows = [line.split() for line in out.splitlines()]
        assert [row[:4] for row in rows[2:]] == [["empty", "0", "0", "0"], ["home", "3", "3", "2"]]
        data = json.loads(run("ls", "--json")[1])
        assert [(one["name"], one["operations"]) for one in data] == [("empty", 0), ("home", 3)]
        assert data[1]["process"] == os.getpid()
        assert home.revision == data[1]["revision"]


def test_status_tells_of_stages_clients_and_refusals(run: Run, live: LiveModel) -> None:
    place(live, "shelf", 1.0)
    with pytest.raises(kv.errors.EditError):
        live.undo(7)
    status, out, err = run("status", "home")
    assert (status, err) == (0, "")
    assert out.startswith("live:home\n  revision 2: 3 operations, 3 frames\n")
    assert "\nfold " in out
    assert f"\n{live.exchange.who}  all " in out
    assert f"  {live.exchange.who}: There is no revision 7" in out
    data = json.loads(run("status", "live:home", "--json")[1])
    assert [client["client"] for client in data["clients"]] == [live.exchange.client]
    assert [stage["name"] for stage in data["stages"]][-1] == "answer"
    assert data["edits"] == 1


def test_history_undo_and_what_hinders_it(run: Run, live: LiveModel) -> None:
    place(live, "shelf", 1.0)
    before = document_hash(live)
    place(live, "shelf", 2.0)
    status, out, err = run("history", "home", "-n", 2)
    assert (status, err) == (0, "")
    newest, older = out.splitlines()[2:]
    assert newest.split()[0] == "3"
    assert newest.endswith(f"{live.exchange.who}  ~ frame shelf")
    assert older.endswith("+ frame shelf")
    rows = json.loads(run("history", "home", "--before", 3, "--json")[1])
    assert [(row["revision"], row["added"]) for row in rows] == [
        (2, ["frame shelf"]),
        (1, ["frame cupboard", "joint hinge"]),
    ]
    said = fail(run, "undo", "home", 2)
    assert "'frame shelf'" in said
    assert "3" in said
    assert run("undo", "home", 3) == (
        0,
        "revision 3 is taken back (~ frame shelf); now at revision 4\n",
        "",
    )
    assert live.wait(4, LONG)
    assert document_hash(live) == before


@pytest.mark.parametrize("options", [(), ("--json",), ("--frames", "door")], ids=" ".join)
def test_watch_prints_a_line_for_each_commit(
    run: Run, live: LiveModel, options: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    watched = threading.Event()

    def print_and_tell(text: str) -> None:
        output.print_line(text)
        watched.set()

    def edit_when_watched() -> None:
        assert watched.wait(LONG)
        place(live, "shelf", 1.0)
        place(live, "cupboard", 2.0)
        place(live, "shelf", 3.0)

    monkeypatch.setattr(exchange, "print_line", print_and_tell)
    editor = threading.Thread(target=edit_when_watched)
    editor.start()
    status, out, err = run("watch", "home", *options, "--count", 1 if options[:1] == ("--frames",) else 3)
    editor.join()
    assert (status, err) == (0, "live:home is at revision 1   (Ctrl-C ends)\n")
    lines = out.splitlines()
    if options == ("--json",):
        found = [json.loads(line) for line in lines]
        assert [one["revision"] for one in found] == [2, 3, 4]
        assert [(one["added"], one["replaced"]) for one in found] == [
            (["frame shelf"], []),
            ([], ["frame cupboard"]),
            ([], ["frame shelf"]),
        ]
        assert found[1]["paths"] == ["frames/cupboard"]
        assert {one["who"] for one in found} == {live.exchange.who}
    elif options:
        (line,) = lines
        assert "  3  " in line
        assert "~ frame cupboard" in line
    else:
        assert [line.split("  ")[1:3] for line in lines] == [[str(k), live.exchange.who] for k in (2, 3, 4)]
        assert lines[0].endswith("  + frame shelf  (frames/shelf)")


# -- edits and files -----------------------------------------------------------------------------------------


def test_a_backup_is_served_as_it_was(run: Run, live: LiveModel, tmp_path: Path) -> None:
    place(live, "shelf", 1.0)
    backup, document = tmp_path / "copy.db", tmp_path / "home.kv.json"
    assert run("dump", "home", backup) == (0, f"{backup}: backup of live:home, revision 2\n", "")
    assert run("dump", "home", document)[0] == 0
    assert sorted(os.listdir(tmp_path)) == ["copy.db", "home.kv.json"]
    place(live, "shelf", 2.0)
    with serve(name="copy", store=backup) as copy:
        assert copy.revision == 2
        assert document_hash(copy.snapshot()) == document_hash(kv.load(document)) != document_hash(live)
        run("undo", "copy", 2)
        assert document_hash(copy.snapshot()) == document_hash(hinged_door())
    for path in (backup, document):
        assert "exists already" in fail(run, "dump", "home", path)
    assert "kineverse convert live:home" in fail(run, "dump", "home", tmp_path / "home.urdf")
    assert "No such file" in fail(run, "dump", "home", tmp_path / "nowhere" / "copy.db")


def test_apply_adds_a_file_whole_or_not_at_all(run: Run, server: Server, tmp_path: Path) -> None:
    file, broken = tmp_path / "table.kv.json", tmp_path / "broken.urdf"
    hinged_door().save(file)
    broken.write_text("<robot name='x'><link")
    before = document_hash(server.snapshot())
    assert "'frame cupboard' is taken. Put a prefix" in fail(run, "apply", "home", file)
    assert "broken.urdf, line 1" in fail(run, "apply", "home", broken)
    assert "no model 'nothing'" in fail(run, "apply", "home", "nothing")
    assert (server.revision, document_hash(server.snapshot())) == (1, before)
    assert run("apply", "home", file, "--prefix", "left") == (
        0,
        "live:home: 2 operations added, revision 2\n",
        "",
    )
    assert {"left/cupboard", "left/door", "cupboard"} <= server.snapshot().frames.keys()


# -- live addresses ------------------------------------------------------------------------------------------


def test_commands_take_live_models(run: Run, server: Server, tmp_path: Path) -> None:
    file, picture = tmp_path / "home.kv.json", tmp_path / "home.png"
    for words in (
        ("info", "live:home"),
        ("fk", "live:home", "door", "--set", "hinge=1"),
        ("convert", "live:home", file),
        ("convert", "live:home", file, "--force"),
        ("diff", "live:home", file, "--values"),
        ("validate", "live:home"),
        ("view", "live:home", "--picture", picture),
        ("unlock", "live:home", "--goal", "hinge=1"),
    ):
        status, out, err = run(*words)
        assert (status, err) == (0, ""), words
        assert out
    assert document_hash(kv.load(file)) == document_hash(server.snapshot())
    assert run("convert", "live:home", file, "--prefix", "left", "--force")[0] == 0
    assert "left/door" in kv.load(file).frames
    assert "--strict" in fail(run, "info", "live:home", "--strict")


def test_a_command_does_not_edit_the_model_of_a_server(run: Run, server: Server, tmp_path: Path) -> None:
    status, _, err = run("view", "live:home", "--robot", "fetch", "--picture", tmp_path / "a.png")
    assert (status, err) == (0, "")
    assert server.revision == 1


def test_a_page_follows_a_live_model(run: Run, live: LiveModel, monkeypatch: pytest.MonkeyPatch) -> None:
    viewer = pytest.importorskip("kineverse.view.viewer")
    pytest.importorskip("viser", reason="the page needs the extra 'view'")
    shown = []

    def edit_and_look(page: kv.view.Viewer) -> None:
        shown.append(set(page.values))
        with live.edit() as edit:
            edit.apply(kv.Prismatic(name="drawer", parent="cupboard", child="box", axis=(1, 0, 0)))
        end = time.monotonic() + LONG
        while "drawer" not in page.values and time.monotonic() < end:
            time.sleep(0.01)
        shown.append(set(page.values))

    monkeypatch.setattr(viewer.Viewer, "wait", edit_and_look)
    assert run("view", "live:home", "--no-browser", "--port", 0)[0] == 0
    assert shown == [{"hinge"}, {"hinge", "drawer"}]


# -- bad input -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("status hone", "no model server 'hone' of this user. Did you mean 'home'"),
        ("info live:hone", "Did you mean 'home'"),
        ("status a/b", "live:tcp/HOST:PORT/NAME"),
        ("watch .home", "does not begin with"),
        ("history live:", "no name of a model server"),
        ("dump live:udp/x:1/home home.db", "live:tcp/HOST:PORT/NAME"),
        ("status live:tcp/127.0.0.1:1/home", "No model server answers at tcp/127.0.0.1:1"),
        ("history home -n 0", "-n is a number of commits from 1"),
        ("watch home --count 0", "--count is a number"),
        ("watch home --frames dor", "Did you mean 'door'"),
        ("undo home 99", "no revision 99"),
        ("serve", "--name"),
        ("serve kichen", "Did you mean 'kitchen'"),
        ("serve --name a/b", "'a/b' is no name of a model server"),
        ("serve --name home", "'home' is running already. Use that one, or another name"),
        ("serve --name new --listen 7410", "tcp/HOST:PORT"),
        ("serve --name new --listen tls/127.0.0.1:1", "tls/127.0.0.1:1 needs --keys"),
        ("serve --name new --listen tcp/0.0.0.0:1", "Listen at tls/0.0.0.0:1 with --keys, "),
        ("serve --name new --listen tcp/0.0.0.0:1", "or say so with --insecure."),
        (
            "serve --name new --keys nowhere",
            "--keys are for an endpoint of TLS: add tls/HOST:PORT to --listen",
        ),
        (
            "serve --name new --listen tls/127.0.0.1:1 --keys nowhere",
            "ca.pem and cert.pem and key.pem missing",
        ),
        ("relay live:home --listen tls/127.0.0.1:1 --keys nowhere", "A relay connects to"),
        ("relay home --listen tls/127.0.0.1:1 --keys nowhere", "no address of a model server"),
        ("relay live:tls/a:1/home --listen tls/127.0.0.1:1 --keys nowhere", "cert.pem and key.pem missing"),
        ("serve --name new --durable", "Name one: --store FILE"),
        ("serve --name new --store text.db", "text.db is no store of a model server"),
        ("serve --name new --store nowhere/new.db", "there is no folder"),
        ("serve --name new --store used.db", "used.db is served by another process"),
    ],
)
def test_bad_input_is_answered_in_a_line(
    run: Run, server: Server, words: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("text.db").write_text("no store, but a text of some length\n" * 100)
    with serve(name="other", store="used.db"):
        assert says in fail(run, *words.split())
        assert list_servers() == ["home", "other"]


def test_a_port_in_use_is_named(run: Run) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        said = fail(run, "serve", "--name", "home", "--listen", endpoint)
    assert said.startswith(f"kineverse: Cannot listen at {endpoint}: ")
    assert "in use" in said
    assert said.endswith("Choose another endpoint.\n")


def test_without_a_server_it_is_said_how_to_start_one(run: Run) -> None:
    assert "None is running; 'kineverse serve' starts one" in fail(run, "status", "home")


def test_without_the_extra_it_is_said_how_to_install_it(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arguments, "MODULES", {**arguments.MODULES, "exchange": "kineverse_no_such_module"})
    for words in ("serve kitchen", "ls", "status home", "undo home 1"):
        assert f"kineverse {words.split()[0]} needs the extra 'exchange'" in fail(run, *words.split())


# -- the server's process ------------------------------------------------------------------------------------


def test_serve_prints_what_to_copy_and_ends_cleanly(run: Run, tmp_path: Path, hears_ctrl_c: None) -> None:
    store = tmp_path / "home.db"
    command = [sys.executable, "-m", "kineverse", "serve", "shelf_door", "--store", str(store)]

    def start() -> tuple[subprocess.Popen[str], list[str]]:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert process.stdout is not None
        return process, [process.stdout.readline().rstrip("\n") for _ in range(4)]

    process, lines = start()
    try:
        assert lines[0].startswith("home: ")
        assert lines[1:] == ["  live:home", '  model = kv.load("live:home")', "  kineverse view live:home"]
        assert "is served by another process" in fail(run, "serve", "--name", "b", "--store", store)
        assert "is running already" in fail(run, "serve", "--name", "home")
        with kv.load("live:home") as model:  # type: ignore[attr-defined]
            place(model, "shelf", 1.0)
        process.send_signal(signal.SIGTERM)
        assert process.wait(LONG) == 0
        assert process.communicate()[1] == "\n"
        assert list_servers() == []
        assert os.listdir(tmp_path) == ["home.db"]

        process, lines = start()
        assert lines[0].endswith("revision 2   (Ctrl-C ends)")
        process.send_signal(signal.SIGINT)
        assert process.wait(LONG) == 0
        assert "has a model already" in process.communicate()[1]
    finally:
        process.kill()
        process.communicate()
