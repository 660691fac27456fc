"""Addresses and names of servers: one server a name, also where one was killed, and a folder for one user."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kineverse.errors import DuplicateNameError, FormatError, InvalidValueError, UnknownNameError
from kineverse.exchange import address
from kineverse.exchange.address import (
    Address,
    Claim,
    check_endpoint,
    check_server_name,
    list_servers,
    runtime_folder,
)

NAMES = st.text("aZ09_.-", min_size=1, max_size=60).filter(lambda name: name[0] not in ".-")
ENDPOINTS = st.sampled_from(
    [
        "",
        "tcp/127.0.0.1:7410",
        "tcp/[::1]:1",
        "tcp/home.lan:80",
        "tls/a:1",
        "tls/a:1,tls/b:2",
        "tcp/a:1,tcp/b:1",
        "unixsock-stream//run/a b/x.sock",
    ]
)

SERVER = """
import sys
from kineverse.exchange.address import Claim
from kineverse.exchange.transport import Transport
claim = Claim(sys.argv[1])
server = Transport.serve([claim.endpoint], claim.secret)
print("ready", flush=True)
sys.stdin.readline()
server.close()
claim.release()
print("released", flush=True)
sys.stdin.readline()
"""


@given(NAMES, ENDPOINTS)
def test_addresses_are_read_as_they_are_written(name: str, endpoint: str) -> None:
    written = Address(name, endpoint)
    assert Address.parse(str(written)) == written
    assert str(written).startswith("live:")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "home",
        "live:",
        "live:-a",
        "live:.a",
        "live:a b",
        "live:ä",
        "live:" + 61 * "a",
        "live:a\n",
        "live:x/home",
        "live:tcp/home",
        "live:tcp/a:b/home",
        "live:tcp/a:1?x/home",
        "live:udp/a:1/home",
        "live:tls/a:1,tcp/b:1/home",
        "live:tls/a:1,tls/b:1,tls/c:1/home",
        "live:tls/a:1,/home",
        "live:tls/a,b:1/home",
        "live:unixsock-stream//x.sock/",
    ],
)
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(FormatError, match="is no address of a model server"):
        Address.parse(text)


def test_an_address_of_tls_has_the_name_of_its_host() -> None:
    with pytest.raises(FormatError, match="IPv6"):
        Address.parse("live:tls/[::1]:1/home")


@given(st.text(max_size=70))
def test_a_name_is_a_name_of_a_file_in_the_folder(text: str) -> None:
    try:
        check_server_name(text)
    except InvalidValueError:
        return
    assert text.isascii()
    assert Path(text).name == text
    assert text not in (".", "..")


def test_what_cannot_be_listened_at_is_refused() -> None:
    for endpoint in ("", "7410", "tcp/127.0.0.1", "tcp/127.0.0.1:7410#iface=eth0", "ws/127.0.0.1:1"):
        with pytest.raises(InvalidValueError, match="nothing to listen at"):
            check_endpoint(endpoint)
    assert check_endpoint("tcp/127.0.0.1:7410") == "tcp/127.0.0.1:7410"


@pytest.fixture(params=[True, False], ids=["sockets", "ports"])
def either(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(address, "UNIX_SOCKETS", request.param)


@pytest.mark.usefixtures("sockets", "either")
def test_a_name_has_one_server_at_a_time() -> None:
    assert list_servers() == []
    with Claim("home") as claim:
        assert Address("home").find() == (claim.endpoint, claim.secret)
        assert list_servers() == ["home"]
        with pytest.raises(DuplicateNameError, match="'home' is running"):
            Claim("home")
        with Claim("kitchen"), Claim("home", "camera"), Claim("home.sock"):
            assert list_servers() == ["home", "home.sock", "kitchen"]
            with pytest.raises(DuplicateNameError, match="'camera'"):
                Claim("home", "camera")
    with pytest.raises(UnknownNameError, match="no model server 'home'"):
        Address("home").find()
    Claim("home").release()


@pytest.mark.usefixtures("sockets")
def test_a_server_that_is_not_there_is_said_with_those_that_are() -> None:
    with Claim("kitchen"), pytest.raises(UnknownNameError, match="'kitchen'"):
        Address("kitchne").find()


@pytest.mark.parametrize("kill", [True, False])
def test_a_name_is_free_again_when_its_server_ends(start: Any, sockets: Path, kill: bool) -> None:
    pytest.importorskip("zenoh")
    server = start(SERVER, "home")
    assert list_servers() == ["home"]
    with pytest.raises(DuplicateNameError):
        Claim("home")
    if kill:
        server.kill()
        server.wait()
        assert (sockets / "home.sock").exists()
    else:
        server.stdin.write("\n")
        server.stdin.flush()
        assert server.stdout.readline() == "released\n"
    assert list_servers() == []
    assert list(sockets.iterdir()) == []
    start(SERVER, "home")
    assert list_servers() == ["home"]


@pytest.mark.usefixtures("sockets")
def test_of_many_who_want_a_name_one_gets_it() -> None:
    for _ in range(3):
        held: list[Claim] = []
        refused: list[Exception] = []
        seen: list[list[str]] = []

        def claim(held: list[Claim] = held, refused: list[Exception] = refused) -> None:
            try:
                held.append(Claim("home"))
            except DuplicateNameError as error:
                refused.append(error)

        def look(seen: list[list[str]] = seen) -> None:
            seen.extend(list_servers() for _ in range(20))

        threads = [threading.Thread(target=work) for work in (*6 * [claim], look, look)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert (len(held), len(refused)) == (1, 5)
        assert list_servers() == ["home"]
        assert all(names in ([], ["home"]) for names in seen)
        held[0].release()


def test_the_folder_is_chosen_by_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("KINEVERSE_RUNTIME_DIR", "XDG_RUNTIME_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert runtime_folder().parent == tmp_path
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "nowhere"))
    assert runtime_folder().parent == tmp_path
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert runtime_folder() == tmp_path / "kineverse"
    monkeypatch.setenv("KINEVERSE_RUNTIME_DIR", str(tmp_path / "mine"))
    assert runtime_folder() == tmp_path / "mine"
    assert {path.stat().st_mode & 0o777 for path in tmp_path.iterdir()} == {0o700}


@pytest.mark.skipif(not address.UNIX_SOCKETS, reason="folders have no modes here")
def test_a_folder_that_others_can_enter_is_refused(sockets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for mode in (0o755, 0o770, 0o701):
        sockets.chmod(mode)
        for use in (runtime_folder, lambda: Claim("home"), Address("home").find):
            with pytest.raises(InvalidValueError, match="by others"):
                use()
        assert list_servers() == []
    sockets.chmod(0o700)
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(InvalidValueError, match="another user"):
        runtime_folder()


@pytest.mark.skipif(not address.UNIX_SOCKETS, reason="there are no sockets")
def test_a_socket_needs_a_short_path(sockets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder, reason in ((100 * "a", "bytes, more than 103"), ("a#b", r"has \? or #")):
        monkeypatch.setenv("KINEVERSE_RUNTIME_DIR", str(sockets / folder))
        with pytest.raises(InvalidValueError, match=reason):
            Claim("home")
        assert list_servers() == []


def test_a_port_is_found_open_without_locks(
    start: Any, sockets: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a system without locks and Unix sockets."""
    transport = pytest.importorskip("kineverse.exchange.transport")
    monkeypatch.setattr(address, "UNIX_SOCKETS", False)
    monkeypatch.setattr(address, "fcntl", None)
    with Claim("home") as claim:
        server = transport.Transport.serve([claim.endpoint], claim.secret)
        assert list_servers() == ["home"]
        with pytest.raises(DuplicateNameError):
            Claim("home")
        server.close()
    assert list_servers() == []
    (sockets / "home.json").write_text("{")
    with pytest.raises(UnknownNameError):
        Address("home").find()
    Claim("home").release()
