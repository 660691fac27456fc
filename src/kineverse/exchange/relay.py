"""Relay of a site: passes on what its clients ask of a model server, and what the server publishes.

It keeps nothing. Its clients have the same keys as at the server, and its own rights say who they are.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Thread

from kineverse._checks import as_entries
from kineverse._runtime import Closing
from kineverse.errors import InvalidValueError

from .access import RELAY, make_grants
from .address import Address, check_endpoint, is_secured, list_endpoints
from .keys import explain_refusal, read_listening
from .transport import Transport

_LONGEST_WAIT = 1.0  # time in which a server answers, or is away [s]


class Relay(Closing):
    """Relay to a model server, which runs until it is closed. It connects as soon as the server is there.

    Parameters
    ----------
    address
        Address of the server, ``live:tls/HOST:PORT/NAME``.
    listen
        Endpoints for clients, ``tls/HOST:PORT``.
    keys
        Folder with the keys of the relay, and ``rights.toml`` about its users; ``kineverse keys`` makes it.

    Attributes
    ----------
    address, keys, rights
        Address of the server, the relay's keys, and its rights.

    Raises
    ------
    InvalidValueError
        For keys or endpoints that cannot be used.
    FormatError
        For an address that is none, or rights that cannot be read.
    MissingDependencyError
        Without the extra ``exchange``.

    See Also
    --------
    kineverse.exchange.serve
    """

    def __init__(self, address: str, *, listen: Iterable[str], keys: str | os.PathLike[str]) -> None:
        self.address = Address.parse(address)
        endpoints = as_entries("listen=", listen, str, "endpoints")
        secured = [is_secured(check_endpoint(one)) for one in endpoints]
        if not self.address.is_secured or not secured or not all(secured):
            raise InvalidValueError(
                "A relay connects to live:tls/HOST:PORT/NAME, and listens at tls/HOST:PORT."
            )
        self.keys, self.rights = read_listening(keys, RELAY)
        self._transport = Transport.serve(
            endpoints,
            keys=self.keys,
            grants=make_grants(self.address.name, self.rights),
            servers=list_endpoints(self.address.endpoint),
        )
        self._signs: SimpleQueue[tuple[str, bool]] = SimpleQueue()
        signs = self._transport.watch_alive(f"kineverse/{self.address.name}/alive/*")
        Thread(
            target=lambda: deque(map(self._signs.put, signs), 0), name="kineverse-relay", daemon=True
        ).start()

    def watch(self) -> Iterator[bool]:
        """Yield whether the server is there, at once and whenever that has changed."""
        alive: set[str] = set()
        told: bool | None = None
        while True:
            with suppress(Empty):
                key, is_there = self._signs.get(timeout=None if told == bool(alive) else _LONGEST_WAIT)
                alive = alive | {key} if is_there else alive - {key}
                if not alive:
                    continue  # one that has started again may be there at once
            if told != bool(alive):
                told = bool(alive)
                yield told

    def explain(self) -> str:
        """Return why the server is not there, as far as can be known."""
        reasons = (explain_refusal(one, self.keys) for one in list_endpoints(self.address.endpoint))
        return "; ".join(reasons)

    def close(self) -> None:
        """End the relay; its clients are offline until it, or another one, is there."""
        self._transport.close()
