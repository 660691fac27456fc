"""Live models and sources that are used wrongly, or in ways nobody thinks of at first."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kineverse as kv
from kineverse.exchange.client import LiveModel
from kineverse.exchange.server import Server, serve
from kineverse.exchange.store import StoreError
from kineverse.formats import document_hash

pytest.importorskip("zenoh")

LONG = 10.0  # longest time that anything is waited for [s]


@pytest.fixture
def server(sockets: Path) -> Iterator[Server]:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("cupboard", "world")
        edit.add_frame("shelf", "cupboard")
        edit.apply(kv.Revolute(name="hinge", parent="cupboard", child="door", axis=(0, 0, 1)))
    with serve(model, name="home") as running:
        yield running


def add(model: kv.Model, name: str) -> None:
    with model.edit() as edit:
        edit.add_frame(name, "world")


def move_cupboard(model: kv.Model, x: float) -> None:
    frame = kv.model.Frame.from_transform("world", kv.translation(x, 0, 0))
    with model.edit() as edit:
        edit.replace("frame cupboard", kv.model.AddFrame("cupboard", frame))


def place(model: kv.Model) -> float:
    return float(model.fk("door")({"hinge": 0})[0, 3])


def test_changes_that_a_live_model_adopts_are_in_all_replicas(
    server: Server, load: Callable[..., LiveModel]
) -> None:
    model, other = load(), load()
    copy = model.copy()
    with copy.edit() as edit:
        edit.add_frame("lamp", "shelf")
        changes = edit.net()
    model.adopt(changes)
    assert other.wait(model.version, LONG)
    assert model.version == other.version == server.revision == 2
    assert document_hash(model) == document_hash(other) == document_hash(server.snapshot())
    with pytest.raises(kv.errors.EditError, match="taken"):
        model.adopt(changes)


def test_an_undo_within_an_edit_is_refused(server: Server, load: Callable[..., LiveModel]) -> None:
    model = load()
    add(model, "lamp")
    with pytest.raises(kv.errors.EditError, match="after the edit"), model.edit() as edit:
        edit.add_frame("hook", "world")
        model.undo(2)
    assert server.revision == model.version == 2
    with pytest.raises(kv.errors.EditError, match="no revision"):
        model.undo(10**30)


def test_who_is_refused_finds_that_in_the_status(
    server: Server, load: Callable[..., LiveModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, note = load(), server._note

    def note_late(*given: Any) -> None:
        time.sleep(0.2)
        note(*given)

    monkeypatch.setattr(server, "_note", note_late)
    with pytest.raises(kv.errors.EditError, match="no revision"):
        model.undo(7)
    (refusal,) = model.exchange.status().refusals
    assert refusal.who == model.exchange.who


def test_nobody_waits_for_a_connection_that_was_closed(
    server: Server, load: Callable[..., LiveModel]
) -> None:
    model, raised = load(), []

    def wait() -> None:
        with pytest.raises(kv.errors.OfflineError, match="was closed") as error:
            model.wait(9)
        raised.append(error)

    waiting = threading.Thread(target=wait, daemon=True)
    waiting.start()
    model.close()
    waiting.join(LONG)
    assert raised
    assert model.wait(1)
    for call in (lambda: model.wait(9), lambda: model.undo(1), lambda: model.adopt(kv.model.NetChanges())):
        with pytest.raises(kv.errors.OfflineError, match="was closed"):
            call()


def test_a_hook_that_wants_to_end_the_program_ends_no_hooks(
    server: Server, load: Callable[..., LiveModel]
) -> None:
    model, heard = load(), []
    done = threading.Event()

    def note(diff: kv.model.Diff) -> None:
        heard.append(diff.added)
        if diff.added == ("frame b",):
            done.set()

    model.listen(lambda diff: sys.exit(3))
    model.listen(note)
    add(model, "a")
    add(model, "b")
    assert done.wait(LONG)
    assert heard == [("frame a",), ("frame b",)]


def test_a_part_is_followed_after_the_store_has_failed(
    server: Server, load: Callable[..., LiveModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, part = load(), load(frames=["door"])

    def fail(batch: object) -> None:
        raise StoreError("The disk is full.")

    with monkeypatch.context() as patch:
        patch.setattr(server._store, "commit", fail)
        with pytest.raises(kv.errors.EditError, match="disk is full"):
            add(model, "lamp")
    for x in (5, 6):  # whether it has joined again before or after
        move_cupboard(model, x)
        assert part.wait(model.version, LONG)
        assert place(part) == place(model) == x


def test_a_part_that_the_server_has_forgotten_is_taken_anew(
    server: Server, load: Callable[..., LiveModel]
) -> None:
    model, part = load(), load(frames=["door"])
    with server._lock:
        server._forget_client(part.exchange.client)
    move_cupboard(model, 5)
    assert part.wait(model.version, LONG)
    assert place(part) == 5


def test_a_part_is_followed_by_another_server_without_what_is_gone(
    tmp_path: Path, load: Callable[..., LiveModel]
) -> None:
    source = kv.Model()
    for name in ("shelf", "lamp"):
        add(source, name)
    with serve(source, name="home", store=tmp_path / "home.db"):
        model, part = load(), load(frames=["shelf", "lamp"])
        with model.edit() as edit:
            edit.remove("frame shelf")
        assert part.wait(model.version, LONG)
    with serve(name="home", store=tmp_path / "home.db"):
        assert model.exchange.wait_for(lambda: model.exchange.is_online, LONG)
        with model.edit() as edit:
            edit.attach("lamp", "world", kv.translation(2, 0, 0))
        assert part.wait(model.version, LONG)
        assert part.fk("lamp")({})[0, 3] == 2
        with model.edit() as edit:
            edit.add_frame("shelf", "lamp")
        assert part.wait(model.version, LONG)
        assert "shelf" in part.frames
        with pytest.raises(kv.errors.UnknownNameError):
            load(frames=["nowhere"])


FORKED = """
import gc, os, sys, time
import kineverse as kv
model = kv.load("live:home")
source = model.exchange.publisher("encoders", ["hinge"])
child = os.fork()
if not child:
    found = []
    for act in (
        lambda: model.edit().__enter__(),
        lambda: model.wait(9),
        lambda: kv.load("live:home"),
        lambda: kv.exchange.serve(name="other"),
    ):
        try:
            act()
        except kv.errors.OfflineError as error:
            found.append("forked" in str(error))
    assert found == [True] * 4, found
    assert "door" in model.frames
    source.close()
    model.close()
    sys.exit(7)
end = time.monotonic() + 10
while not (done := os.waitpid(child, os.WNOHANG))[0] and time.monotonic() < end:
    time.sleep(0.01)
assert os.waitstatus_to_exitcode(done[1]) == 7, done
with model.edit() as edit:
    edit.add_frame("of the parent", "world")
print(model.version)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_is_told_and_ends(server: Server) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FORKED], capture_output=True, text=True, timeout=30, check=False
    )
    assert done.stdout == "2\n", done.stderr


def test_a_source_that_is_refused_leaves_the_others_alone(
    server: Server, load: Callable[..., LiveModel]
) -> None:
    model, other = load(), load()
    wrong: list[tuple[Any, dict[str, Any]]] = [
        (["x"], {"offset": float("nan")}),
        (["x"], {"offset": "soon"}),
        (["x"], {"offset": 1e301}),
        ([5], {}),
        (None, {}),
        (["x" * 5000], {}),
    ]
    for coordinates, options in wrong:
        with pytest.raises((kv.errors.InvalidValueError, kv.errors.FormatError)):
            model.exchange.publisher("wrong", coordinates, **options)
    reader = model.exchange.reader("arm")  # one name, not three
    assert reader.coordinates == ("arm",)
    source = other.exchange.publisher("wrong", "arm")
    for stamp in ("now", float("nan")):
        with pytest.raises(kv.errors.InvalidValueError, match="stamp"):
            source.put([1], stamp=stamp)  # type: ignore[arg-type]
    for timeout in (-1, float("nan"), None):
        with pytest.raises(kv.errors.InvalidValueError, match="timeout"):
            reader.wait(timeout)  # type: ignore[arg-type]
    for _ in range(100):
        source.put([0.5])
        if reader.wait(LONG / 100):
            break
    with pytest.raises(kv.errors.InvalidValueError, match="floating-point"):
        reader.into(np.zeros(1, dtype=int))
    vector = np.zeros(1)
    assert reader.into(vector) == 1
    assert vector[0] == 0.5


def test_arguments_of_another_kind_are_one_error(server: Server, load: Callable[..., LiveModel]) -> None:
    connection = load().exchange
    wrong: list[Callable[[], object]] = [
        lambda: load(frames=["door"], symbols=[5]),
        lambda: serve(5),  # type: ignore[arg-type]
        lambda: serve(name="other", listen="tcp"),
        lambda: serve(name="other", listen=None),  # type: ignore[arg-type]
        lambda: serve(name="other", durable=True),
        lambda: connection.history(before=-1),
    ]
    for call in wrong:
        with pytest.raises(kv.errors.InvalidValueError):
            call()
    assert [*load(symbols="hinge").articulations] == ["hinge"]
    with pytest.raises(kv.errors.FormatError, match="nonsense"):
        load(symbols=["hinge:nonsense"])
    assert len(connection.history(most=10**30, before=10**30)) == 1


def test_a_source_whose_model_is_gone_says_so(server: Server, sockets: Path) -> None:
    model: Any = kv.load("live:home")
    source = model.exchange.publisher("encoders", ["hinge"])
    gone, connection = weakref.ref(model), model.exchange
    del model
    gc.collect()  # a thread that follows the server may still have it for a moment
    assert connection.wait_for(lambda: connection.is_closed, LONG)
    assert gone() is None
    with pytest.raises(kv.errors.OfflineError, match="was closed"):
        source.put([0.5])
