"""Access control of the page: the Host, the Origin and the token of a request.

Any other page that is open in the browser can send requests to this computer: by a WebSocket, which browsers
open across origins, or under a name that has been pointed to this computer (DNS rebinding). The headers Host
and Origin of such requests tell them apart (RFC 6454; RFC 6455, 10.2), and they are refused.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
import socket
from collections.abc import Iterable
from dataclasses import dataclass, field
from urllib.parse import parse_qsl

LOOPBACK = frozenset(("127.0.0.1", "localhost", "[::1]"))
"""The names under which a computer reaches itself, as in a header Host."""

_AUTHORITY = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::([0-9]{1,5}))?")

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob:; script-src-attr 'none'; "
    "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; worker-src blob:; "
    "connect-src data: ws://{host} http://{host}; object-src 'none'; frame-src 'none'; "
    "base-uri 'none'; form-action 'none'"
)


@dataclass(frozen=True, slots=True)
class AccessControl:
    """Rule by which requests are answered or refused."""

    host: str  # address that the server is bound to
    token: str = field(repr=False)  # first part of every path; may be empty for a page of this computer alone

    @staticmethod
    def from_host(host: str, *, secret: bool = False) -> AccessControl:
        """Return the rule for a host: with a random token, except on this computer if none is wanted."""
        alone = host in ("localhost", "::1") or host.startswith("127.")
        return AccessControl(host, "" if alone and not secret else secrets.token_urlsafe(24))

    def address(self, port: int) -> str:
        """Return the address of the page, token included."""
        unspecified = self.host in ("0.0.0.0", "::")
        host = _own_address(self.host) if unspecified else self.host
        name = f"[{host}]" if ":" in host else host
        return f"http://{name}:{port}/{self.token}".rstrip("/")

    def inner_path(self, path: str) -> str | None:
        """Return a path without the token in front; None if the token is wrong or missing."""
        if not self.token:
            return path
        where, question, query = path.partition("?")
        first, _, rest = where.removeprefix("/").partition("/")
        own = hmac.compare_digest(first.encode(), self.token.encode())
        return f"/{rest}{question}{query}" if own else None

    def refusal(
        self, path: str, hosts: Iterable[str], origins: Iterable[str], port: int, websocket: bool
    ) -> str:
        """Return the reason to refuse a request, empty if it is accepted."""
        host = _authority(hosts)
        if host is None or host[1] != port or not self._is_own(host[0]):
            return "the host is not that of the page"
        origins = list(origins)
        if origins and (not origins[0].startswith("http://") or _authority(o[7:] for o in origins) != host):
            return "the origin is not that of the page"
        # Browsers send an Origin with every WebSocket. A program on this computer may leave it out.
        if websocket and not origins and host[0] not in LOOPBACK:
            return "a WebSocket over the network needs an origin"
        if self.inner_path(path) is None:
            return "the address has not the token of the page"
        return self._refused_query(path, host)

    def headers(self, host: str) -> dict[str, str]:
        """Return the headers of the page, which allow it to connect to its own host only."""
        return {
            "Content-Security-Policy": _POLICY.format(host=host),
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }

    def _is_own(self, name: str) -> bool:
        if name in LOOPBACK or name.strip("[]") == self.host.lower():
            return True
        if not self.token:
            return False
        # The owner of a name can point it to this computer; a number cannot be.
        own = socket.gethostname().lower()
        return name in (own, f"{own}.local") or _is_number(name)

    def _refused_query(self, path: str, host: tuple[str, int]) -> str:
        """Return the reason to refuse a query that has the page show data from elsewhere, else empty."""
        where = path.partition("?")[0].rstrip("/")
        for key, value in parse_qsl(path.partition("?")[2], keep_blank_values=True):
            address, _, rest = value.removeprefix("ws://").partition("/")
            own = (
                value.startswith("ws://")
                and _authority([address]) == host
                and f"/{rest}".rstrip("/") == where
            )
            if key == "playbackPath" or (key == "websocket" and not own):
                return "the address has the page show something else"
        return ""


def _authority(texts: Iterable[str]) -> tuple[str, int] | None:
    """Return name and port of the only text, None if it has another form or there are several."""
    found = list(texts)
    match = _AUTHORITY.fullmatch(found[0].lower()) if len(found) == 1 else None
    return (match[1], int(match[2] or 80)) if match else None


def _is_number(name: str) -> bool:
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def _own_address(host: str) -> str:
    """Return an address under which others reach a server that listens on all addresses."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            # Nothing is sent: this only selects an address. The target is one reserved for documentation.
            probe.connect(("2001:db8::1" if ":" in host else "192.0.2.1", 9))
            return str(probe.getsockname()[0])
    except OSError:
        return socket.gethostname()
