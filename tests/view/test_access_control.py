"""Access control of the page: attacks by headers, on the rule itself and on a running server."""

from __future__ import annotations

import socket

import pytest

from kineverse.errors import InvalidValueError, KineverseError
from kineverse.view import server as web
from kineverse.view.access_control import AccessControl

viser = pytest.importorskip("viser", reason="the page needs the extra 'view'")

ALONE = AccessControl("127.0.0.1", "")
SHARED = AccessControl("0.0.0.0", "s3cret")
OWN = {"hosts": ["127.0.0.1:8080"], "origins": ["http://127.0.0.1:8080"], "port": 8080, "websocket": True}

HOST, ORIGIN, TOKEN, ELSE = (
    "the host is not that of the page",
    "the origin is not that of the page",
    "the address has not the token of the page",
    "the address has the page show something else",
)

FOREIGN_HOSTS = (
    [],
    ["evil.example:8080"],
    ["127.0.0.1"],
    ["127.0.0.1:8081"],
    ["127.0.0.1.evil.example:8080"],
    ["evil.example@127.0.0.1:8080"],
    ["127.0.0.1:8080, evil.example:8080"],
    ["127.0.0.1:8080", "evil.example:8080"],
    ["localhost.:8080"],
    ["127.0.0.1:08080x"],
    [" 127.0.0.1:8080"],
    ["192.168.0.7:8080"],
)
FOREIGN_ORIGINS = (
    "null",
    "",
    "http://evil.example",
    "http://evil.example:8080",
    "https://127.0.0.1:8080",
    "http://127.0.0.1:8081",
    "http://127.0.0.1",
    "http://localhost:8080",
    "http://127.0.0.1:8080.evil.example",
    "http://127.0.0.1:8080/",
    "file://127.0.0.1:8080",
)


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "[::1]", "LOCALHOST"])
def test_requests_of_the_own_page_are_accepted(name):
    own = {"hosts": [f"{name}:8080"], "origins": [f"http://{name}:8080"], "port": 8080}
    assert ALONE.refusal("/", **own, websocket=True) == ""
    assert ALONE.refusal("/", **(own | {"origins": []}), websocket=False) == ""
    # A program on this computer is no browser, and may leave the origin out.
    assert ALONE.refusal("/", **(own | {"origins": []}), websocket=True) == ""
    assert ALONE.refusal("/", [name], [f"http://{name}"], 80, websocket=True) == ""


@pytest.mark.parametrize("websocket", [True, False])
def test_other_hosts_and_origins_are_refused(websocket):
    own = OWN | {"websocket": websocket}
    for hosts in FOREIGN_HOSTS:
        assert ALONE.refusal("/", **(own | {"hosts": hosts})) == HOST, hosts
    for origin in FOREIGN_ORIGINS:
        assert ALONE.refusal("/", **(own | {"origins": [origin]})) == ORIGIN, origin
    assert ALONE.refusal("/", **(own | {"origins": [*OWN["origins"], "http://evil.example"]})) == ORIGIN


def test_network_requests_need_the_token_and_a_numeric_or_own_host():
    lan = {"hosts": ["192.168.0.7:8080"], "origins": ["http://192.168.0.7:8080"], "port": 8080}
    for path in ("/s3cret", "/s3cret/", "/s3cret/x", "/s3cret?darkMode"):
        assert SHARED.refusal(path, **lan, websocket=True) == ""
    for path in (
        "/",
        "",
        "/s3cre",
        "/s3crets",
        "/S3CRET",
        "//s3cret",
        "/?s3cret",
        "/x/s3cret",
        "/s3cr%65t",
        "/ß",
    ):
        assert SHARED.refusal(path, **lan, websocket=False) == TOKEN, path
    own = socket.gethostname()
    assert SHARED.refusal("/s3cret", [f"{own}:8080"], [f"http://{own}:8080"], 8080, True) == ""
    rebound = {"hosts": ["rebound.example:8080"], "origins": ["http://rebound.example:8080"], "port": 8080}
    assert SHARED.refusal("/s3cret", **rebound, websocket=True) == HOST
    assert SHARED.refusal("/s3cret", **(lan | {"origins": []}), websocket=True) == (
        "a WebSocket over the network needs an origin"
    )
    assert (SHARED.inner_path("/s3cret/a?b/c"), SHARED.inner_path("/s3cret")) == ("/a?b/c", "/")


def test_queries_that_show_data_from_elsewhere_are_refused():
    assert ALONE.refusal("/?websocket=ws://127.0.0.1:8080", **OWN) == ""
    assert SHARED.refusal("/s3cret?websocket=ws://127.0.0.1:8080/s3cret", **OWN) == ""
    for query in (
        "websocket=ws://evil.example",
        "websocket=wss://127.0.0.1:8080",
        "websocket=ws%3A%2F%2Fevil.example%3A8080",
        "darkMode&websocket=",
        "websocket=ws://127.0.0.1:8080&websocket=ws://evil.example",
        "websocket=ws://127.0.0.1:8080@evil.example",
        "playbackPath=data:,",
        "playbackPath=http://evil.example/x.viser",
    ):
        assert ALONE.refusal(f"/?{query}", **OWN) == ELSE, query


def test_tokens_are_random_and_for_network_addresses_only():
    for host in ("127.0.0.1", "localhost", "::1", "127.0.0.2"):
        assert AccessControl.from_host(host).token == ""
    one, other = AccessControl.from_host("0.0.0.0"), AccessControl.from_host("0.0.0.0")
    assert one.token != other.token
    assert len(one.token) >= 32
    assert one.address(8080).endswith(f":8080/{one.token}")
    assert not one.address(8080).startswith("http://0.0.0.0")
    assert one.token not in repr(one)
    assert AccessControl("::1", "").address(80) == "http://[::1]:80"


def answer(port: int, path: str = "/", host: str | None = None, *lines: str) -> int:
    """Send a request with any headers, and return the status of the answer."""
    head = [f"GET {path} HTTP/1.1", f"Host: {host or f'127.0.0.1:{port}'}", *lines, "", ""]
    with socket.create_connection(("127.0.0.1", port), timeout=20.0) as connection:
        connection.sendall("\r\n".join(head).encode())
        start = b""
        while b"\r\n" not in start:
            start += connection.recv(4096)
    return int(start.split()[1])


def handshake(port: int, path: str = "/", host: str | None = None, origin: str | None = None) -> int:
    lines = ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
    lines += [
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        f"Sec-WebSocket-Protocol: viser-v{viser.__version__}",
    ]
    lines += [] if origin is None else [f"Origin: {origin}"]
    return answer(port, path, host, *lines)


def test_a_running_server_answers_its_own_page_only():
    server = web.start(0, "a <b> title")
    try:
        port = server.get_port()
        own = f"http://127.0.0.1:{port}"
        assert server.address == own
        assert (answer(port), handshake(port, origin=own), handshake(port)) == (200, 101, 101)
        assert handshake(port, host=f"localhost:{port}", origin=f"http://localhost:{port}") == 101
        for origin in (
            "null",
            "http://evil.example",
            f"http://localhost:{port}",
            f"http://127.0.0.1:{port + 1}",
        ):
            assert (handshake(port, origin=origin), answer(port, "/", None, f"Origin: {origin}")) == (
                403,
                403,
            )
        for host in ("evil.example", f"rebound.example:{port}", f"127.0.0.1:{port + 1}", "127.0.0.1"):
            assert (handshake(port, host=host, origin=f"http://{host}"), answer(port, host=host)) == (
                403,
                403,
            )
        assert answer(port, "/?playbackPath=x") == 403
        assert answer(port, "/../../_viser.py") == 404
    finally:
        web.stop(server)


def test_a_network_server_requires_its_token(monkeypatch):
    monkeypatch.setattr(
        AccessControl, "from_host", staticmethod(lambda host, **_: AccessControl(host, "s3cret"))
    )
    server = web.start(0, "shared")
    try:
        port = server.get_port()
        own = f"http://127.0.0.1:{port}"
        assert server.address == f"{own}/s3cret"
        for path, page, socket_ in (
            ("/s3cret", 200, 101),
            ("/s3cret/", 200, 101),
            ("/", 403, 403),
            ("/s3", 403, 403),
        ):
            assert (answer(port, path), handshake(port, path, origin=own)) == (page, socket_)
    finally:
        web.stop(server)


def test_a_viser_that_bypasses_access_control_is_refused(monkeypatch):
    monkeypatch.setattr(web, "_replace_global", lambda function, name, thing: function)
    stopped = []
    monkeypatch.setattr(web, "stop", lambda server, stop=web.stop: (stop(server), stopped.append(server)))
    with pytest.raises(
        KineverseError, match=r"serves pages in a way that is not known here.*pip install 'viser=="
    ):
        web.start(0)
    assert len(stopped) == 1


def test_viser_and_websockets_are_unchanged_for_other_servers():
    import websockets.asyncio.server
    from viser import infra

    before = websockets.asyncio.server.serve, infra.WebsockServer, infra.WebsockServer._background_worker
    web.stop(web.start(0))
    assert before == (
        websockets.asyncio.server.serve,
        infra.WebsockServer,
        infra.WebsockServer._background_worker,
    )


def test_hosts_of_other_computers_are_refused(monkeypatch):
    with pytest.raises(InvalidValueError, match=r"'192\.0\.2\.77' is no address of this computer"):
        web.start(0, host="192.0.2.77")

    def unknown(*_, **__):
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(InvalidValueError, match="there is no host 'nowhere': Name or service not known"):
        web.start(0, host="nowhere")
