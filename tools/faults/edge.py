"""Faults of networks: clients are cut off, slow, or lose their relay; what was acknowledged is not lost."""

from __future__ import annotations

import argparse
import os
import socket
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from threading import Thread
from unittest.mock import patch

import kineverse as kv
from kineverse.exchange.client import LiveModel
from kineverse.exchange.keys import make_keys
from kineverse.exchange.server import serve

from .client import load
from .processes import Process, folder, start, wait_until
from .proxy import CUTS, Proxy
from .served import NAME
from .server import (
    HELD_UP,
    KINDS,
    LONG,
    check,
    check_presence,
    check_replicas,
    check_store,
    has_edited,
    make_store,
    say,
    stop,
    wait_for_edits,
)

ROUTES = ("tcp", "tls", "relay")
"""Ways to a server that can be cut: a connection of a client, the same by TLS, or that of a site's relay."""
NOTICED = 3.0
"""Time in which a client notices that it is cut off [s]."""
DELAY = 0.01
"""Time that bytes take from one site to another [s]."""
HOST = "127.0.0.1"


# -- sites ---------------------------------------------------------------------------------------------------


def find_port() -> int:
    """Return a port of this computer that is free."""
    with socket.socket() as one:
        one.bind((HOST, 0))
        return int(one.getsockname()[1])


class Home:
    """Site of the server, with a client at its socket; users and relays elsewhere have their keys."""

    def __init__(self, running: ExitStack, path: Path, seed: int, secured: bool) -> None:
        self._running, self._path, self.port = running, path, find_port()
        self._scheme = "tls" if secured else "tcp"
        self._keys, self._copies = path / "keys", 0
        store = path / "home.db"
        make_store(store)
        options = [f"listen={self.endpoint(self.port)}"]
        if secured:
            make_keys(self._keys, server=[HOST], user=["alice"], relay={"site": [HOST]})
            for rights in self._keys.rglob("rights.toml"):
                rights.write_text(rights.read_text("utf-8").replace('"see"', '"edit"'), "utf-8")
            running.enter_context(patch.dict(os.environ, KINEVERSE_KEYS=str(self._keys / "users" / "alice")))
            options.append(f"keys={self._keys / 'server'}")
        self.server = start(running, "served", store, *options)
        self.clients: dict[Process, int] = {}  # with the number of their models
        self._seed, self.longest = seed, defaultdict[str, list[float]](list)
        self.near = self.join("near", "", "whole")

    def endpoint(self, port: int) -> str:
        return f"{self._scheme}/{HOST}:{port}"

    def join(self, name: str, endpoint: str, *kinds: str) -> Process:
        """Start clients of some kinds, which edit from now on, at an endpoint."""
        what = [f"{kind}@{endpoint}" for kind in kinds]
        client = start(self._running, "client", name, self._seed, 0, *what)
        self.clients[client] = len(kinds)
        return client

    def start_relay(self, server: int, port: int) -> Process:
        """Start a relay between two ports, and return when it is connected."""
        address, keys = f"live:{self.endpoint(server)}/{NAME}", self._keys / "relays" / "site"
        return start(self._running, "relayed", address, self.endpoint(port), keys)

    def check(self) -> int:
        """Let all pause, and check that all have what was acknowledged; return the revision."""
        for client in self.clients:
            client.tell("pause")
        for client in self.clients:
            client.wait_for_reply()
        check_presence(sum(self.clients.values()))
        end = check_replicas(self.server, [*self.clients])
        self._copies += 1
        copy = self._path / f"copy {self._copies}.db"
        with closing(load("whole")) as model:
            model.exchange.backup(copy)
        check(check_store(copy, self.clients) == end, "the store has another model")
        copy.unlink()
        for client in self.clients:
            client.ask("resume")
        return end[0]

    def wait_to_notice(self, client: Process, since: int) -> float:
        """Wait until all models of a client have noticed that the server is away, and return when."""

        def notices() -> dict[str, float]:
            client.check()
            told = [one for one in client.told[since:] if "online" in one]
            return {one["client"]: one["at"] for one in told if not one["online"]}

        wait_until(
            lambda: len(notices()) == self.clients[client], LONG, "clients that notice that they are cut"
        )
        return max(notices().values())

    def note_longest(self, how: str) -> None:
        """Note how long an edit at the server's side took at most, since this was noted before."""
        ((_, longest),) = self.near.ask("longest")
        self.longest[how].append(longest)

    def stop(self, found: Counter[str], most: float) -> dict[str, int]:
        """Let all stop, and return what happened; other work of the computer may hold up some rounds."""
        found["longest of others ms"] = round(1e3 * max(max(times) for times in self.longest.values()))
        for how, times in self.longest.items():
            check(min(times) < most, f"an edit took {min(times):.2f} s or more whenever others had a {how}")
        return dict(found + stop(self.clients))


# -- partitions ----------------------------------------------------------------------------------------------


def try_partitions(
    rounds: int, seconds: float, seed: int, route: str, most: float = HELD_UP
) -> dict[str, int]:
    """Cut clients off while all edit: silently and by a reset in turn; return what happened."""
    found: Counter[str] = Counter()
    with folder() as path, ExitStack() as running:
        home = Home(running, path, seed, route != "tcp")
        proxy = running.enter_context(closing(Proxy(home.port, DELAY)))
        port = proxy.port
        if route == "relay":
            port = find_port()
            home.start_relay(proxy.port, port)
        far = home.join("far", home.endpoint(port), *KINDS)
        for number in range(rounds):
            wait_for_edits(home.near, far)
            how = CUTS[number % len(CUTS)]
            _cut(home, far, proxy, how, seconds, found)
            wait_for_edits(home.near, far)
            home.note_longest(f"{how} cut")
            found["revisions"] = home.check()
        return home.stop(found, most)


def _cut(home: Home, far: Process, proxy: Proxy, how: str, seconds: float, found: Counter[str]) -> None:
    since, since_near = len(far.told), len(home.near.told)
    proxy.cut(how)
    begin = time.monotonic()
    noticed = home.wait_to_notice(far, since) - begin
    check(noticed < NOTICED, f"clients have noticed after {noticed:.1f} s that they are cut off ({how})")
    time.sleep(max(0.0, seconds - noticed) / 2)  # for answers that had come, and were not told yet
    since = len(far.told)
    time.sleep(max(0.0, begin + seconds - time.monotonic()))
    check(min(far.ask("read")) > 0, "there is nothing to read")
    check(all(far.ask("refuses")), "a client that is cut off may begin an edit")
    check(not has_edited(far, since), "an edit of a client that was cut off was acknowledged")
    check(has_edited(home.near, since_near), "nobody has edited at the server's side")
    found["edits meanwhile"] += sum("number" in told for told in home.near.told[since_near:])
    revision, _ = home.server.ask("state")
    proxy.heal()
    healed = time.monotonic()
    caught_up = far.ask("follow", revision) - healed
    for name, time_ in ((f"noticed after ms, {how}", noticed), (f"up to date after ms, {how}", caught_up)):
        found[name] = max(found[name], round(1e3 * time_))


# -- relays that are killed ----------------------------------------------------------------------------------


def try_relays(kills: int, seed: int, most: float = HELD_UP) -> dict[str, int]:
    """Kill relays in turn while all edit: who has a second one goes on, the others wait for theirs."""
    found: Counter[str] = Counter()
    with folder() as path, ExitStack() as running:
        home = Home(running, path, seed, secured=True)
        ports = find_port(), find_port()
        relays = [home.start_relay(home.port, port) for port in ports]
        first, second = map(home.endpoint, ports)
        one, both = home.join("one", first, "whole"), home.join("both", f"{first},{second}", "whole", "0")
        for number in range(kills):
            wait_for_edits(home.near, one, both)
            since, killed = len(one.told), number % len(relays)
            relays[killed].kill()
            begin = time.monotonic()
            wait_for_edits(both)
            _note(found, "edits by another relay after ms", begin)
            if killed == 0:
                home.wait_to_notice(one, since)
            relays[killed] = home.start_relay(home.port, ports[killed])
            begin = time.monotonic()
            wait_for_edits(one)
            _note(found, "edits by the same relay after ms", begin)
            home.note_longest("killed relay")
            found["revisions"] = home.check()
        return home.stop(found, most)


def _note(found: Counter[str], name: str, begin: float) -> None:
    found[name] = max(found[name], round(1e3 * (time.monotonic() - begin)))


# -- slow connections ----------------------------------------------------------------------------------------


def try_slow(rate: float, copies: int, most: float = 2 * HELD_UP) -> dict[str, int]:
    """Load some kitchens over a connection of a rate [bit/s], while others edit and ask.

    A model of 40 takes the server half a second to put together.
    """
    found: Counter[str] = Counter()
    with folder() as path, ExitStack() as running:
        model, store, port = kv.Model(), path / "home.db", find_port()
        with model.edit() as edit:
            for number in range(copies):
                edit.include("kitchen", prefix=f"kitchen {number}")
        serve(model, store=store, name=NAME).close()
        start(running, "served", store, f"listen=tcp/{HOST}:{port}")
        other = start(running, "client", "other", "1", -1, "whole")
        proxy = running.enter_context(closing(Proxy(port, DELAY, rate / 8)))
        near, loaded = running.enter_context(closing(load("whole"))), list[LiveModel]()
        begin = time.monotonic()
        loading = Thread(target=lambda: loaded.append(load("whole", f"tcp/{HOST}:{proxy.port}")))
        loading.start()
        while loading.is_alive():
            asked = time.monotonic()
            near.exchange.status()
            _note(found, "longest question of others ms", asked)
            time.sleep(0.02)
        check(bool(loaded), "a model could not be loaded over a slow connection")
        _note(found, "loaded after ms", begin)
        with closing(loaded[0]) as far:
            begin = time.monotonic()
            far.transact(lambda edit: edit.add_frame("last", "world"))
            _note(found, "edited after ms", begin)
            found["kB"] = proxy.down // 1000
            ((outcomes, longest),) = other.ask("stop")
            found.update(outcomes)
        found["longest edit of others ms"] = round(1e3 * longest)
        longest = max(longest, found["longest question of others ms"] / 1e3)
        check(longest < most, f"others were held up by a slow connection for {longest:.2f} s")
    return dict(found)


# -- the command ---------------------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rounds", type=int, default=10, help="how many partitions by each route (10)")
    parser.add_argument("--seconds", type=float, default=30.0, help="length of a partition [s] (30)")
    parser.add_argument("--route", choices=ROUTES, action="append", help="one of the routes (all)")
    parser.add_argument("--kills", type=int, default=10, help="how many killed relays (10)")
    parser.add_argument("--seed", type=int, default=1, help="of edits and times (1)")


def run(given: argparse.Namespace) -> Iterator[str]:
    """Yield what was tried."""
    if given.rounds:
        for route in given.route or ROUTES:
            found = try_partitions(given.rounds, given.seconds, given.seed, route)
            yield f"{given.rounds} partitions of {given.seconds:g} s, {route}: {say(found)}"
    if given.kills:
        yield f"{given.kills} killed relays: {say(try_relays(given.kills, given.seed))}"
    for rate, copies in ((20e6, 40), (250e3, 1)):
        yield f"{copies} kitchens at {rate / 1e6:g} Mbit/s: {say(try_slow(rate, copies))}"
