"""Endpoints of TLS, and ways past them that have to be closed: directly, and through the relay of a site."""

from __future__ import annotations

import shutil
import socket
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, NamedTuple

import pytest

pytest.importorskip("cryptography")
pytest.importorskip("zenoh")

import kineverse as kv
from kineverse.errors import ForbiddenError, OfflineError
from kineverse.exchange import protocol, transport
from kineverse.exchange.address import Address
from kineverse.exchange.connection import Connection
from kineverse.exchange.keys import Keys, _Authority, make_keys
from kineverse.exchange.relay import Relay
from kineverse.exchange.server import Server, serve
from kineverse.exchange.transport import Grant, NoAnswerError, Transport

LATE = 10.0
"""Time after which a test fails [s]; what is awaited comes within milliseconds."""

AS_ROUTER = {"mode": "router", "listen/endpoints": []}

RIGHTS = """
[users]
alice = "edit"
bob = "see"
carol = ["kitchen/"]
[relays]
site = ["alice", "bob"]
"""


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


class Site(NamedTuple):
    """Server ``home`` with a relay, keys of their users, and their addresses."""

    keys: Path
    server: Server
    direct: str
    relay: str

    def endpoint(self, way: str) -> str:
        return Address.parse(getattr(self, way)).endpoint

    def attack(self, user: str, way: str, **settings: object) -> Transport:
        """Return a connection with the keys of a user, also as another kind of program than a client."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(transport, "_RETRY", transport._RETRY | settings)
            return Transport.connect(self.endpoint(way), keys=Keys.read(self.keys / "users" / user))


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys") / "all"
    make_keys(
        folder, server=["localhost"], user=["alice", "bob", "carol", "dave"], relay={"site": ["localhost"]}
    )
    for place in ("server", "relays/site"):
        (folder / place / "rights.toml").write_text(RIGHTS, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def site(keys: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="hinge", parent="world", child="door", axis=(0, 0, 1)))
    endpoints = [f"tls/localhost:{free_port()}" for _ in range(2)]
    addresses = [Address("home", endpoint) for endpoint in endpoints]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("KINEVERSE_RUNTIME_DIR", str(tmp_path_factory.mktemp("s", numbered=True)))
        with (
            serve(model, name="home", listen=endpoints[:1], keys=keys / "server") as server,
            Relay(str(addresses[0]), listen=endpoints[1:], keys=keys / "relays" / "site") as relay,
        ):
            assert next(relay.watch())
            yield Site(keys, server, *map(str, addresses))


@pytest.fixture(params=["direct", "relay"])
def way(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def load(site: Site, monkeypatch: pytest.MonkeyPatch) -> Generator[Callable[..., Any]]:
    """Function that loads the model as a user, in a way to the server."""
    opened: list[Any] = []

    def load_as(user: str, way: str, **part: Any) -> Any:
        monkeypatch.setenv("KINEVERSE_KEYS", str(site.keys / "users" / user))
        opened.append(kv.load(getattr(site, way), **part))
        return opened[-1]

    yield load_as
    for model in opened:
        model.close()


@pytest.fixture
def witness(site: Site) -> Generator[Transport]:
    """Connection of this computer's user, who hears everything."""
    with closing(Transport.connect(*Address("home").find())) as transport:
        yield transport


def collect(channel: Any) -> list[Any]:
    found: list[Any] = []
    threading.Thread(target=lambda: deque(map(found.append, channel), 0), daemon=True).start()
    return found


def until(holds: Callable[[], bool]) -> None:
    late = time.monotonic() + LATE
    while not holds():
        assert time.monotonic() < late
        time.sleep(0.005)


def key(end: str) -> str:
    return f"kineverse/home/{end}"


def ask(asker: Transport, end: str) -> bytes:
    """Return the answer to a question about the server, empty if nobody answers."""
    try:
        return asker.ask(key(end), protocol.encode(protocol.GetStatus()), LATE)
    except NoAnswerError:
        return b""


def wait_to_be_known(attacker: Transport, user: str) -> None:
    """Wait until what is sent would get to the server."""
    if user == "dave":
        until(lambda: attacker.is_alive(key("alive/*"), LATE))
    else:
        until(lambda: ask(attacker, f"user/{user}/ask") != b"")


# -- what users do -------------------------------------------------------------------------------------------


def test_users_do_what_their_rights_say(
    site: Site, way: str, load: Callable[..., Any], tmp_path: Path
) -> None:
    alice, bob = load("alice", way), load("bob", way, frames=["door"])
    here = kv.load("live:home")
    before = alice.version
    with alice.edit() as edit:
        edit.add_frame(f"door/{way}", "door")
    assert bob.wait(alice.version, LATE)
    assert here.wait(alice.version, LATE)
    assert f"door/{way}" in here.frames
    assert here.exchange.history(1)[0].who.startswith("alice, ")
    with pytest.raises(ForbiddenError, match="bob may see, and not edit"), bob.edit() as edit:
        edit.remove("joint hinge")
    with pytest.raises(kv.errors.KineverseError, match="bob may see"):
        bob.exchange.backup(tmp_path / "copy.db")
    alice.exchange.backup(tmp_path / "copy.db")
    alice.undo(alice.version)
    with here.edit() as edit:
        edit.add_frame(f"{way}", "world")
    assert alice.wait(here.version, LATE)
    assert site.server.revision == before + 3
    assert {*alice.frames} == {*here.frames}
    names = {one.who.partition(", ")[0] for one in bob.exchange.status().clients}
    assert {"alice", "bob"} <= names
    assert (alice.exchange.user, bob.exchange.user, here.exchange.user) == ("alice", "bob", "")
    here.close()


def test_a_right_below_a_prefix_holds_nowhere_else(site: Site, load: Callable[..., Any]) -> None:
    carol, here = load("carol", "direct"), kv.load("live:home")
    with carol.edit() as edit:
        edit.add_frame("kitchen/cup", "world", tag="cup")
    assert here.wait(carol.version, LATE)
    for act in (
        lambda edit: edit.remove("joint hinge"),
        lambda edit: edit.attach("door", "kitchen/cup", kv.translation(0, 0, 0)),
        lambda edit: edit.constrain("kitchen/stop", 0, kv.position("hinge"), 0),
        lambda edit: edit.replace("cup", kv.model.AddFrame("kitchen2/cup", kv.model.Frame("world", ()))),
    ):
        with pytest.raises(ForbiddenError, match="carol may edit below kitchen/, and"), carol.edit() as edit:
            act(edit)
    with pytest.raises(ForbiddenError):
        carol.undo(1)
    assert carol.version == here.version == site.server.revision
    carol.undo(carol.version)
    assert "kitchen/cup" not in carol.frames
    here.close()


def test_states_are_sent_by_those_who_may_edit_everything(
    way: str, load: Callable[..., Any], site: Site
) -> None:
    alice, bob = load("alice", way), load("bob", "direct" if way == "relay" else "relay")
    source = alice.exchange.publisher("encoders", ["hinge"])
    reader = bob.exchange.reader(["hinge"])
    late = time.monotonic() + LATE
    while not reader.wait(0.02):
        source.put([0.5])
        assert time.monotonic() < late
    assert dict(reader.state) == {kv.position("hinge"): 0.5}
    source.close()
    with pytest.raises(kv.errors.KineverseError, match="bob may see"):
        bob.exchange.publisher("lies", ["hinge"])


def test_a_user_without_a_right_is_told_so(site: Site, way: str, load: Callable[..., Any]) -> None:
    with pytest.raises(OfflineError, match=r"there, and does not answer the user 'dave': .*rights"):
        load("dave", way)
    if way == "relay":  # the server does not let it speak for her
        with pytest.raises(OfflineError, match=r"'carol': .*rights"):
            load("carol", way)


# -- who is not let in ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def foreign(site: Site, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys that are wrong in some way, each in a folder."""
    folder = tmp_path_factory.mktemp("foreign")
    make_keys(folder / "other", server=["localhost"], user=["alice"])
    shutil.copytree(folder / "other" / "users" / "alice", folder / "another authority")
    shutil.copytree(folder / "another authority", folder / "foreign")
    make_keys(folder / "late", server=["localhost"], user=["alice"])
    ours = site.keys / "users" / "alice"
    shutil.copy(ours / "ca.pem", folder / "foreign" / "ca.pem")
    shutil.copytree(site.keys / "authority", folder / "ours" / "authority")
    make_keys(folder / "ours", server=["localhost"], user=["alice"], days=-1)
    shutil.copytree(folder / "ours" / "users" / "alice", folder / "expired")
    # A user who signs a certificate for another one.
    shutil.copytree(ours, folder / "users authority")
    shutil.copy(ours / "cert.pem", folder / "users authority" / "ca.pem")
    _Authority(folder / "users authority").issue(folder / "signed by a user", "bob", (), 1.0)
    shutil.copy(ours / "ca.pem", folder / "signed by a user" / "ca.pem")
    shutil.copytree(folder / "signed by a user", folder / "a chain")
    with (folder / "a chain" / "cert.pem").open("a") as chain:
        chain.write((ours / "cert.pem").read_text())
    shutil.copytree(site.keys / "server", folder / "of the server")
    return folder


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "another authority",
            "its certificate is of another authority than .*ca.pem: it is a foreign server",
        ),
        ("foreign", "does not know the authority of .*cert.pem"),
        ("expired", "cert.pem has expired"),
        ("signed by a user", "does not know the authority of .*cert.pem"),
        ("a chain", "the connection was refused"),
    ],
)
def test_wrong_keys_are_refused_with_a_reason(
    site: Site, foreign: Path, way: str, name: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("KINEVERSE_KEYS", str(foreign / name))
    with pytest.raises(OfflineError, match=message):
        kv.load(getattr(site, way))


def test_a_server_is_no_client(site: Site, foreign: Path, way: str) -> None:
    with pytest.raises(NoAnswerError):
        Transport.connect(site.endpoint(way), keys=Keys.read(foreign / "of the server"))


def test_without_a_certificate_nobody_is_let_in(site: Site, way: str) -> None:
    endpoint = site.endpoint(way)
    with pytest.raises(NoAnswerError):
        Transport.connect(endpoint)
    with pytest.raises(NoAnswerError):
        Transport.connect(endpoint.replace("tls", "tcp", 1))
    context = ssl.create_default_context(cafile=site.keys / "server" / "ca.pem")
    place = "localhost", int(endpoint.rpartition(":")[2])
    with (
        socket.create_connection(place, LATE) as plain,
        context.wrap_socket(plain, server_hostname="localhost") as secured,
        pytest.raises(ssl.SSLError, match=r"(?i)certificate.required"),
    ):
        secured.recv(1)


@pytest.mark.parametrize(
    ("made", "message"),
    [
        ({"server": ["elsewhere.lan"]}, "for another host than localhost"),
        ({"server": ["localhost"], "days": -1}, "its certificate has expired"),
    ],
)
def test_a_wrong_server_is_not_talked_to(
    keys: Path, tmp_path: Path, made: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(keys / "authority", tmp_path / "authority")
    make_keys(tmp_path, **made)
    monkeypatch.setenv("KINEVERSE_KEYS", str(keys / "users" / "alice"))
    endpoint = f"tls/localhost:{free_port()}"
    with closing(Transport.serve([endpoint], keys=Keys.read(tmp_path / "server"))) as server:
        server.answers("kineverse/home/**")
        with pytest.raises(OfflineError, match=message):
            kv.load(f"live:{endpoint}/home")
    with pytest.raises(OfflineError, match=r"nobody is there.*; tls/localhost:\d+: nobody is there"):
        kv.load(f"live:{endpoint},{endpoint}/home")


def test_a_user_is_no_server(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint = f"tls/localhost:{free_port()}"
    monkeypatch.setenv("KINEVERSE_KEYS", str(site.keys / "users" / "bob"))
    with (
        closing(Transport.serve([endpoint], keys=Keys.read(site.keys / "users" / "alice"))),
        pytest.raises(OfflineError),
    ):
        Connection(Address("home", endpoint))


def test_a_server_by_another_name_is_not_listened_to(
    keys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zenoh takes the certificates of public authorities, too; they are never those of a model server."""
    with monkeypatch.context() as patch:
        patch.setattr("kineverse.exchange.keys.SERVER", "localhost")
        _Authority(keys / "authority").issue(tmp_path / "public", "localhost", ["localhost"], 1.0)
    endpoint, heard = f"tls/localhost:{free_port()}", []
    everybody = [Grant(use, ("**",), None) for use in transport._FLOWS]
    users = Keys.read(keys / "users" / "alice")
    with closing(Transport.serve([endpoint], keys=Keys.read(tmp_path / "public"), grants=everybody)) as false:
        asked = [collect(false.answers(key(end))) for end in ("user/*/ask", "ask")]
        token = false.alive(key("alive/x"))
        news = Relay(
            f"live:{endpoint}/home", listen=[f"tls/localhost:{free_port()}"], keys=keys / "relays/site"
        )
        with closing(Transport.connect(endpoint, keys=users)) as alice, news:
            heard = collect(alice.subscribe("**"))
            assert ask(alice, "user/alice/ask") == b""
            assert not alice.is_alive(key("alive/*"), LATE)
            false.publish(key("log"), b"false")
            assert not next(news.watch())  # after a second
            assert ask(alice, "user/alice/ask") == b""
        token.close()
    assert not heard
    assert not any(asked)


# -- who is let in, and does what is not granted -------------------------------------------------------------


@pytest.mark.parametrize(("user", "settings"), [("alice", {}), ("bob", {}), ("bob", AS_ROUTER), ("dave", {})])
def test_questions_are_asked_under_the_own_name_alone(
    site: Site, way: str, user: str, settings: dict[str, object]
) -> None:
    other = "bob" if user == "alice" else "alice"
    question = protocol.encode(protocol.GetStatus())
    keys = [
        *(
            f"user/{one}/{kind}"
            for one in (other, "*", "carol", "$*", f"{user}/x")
            for kind in ("edit", "ask")
        ),
        *("edit", "ask", "user/**", "**", "*/ask", f"user/{user}/**"),
    ]
    with closing(site.attack(user, way, **settings)) as attacker:
        wait_to_be_known(attacker, user)
        for one in [*map(key, keys), "**", "kineverse/*/ask"]:
            with pytest.raises(NoAnswerError, match="Nobody answers"):
                attacker.ask(one, question, LATE)


@pytest.mark.parametrize(("user", "settings"), [("alice", {}), ("bob", {}), ("bob", AS_ROUTER), ("dave", {})])
def test_only_the_server_publishes(
    site: Site, way: str, user: str, settings: dict[str, object], witness: Transport
) -> None:
    heard, alive = collect(witness.subscribe("**")), collect(witness.watch_alive("**"))
    with closing(site.attack(user, way, **settings)) as attacker, closing(site.attack("alice", way)) as last:
        wait_to_be_known(attacker, user)
        if user != "dave":
            until(lambda: attacker.publish(key("seen"), b"first") or b"first" in heard)
        ends = ["log", "view/1", "beat", "alive/x", "user/alice/edit", "user/x", "x", "client/1"]
        ends += [] if user == "alice" else ["state/joints", "state/joints/layout"]
        ends += ["seen"] if user == "dave" else []
        for one in [*map(key, ends), "kineverse/other/log", "x"]:
            attacker.publish(one, b"false")
        tokens = [attacker.alive(one) for one in (key("alive/x"), key("user/x"), "kineverse/other/alive/x")]
        tokens += [attacker.alive(key("client/dave"))] if user == "dave" else []
        if user != "dave":
            attacker.publish(key("seen"), b"last")
            tokens.append(attacker.alive(key("client/last")))
        else:  # she is not heard at all, so somebody else is waited for, and then her own connection
            with pytest.raises(NoAnswerError):
                attacker.ask(key("ask"), b"", LATE)
            last.publish(key("seen"), b"last")
            tokens.append(last.alive(key("client/last")))
        until(lambda: b"last" in heard and (key("client/last"), True) in alive)
    assert b"false" not in heard
    epoch = f"alive/{site.server._authority.epoch}"
    assert {one for one, _ in alive if "client" not in one} == {key(epoch)}
    assert key("client/dave") not in {one for one, _ in alive}


def test_only_the_server_answers(site: Site, way: str, load: Callable[..., Any]) -> None:
    question = protocol.encode(protocol.GetStatus())
    with closing(site.attack("alice", way)) as attacker, closing(site.attack("bob", way)) as bob:
        stolen = [
            collect(attacker.answers(one))
            for one in (
                key("user/bob/ask"),
                key("user/*/ask"),
                key("**"),
                "**",
                key("ask"),
                key("user/alice/ask"),
            )
        ]
        until(lambda: bob.ask(key("user/bob/ask"), question, LATE) != b"")
        for _ in range(20):
            assert isinstance(
                protocol.decode_answer(bob.ask(key("user/bob/ask"), question, LATE)), protocol.Status
            )
        with pytest.raises(NoAnswerError):
            bob.ask(key("x"), question, LATE)
    assert not any(stolen)


def test_users_do_not_hear_or_see_what_is_not_theirs(site: Site, way: str, witness: Transport) -> None:
    with closing(site.attack("bob", way)) as attacker, closing(site.attack("dave", way)) as dave:
        secret = [attacker.subscribe(one) for one in ("**", key("**"), key("user/**"), key("x"), key("*"))]
        secret += [dave.subscribe(one) for one in (key("log"), key("beat"), key("state/*"), "**")]
        hidden = [collect(one.watch_alive(key("client/*"))) for one in (attacker, dave)]
        hidden += [collect(one.watch_alive("**")) for one in (attacker, dave)]
        found, open_ = [*map(collect, secret)], collect(attacker.subscribe(key("state/joints")))
        there = [collect(one.watch_alive(key("alive/*"))) for one in (attacker, dave)]
        token = witness.alive(key("client/w"))
        until(lambda: all(there))

        def is_heard() -> bool:
            for one in ("log", "x", "user/alice/edit", "seen"):
                witness.publish(key(one), b"secret")
            witness.publish(key("state/joints"), b"last")
            return b"last" in open_

        until(is_heard)
        token.close()
    assert not any(b"secret" in one for one in found)
    assert not any(found[5:])  # of one who has a certificate, and no right
    assert not [one for signs in hidden for one, _ in signs if "client" in one]


def test_states_and_their_layouts_are_not_forged(site: Site, way: str, witness: Transport) -> None:
    with closing(site.attack("bob", way)) as bob, closing(site.attack("alice", way)) as alice:
        forged = bob.answers(key("state/joints/layout"))
        stolen = collect(forged)
        heard = collect(witness.subscribe(key("state/*")))

        def answer(questions: Any) -> None:
            for question in questions:
                question.answer(b"true")

        answered = alice.answers(key("state/joints/layout"))
        threading.Thread(target=answer, args=(answered,), daemon=True).start()

        until(lambda: ask(witness, "state/joints/layout") == b"true")
        bob.publish(key("state/joints"), b"false")
        with pytest.raises(NoAnswerError):
            bob.ask(key("x"), b"", LATE)
        assert not stolen
        forged.close()  # else it would answer bob itself
        until(lambda: ask(bob, "state/joints/layout") == b"true")

        def is_heard() -> bool:
            alice.publish(key("state/joints"), b"true")
            return b"true" in heard

        until(is_heard)
    assert b"false" not in heard


def test_a_relay_speaks_for_its_users_alone(site: Site) -> None:
    with closing(
        Transport.connect(site.endpoint("direct"), keys=Keys.read(site.keys / "relays" / "site"))
    ) as r:
        question = protocol.encode(protocol.GetStatus())
        until(lambda: r.ask(key("user/alice/ask"), question, LATE) != b"")
        for one in ("user/carol/ask", "user/dave/ask", "user/*/ask", "ask", "edit", "user/site/ask"):
            with pytest.raises(NoAnswerError):
                r.ask(key(one), question, LATE)


# -- relays that come and go ---------------------------------------------------------------------------------


def test_a_relay_waits_for_its_server_and_finds_it_again(
    keys: Path, sockets: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    server, relay = (f"tls/localhost:{free_port()}" for _ in range(2))
    monkeypatch.setenv("KINEVERSE_KEYS", str(keys / "users" / "alice"))

    def start() -> Server:
        return serve(name="home", listen=[server], keys=keys / "server", store=tmp_path / "home.db")

    with Relay(f"live:{server}/home", listen=[relay], keys=keys / "relays" / "site") as running:
        news = running.watch()
        assert not next(news)
        assert "nobody is there" in running.explain()
        with start():
            assert next(news)
            model = kv.load(f"live:{relay},{server}/home")
            with model.edit() as edit:
                edit.add_frame("first", "world")
        until(lambda: not model.exchange.is_online)
        with start() as again:
            until(lambda: model.exchange.is_online)
            with model.edit() as edit:
                edit.add_frame("second", "world")
            assert again.revision == 2
            running.close()  # and the client goes to the server itself, often before anybody sees it offline

            def is_edited() -> bool:
                with suppress(OfflineError), model.edit() as edit:
                    edit.add_frame("third", "world")
                return again.revision == 3

            until(is_edited)
            model.close()
