"""Faults of model servers: what was acknowledged is there, once and whole, and all have the same model."""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from random import Random
from typing import Any

import kineverse as kv
from kineverse.errors import DuplicateNameError, FormatError, KineverseError, UnknownNameError
from kineverse.exchange import protocol
from kineverse.exchange.authority import Authority
from kineverse.exchange.server import serve
from kineverse.exchange.store import Store
from kineverse.formats import document_hash, operation_from_bytes
from kineverse.model import NetChanges, PlacedEntry

from .client import load
from .edits import build, count, do_something
from .processes import Process, begin, folder, start, wait_until
from .served import NAME
from .store import damage, put_image, take_image

KINDS = ("whole", "0", "1")
"""What the clients of a process load: the whole model, and two parts."""
LONG = 20.0
"""Time in which a client notices that a server is back, and all have the same [s]."""
SOON = 8.0
"""Time in which a server forgets clients that are gone [s]."""
HELD_UP = 0.5
"""Longest time that an edit takes whatever others do [s]."""
ROUNDS_TOGETHER = 20
"""Kills of one store, before the next one."""


# -- what must hold ------------------------------------------------------------------------------------------


class Log:
    """Log of a store: replayed, and checked."""

    def __init__(self, store: Store) -> None:
        commits = store.commits_after(0, protocol.NO_CHAIN, 10**9)
        check(commits is not None and len(commits) == store.revision, "the log has gaps")
        self.model, self.commits = kv.Model(), list[protocol.CommitMessage]()
        self.added, self.removed = dict[str, int](), dict[str, int]()  # revisions of chains
        chain, known = protocol.NO_CHAIN, set[tuple[str, int]]()
        for number, (data, link) in enumerate(commits or (), 1):
            commit: protocol.CommitMessage = protocol.decode_commit(data)
            chain = protocol.chain(chain, data)
            check(link == chain, f"the chain of revision {number} is another")
            check((commit.revision, commit.previous) == (number, number - 1), f"{number} is out of order")
            edit = commit.client, commit.number
            check(edit not in known, f"an edit is at revision {number}, and was made before")
            known.add(edit)
            self.commits.append(commit)
            self._note_chains(commit)
            changes = commit.changes
            put = [
                PlacedEntry(operation_from_bytes(one.blob), one.after or None, one.at_end)
                for one in changes.put
            ]
            self.model.adopt(
                NetChanges(tuple(put), changes.replaced, changes.rerun, changes.moved, changes.removed)
            )

    def _note_chains(self, commit: protocol.CommitMessage) -> None:
        known = {*commit.changes.replaced, *commit.changes.rerun}
        put = [tag for tag in map(protocol.tag_of, commit.changes.put) if tag not in known]
        for tags, into in ((put, self.added), (commit.changes.removed, self.removed)):
            parts = Counter(
                tag.rpartition("/")[0] for tag in tags if tag.startswith("part/") and tag[-2] == "/"
            )
            for name, parts_there in parts.items():
                check(parts_there == 3, f"revision {commit.revision} has {parts_there} of 3 frames of {name}")
                check(name not in into, f"{name} is at revision {commit.revision}, and was so before")
                into[name] = commit.revision


def check(is_so: bool, violation: str) -> None:
    if not is_so:
        raise AssertionError(violation)


def check_store(path: Path, clients: Iterable[Process], killed: int = 0) -> tuple[int, str]:
    """Check the log of a store against what clients were told; return its revision and hash."""
    store = Store(path)
    try:
        log = Log(store)
        model = Authority(store).model
        check(document_hash(model) == document_hash(log.model), "the store has another model than its log")
        made, unknown, counts = 0, killed, False
        for told in (told for client in clients for told in client.told):
            if "number" in told:
                _check_answer(store, log, told)
            elif told.get("added") == "made":
                check(told["chain"] in log.added, f"{told['chain']} was acknowledged, and was not added")
            elif told.get("removed") == "made":
                check(told["chain"] in log.removed, f"{told['chain']} was acknowledged, and is there")
            elif told.get("added") in ("conflict", "failed"):
                check(told["chain"] not in log.added, f"{told['chain']} was refused, and was added")
            counts |= "counted" in told
            made += told.get("counted") == "made"
            unknown += told.get("counted") == "unknown"
        counted = count(model) if counts else made
        check(
            made <= counted <= made + unknown, f"{made} to {made + unknown} were counted, and {counted} are"
        )
        return model.version, document_hash(model)
    finally:
        store.close()


def _check_answer(store: Store, log: Log, told: dict[str, Any]) -> None:
    client, number, revision, chain = (told[name] for name in ("client", "number", "revision", "chain"))
    found = store.find_answer(client, number)
    what = f"edit {number} of {client} was acknowledged as revision {revision}"
    check(revision <= store.revision, f"{what}, and the store ends at {store.revision}")
    if found is None:  # it did nothing, and got the last revision then
        check(chain == store._chain_at(revision).hex(), f"{what}, with another chain")
        return
    check(found == (revision, bytes.fromhex(chain)), f"{what}, and is {found[0]}")
    commit = log.commits[revision - 1]
    check((commit.client, commit.number) == (client, number), f"{what}, which is another edit")


def check_replicas(server: Process, clients: Sequence[Process]) -> tuple[int, str]:
    """Check that the server, all clients and those who join now have the same; return revision and hash."""
    revision, digest = server.ask("state")
    wanted = {kind: _join(kind) for kind in KINDS}
    check(wanted["whole"] == digest, "one who joins gets another model than the server has")
    for client in clients:
        for kind, got in client.ask("state", revision):
            what = f"{client.what}: the replica of {kind!r} differs from what one who joins gets"
            check(wanted[kind] in ("", got), what)
    return revision, digest


def _join(kind: str) -> str:
    """Return the hash of what one gets who joins, empty if the frames of a part are not there."""
    try:
        model = load(kind)
    except UnknownNameError:
        return ""
    try:
        return document_hash(model)
    finally:
        model.close()


def make_store(path: Path) -> None:
    serve(build(), store=path, name=NAME).close()


# -- processes that are killed -------------------------------------------------------------------------------


def try_kills(rounds: int, seed: int, processes: int = 3) -> dict[str, int]:
    """Kill servers and clients at random moments under load; return what happened."""
    random = Random(seed)
    found: Counter[str] = Counter()
    while found["servers"] < rounds:
        with folder() as path, ExitStack() as running:
            store = path / "home.db"
            make_store(store)
            server = start(running, "served", store)
            clients = [_start_client(running, f"{seed}.{found['servers']}", k) for k in range(processes)]
            gone: list[Process] = []
            for number in range(min(ROUNDS_TOGETHER, rounds - found["servers"])):
                time.sleep(random.uniform(0, 0.8))
                if number % 2 == 0:
                    clients[0].kill()
                    gone.append(clients.pop(0))
                    clients.append(
                        _start_client(running, f"{seed}.{found['servers']}", processes + len(gone))
                    )
                server.kill()
                killed = time.monotonic()
                server = start(running, "served", store, ("late", "")[number % 2])
                wait_for_edits(*clients, all_of_them=False)
                found["longest ms"] = max(found["longest ms"], round(1e3 * (time.monotonic() - killed)))
                found["servers"] += 1
            wait_for_edits(*clients)
            check_presence(len(clients) * len(KINDS))
            found += stop(clients)
            end = check_replicas(server, clients)
            server.kill()
            check(
                check_store(store, [*clients, *gone], len(gone) * len(KINDS)) == end,
                "the store has another model",
            )
            found["clients"] += len(gone)
            found["revisions"] += end[0]
    return dict(found)


def _start_client(running: ExitStack, seed: str, number: int) -> Process:
    return start(running, "client", f"p{number}", seed, 0, *KINDS)


def has_edited(client: Process, since: int) -> bool:
    client.check()
    return any("number" in told for told in client.told[since:])


def check_presence(wanted: int) -> None:
    """Check that a server knows the clients that are there, and no others."""
    model = load("whole")
    try:
        late = time.monotonic() + SOON
        while len(clients := model.exchange.status().clients) != wanted + 1:
            known = [(one.who, one.view, one.revision) for one in clients]
            check(time.monotonic() < late, f"the server has {wanted} clients and this one, and knows {known}")
            time.sleep(0.05)
    finally:
        model.close()


# -- messages ------------------------------------------------------------------------------------------------


def try_messages(
    requests: int, publications: int, seed: int, senders: int = 2, most: float = HELD_UP
) -> dict[str, int]:
    """Send mutated messages to a server and its clients; return how they were answered."""
    found: Counter[str] = Counter()
    with folder() as path, ExitStack() as running:
        store = path / "home.db"
        make_store(store)
        server = start(running, "served", store)
        client = start(running, "client", "p", f"{seed}", -1, "whole")
        follower = start(running, "client", "q", f"{seed}", 1, *KINDS)
        follower.ask("stop")
        enemies = [begin(running, "messages", f"{seed}.{k}") for k in range(senders)]
        for enemy in enemies:
            enemy.wait_for_reply()
        for enemy in enemies:
            enemy.tell("ask", requests // senders)
        for enemy in enemies:
            for outcome, number in enemy.wait_for_reply(3600).items():
                found[outcome] = (
                    max(found[outcome], number) if outcome == "longest ms" else found[outcome] + number
                )
        ((_, longest),) = client.ask("stop")
        check(
            longest < most,
            f"while nonsense was sent, an edit of another client took {longest:.2f} s: "
            f"{[told for told in client.told if 'slow' in told]}",
        )
        found["longest of others ms"] = round(1e3 * longest)
        check_replicas(server, [client, follower])
        check_presence(1 + len(KINDS))
        busy = start(running, "client", "r", f"{seed}", -1, *KINDS)
        for enemy in enemies:
            enemy.tell("publish", publications // senders)
        for enemy in enemies:
            found.update({f"published {end}": number for end, number in enemy.wait_for_reply(3600).items()})
        busy.ask("stop")
        clients = [client, follower, busy]
        check_replicas(server, clients)
        server.close()
        check_store(store, clients)
    return dict(found)


# -- disks, files and names --------------------------------------------------------------------------


def try_full_disks(rounds: int, seed: int) -> dict[str, int]:
    """Let the disk be full under load: edits are refused, and made again when there is room."""
    random = Random(seed)
    with folder() as path, ExitStack() as running:
        store = path / "home.db"
        make_store(store)
        server = start(running, "served", store)
        client = _start_client(running, f"{seed}", 0)
        wait_for_edits(client)
        for _ in range(rounds):
            server.ask("room", random.uniform(0, 1.1))
            begin = len(client.told)
            wait_until(
                lambda begin=begin: "failed" in outcomes_of(client, begin), LONG, "an edit that is refused"
            )
            server.ask("any-room")
            wait_for_edits(client)
        found = Counter(outcomes_of(client, 0))
        client.ask("stop")
        end = check_replicas(server, [client])
        server.close()
        check(check_store(store, [client]) == end, "the store has another model")
    return dict(found)


def outcomes_of(client: Process, since: int) -> list[str]:
    client.check()
    names = ("added", "removed", "counted")
    return [told[name] for told in client.told[since:] for name in names if name in told]


def wait_for_edits(*clients: Process, all_of_them: bool = True) -> None:
    """Wait until the clients, or one of them, have got an edit made from now on."""
    since = [len(client.told) for client in clients]
    enough = all if all_of_them else any
    wait_until(lambda: enough(map(has_edited, clients, since)), LONG, f"an edit of {clients[0].what}")


def try_damages(count: int, seed: int) -> dict[str, int]:
    """Serve damaged stores: they are refused in one line, or at a revision that they were at."""
    random = Random(seed)
    found = Counter(opened=0, refused=0)
    with folder() as path:
        store = path / "home.db"
        images, hashes = [], dict[int, str]()
        with serve(build(), store=store, name=NAME) as server:
            model = load("whole")
            hashes[server.revision] = document_hash(server.snapshot())
            for number in range(60):
                with suppress(KineverseError), model.edit() as edit:
                    do_something(edit, random, f"{number}")
                hashes[server.revision] = document_hash(server.snapshot())
                if number % 10 == 0:
                    images.append((server.revision, take_image(store)))
            model.close()
        images += [(max(hashes), take_image(store))] * len(images)  # closed, so that all is in one file
        for number in range(count):
            how, image = damage(random, images)
            put_image(store, image)
            try:
                with serve(store=store) as server:
                    snapshot = server.snapshot()
                    right = snapshot.version == 0 or hashes.get(snapshot.version) == document_hash(snapshot)
                    check(right, f"damage {number} of seed {seed}, {how}: another model")
                found["opened"] += 1
            except FormatError as error:
                check("\n" not in str(error) and str(store) in str(error), f"{how}: {error}")
                found["refused"] += 1
        put_image(store, images[-1][1])
        with serve(store=store, name=NAME) as server:
            check(server.revision == images[-1][0], "the store is at another revision")
    return dict(found)


def stop(clients: Iterable[Process]) -> Counter[str]:
    """Let clients stop, after the edits that they have to make, and return how these ended."""
    found: Counter[str] = Counter()
    for client in clients:
        client.tell("stop")
    for client in clients:
        for outcomes, _ in client.wait_for_reply(3600):
            found.update(outcomes)
    return found


def try_twice() -> None:
    """Start a second server on a store, and one with a name that is taken: both are refused."""
    with folder() as path, ExitStack() as running:
        store, other = path / "home.db", path / "other.db"
        make_store(store)
        start(running, "served", store)
        for options, error in (
            ({"store": store, "name": "second"}, FormatError),
            ({"store": other, "name": NAME}, DuplicateNameError),
            ({"models": build(), "name": NAME}, DuplicateNameError),
        ):
            try:
                serve(**options).close()  # type: ignore[arg-type]
            except error as refusal:
                check("\n" not in str(refusal), str(refusal))
            else:
                raise AssertionError(f"{options} is served twice")
        check(_join("whole") != "", "the first server is there")


# -- many edits, and processes that stand still --------------------------------------------------------------


def try_edits(edits: int, clients: int, seed: int, how: str = "") -> dict[str, int]:
    """Make random edits in processes of two clients each; in the end all have the same model.

    ``jump``: the clock of the server jumps, and nothing but the times that it tells depends on it.
    """
    with folder() as path, ExitStack() as running:
        store = path / "home.db"
        make_store(store)
        server = start(running, "served", store, how)
        kinds = [("whole", "0"), ("whole", "1"), ("whole", "whole")]
        processes = [
            begin(running, "client", f"p{k}", seed, edits // clients, *kinds[k % len(kinds)])
            for k in range(clients // 2)
        ]
        for process in processes:
            process.wait_for_reply()
        found = stop(processes)
        check_presence(clients)
        end = check_replicas(server, processes)
        server.close()
        check(check_store(store, processes) == end, "the store has another model")
        found["revisions"] = end[0]
        return dict(found)


def try_freezing(seconds: float, seed: int, most: float = HELD_UP) -> dict[str, int]:
    """Let a client, which has slow hooks, and then the server stand still: others go on, and all catch up."""
    found: dict[str, int] = {}
    with folder() as path, ExitStack() as running:
        store = path / "home.db"
        make_store(store)
        server = start(running, "served", store)
        clients = [_start_client(running, f"{seed}", k) for k in range(2)]
        frozen, other = clients
        frozen.ask("hook", 0.3)
        wait_for_edits(*clients)
        frozen.freeze()
        time.sleep(seconds)
        ((_, longest), *_) = other.ask("longest")
        frozen.thaw()
        found["longest of others ms"] = round(1e3 * longest)
        check(longest < most, f"while a client stood still, an edit of another took {longest:.2f} s")
        wait_for_edits(*clients)
        server.freeze()
        begin_time = time.monotonic()
        wait_until(lambda: not other.ask("online"), LONG, "a client that notices a frozen server")
        found["noticed after ms"] = round(1e3 * (time.monotonic() - begin_time))
        check(min(other.ask("read")) > 0, "there is nothing to read")
        time.sleep(max(0.0, seconds - (time.monotonic() - begin_time)))
        server.thaw()
        wait_for_edits(*clients)
        found.update(stop(clients))
        end = check_replicas(server, clients)
        server.close()
        check(check_store(store, clients) == end, "the store has another model")
    return found


# -- the command ---------------------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--kills", type=int, default=200, help="how many killed servers (200)")
    parser.add_argument("--edits", type=int, default=24_000, help="how many random edits (24 000)")
    parser.add_argument(
        "--messages", type=int, default=1_000_000, help="how many mutated messages (1 000 000)"
    )
    parser.add_argument(
        "--rounds", type=int, default=50, help="how many full disks; damaged stores: ten times (50)"
    )
    parser.add_argument("--seed", type=int, default=1, help="of edits, damages and times (1)")


def run(given: argparse.Namespace) -> Iterator[str]:
    """Yield what was tried."""
    seed = given.seed
    if given.rounds:
        try_twice()
        yield "a second server of a store and one of a name: refused"
        yield f"{10 * given.rounds} damaged stores: {say(try_damages(10 * given.rounds, seed))}"
        yield f"{given.rounds} full disks: {say(try_full_disks(given.rounds, seed))}"
        yield f"a client and a server that stand still: {say(try_freezing(3.0, seed))}"
    if given.kills:
        yield f"{given.kills} killed servers: {say(try_kills(given.kills, seed))}"
    if given.edits:
        few = given.edits // 10
        yield f"{few} edits and a clock that jumps: {say(try_edits(few, 8, seed, 'jump'))}"
        yield f"{given.edits} edits by 8 clients: {say(try_edits(given.edits, 8, seed))}"
    if given.messages:
        found = try_messages(given.messages, given.messages // 50, seed)
        yield f"{given.messages} messages, and {given.messages // 50} to clients: {say(found)}"


def say(found: dict[str, int]) -> str:
    return ", ".join(f"{name} {number}" for name, number in sorted(found.items()))
