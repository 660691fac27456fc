"""Costs of a model server for clients at other sites: bytes and CPU time of messages, and their sums."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from figures.pages import Table

from kineverse.exchange.client import LiveModel

from .client import load
from .edge import Home, find_port
from .edits import count_on
from .processes import Process, folder, start
from .proxy import Proxy

HEAD = ("message", "up [B]", "down [B]", "server [µs]", "relay [µs]")
"""Columns: bytes from and to the site of a client by TLS, and CPU times of the server and of a relay."""
EDIT, CLIENT, SITE, SECOND, BEHIND, STATE, JOIN = (
    "an edit of a frame, to who makes it",
    "an edit of a frame, to each other client",
    "an edit of a frame, to each relay",
    "a second of each client",
    "a second of each client of a relay",
    "20 values of state, to each reader",
    "a kitchen and a PR2, to who loads them",
)
PAUSE, SELDOM = 0.02, 0.5
"""Time between two edits, and between those that tell the costs of a second from the costs of an edit [s]."""
ON_PAPER_HEAD = (
    "sites",
    "clients",
    "edits/s",
    "way",
    "server's CPU [%]",
    "server sends [Mbit/s]",
    "site gets [Mbit/s]",
)
SCENARIOS = ((1, 5, 1), (5, 20, 10), (20, 200, 20), (20, 1000, 20), (100, 1000, 50))
"""Numbers of sites, of clients of all sites together, and of edits in a second."""

Row = tuple[str, ...]


# -- measurements --------------------------------------------------------------------------------------------


class Meter:
    """Bytes at a proxy, and CPU times of processes, since its start."""

    def __init__(self, proxy: Proxy, *processes: int) -> None:
        self._proxy, self._processes = proxy, processes
        self._begin = self._read()

    def _read(self) -> list[float]:
        return [self._proxy.up, self._proxy.down, *map(_cpu_time, self._processes)]

    def read(self, number: float) -> list[float]:
        """Return what there was of each, for one of a number."""
        return [(now - then) / number for now, then in zip(self._read(), self._begin, strict=True)]


def _cpu_time(process: int) -> float:
    """Return the CPU time of a process [s]."""
    words = Path(f"/proc/{process}/stat").read_text("utf-8").rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Size:
    """Size of the measurement: edits in a row, clients, seconds with few edits, and turns of all of that."""

    edits: int
    clients: int
    seconds: float
    turns: int = 4


def measure(size: Size) -> list[Row]:
    """Return the rows of costs."""
    edits, clients = size.edits, size.clients
    with folder() as path, ExitStack() as running:
        home = Home(running, path, 1, secured=True)
        home.near.kill()
        proxies = [running.enter_context(closing(Proxy(home.port))) for _ in range(3)]
        own, others, site = proxies
        editor = running.enter_context(closing(load("whole", home.endpoint(own.port))))
        server = home.server.id
        _edit(editor, edits)  # the first ones take longer
        meter = Meter(own, server)
        _edit(editor, edits)
        alone = meter.read(edits)

        follower = start(
            running, "client", "followers", 1, 1, *[f"whole@{home.endpoint(others.port)}"] * clients
        )
        direct = _split(editor, follower, others, [server], size) / clients
        follower.kill()

        port = find_port()
        relay = home.start_relay(site.port, port)
        follower = start(running, "client", "site", 1, 1, *[f"whole@{home.endpoint(port)}"] * clients)
        relayed = _split(editor, follower, site, [server, relay.id], size)
        follower.kill()

        state = _measure_state(editor, own, home, others, edits)
        for name in ("kitchen", "pr2"):
            with editor.edit() as edit:
                edit.include(name)
        meter = Meter(others, server)
        for _ in range(clients):
            load("whole", home.endpoint(others.port)).close()
        joined = meter.read(clients)
    return [
        _row(EDIT, *alone),
        _row(CLIENT, None, *direct[1, 1:], relayed[1, 3] / clients),
        _row(SITE, None, relayed[1, 1], direct[1, 2]),
        _row(SECOND, *direct[0]),
        _row(BEHIND, relayed[0, 0] / clients, None, *relayed[0, 2:] / clients),
        _row(STATE, *state),
        _row(JOIN, *joined),
    ]


def _split(editor: LiveModel, follower: Process, proxy: Proxy, processes: Sequence[int], size: Size) -> Any:
    """Return costs of a second and of an edit, beside those of the server alone, by few edits and by many.

    Columns are bytes up and down, and CPU times of processes, the first of which is the server. The computer
    does other things as well, so clients are cut off and let through in turn.
    """
    alone, few, many = (np.zeros(4 + len(processes)) for _ in range(3))
    for _ in range(size.turns):
        for total, number, pause in (
            (alone, size.edits, PAUSE),
            (few, size.seconds / SELDOM, SELDOM),
            (many, size.edits, PAUSE),
        ):
            if total is alone:
                proxy.cut("reset")
            else:
                proxy.heal()
                follower.ask("follow", editor.version)
            time.sleep(SELDOM)
            meter, begin, made = Meter(proxy, *processes), time.monotonic(), round(number / size.turns)
            _edit(editor, made, pause)
            if total is not alone:
                follower.ask("follow", editor.version)
            total += [time.monotonic() - begin, made, *meter.read(1)]
    for total in (few, many):
        total[4] -= total[1] * alone[4] / alone[1]
    return np.linalg.solve([few[:2], many[:2]], [few[2:], many[2:]])


def _edit(editor: LiveModel, number: int, pause: float = PAUSE) -> None:
    """Put a frame at another place, again and again.

    Others are in one process, and would ask for what they have no time to take.
    """
    for _ in range(number):
        with editor.edit() as edit:
            count_on(edit)
        time.sleep(pause)


def _measure_state(
    source: LiveModel, own: Proxy, home: Home, others: Proxy, number: int, readers: int = 2
) -> list[float]:
    """Send vectors; return the bytes of one, and the bytes and the server's CPU time for each reader."""
    names = [f"robot/{k}" for k in range(20)]
    publisher = source.exchange.publisher("robot", names)
    with ExitStack() as opened:
        models = [
            opened.enter_context(closing(load("whole", home.endpoint(others.port)))) for _ in range(readers)
        ]
        reading = [model.exchange.reader(names) for model in models]
        while not all(reader.received.get("robot") for reader in reading):
            publisher.put(range(20))
            time.sleep(0.01)
        sent, got = Meter(own), Meter(others, home.server.id)
        for _ in range(number):
            publisher.put(range(20))
            time.sleep(0.002)
        (up, _), (_, down, cpu) = sent.read(number), got.read(number)
    return [up, down / readers, cpu / readers]


def _row(
    message: str, up: float | None, down: float | None, server: float, relay: float | None = None
) -> Row:
    numbers = up, down, 1e6 * server, None if relay is None else 1e6 * relay
    return message, *("" if one is None else f"{max(0.0, one):.0f}" for one in numbers)


# -- on paper ------------------------------------------------------------------------------------------------


def write_on_paper(rows: Sequence[Row]) -> list[Row]:
    """Return what the costs add up to, for some numbers of sites, clients and edits."""
    costs = {message: [float(cell or 0) for cell in cells] for message, *cells in rows}
    result = []
    for sites, clients, rate in SCENARIOS:
        for way, number, cost, behind in (
            ("direct", clients, costs[CLIENT], 0),
            ("relays", sites, costs[SITE], clients),
        ):
            _, down, server, _ = (
                rate * (own + number * other) + number * second
                for own, other, second in zip(costs[EDIT], cost, costs[SECOND], strict=True)
            )
            server += behind * costs[BEHIND][2]
            gets = number / sites * (rate * cost[1] + costs[SECOND][1])
            numbers = server / 1e4, 8e-6 * down, 8e-6 * gets
            result.append(
                (f"{sites}", f"{clients}", f"{rate}", way, *(f"{_round(number):g}" for number in numbers))
            )
    return result


def _round(number: float) -> float:
    return float(f"{number:.2g}")


def format_tables(size: Size) -> str:
    """Return both tables in Markdown."""
    rows = measure(size)
    tables = ("Costs", HEAD, rows), ("On paper", ON_PAPER_HEAD, write_on_paper(rows))
    return "\n".join(f"## {title}\n\n{Table(head, tuple(cells))}" for title, head, cells in tables)


# -- the command ---------------------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--edits", type=int, default=1000, help="how many edits (1000)")
    parser.add_argument("--clients", type=int, default=20, help="how many clients (20)")
    parser.add_argument("--seconds", type=float, default=10.0, help="time with few edits [s] (10)")


def run(given: argparse.Namespace) -> Iterator[str]:
    """Yield both tables."""
    yield "\n" + format_tables(Size(given.edits, given.clients, given.seconds))
