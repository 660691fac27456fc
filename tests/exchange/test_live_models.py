"""Live models: all replicas are equal, edits are all or nothing, and hooks hear every commit once."""

from __future__ import annotations

import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kineverse as kv
from cupboards import hinged_door
from kineverse.exchange import protocol
from kineverse.exchange.client import LiveModel
from kineverse.exchange.server import Server, serve
from kineverse.formats import document_hash
from kineverse.model.basic_operations import SetBody

pytest.importorskip("zenoh")

LONG = 10.0  # longest time that anything is waited for [s]


@pytest.fixture
def server(sockets: Path) -> Iterator[Server]:
    with serve(hinged_door(), name="home") as running:
        yield running


def add(model: kv.Model, name: str, x: float = 0.0, parent: str = "world") -> None:
    with model.edit() as edit:
        edit.add_frame(name, parent, kv.translation(x, 0, 0))


def replace(model: kv.Model, name: str, x: float) -> None:
    frame = kv.model.Frame.from_transform("world", kv.translation(x, 0, 0))
    with model.edit() as edit:
        edit.replace(f"frame {name}", kv.model.AddFrame(name, frame))


def position(model: kv.Model, frame: str) -> float:
    return float(model.fk(frame)({})[0, 3])


def test_an_edit_of_one_process_is_in_all_replicas(server: Server, load: Callable[..., LiveModel]) -> None:
    one, other = load(), load()
    add(one, "shelf", 0.5)
    assert other.wait(one.version, LONG)
    assert position(other, "shelf") == 0.5
    replace(other, "shelf", 0.7)
    assert one.wait(other.version, LONG)
    assert position(one, "shelf") == 0.7
    with one.edit() as edit:
        edit.remove("frame shelf")
    assert other.wait(one.version, LONG)
    assert "shelf" not in other.frames
    assert one.version == other.version == server.revision == 4
    assert len({document_hash(model) for model in (one, other, server.snapshot(), load())}) == 1


def test_a_live_model_answers_like_any_model(server: Server, load: Callable[..., LiveModel]) -> None:
    live, model = load(), hinged_door()
    assert live.degrees_of_freedom == model.degrees_of_freedom
    assert live.speeds == model.speeds
    assert live.constraints_for(live.degrees_of_freedom).keys() == model.constraints.keys()
    assert live.default_state() == model.default_state()
    assert vars(LiveModel).keys() & {name for kind in kv.Model.__mro__[:-1] for name in vars(kind)} == {
        *("__doc__", "__init__", "__module__", "_deliver", "_repr_html_", "adopt", "edit")
    }


def test_an_edit_that_raises_is_not_asked_for(server: Server, load: Callable[..., LiveModel]) -> None:
    model = load()
    before = document_hash(model)
    with pytest.raises(RuntimeError, match="mine"), model.edit() as edit:
        edit.add_frame("shelf", "world")
        raise RuntimeError("mine")
    with pytest.raises(kv.errors.EditError), model.edit() as edit:
        edit.remove(model.history.tags[0])  # others need it
    with model.edit() as edit:
        edit.add_frame("shelf", "world")
        edit.remove("frame shelf")
    assert server.revision == model.version == 1
    assert document_hash(model) == before


def test_hooks_hear_each_commit_once_in_order_and_may_edit(
    server: Server, load: Callable[..., LiveModel]
) -> None:
    model, other = load(), load()
    versions: list[int] = []
    threads = set()
    done = threading.Event()

    def hook(diff: kv.model.Diff) -> None:
        versions.append(diff.version)
        threads.add(threading.current_thread())
        if diff.added == ("frame a3",):
            add(model, "from the hook")
        if diff.added == ("frame from the hook",):
            done.set()

    model.listen(hook)
    for i in range(6):
        add(other, f"a{i}")
    assert done.wait(LONG)
    assert model.wait(server.revision, LONG)
    end = time.monotonic() + LONG
    while versions[-1] < server.revision and time.monotonic() < end:
        time.sleep(0.005)
    assert versions == list(range(2, server.revision + 1))
    assert len(threads) == 1
    assert threading.current_thread() not in threads


def test_edits_that_do_not_meet_are_merged(server: Server, load: Callable[..., LiveModel]) -> None:
    one, other = load(), load()
    with one.edit() as edit:
        edit.add_frame("left", "world")
        add(other, "right")
    assert {"left", "right"} <= set(one.frames)
    assert one.version == 3
    assert other.wait(3, LONG)
    assert document_hash(one) == document_hash(other) == document_hash(server.snapshot())


def test_a_conflict_names_what_met_and_changes_nothing(
    server: Server, load: Callable[..., LiveModel]
) -> None:
    one, other = load(), load()
    add(one, "shelf", 0.5)
    other.wait(one.version, LONG)
    with pytest.raises(kv.errors.ConflictError) as caught, one.edit() as edit:
        replace(other, "shelf", 0.7)
        edit.replace("frame shelf", kv.model.AddFrame("shelf", kv.model.Frame("world", ())))
    error = caught.value
    assert error.tags == ("frame shelf",)
    assert error.revision == other.version == 3
    assert error.who == other.exchange.who
    assert one.wait(3, LONG)
    assert position(one, "shelf") == 0.7


def test_what_is_read_by_hand_needs_a_strict_edit(server: Server, load: Callable[..., LiveModel]) -> None:
    one, other = load(), load()
    with pytest.raises(kv.errors.ConflictError, match="meanwhile"), one.edit(strict=True) as edit:
        add(other, "right")
        edit.add_frame("left", "world")
    assert one.wait(2, LONG)
    assert "left" not in one.frames


def test_transact_calls_again_after_a_conflict(server: Server, load: Callable[..., LiveModel]) -> None:
    one, other = load(), load()
    add(one, "count", 0.0)
    other.wait(one.version, LONG)
    seen = []

    def change(edit: kv.model.Edit) -> str:
        x = position(edit.model, "count")  # type: ignore[arg-type]
        seen.append(x)
        if len(seen) == 1:
            replace(other, "count", 5.0)
        frame = kv.model.Frame.from_transform("world", kv.translation(x + 1, 0, 0))
        edit.replace("frame count", kv.model.AddFrame("count", frame))
        return "done"

    assert one.transact(change) == "done"
    assert seen == [0.0, 5.0]
    assert position(one, "count") == 6.0

    def never(edit: kv.model.Edit) -> None:
        replace(other, "count", position(other, "count") + 1)
        edit.replace("frame count", kv.model.AddFrame("count", kv.model.Frame("world", ())))

    with pytest.raises(kv.errors.ConflictError):
        one.transact(never, attempts=2)


def test_an_edit_asked_twice_is_answered_alike(server: Server, load: Callable[..., LiveModel]) -> None:
    model = load()
    proposed: list[protocol.EditRequest] = []
    with model._transaction(lambda edit: proposed.extend(model._propose(edit, False))) as edit:
        edit.add_frame("shelf", "world")
    answers = {model.exchange.ask_edit(proposed[0]) for _ in range(3)}
    assert answers == {protocol.Committed(2, server._authority.chain)}
    assert server.revision == 2


def test_a_part_equals_the_whole_while_its_closure_changes(
    server: Server, load: Callable[..., LiveModel]
) -> None:
    whole = load()
    add(whole, "wall", 1.0)
    part = load(frames=["door"])
    assert len(part.frames) < len(whole.frames)
    heard: list[kv.model.Diff] = []
    part.listen(heard.append)
    add(whole, "elsewhere")
    assert part.wait(whole.version, LONG)
    assert "elsewhere" not in part.frames
    with whole.edit() as edit:
        edit.attach("door", "wall", kv.translation(0, 2, 0))
    assert part.wait(whole.version, LONG)
    assert "wall" in part.frames
    state = dict.fromkeys(map(str, whole.symbols_of("door")), 0.4)
    assert np.array_equal(part.fk("door")(state), whole.fk("door")(state))
    assert part.constraints_for("door") == whole.constraints_for("door")


def test_all_frames_can_be_followed_without_bodies(server: Server, load: Callable[..., LiveModel]) -> None:
    whole = load()
    with whole.edit() as edit:
        edit.apply(SetBody("door", kv.model.Body(visuals=(kv.model.Shape(kv.model.Sphere(0.1)),))))
    part, body = load(bodies=False), load(frames=["door"], bodies=True)
    add(whole, "shelf", 0.5)
    for one in (part, body):
        assert one.wait(whole.version, LONG)
    assert list(part.frames) == list(whole.frames)
    assert not part.bodies
    assert list(body.bodies) == ["door"]


def test_an_edit_of_a_part_is_in_the_whole(server: Server, load: Callable[..., LiveModel]) -> None:
    whole, part = load(), load(frames=["door"])
    heard: list[kv.model.Diff] = []
    part.listen(heard.append)
    with part.edit() as edit:
        edit.add_frame("knob", "door", kv.translation(0.6, 0, 0))
    assert part.version == server.revision
    assert whole.wait(part.version, LONG)
    assert whole.frames["knob"].parent == "door"
    add(whole, "wall")
    with pytest.raises(kv.errors.KineverseError, match="wall"), part.edit() as edit:
        edit.add_frame("hook", "wall")
    with pytest.raises(kv.errors.EditError, match="while it is edited"), part.edit():
        part.wait(server.revision, LONG)
    assert heard == []  # nothing of this part has changed


def test_a_part_of_a_file_and_unknown_names_are_refused(
    server: Server, load: Callable[..., LiveModel]
) -> None:
    with pytest.raises(kv.errors.UnknownNameError, match="door"):
        load(frames=["dor"])
    with pytest.raises(kv.errors.InvalidValueError, match="live"):
        kv.load("kitchen", frames=["kitchen/fridge_door"])
    with pytest.raises(kv.errors.UnknownNameError, match="home"):
        load("live:hom")
    with pytest.raises(kv.errors.FormatError, match="live:"):
        load("live:")
    with pytest.raises(kv.errors.DuplicateNameError, match="home"):
        serve("kitchen", name="home")


def test_reading_goes_on_without_the_server_and_it_catches_up(
    tmp_path: Path, load: Callable[..., LiveModel]
) -> None:
    store = tmp_path / "home.db"
    with serve(hinged_door(), store=store) as server:
        model, part = load(), load(frames=["door"])
        add(model, "shelf")
        revision = server.revision
    assert model.exchange.wait_for(lambda: not model.exchange.is_online, LONG)
    assert position(model, "shelf") == 0.0
    with pytest.raises(kv.errors.OfflineError), model.edit() as edit:
        edit.add_frame("other", "world")
    with serve(store=store) as server:
        assert server.revision == revision
        late = load()
        add(late, "back")
        with late.edit() as edit:
            edit.add_frame("knob", "door")
            edit.attach("door", "shelf", kv.translation(0, 1, 0))
        for one in (model, part):
            assert one.wait(server.revision, LONG)
            assert one.frames["door"].parent == "shelf"
        assert document_hash(model) == document_hash(late)
        add(model, "again")
        assert late.wait(server.revision, LONG)


def test_a_replica_that_missed_commits_catches_up(
    server: Server, load: Callable[..., LiveModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, other = load(), load()
    heard: list[int] = []
    model.listen(lambda diff: heard.append(diff.version))
    adopt = LiveModel._adopt_commit
    lost = [2, 3]

    def lose(self: LiveModel, published: protocol.Published, commit: protocol.CommitMessage) -> None:
        if self is model and commit.revision in lost:
            lost.remove(commit.revision)
        else:
            adopt(self, published, commit)

    monkeypatch.setattr(LiveModel, "_adopt_commit", lose)
    for i in range(4):
        add(other, f"a{i}")
    assert model.wait(other.version, LONG)
    add(model, "last")
    assert not lost
    assert document_hash(model) == document_hash(server.snapshot())


def test_undo_takes_back_commits_of_others_and_of_before(
    tmp_path: Path, load: Callable[..., LiveModel]
) -> None:
    store = tmp_path / "home.db"
    with serve(hinged_door(), store=store):
        model = load()
        add(model, "shelf", 1.0)
        replace(model, "shelf", 2.0)
        add(model, "other")
    with serve(store=store) as server:
        model = load()
        model.undo(3)
        assert position(model, "shelf") == 1.0
        assert "other" in model.frames
        model.undo(server.revision)
        assert position(model, "shelf") == 2.0
        with pytest.raises(kv.errors.ConflictError):
            model.undo(2)
        rows = model.exchange.history()
        assert [row.revision for row in rows] == list(range(server.revision, 0, -1))
        assert rows[-2].added == ("frame shelf",)


def test_copies_are_local_and_a_model_can_be_included(
    server: Server, load: Callable[..., LiveModel], tmp_path: Path
) -> None:
    live = load()
    copies = [live.copy(), pickle.loads(pickle.dumps(live)), live.snapshot().model()]
    for copy in copies:
        add(copy, "mine")
        assert not isinstance(copy, LiveModel)
    local = kv.Model()
    local.include("live:home", prefix="left")
    assert "left/door" in local.frames
    live.save(tmp_path / "home.kv.json")
    assert document_hash(kv.load(tmp_path / "home.kv.json")) == document_hash(live)
    assert server.revision == 1


def test_a_store_with_a_model_keeps_it(tmp_path: Path, load: Callable[..., LiveModel]) -> None:
    with serve(hinged_door(), store=tmp_path / "home.db") as server:
        before = document_hash(server.snapshot())
    with serve("kitchen", store=tmp_path / "home.db") as server:
        assert document_hash(server.snapshot()) == before
        assert server.name == "home"
        with pytest.raises(kv.errors.FormatError, match="another process"):
            serve(store=tmp_path / "home.db", name="second")


@pytest.mark.parametrize("content", [b"", b"\x00" * 40, b"\x91\xa4edit", b"nonsense"])
@pytest.mark.parametrize("key", ["edit", "ask"])
def test_nonsense_is_answered_with_one_error(
    server: Server, load: Callable[..., LiveModel], key: str, content: bytes
) -> None:
    model = load()
    add(model, "first")
    data = model.exchange.transport.ask(model.exchange.key(key), content, LONG)
    answer: object = protocol.decode_answer(data)
    assert isinstance(answer, protocol.Refused)
    assert answer.reason == "malformed"
    add(model, "still there")


def test_another_protocol_is_one_error(server: Server, load: Callable[..., LiveModel]) -> None:
    model = load()
    other = protocol.JoinRequest(protocol.PROTOCOL + 1, "9.9", "", "")
    with pytest.raises(kv.errors.FormatError, match="Update the older one"):
        model.exchange.join(other)


SERVER = """
import sys
from kineverse.exchange.server import serve
with serve(store=sys.argv[1]) as server:
    print("ready", flush=True)
    server.wait(60)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_what_was_acknowledged_survives_a_killed_server(
    tmp_path: Path, load: Callable[..., LiveModel], start: Callable[..., Any]
) -> None:
    store = tmp_path / "home.db"
    serve(hinged_door(), store=store).close()
    process = start(SERVER, str(store))
    model = load()
    for i in range(20):
        add(model, f"a{i}")
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    start(SERVER, str(store))
    assert model.exchange.wait_for(lambda: model.exchange.is_online, LONG)
    model.transact(lambda edit: edit.add_frame("after", "world"))
    fresh = load()
    assert {f"a{i}" for i in range(20)} | {"after"} <= set(fresh.frames)
    assert document_hash(fresh) == document_hash(model)
