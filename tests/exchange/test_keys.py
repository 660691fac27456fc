"""Keys: folders that are made and read, and what is no key; endpoints that need some."""

from __future__ import annotations

import importlib
import os
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cryptography")
pytest.importorskip("zenoh")

from kineverse.cli import main
from kineverse.cli.serve import list_addresses
from kineverse.errors import DuplicateNameError, InvalidValueError, KineverseError, MissingDependencyError
from kineverse.exchange import keys
from kineverse.exchange.access import RELAY, make_grants
from kineverse.exchange.address import Address, check_protected
from kineverse.exchange.keys import Keys, make_keys, read_listening
from kineverse.exchange.relay import Relay
from kineverse.exchange.rights import Right, Rights
from kineverse.exchange.server import serve
from kineverse.exchange.transport import SERVER


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Keys of a server, a user and a relay."""
    folder = tmp_path / "keys"
    make_keys(folder, server=["home.lan", "::1"], user=["alice"], relay={"hamburg": ["10.0.0.7"]})
    return folder


def modes(folder: Path) -> Iterable[int]:
    for path in folder.rglob("*"):
        yield path.stat().st_mode & 0o777


def test_folders_are_ready_to_be_copied(home: Path) -> None:
    alice, relay = Keys.read(home / "users" / "alice"), Keys.read(home / "relays" / "hamburg")
    server, rights = read_listening(home / "server", SERVER)
    assert (alice.user, server.name, relay.name) == ("alice", "model server", "relay hamburg")
    assert (server.hosts, relay.hosts, alice.hosts) == (("home.lan", "::1"), ("10.0.0.7",), ())
    assert rights == Rights({"alice": Right((), "alice")}, {"hamburg": ("alice",)})
    assert read_listening(home / "relays" / "hamburg", RELAY)[1] == Rights(rights.users)
    assert {*modes(home)} == {0o600, 0o700}


def test_who_comes_later_is_added(home: Path) -> None:
    rights = home / "server" / "rights.toml"
    rights.write_text(
        '# ours\n[users] # people\nalice = ["kitchen/"]\n\n[relays]\nhamburg = ["alice"]\n', encoding="utf-8"
    )
    authority = (home / "authority" / "ca.pem").read_bytes()
    make_keys(home, user=["b.ob"], relay={"kiel": ["kiel.lan"]})
    assert (home / "users" / "b.ob" / "ca.pem").read_bytes() == authority
    found = Rights.read(rights)
    assert {user: right.prefixes for user, right in found.users.items()} == {
        "b.ob": (),
        "alice": ("kitchen/",),
    }
    assert {name: {*users} for name, users in found.relays.items()} == {
        "kiel": {"alice", "b.ob"},
        "hamburg": {"alice"},
    }
    assert Rights.read(home / "relays" / "kiel" / "rights.toml").users == found.users
    assert rights.read_text(encoding="utf-8").startswith("# ours\n[users] # people\n")


def test_keys_are_replaced_only_if_that_is_said(home: Path) -> None:
    before = Keys.read(home / "users" / "alice").certificate.read_bytes()
    with pytest.raises(DuplicateNameError, match="has keys already"):
        make_keys(home, user=["bob", "alice"])
    assert not (home / "users" / "bob").exists()
    make_keys(home, user=["alice"], renew=True, days=3)
    assert Keys.read(home / "users" / "alice").certificate.read_bytes() != before


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "nobody to make keys for"),
        ({"user": ["a b"]}, "no name of a user"),
        ({"user": ["*"]}, "no name of a user"),
        ({"relay": {"../x": ["a"]}}, "no name of a relay"),
        ({"relay": {"x": []}}, "needs the names of its hosts"),
        ({"relay": {"alice": ["a"]}}, "is a user and a relay"),
        ({"server": ["a b"], "renew": True}, "neither the name of a host"),
        ({"relay": {"x": ["-a"]}}, "neither the name of a host"),
        ({"relay": {"x": ["*.lan"]}}, "neither the name of a host"),
    ],
)
def test_for_others_nothing_is_made(home: Path, given: dict[str, Any], message: str) -> None:
    with pytest.raises(KineverseError, match=message):
        make_keys(home, **given)
    assert not [*home.glob("*/*/key.pem")][2:]


def test_without_an_authority_or_a_server_nothing_is_made(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InvalidValueError, match="no server yet"):
        make_keys(tmp_path / "other", user=["alice"])
    assert not (tmp_path / "other").exists()
    (home / "authority" / "key.pem").unlink()
    with pytest.raises(InvalidValueError, match="nothing can be signed"):
        make_keys(home, user=["bob"])
    with monkeypatch.context() as patch:
        patch.setattr(keys, "_AUTHORITY_DAYS", -1)
        make_keys(tmp_path / "old", server=["a"], days=-2)
    with pytest.raises(InvalidValueError, match=r"authority in .* has expired"):
        make_keys(tmp_path / "old", user=["bob"])
    (tmp_path / "file").touch()
    with pytest.raises(InvalidValueError, match="cannot be written"):
        make_keys(tmp_path / "file", server=["a"])


def test_rights_that_cannot_be_added_to_are_left(home: Path) -> None:
    path = home / "server" / "rights.toml"
    path.write_text('users = {alice = "edit"}\n', encoding="utf-8")
    with pytest.raises(InvalidValueError, match="write it by hand"):
        make_keys(home, user=["bob"])
    assert path.read_text(encoding="utf-8") == 'users = {alice = "edit"}\n'
    assert not (home / "users" / "bob" / "key.pem").exists()


def damage(folder: Path, how: str) -> None:
    other = folder.parents[1] / "server"
    if how == "missing":
        (folder / "cert.pem").unlink()
    elif how == "of another":
        shutil.copy(other / "key.pem", folder / "key.pem")
    elif how == "of a server":
        shutil.copy(other / "cert.pem", folder / "cert.pem")
        shutil.copy(other / "key.pem", folder / "key.pem")
    elif how == "readable":
        (folder / "key.pem").chmod(0o640)
    else:
        (folder / how).write_text("nonsense")


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("missing", "cert.pem missing.*KINEVERSE_KEYS"),
        ("ca.pem", "ca.pem is no certificate"),
        ("cert.pem", "cert.pem is no certificate"),
        ("key.pem", "is not the key of"),
        ("of another", "is not the key of"),
        ("of a server", "'model server', which is no user"),
        ("readable", "Others can read .*chmod 600"),
    ],
)
def test_what_are_no_keys_of_a_user_is_said(
    home: Path, monkeypatch: pytest.MonkeyPatch, how: str, message: str
) -> None:
    folder = home / "users" / "alice"
    monkeypatch.setenv("KINEVERSE_KEYS", str(folder))
    assert Keys.read().user == "alice"
    damage(folder, how)
    with pytest.raises(InvalidValueError, match=message):
        print(Keys.read().user)


def test_keys_are_found_in_the_configuration(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("KINEVERSE_KEYS", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(home))
    with pytest.raises(InvalidValueError, match=r"ca\.pem and cert\.pem and key\.pem missing"):
        Keys.read()
    shutil.copytree(home / "users" / "alice", home / "kineverse" / "keys")
    assert Keys.read().user == "alice"


def test_a_relay_is_granted_what_its_users_may_together() -> None:
    users = {"ann": Right((), "ann"), "ben": Right(("",), "ben"), "cleo": Right(("kitchen/",), "cleo")}
    grants = make_grants("home", Rights(users, {"r": ("ann", "cleo"), "s": ("ann", "ben"), "none": ()}))

    def granted(use: str, end: str) -> set[str]:
        found = [grant for grant in grants if grant.use == use and f"kineverse/home/{end}" in grant.keys]
        return {name for grant in found for name in grant.names or ("everybody",)}

    assert granted("publish", "state/*") == granted("answer", "state/*/layout") == {"ben", "relay s"}
    assert granted("read", "log") == {"ann", "ben", "cleo", "relay r", "relay s"}
    assert granted("ask", "user/ann/edit") == {"ann", "relay r", "relay s"}
    assert granted("ask", "user/cleo/ask") == {"cleo", "relay r"}
    assert granted("watch", "alive/*") == {"everybody"}
    assert {
        end for end in ("edit", "ask", "log", "beat", "alive/*", "view/*") if granted("publish", end)
    } == set()


@pytest.mark.parametrize("endpoint", ["tcp/0.0.0.0:1", "tcp/[::]:1", "tcp/home.lan:1", "tcp/192.0.2.1:1"])
def test_other_computers_need_keys(endpoint: str) -> None:
    with pytest.raises(InvalidValueError, match="Listen at tls/"):
        check_protected([endpoint], None, insecure=False)
    with pytest.raises(InvalidValueError, match="Listen at tls/"):
        check_protected(["tls/a:1", endpoint], "keys", insecure=False)
    check_protected([endpoint], None, insecure=True)
    check_protected(["tcp/127.0.0.1:1", "tcp/localhost:1", "tcp/[::1]:1", "unixsock-stream/a"], None, False)


def test_what_a_server_cannot_listen_with_is_said(home: Path, sockets: Path) -> None:
    def listen(keys: Path | None, endpoint: str = "tls/127.0.0.1:1") -> None:
        with pytest.raises(KineverseError) as raised:
            serve(name="home", listen=[endpoint], keys=keys)
        messages.append(str(raised.value))

    messages: list[str] = []
    server = home / "server"
    listen(None)
    listen(server, "tcp/127.0.0.1:1")
    listen(home / "users" / "alice")
    listen(home)
    (server / "rights.toml").rename(server / "old")
    listen(server)
    (server / "old").rename(server / "rights.toml")
    make_keys(home, server=["home.lan"], days=-1, renew=True)
    listen(server)
    wanted = ("needs keys=", "are for an endpoint of TLS", "those of 'alice'", "missing", "rights", "expired")
    for message, words in zip(messages, wanted, strict=True):
        assert words in message
    assert os.listdir(sockets) == []


def test_a_relay_wants_addresses_of_tls_and_keys_of_its_own(home: Path) -> None:
    there, keys = Address.parse("live:tls/127.0.0.1:1/home"), home / "relays" / "hamburg"
    for address, listen, folder, message in (
        (Address.parse("live:tcp/127.0.0.1:1/home"), ["tls/a:1"], keys, "A relay connects to"),
        (Address.parse("live:home"), ["tls/a:1"], keys, "A relay connects to"),
        (there, ["tcp/127.0.0.1:1"], keys, "A relay connects to"),
        (there, ["nonsense"], keys, "nothing to listen at"),
        (there, [], keys, "A relay connects to"),
        (there, ["tls/127.0.0.1:1"], home / "server", "Name the folder of the relay"),
    ):
        with pytest.raises(InvalidValueError, match=message):
            Relay(str(address), listen=listen, keys=folder)


def test_the_package_of_certificates_can_be_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cryptography", None)
    monkeypatch.delitem(sys.modules, "kineverse.exchange.keys")
    with pytest.raises(MissingDependencyError, match="need the package cryptography"):
        importlib.import_module("kineverse.exchange.keys")


def test_addresses_for_clients_have_a_host_of_the_certificate(home: Path) -> None:
    """An address by which the server does not show its certificate would be refused by each client."""
    endpoints = ["tls/0.0.0.0:1", "tls/[::]:2", "tls/127.0.0.1:3", "tls/home.lan:4", "unixsock-stream//x"]
    assert list_addresses(endpoints, "home", str(home / "server")) == [
        "live:tls/home.lan:1/home",
        "live:tls/home.lan:2/home",
        "live:tls/home.lan:3/home",
        "live:tls/home.lan:4/home",
        "live:unixsock-stream//x/home",
    ]
    assert list_addresses(["tcp/0.0.0.0:1"], "home", None) == ["live:tcp/0.0.0.0:1/home"]


def test_the_command_says_what_is_for_whom(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = str(tmp_path / "k")
    words = [
        "keys",
        folder,
        "--server",
        "home.lan",
        "--user",
        "alice",
        "bob",
        "bob",
        "--relay",
        "hamburg",
        "h.lan",
    ]
    assert main(words) == 0
    printed = capsys.readouterr()
    for name in ("authority", "server", "user alice", "user bob", "relay hamburg"):
        assert name in printed.out
    assert "rights.toml" in printed.err
    for wrong, message in (
        (["--user", "alice"], "--renew"),
        (["--user", "a/b"], "no name of a user"),
        (["--relay", "kiel"], "hosts"),
        (["--days", "0"], "--days"),
        (["--user", "eve", "--days", "1e9"], "--days is at most"),
        ([], "--server"),
    ):
        assert main(["keys", folder, *wrong]) == 2
        assert message in capsys.readouterr().err
