"""The store of a model server: what is committed is there, whatever becomes of the process, the file and the disk."""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from faults.store import Expected, put_image, take_image, try_damages, try_kills

from kineverse.errors import FormatError, InvalidValueError
from kineverse.exchange import protocol
from kineverse.exchange import store as stores
from kineverse.exchange.store import Store, StoredCommit, StoreError


@contextlib.contextmanager
def opened(path: Path | None) -> Iterator[Store]:
    store = Store(path)
    try:
        yield store
    finally:
        store.close()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "home.db"


@pytest.fixture
def filled(path: Path) -> Path:
    """Return the path of a closed store with 30 commits of the seed 1."""
    with opened(path) as store:
        store.name = "home"
        store.commit(Expected(1).up_to(30))
    return path


@pytest.mark.parametrize("in_memory", [False, True])
def test_a_store_has_what_was_committed(path: Path, in_memory: bool) -> None:
    expected = Expected(3)
    with opened(None if in_memory else path) as store:
        assert (store.revision, store.chain, store.operations()) == (0, protocol.NO_CHAIN, [])
        for end in (1, 2, 5, 60, 61):
            store.commit(expected.up_to(end)[store.revision :])
            assert store.revision == end
            assert expected.find_difference(store) == ""
        store.reload()
        assert expected.find_difference(store) == ""
    if not in_memory:
        assert os.listdir(path.parent) == ["home.db"]
        with opened(path) as store:
            assert store.revision == 61
            assert expected.find_difference(store) == ""


def test_a_gap_is_closed_from_a_chain_that_the_store_knows() -> None:
    log = Expected(1).up_to(30)
    with opened(None) as store:
        store.commit(log)
        assert store.commits_after(10, log[9].chain, 20) == [(one.commit, one.chain) for one in log[10:]]
        assert store.commits_after(30, store.chain, 0) == []
        for revision, chain, most in ((10, log[9].chain, 19), (10, log[8].chain, 99), (31, store.chain, 99)):
            assert store.commits_after(revision, chain, most) is None
        assert store.commits_after(-1, protocol.NO_CHAIN, 99) is None


def test_the_log_is_read_backwards() -> None:
    log = Expected(1).up_to(30)
    with opened(None) as store:
        store.commit(log)
        assert store.last_commits(5, 1 << 62) == [one.commit for one in log[:-6:-1]]
        assert store.last_commits(5, 3) == [log[1].commit, log[0].commit]
        assert store.find_answer(log[0].client, 31) is None
        with pytest.raises(InvalidValueError, match="There is no revision 31; the last one is 30"):
            store.commit_of(31)


def test_names_digests_and_places_of_files_are_kept(path: Path) -> None:
    one, sha256 = Expected(1).up_to(1)[0], "ab" * 32
    files = (protocol.MeshContent("cup", 0, sha256, 5),)
    with opened(path) as store:
        store.name = "home"
        store.commit([replace(one, put=[("cup", 0, b"blob")], removed=(), files=files)])
        store.add_path(sha256, "/meshes/cup.stl")
    with opened(path) as store:
        assert store.name == "home"
        assert store.operations()[0][2] == files
        assert store.paths() == {sha256: "/meshes/cup.stl"}
        store.name = "lab"
        assert store.name == "lab"


BAD = {
    "does not follow": lambda one: replace(one, chain=bytes(32)),
    "follow revision": lambda one: replace(one, revision=one.revision + 1),
    "not there": lambda one: replace(one, removed=["nothing"]),
    "its place": lambda one: replace(one, put=[("a", 7, b"a"), ("b", 7, b"b")]),
    "client and number": lambda one: replace(one, number=1),
}


@pytest.mark.parametrize("message", BAD)
def test_a_batch_is_stored_as_a_whole_or_not_at_all(path: Path, message: str) -> None:
    expected = Expected(1)
    *good, last = expected.up_to(33)[30:]
    with opened(path) as store:
        store.commit(expected.up_to(30))
        with pytest.raises((InvalidValueError, StoreError), match=message):
            store.commit([*good, BAD[message](last)])
        assert store.revision == 30
        assert expected.find_difference(store) == ""
        store.commit([*good, last])
    with opened(path) as store:
        assert store.revision == 33
        assert expected.find_difference(store) == ""


def test_a_commit_writes_what_it_touches(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cost of one commit is the same for 50 and for 5000 operations: of rows, and of bytes on the disk."""
    digests: list[object] = []
    digest = stores._digest
    monkeypatch.setattr(stores, "_digest", lambda *row: digests.append(row) or digest(*row))
    costs = []
    for size in (50, 5000):
        with opened(path) as store:
            new = [(f"op {i}", i << 20, bytes(500)) for i in range(len(store.operations()), size)]
            store.commit([make_commit(store, new)])
        with opened(path) as store:
            digests.clear()
            store.commit([make_commit(store, [("op 20", 20 << 20, bytes(400))])])
            costs.append((len(digests), Path(f"{path}-wal").stat().st_size))
    (rows, size), (rows_of_many, size_of_many) = costs
    assert rows == rows_of_many <= 5
    assert size_of_many <= size + 4 * 4120  # trees are a level deeper


def make_commit(store: Store, put: list[tuple[str, int, bytes]]) -> StoredCommit:
    revision, data = store.revision + 1, str(store.revision).encode()
    return StoredCommit(revision, protocol.chain(store.chain, data), "0" * 32, revision, data, put)


def test_threads_see_whole_batches(path: Path) -> None:
    expected, seen = Expected(1), []
    log = expected.up_to(60)
    done = threading.Event()
    with opened(path) as store:

        def read() -> None:
            while not done.is_set():
                seen.append(store.commits_after(0, protocol.NO_CHAIN, 99))

        thread = threading.Thread(target=read)
        thread.start()
        try:
            for i in range(0, 60, 3):
                store.commit(log[i : i + 3])
        finally:
            done.set()
            thread.join(10)
    assert all(len(commits) % 3 == 0 for commits in seen)


# -- files ---------------------------------------------------------------------------------------------------


def write_other_database(path: Path) -> None:
    db = sqlite3.connect(path)
    db.execute("CREATE TABLE t (x)")
    db.close()


def write_next_version(path: Path) -> None:
    Store(path).close()
    db = sqlite3.connect(path)
    db.execute("PRAGMA user_version = 2")
    db.close()


def write_only_the_newest_commits(path: Path) -> None:
    with opened(path) as store:
        store.commit(Expected(1).up_to(3))
        image = take_image(path)
    put_image(path, {"-wal": image["-wal"]})


FILES = {
    "is no store of a model server, or damaged": lambda path: path.write_bytes(b"a text " * 1000),
    "is no store of a model server.": write_other_database,
    "is a store of version 2; Kineverse .* reads version 1. Serve it with": write_next_version,
    "is empty. Restore": lambda path: path.touch(),
    "is no file": lambda path: path.mkdir(),
    "there is no folder": lambda path: path.parent.rmdir(),
    "is missing, but": write_only_the_newest_commits,
}


@pytest.mark.parametrize("message", FILES)
def test_a_file_that_is_no_store_is_refused_in_one_line(tmp_path: Path, message: str) -> None:
    path = tmp_path / "below" / "home.db"
    path.parent.mkdir()
    FILES[message](path)
    before = {file.name: file.is_file() and file.read_bytes() for file in path.parent.glob("*")}
    with pytest.raises(FormatError, match=message) as error:
        Store(path)
    assert "\n" not in str(error.value)
    assert {file.name: file.is_file() and file.read_bytes() for file in path.parent.glob("*")} == before


@pytest.mark.skipif(not hasattr(os, "setresuid"), reason="needs the rights of files of POSIX")
@pytest.mark.parametrize("protected", ["file", "folder"])
def test_a_file_that_may_not_be_written_is_refused(filled: Path, protected: str) -> None:
    folder = Path(
        tempfile.mkdtemp()
    )  # root has all rights, and nobody else has any to the folder of the test
    path = folder / "home.db"
    shutil.copy(filled, path)
    path.chmod(0o444 if protected == "file" else 0o666)
    folder.chmod(0o777 if protected == "file" else 0o555)
    user = os.getresuid()
    try:
        if os.geteuid() == 0:
            os.setresuid(65534, 65534, 0)
        with pytest.raises(StoreError, match="cannot be written: this user has no access to"):
            Store(path)
    finally:
        os.setresuid(*user)
        folder.chmod(0o700)
        shutil.rmtree(folder)


def test_a_backup_is_the_store_of_that_moment(path: Path, tmp_path: Path) -> None:
    expected, copy = Expected(1), tmp_path / "backup.db"
    with opened(path) as store:
        store.name = "home"
        store.commit(expected.up_to(20))
        store.backup(copy)
        store.commit(expected.up_to(25)[20:])
        with pytest.raises(StoreError, match="exists already"):
            store.backup(copy)
        with pytest.raises(StoreError, match="there is no folder"):
            store.backup(tmp_path / "nowhere" / "backup.db")
    with opened(copy) as store:
        assert (store.revision, store.name) == (20, "home")
        assert expected.find_difference(store) == ""
        store.commit(expected.up_to(21)[20:])
        assert expected.find_difference(store) == ""


# -- faults --------------------------------------------------------------------------------------------------


def test_a_damaged_store_is_refused_or_at_a_revision_that_was_committed(tmp_path: Path) -> None:
    """``make faults ARGS=store`` tries more."""
    outcomes = try_damages(60, 1, tmp_path)
    assert min(outcomes.values()) > 12


def test_the_search_for_faults_notices_a_store_that_checks_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stores, "_digest", lambda *row: 0)
    with pytest.raises(AssertionError, match="damage"):
        try_damages(100, 2, tmp_path)


def test_what_was_acknowledged_survives_a_kill(tmp_path: Path) -> None:
    """A process that commits is killed, again and again; while it runs, another one is refused."""
    revisions = try_kills(3, 1, tmp_path)
    assert revisions == sorted(revisions)
    assert revisions[-1] > 3


def test_a_full_disk_leaves_the_last_revision(path: Path) -> None:
    resource = pytest.importorskip("resource")
    expected, usual = Expected(5), resource.getrlimit(resource.RLIMIT_FSIZE)

    with opened(path) as store:
        for room in (0, 1, 500, 5000, 9000, 20_000):
            size = max(one.stat().st_size for one in path.parent.iterdir())
            resource.setrlimit(resource.RLIMIT_FSIZE, (size + room, usual[1]))
            try:
                with pytest.raises(StoreError, match=r"home\.db cannot be .*disk"):
                    while store.revision < 1000:
                        store.commit(expected.up_to(store.revision + 2)[-2:])
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, usual)
            assert expected.find_difference(store) == ""
            store.reload()
            assert expected.find_difference(store) == ""
            store.commit(expected.up_to(store.revision + 1)[-1:])
        revision, copy = store.revision, path.with_name("backup.db")
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, usual[1]))
        try:
            with pytest.raises(StoreError, match=r"backup\.db cannot be .*disk"):
                store.backup(copy)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, usual)
        assert sorted(os.listdir(path.parent)) == ["home.db", "home.db-wal"]
    with opened(path) as store:
        assert store.revision == revision
        assert expected.find_difference(store) == ""
