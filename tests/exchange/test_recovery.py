"""Live models after something was lost or false: they notice it, and follow the server again."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import kineverse as kv
from kineverse.exchange import protocol
from kineverse.exchange.client import LiveModel
from kineverse.exchange.connection import Connection
from kineverse.exchange.server import Server, serve
from kineverse.exchange.store import Store, StoreError
from kineverse.exchange.views import Views
from kineverse.formats import document_hash

pytest.importorskip("zenoh")

LONG = 10.0
"""Longest time that anything is waited for [s]."""


@pytest.fixture(autouse=True)
def folder(sockets: Path) -> Path:
    return sockets


@pytest.fixture
def server() -> Iterator[Server]:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("part/base", "world")
    with serve(model, name="home") as running:
        yield running


@pytest.fixture
def load() -> Iterator[Callable[..., LiveModel]]:
    opened: list[LiveModel] = []

    def load_one(**part: object) -> LiveModel:
        opened.append(kv.load("live:home", **part))  # type: ignore[arg-type]
        return opened[-1]

    yield load_one
    for model in opened:
        model.close()


def add(model: kv.Model, name: str, x: float = 0.0) -> None:
    with model.edit() as edit:
        edit.add_frame(name, "world", kv.translation(x, 0, 0))


def wait_until(is_so: Callable[[], bool]) -> bool:
    late = time.monotonic() + LONG
    while not is_so() and time.monotonic() < late:
        time.sleep(0.01)
    return is_so()


def agrees(part: LiveModel, load: Callable[..., LiveModel]) -> bool:
    """Return whether a part is what one gets who joins now."""
    fresh = load(frames=["part/"])
    assert part.wait(fresh.version, LONG)
    return document_hash(part) == document_hash(fresh)


def test_a_part_whose_client_was_thought_to_be_gone_follows_again(
    server: Server, load: Callable[..., LiveModel]
) -> None:
    """As after a process that stood still for longer than the lease."""
    whole, part = load(), load(frames=["part/"])
    server._forget(part.exchange.client)
    add(whole, "part/new")
    assert part.wait(whole.version, LONG)
    assert "part/new" in part.frames


def test_parts_follow_after_an_error_of_the_store(
    server: Server, load: Callable[..., LiveModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, part, other = load(), load(frames=["part/"]), load(frames=["part/"])

    def fail(*_: object) -> None:
        raise StoreError("The disk is full.")

    with monkeypatch.context() as patch:
        patch.setattr(Store, "commit", fail)
        with pytest.raises(kv.errors.EditError, match="disk is full"):
            add(whole, "part/lost")
    epoch = server._authority.epoch
    for model in (whole, part, other):
        assert wait_until(lambda model=model: model.exchange.epoch == epoch and model.exchange.is_online)
    for number in range(3):
        add(whole, f"part/{number}")
        for model in (part, other):
            assert model.wait(whole.version, LONG)
            assert f"part/{number}" in model.frames


def test_an_edit_that_parts_cannot_follow_is_made(
    server: Server, load: Callable[..., LiveModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, part = load(), load(frames=["part/"])
    commit, failures = Views.commit, [1]

    def fail_once(self: Views, *diffs: object) -> object:
        if failures:
            raise ZeroDivisionError(failures.pop())
        return commit(self, *diffs)  # type: ignore[arg-type]

    monkeypatch.setattr(Views, "commit", fail_once)
    add(whole, "part/new")
    assert part.wait(whole.version, LONG)
    assert "part/new" in part.frames
    assert not failures


def test_who_asks_without_a_sign_of_life_is_forgotten(server: Server, load: Callable[..., LiveModel]) -> None:
    model = load()
    join = protocol.JoinRequest(protocol.PROTOCOL, "", "f" * 32, "nobody", ("part/base",), is_part=True)
    announce = protocol.Announce("f" * 32, "joints", "tcp/localhost:1", ("a",))
    for question in (join, announce):
        model.exchange.transport.ask(model.exchange.key("ask"), protocol.encode(question), LONG)
    status = model.exchange.status()
    assert len(status.clients) == 2
    assert status.sources
    assert wait_until(lambda: len(model.exchange.status().clients) == 1)
    assert not model.exchange.status().sources
    assert not [*server._views]


@pytest.mark.parametrize("frames", [None, ["part/"]])
def test_a_false_commit_is_noticed(
    server: Server, load: Callable[..., LiveModel], frames: list[str] | None
) -> None:
    whole, model = load(), load(frames=frames)
    add(whole, "part/shelf", 1.0)
    assert model.wait(whole.version, LONG)
    other = kv.Model()
    add(other, "part/shelf", 2.0)
    blob = kv.formats.operation_to_bytes(other, "frame part/shelf")
    changes = protocol.Changes((protocol.Placed(blob),), ("frame part/shelf",))
    false = protocol.CommitMessage(model.version + 1, model.version, "f" * 32, 1, "nobody", 0.0, changes)
    epoch, chain = server._authority.epoch, bytes(32)
    published = protocol.encode(protocol.Published(epoch, chain, protocol.encode(false)))
    key = "log" if frames is None else f"view/{model._view}"
    whole.exchange.transport.publish(whole.exchange.key(key), published)
    time.sleep(0.1)
    add(whole, "elsewhere")
    assert model.wait(whole.version, LONG)
    assert float(model.fk("part/shelf")({})[0, 3]) == 1.0
    assert frames is None or agrees(model, load)


@pytest.mark.parametrize("ahead", [1, 5])
def test_a_false_sign_of_life_is_noticed(server: Server, load: Callable[..., LiveModel], ahead: int) -> None:
    whole, part = load(), load(frames=["part/"])
    add(whole, "part/first")
    assert part.wait(whole.version, LONG)
    beat = protocol.Beat(
        server._authority.epoch, server.revision + ahead, bytes(32), {part._view: server.revision}
    )
    whole.exchange.transport.publish(whole.exchange.key("beat"), protocol.encode(beat))
    time.sleep(0.1)
    add(whole, "part/second")
    add(whole, "elsewhere")
    assert wait_until(lambda: "part/second" in part.frames)
    with part.edit() as edit:
        edit.add_frame("part/third", "world")
    assert agrees(part, load)


def test_catching_up_gives_way_to_a_server_that_goes_away(
    server: Server, load: Callable[..., LiveModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    """So an edit that was acknowledged raises nothing."""
    model = load()

    def is_away(*_: object) -> None:
        raise kv.errors.OfflineError("away")

    monkeypatch.setattr(Connection, "ask_missed", lambda *_: None)
    monkeypatch.setattr(Connection, "join", is_away)
    model._close_gap()


def test_a_store_that_was_restored_is_followed_from_its_revision(
    tmp_path: Path, load: Callable[..., LiveModel]
) -> None:
    store, backup = tmp_path / "home.db", tmp_path / "backup.db"
    with serve(store=store) as server:
        whole = load()
        add(whole, "part/kept")
        part = load(frames=["part/"])
        server._store.backup(backup)
        for number in range(3):
            add(whole, f"part/{number}")
        assert part.wait(whole.version, LONG)
    backup.rename(store)
    with serve(store=store) as server:
        epoch = server._authority.epoch
        for model in (whole, part):
            assert wait_until(lambda model=model: model.exchange.epoch == epoch and model.exchange.is_online)
            assert [*model.frames] == ["part/kept"]
            assert model.version == server.revision == 1
        add(part, "part/new")
        assert whole.wait(server.revision, LONG)
        assert document_hash(whole) == document_hash(server.snapshot())
        assert agrees(part, load)
