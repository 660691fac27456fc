"""Faults of stores: each store opens at a revision that was committed, or is refused and left as it is.

The commits are a function of a seed. So the contents of each revision are known without the store.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from random import Random

import msgspec

from kineverse.exchange import protocol
from kineverse.exchange.store import Replaced, Store, StoredCommit, StoreError

PAGE = 4096
GAP = 1 << 20
CLIENT = "0123456789abcdef" * 2
Files = tuple[protocol.MeshContent, ...]
Operations = dict[str, tuple[int, bytes, Files]]
"""Place, blob and files of each operation by its tag."""


# -- commits -------------------------------------------------------------------------------------------------


def make_commit(seed: int, revision: int, chain: bytes, operations: Operations) -> StoredCommit:
    """Return the commit of a revision, and bring the operations up to date."""
    random = Random(f"{seed} {revision}")
    tags = sorted(operations, key=lambda tag: operations[tag][0])
    removed = random.sample(tags, random.randint(0, 2)) if len(tags) > 20 else []
    again = random.sample(tags, random.randint(0, min(3, len(tags))))
    new = [f"op {revision} {i}" for i in range(random.randint(0, 3))]
    put, before = [], []
    last = max((place for place, *_ in operations.values()), default=0)
    for tag in [*removed, *(tag for tag in again if tag not in removed), *new]:
        place, blob, _ = operations.get(tag, (None, None, ()))
        at = tags.index(tag) if tag in operations else len(tags)
        before.append(Replaced(tag, blob, tags[at - 1] if at else "", place or 0))
        if tag in removed:
            del operations[tag]
            continue
        if place is None or random.random() < 0.1:  # new, or moved to the end
            place = last = last + GAP
        content = random.randbytes(random.choice((20, 900, 9000)))
        sha256 = random.randbytes(32).hex()
        files = (protocol.MeshContent(tag, 0, sha256, revision),) if random.random() < 0.3 else ()
        operations[tag] = place, msgspec.msgpack.encode((tag, content)), files
        put.append((tag, *operations[tag]))
    if random.random() < 0.05:  # all get new places
        order = sorted(operations, key=lambda tag: operations[tag][0])
        operations.update({tag: (i * GAP, *operations[tag][1:]) for i, tag in enumerate(order)})
        put = [(tag, *operations[tag]) for tag in order]
    data = msgspec.msgpack.encode((revision, removed, put))
    chain = protocol.chain(chain, data)
    rows, files = [one[:3] for one in put], [file for *_, some in put for file in some]
    return StoredCommit(revision, chain, CLIENT, revision, data, rows, removed, tuple(before), files)


def commits(
    seed: int, revision: int = 0, chain: bytes = protocol.NO_CHAIN, operations: Operations | None = None
) -> Iterator[tuple[StoredCommit, Operations]]:
    """Yield the commits after a revision, and the operations then."""
    now = dict(operations or {})
    while True:
        revision += 1
        commit = make_commit(seed, revision, chain, now)
        chain = commit.chain
        yield commit, now


def make_path(commit: StoredCommit) -> tuple[str, str]:
    """Return a digest and a path of a file, the same for equal commits."""
    return commit.chain.hex(), f"meshes/{commit.revision}.stl"


class Expected:
    """Contents of a store at each revision."""

    def __init__(self, seed: int) -> None:
        self._commits = commits(seed)
        self.log: list[StoredCommit] = []
        self._operations: list[list[tuple[int, bytes, Files]]] = [[]]

    def up_to(self, revision: int) -> Sequence[StoredCommit]:
        """Return the commits up to a revision."""
        while len(self.log) < revision:
            commit, operations = next(self._commits)
            self.log.append(commit)
            self._operations.append(sorted(operations.values(), key=lambda row: row[0]))
        return self.log[:revision]

    def find_difference(self, store: Store) -> str:
        """Return what a store has wrong for the revision that it says it has, else an empty text."""
        log = self.up_to(store.revision)
        if store.operations() != self._operations[store.revision]:
            return "operations"
        if store.chain != (log[-1].chain if log else protocol.NO_CHAIN):
            return "chain"
        if store.commits_after(0, protocol.NO_CHAIN, 10**9) != [(one.commit, one.chain) for one in log]:
            return "log"
        if not store.paths().items() <= {make_path(one) for one in log}:
            return "paths"
        for one in [*log[::10], *log[-10:]]:  # each takes two queries
            if store.commit_of(one.revision) != (one.commit, one.replaced):
                return "replaced"
            if store.find_answer(one.client, one.number) != (one.revision, one.chain):
                return "answers"
        return ""


# -- damages -------------------------------------------------------------------------------------------------

Image = dict[str, bytes]
"""Files of a store by their suffix: none, or ``-wal``."""


def take_image(path: Path) -> Image:
    """Return the files of a store as they are now, as a process leaves them that is killed."""
    files = {suffix: Path(f"{path}{suffix}") for suffix in ("", "-wal", "-shm", "-journal")}
    return {suffix: file.read_bytes() for suffix, file in files.items() if file.exists()}


def put_image(path: Path, image: Image) -> None:
    """Write the files of a store in place of those there."""
    for suffix in ("", "-wal", "-shm", "-journal"):
        Path(f"{path}{suffix}").unlink(missing_ok=True)
    for suffix, data in image.items():
        Path(f"{path}{suffix}").write_bytes(data)


def make_images(folder: Path, expected: Expected, count: int = 120) -> list[tuple[int, Image]]:
    """Return images of a store that is open, at several revisions, and of one that is closed at the end."""
    path = folder / "images.db"
    put_image(path, {})
    images = []
    store = Store(path)
    store._db.execute("PRAGMA wal_autocheckpoint = 100")  # as in a long run, but in small files
    for one in expected.up_to(count):
        store.commit([one])
        if one.revision % 20 == 0:
            store.add_path(*make_path(one))
        if one.revision % (count // 8) == 0:
            images.append((one.revision, take_image(path)))
    store.close()
    return [*images, (count, take_image(path))]


def flip(random: Random, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(random.choice((1, 1, 3))):
        changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
    return bytes(changed)


def cut_at_page(random: Random, data: bytes) -> bytes:
    return data[: PAGE * random.randrange(max(1, len(data) // PAGE))]


def cut_anywhere(random: Random, data: bytes) -> bytes:
    return data[: random.randrange(len(data))]


def zero_page(random: Random, data: bytes) -> bytes:
    at = PAGE * random.randrange(max(1, len(data) // PAGE))
    return data[:at] + bytes(min(PAGE, len(data) - at)) + data[at + PAGE :]


def overwrite(random: Random, data: bytes) -> bytes:
    at, count = random.randrange(len(data)), random.choice((4, 100, 5000))
    return data[:at] + random.randbytes(min(count, len(data) - at)) + data[at + count :]


def swap_pages(random: Random, data: bytes) -> bytes:
    pages = [data[at : at + PAGE] for at in range(0, len(data), PAGE)]
    a, b = random.randrange(len(pages)), random.randrange(len(pages))
    pages[a], pages[b] = pages[b], pages[a]
    return b"".join(pages)


def append(random: Random, data: bytes) -> bytes:
    return data + random.randbytes(random.choice((1, PAGE, 3 * PAGE)))


DAMAGES: tuple[Callable[[Random, bytes], bytes], ...] = (
    flip,
    flip,
    flip,
    cut_at_page,
    cut_anywhere,
    zero_page,
    overwrite,
    swap_pages,
    append,
)


def damage(random: Random, images: Sequence[tuple[int, Image]]) -> tuple[str, Image]:
    """Return a damaged image, and how it was damaged."""
    (first, image), (second, other) = random.choice(images), random.choice(images)
    kind = random.random()
    if kind < 0.1 and "-wal" in image:
        return f"{first} without -wal", {"": image[""]}
    if kind < 0.2 and "-wal" in other:
        return f"{first} with the -wal of {second}", {"": image[""], "-wal": other["-wal"]}
    if kind < 0.3:  # a checkpoint that did not end, or pages that were lost
        size = max(len(image[""]), len(other[""]))
        old, new = image[""].ljust(size, b"\0"), other[""].ljust(size, b"\0")
        mixed = b"".join(random.choice((old, new))[at : at + PAGE] for at in range(0, size, PAGE))
        return f"pages of {first} and {second}, -wal of {second}", other | {"": mixed}
    suffix = random.choice(sorted(suffix for suffix, data in image.items() if data))
    how = random.choice(DAMAGES)
    return f"{how.__name__} of {first}{suffix}", image | {suffix: how(random, image[suffix])}


def check_image(path: Path, image: Image, expected: Expected) -> tuple[str, str]:
    """Open a store of an image, and return how that ended and what is wrong, if anything."""
    put_image(path, image)
    try:
        store = Store(path)
    except Exception as error:
        if not isinstance(error, StoreError):
            return "failed", repr(error)
        kept = {suffix: data for suffix, data in take_image(path).items() if suffix != "-shm"}
        return "refused", "" if kept == image else f"the files were changed, although: {error}"
    try:
        wrong = expected.find_difference(store)
        if not wrong:  # it goes on from there
            store.commit([expected.up_to(store.revision + 1)[-1]])
            wrong = expected.find_difference(store)
    except Exception as error:
        wrong = repr(error)
    finally:
        store.close()
    return "opened", wrong


def try_damages(count: int, seed: int, folder: Path) -> dict[str, int]:
    """Damage stores and return how often they were opened and refused; raise for a violation."""
    expected = Expected(seed)
    images = make_images(folder, expected)
    outcomes = {"opened": 0, "refused": 0}
    for number in range(count):
        random = Random(f"{seed} {number}")
        how, image = damage(random, images)
        outcome, wrong = check_image(folder / "damaged.db", image, expected)
        if wrong:
            raise AssertionError(f"damage {number} of seed {seed}, {how}: {outcome}, {wrong}")
        outcomes[outcome] += 1
    return outcomes


# -- processes that are killed -------------------------------------------------------------------------------


def commit_for_ever(path: Path, seed: int, durable: bool) -> None:
    """Commit in batches, and write each revision to standard output when it is stored."""
    store = Store(path, durable=durable)
    operations = {msgspec.msgpack.decode(row[1])[0]: row for row in store.operations()}
    random, following = Random(), commits(seed, store.revision, store.chain, operations)
    sys.stdout.write(f"{store.revision}\n")
    sys.stdout.flush()
    while True:
        batch = [next(following)[0] for _ in range(random.choice((1, 1, 1, 5, 20)))]
        store.commit(batch)
        sys.stdout.write(f"{store.revision}\n")
        sys.stdout.flush()


def try_kills(rounds: int, seed: int, folder: Path) -> list[int]:
    """Kill processes that commit, and return the revisions then; raise for a commit that is not complete."""
    path, expected, random = folder / "killed.db", Expected(seed), Random(seed)
    revisions = []
    for number in range(rounds):
        with subprocess.Popen(
            [sys.executable, "-m", "faults.store", str(path), str(seed), ("durable", "fast")[number % 2]],
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        ) as process:
            assert process.stdout is not None
            first = process.stdout.readline()
            time.sleep(random.uniform(0, 0.2))
            try:
                Store(path).close()
            except StoreError as error:
                wrong = "" if "served by another process" in str(error) else str(error)
            else:
                wrong = "two processes have opened the store"
            process.kill()
            told = [first, *process.stdout.read().splitlines(keepends=True)]
        acknowledged = int([line for line in told if line.endswith(b"\n")][-1])
        store = Store(path)
        try:
            wrong = wrong or expected.find_difference(store)
            if store.revision < acknowledged:
                wrong = f"{acknowledged} was acknowledged, and the store is at {store.revision}"
        finally:
            store.close()
        if wrong:
            raise AssertionError(f"round {number} of seed {seed}: {wrong}")
        revisions.append(acknowledged)
    return revisions


# -- the command ---------------------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--damages", type=int, default=10_000, help="how many damaged files (10 000)")
    parser.add_argument("--kills", type=int, default=100, help="how many killed processes (100)")
    parser.add_argument("--seed", type=int, default=1, help="of commits, damages and times (1)")


def run(given: argparse.Namespace) -> Iterator[str]:
    """Yield what was tried."""
    folder = Path(tempfile.mkdtemp(prefix="kineverse-faults-"))
    try:
        outcomes = try_damages(given.damages, given.seed, folder)
        yield f"{given.damages} damages: {outcomes['opened']} opened, {outcomes['refused']} refused"
        revisions = try_kills(given.kills, given.seed, folder)
        yield f"{given.kills} processes killed, at revisions up to {max(revisions, default=0)}"
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    commit_for_ever(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3] == "durable")
