"""Web server of the page, which answers requests of its own page only and prints nothing."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import errno
import html
import logging
import socket
from collections.abc import Callable
from types import FunctionType
from typing import Any

from kineverse._extras import install_command
from kineverse.errors import InvalidValueError, KineverseError, MissingDependencyError

from .access_control import AccessControl

logger = logging.getLogger(__name__)

HOST = "127.0.0.1"
PREFERRED_PORT = 8080

TAKEN_DOWN = (
    "There is no page to wait for: it has been taken down. Wait inside of the 'with' that opened it; "
    "kv.show(model) waits by itself."
)

_TITLE, _END = b"<title>Viser</title>", b"</body>"
_OWN = "X-Kineverse"  # header of requests by scripts of the page


def start(port: int | None = None, label: str = "", host: str = HOST, *, secret: bool = False) -> Any:
    """Start a viser server that answers requests of its own page only, at a random address if secret."""
    try:
        import viser
        from viser import infra
    except ImportError as error:
        raise MissingDependencyError(
            f"the page in the browser needs viser: {install_command('view')}"
        ) from error

    access = AccessControl.from_host(host, secret=secret)
    gate = _GuardedWebsockets(access, label)

    class GuardedWebsockServer(infra.WebsockServer):
        _background_worker = _replace_global(infra.WebsockServer._background_worker, "websockets", gate)

    class LocalServer(viser.ViserServer):
        """Server that a browser cannot tell to publish itself on the internet."""

        __init__ = _replace_global(
            viser.ViserServer.__init__, "infra", _PatchedModule(infra, WebsockServer=GuardedWebsockServer)
        )

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

        @property
        def address(self) -> str:
            return access.address(self.get_port())

        def add_html(self, content: str) -> None:
            """Add HTML to the page, for browsers that load it from now on."""
            gate.html += content

        def add_answer(self, path: str, function: Callable[[str], str]) -> None:
            """Answer requests of the page's own scripts for a path by a function of their header: JSON."""
            gate.answers[path] = function

        @property
        def is_behind(self) -> bool:
            """True while a browser has not taken what was drawn last."""
            buffer = self._websock_server._broadcast_buffer
            return any(buffer.message_counter - 1 > last for last in buffer.generator_cursors.values())

    with suppress_console():
        server = LocalServer(host=host, port=find_free_port(host, port), label=label, verbose=False)
    if not gate.installed:
        stop(server)
        raise KineverseError(
            f"viser {viser.__version__} serves pages in a way that is not known here: any other page in the "
            "browser could read them. Install another version: pip install 'viser==1.1.1'"
        )
    return server


def stop(server: Any) -> None:
    """Stop a server, and wait until it has released its port."""
    with suppress_console():
        server.stop()


@contextlib.contextmanager
def suppress_console() -> Any:
    """Keep viser from printing to standard output, which belongs to the caller."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


class _PatchedModule:
    """Module with other objects under some of its names."""

    def __init__(self, module: Any, **names: Any) -> None:
        self.__dict__.update(names, _module=module)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


class _GuardedWebsockets(_PatchedModule):
    """Module ``websockets`` for one server, whose requests pass access control.

    viser has no hook for that. The functions of this server get another global ``websockets``; viser and
    websockets stay unchanged for all other servers.
    """

    def __init__(self, access: AccessControl, title: str) -> None:
        import websockets.asyncio.server

        server = _PatchedModule(websockets.asyncio.server, serve=self._serve)
        super().__init__(websockets, asyncio=_PatchedModule(websockets.asyncio, server=server))
        self.installed = False
        self.html, self.answers = "", dict[str, Callable[[str], str]]()
        self._access, self._title = access, title

    def _serve(self, *arguments: Any, process_request: Any, **options: Any) -> Any:
        import websockets.asyncio.server

        self.installed = True
        checked = self._checked(process_request)
        return websockets.asyncio.server.serve(*arguments, process_request=checked, **options)

    def _checked(self, process_request: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Return a handler that refuses requests, answers them, or passes them on without the token."""
        from websockets.http11 import Response

        access = self._access

        async def process(connection: Any, request: Any) -> Any:
            headers = request.headers.copy()
            hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
            upgrades = bool(headers.get_all("Upgrade"))
            reason = access.refusal(request.path, hosts, origins, connection.local_address[1], upgrades)
            if reason:
                logger.info("a request was refused: %s (host %r, origin %r)", reason, hosts, origins)
                text = f"Refused: {reason}.\n".encode()
                about = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(text))}
                return Response(403, "Forbidden", type(headers)(about), text)
            # The page is changed below, which requires that it is not compressed.
            headers.pop("Accept-Encoding", None)
            path = access.inner_path(request.path)
            answer = self.answers.get(path or "")
            # Browsers send this header from scripts of the page alone: other pages would have to ask before.
            if answer is not None and _OWN in headers:
                text = (await asyncio.to_thread(answer, headers[_OWN])).encode()
                about = {"Content-Type": "application/json", "Content-Length": str(len(text))}
                about |= {"Cache-Control": "no-store"}
                return Response(200, "OK", type(headers)(about), text)
            inner = dataclasses.replace(request, path=path, headers=headers)
            response = process_request(connection, inner)
            if response is not None:
                title = f"<title>{html.escape(self._title)}</title>" if self._title else _TITLE.decode()
                body = (response.body or b"").replace(_TITLE, title.encode(), 1)
                before, end, after = body.rpartition(_END)
                response.body = before + self.html.encode() + end + after
                response.headers.pop("Content-Length", None)
                response.headers.update(
                    access.headers(hosts[0]), **{"Content-Length": str(len(response.body))}
                )
            return response

        return process


def _replace_global(function: Any, name: str, thing: Any) -> Any:
    """Return a copy of a function with another object under one global name."""
    seen = {**function.__globals__, name: thing}
    copy = FunctionType(
        function.__code__, seen, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__kwdefaults__ = function.__kwdefaults__
    return copy


def find_free_port(host: str, port: int | None = None) -> int:
    """Return the port itself if it is free, and without one the preferred or any free port of a host.

    A port that is none or is taken, and a host that is none, are an InvalidValueError.
    """
    if port is not None and not 0 <= port <= 65535:
        raise InvalidValueError(f"{port} is not a port; ports are numbers from 0 (any free one) to 65535")
    try:
        family, _, _, _, place = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise InvalidValueError(f"there is no host {host!r}: {error.strerror}") from None
    wanted = [PREFERRED_PORT, 0] if port is None else [port]
    for candidate in wanted:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((place[0], candidate, *place[2:]))
            except OSError as error:
                if error.errno == errno.EADDRNOTAVAIL:
                    raise InvalidValueError(f"{host!r} is no address of this computer") from None
                continue
            return int(probe.getsockname()[1])
    raise InvalidValueError(f"port {port} is taken; without --port a free one is chosen")
