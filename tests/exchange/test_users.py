"""Users of a model server: who they are is in the key of their questions, and what they may do in its rights."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

import pytest
from msgspec.structs import replace
from replicas import Replica

import kineverse as kv
from kineverse.exchange import protocol
from kineverse.exchange import server as servers
from kineverse.exchange.address import Address
from kineverse.exchange.client import LiveModel
from kineverse.exchange.connection import Connection
from kineverse.exchange.protocol import Committed, Refused
from kineverse.exchange.rights import Right, Rights
from kineverse.exchange.server import Server, serve
from kineverse.exchange.state import THROUGH_SERVER
from kineverse.exchange.transport import NoAnswerError, Transport
from kineverse.model import Edit

pytest.importorskip("zenoh")

Ask: TypeAlias = Callable[[str, protocol.Request], Any]

ME = 32 * "a"
LONG = 10.0  # longest time that anything is waited for [s]

RIGHTS = Rights(
    {
        "alice": Right(("",), "alice"),
        "bob": Right((), "bob"),
        "carol": Right(("kitchen/", "table/"), "carol"),
    }
)


@pytest.fixture
def served(sockets: Path, monkeypatch: pytest.MonkeyPatch) -> Generator[Server]:
    """Server whose users are known by the keys of their questions; access control is not what is tested."""
    model = kv.Model()
    with model.edit() as edit:
        for side in "kitchen", "pr2":
            edit.add_frame(f"{side}/base", "world", tag=f"{side} base")
            edit.write(f"{side}/level", 1.0, f"{side} level")
    monkeypatch.setattr(servers, "BEAT", 0.1)
    with serve(model, name="home") as server:
        server._rights = RIGHTS
        yield server


@pytest.fixture
def ask(served: Server) -> Generator[Ask]:
    """Function that asks a question under a key, by nothing but the protocol."""
    transport = Transport.connect(*Address.parse("live:home").find())

    def ask_one(key: str, request: protocol.Request) -> Any:
        return protocol.decode_answer(transport.ask(f"kineverse/home/{key}", protocol.encode(request), 5.0))

    yield ask_one
    transport.close()


def draft(server: Server, name: str, number: int = 1, who: str = "me") -> protocol.EditRequest:
    """Return an edit that writes a datum."""
    request = Replica(server._authority).draft(lambda edit: edit.write(name, 1, name))
    return replace(request, number=number, who=who)


def wait_until(is_so: Callable[[], bool]) -> None:
    end = time.monotonic() + LONG
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_who_edits_is_known_by_the_key_and_not_by_the_message(served: Server, ask: Ask) -> None:
    said = "alice, laptop\n\x1b[31m" + 60_000 * "x"
    assert isinstance(ask("user/carol/edit", draft(served, "kitchen/x", who=said)), Committed)
    (row,) = ask("ask", protocol.GetHistory(1)).rows
    assert row.who.startswith("carol, alice, laptop[31mx")
    assert len(row.who) < 300
    (commit,) = served._store.last_commits(1, 100)
    kept = protocol.decode_commit(commit).client
    assert kept == protocol.identity_of("carol", ME) != ME
    assert ask("user/carol/edit", draft(served, "pr2/x", 2, who="alice")).reason == "forbidden"
    wait_until(lambda: [one.who for one in ask("ask", protocol.GetStatus()).refusals] == ["carol, alice"])


def test_the_number_of_another_is_not_answered_and_not_taken(served: Server, ask: Ask) -> None:
    first = ask("user/alice/edit", draft(served, "pr2/x"))
    for key, name in ("user/carol/edit", "kitchen/x"), ("edit", "pr2/y"):
        assert ask(key, draft(served, name)).revision == first.revision + 1 + (key == "edit")
    again = draft(served, "kitchen/z")  # of the same client and number
    assert ask("user/alice/edit", again) == first
    assert served.revision == 4


@pytest.mark.parametrize(
    "key",
    [
        "user/dave/edit",
        "user/*/edit",
        "user/car*/edit",
        "user/carol/*",
        "user/**",
        "**",
        "*",
        "user/Carol/edit",
    ],
)
def test_a_key_that_names_no_user_gets_nothing(served: Server, ask: Ask, key: str) -> None:
    chain = served._authority.chain
    with suppress(NoAnswerError):  # a part of a name with a star leads nowhere
        assert ask(key, draft(served, "kitchen/x")).reason in ("forbidden", "malformed")
        assert ask(key.replace("edit", "ask"), protocol.GetHistory()).reason == "forbidden"
    assert served._authority.chain == chain


ANNOUNCED = protocol.Announce(ME, "lidar", THROUGH_SERVER, ("kitchen/door",))
BACKUP = protocol.GetBackup(ME)
UNDO = protocol.UndoRequest(ME, 9, "me", 1)


@pytest.mark.parametrize("user", RIGHTS.users)
def test_each_kind_of_request_asks_for_the_right(served: Server, ask: Ask, user: str) -> None:
    right, me = RIGHTS.users[user], f"user/{user}"
    join = protocol.JoinRequest(protocol.PROTOCOL, "", ME, "me")
    joined = ask(f"{me}/ask", join)
    assert isinstance(joined, protocol.Joined)
    missed = ask(f"{me}/ask", protocol.Since(ME, "me", "", joined.revision, joined.chain))
    assert isinstance(missed, protocol.Missed)
    status = ask(f"{me}/ask", protocol.GetStatus())
    assert [one.client for one in status.clients] == [protocol.identity_of(user, ME)]
    assert status.clients[0].who == f"{user}, me"
    assert isinstance(ask(f"{me}/ask", protocol.GetHistory()), protocol.CommitList)
    assert ask(f"{me}/ask", protocol.GetFile(64 * "0")).reason == "unknown"
    answers = {
        "announce": ask(f"{me}/ask", ANNOUNCED),
        "backup": ask(f"{me}/ask", BACKUP),
        "undo": ask(f"{me}/edit", UNDO),
        "everywhere": ask(f"{me}/edit", draft(served, "pr2/x", 10)),
    }
    for what, answer in answers.items():
        assert isinstance(answer, Refused) == (not right.may_edit_all), what
        assert not isinstance(answer, Refused) or answer.reason == "forbidden"
        assert not isinstance(answer, Refused) or answer.message.startswith(f"{user} may ")
    below = ask(f"{me}/edit", draft(served, "kitchen/x", 11))
    assert isinstance(below, Refused) == (not right.may_edit)
    assert ask(f"{me}/ask", UNDO).reason == ("malformed" if right.may_edit else "forbidden")
    assert ask(f"{me}/edit", join).reason == "malformed"


def test_a_source_of_another_computer_sends_through_the_server(served: Server, ask: Ask) -> None:
    for endpoint in "unixsock-stream//tmp/false.sock", "tcp/198.51.100.1:7410":
        false = replace(ANNOUNCED, endpoint=endpoint)
        assert ask("user/alice/ask", false).reason == "malformed"
        assert not ask("ask", protocol.GetStatus()).sources
    assert isinstance(ask("user/alice/ask", ANNOUNCED), protocol.Done)
    assert isinstance(ask("user/alice/ask", replace(ANNOUNCED, endpoint="")), protocol.Done)
    assert not ask("ask", protocol.GetStatus()).sources


def test_nobody_takes_the_place_of_anothers_client(served: Server, ask: Ask) -> None:
    join = protocol.JoinRequest(protocol.PROTOCOL, "", ME, "me", ("kitchen/base",), is_part=True)
    part = ask("user/alice/ask", join)
    assert isinstance(ask("user/alice/ask", BACKUP), protocol.FilePart)
    assert isinstance(ask("user/bob/ask", replace(join, frames=(), is_part=False)), protocol.Joined)
    shown = protocol.identity_of("alice", ME)  # as the status names her client
    assert (
        ask("user/bob/ask", protocol.Since(shown, "", part.view, part.revision, part.chain)).reason == "stale"
    )
    again = ask("user/alice/ask", protocol.Since(ME, "", part.view, part.revision, part.chain))
    assert isinstance(again, protocol.Missed)


# -- live models ---------------------------------------------------------------------------------------------


@pytest.fixture
def load_as(served: Server, monkeypatch: pytest.MonkeyPatch) -> Generator[Callable[[str], LiveModel]]:
    """Function that loads the model as a user."""
    connect, opened = Connection._connect, []

    def load_one(user: str) -> LiveModel:
        def connect_as(connection: Connection) -> Transport:
            connection.user = user
            return connect(connection)

        with monkeypatch.context() as patched:
            patched.setattr(Connection, "_connect", connect_as)
            opened.append(kv.load("live:home"))
        return opened[-1]

    yield load_one
    for model in opened:
        model.close()


def test_users_edit_by_their_rights(served: Server, load_as: Callable[[str], LiveModel]) -> None:
    alice, bob, carol = map(load_as, RIGHTS.users)
    carol.transact(lambda edit: edit.add_frame("kitchen/new", "pr2/base"))
    alice.transact(lambda edit: edit.write("pr2/x", 1))
    assert bob.wait(3, 10.0)
    assert bob.frames["kitchen/new"].parent == "pr2/base"
    assert [row.who.partition(",")[0] for row in bob.exchange.history(2)] == ["alice", "carol"]
    calls = []

    def steal(edit: Edit) -> None:
        calls.append(edit)
        edit.remove("pr2 level")

    for model, allowed in (
        (bob, "bob may see, and not edit"),
        (carol, "carol may edit below kitchen/ and table/"),
    ):
        with pytest.raises(kv.errors.ForbiddenError, match=allowed):
            model.transact(lambda edit: edit.write("pr2/y", 1))
        with pytest.raises(kv.errors.ForbiddenError, match=allowed):
            model.undo(3)
        with pytest.raises(kv.errors.ForbiddenError, match=allowed):
            model.exchange.publisher("lidar", ["kitchen/door"])
        assert issubclass(kv.errors.ForbiddenError, kv.errors.EditError)
        assert not issubclass(kv.errors.ForbiddenError, kv.errors.ConflictError)
    with pytest.raises(kv.errors.ForbiddenError, match="'pr2 level' writes data/pr2/level"):
        carol.transact(steal)
    assert len(calls) == 1
    assert served.revision == 3
    refused = [*2 * ["bob"], *3 * ["carol"]]
    assert [one.who.partition(",")[0] for one in alice.exchange.status().refusals] == refused


def test_a_client_of_a_user_is_there_as_long_as_it_lives(
    served: Server, load_as: Callable[[str], LiveModel]
) -> None:
    carol, alice = load_as("carol"), load_as("alice")

    def listed() -> list[str]:
        return sorted(one.who.partition(",")[0] for one in alice.exchange.status().clients)

    end = time.monotonic() + 5 * servers.BEAT  # who shows no sign of life is forgotten at the second beat
    while time.monotonic() < end:
        assert listed() == ["alice", "carol"]
    carol.close()
    wait_until(lambda: listed() == ["alice"])
