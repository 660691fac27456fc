"""Store of a model server: one SQLite file with the operations of a model and the log of its commits.

A commit writes what it touches: the rows of its operations, one row of the log, and the only row of ``meta``.
That row has the sum of the digests of all rows, its own included. So a file that is damaged, truncated or
mixed from two states is refused when it is opened, and left as it is. The paths of meshes are kept beside.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import msgspec

from kineverse._version import __version__
from kineverse.errors import FormatError, InvalidValueError

from . import protocol

VERSION: Final = 1
_APPLICATION: Final = 0x4B764D53
_SCHEMA: Final = (
    "CREATE TABLE meta (name TEXT NOT NULL, revision INTEGER NOT NULL, chain BLOB NOT NULL,"
    " total BLOB NOT NULL)",
    "CREATE TABLE operations (place INTEGER PRIMARY KEY, tag TEXT NOT NULL, blob BLOB NOT NULL,"
    " files BLOB NOT NULL)",
    "CREATE TABLE log (revision INTEGER PRIMARY KEY, chain BLOB NOT NULL, client TEXT NOT NULL,"
    " number INTEGER NOT NULL, data BLOB NOT NULL, replaced BLOB NOT NULL)",
    "CREATE TABLE paths (sha256 TEXT PRIMARY KEY, path TEXT NOT NULL)",
    "CREATE UNIQUE INDEX answers ON log (client, number)",
)
_MODULUS: Final = 1 << 256
_ENCODE: Final = msgspec.msgpack.Encoder().encode


class StoreError(FormatError):
    """A store cannot be opened, read or written; it still contains its last revision."""


class Replaced(msgspec.Struct, frozen=True, array_like=True):
    """Operation as it was before a commit that put or removed it; without a blob it was not there.

    ``after`` is the tag of the operation before it, empty at the beginning.
    """

    tag: str
    blob: bytes | None
    after: str
    place: int


_NO_FILES: Final = _ENCODE(())
_decode_files = msgspec.msgpack.Decoder(tuple[protocol.MeshContent, ...]).decode
_decode_replaced = msgspec.msgpack.Decoder(tuple[Replaced, ...]).decode


@dataclass(frozen=True, slots=True)
class StoredCommit:
    """Commit to be stored: its message, its rows, and what its edit replaced.

    ``put`` has tags, places and blobs, and ``files`` the digests of their meshes. A commit that gives all
    operations new places puts all of them.
    """

    revision: int
    chain: bytes
    client: str
    number: int
    commit: bytes
    put: Sequence[tuple[str, int, bytes]] = ()
    removed: Sequence[str] = ()
    replaced: tuple[Replaced, ...] = ()
    files: Sequence[protocol.MeshContent] = ()


class Store:
    """Operations, log and answers of a model server, in a file or in memory; threads may share it.

    An error of the disk leaves the last revision, and :meth:`reload` checks it. Only one process has a file
    open. If the power fails, a ``durable`` store keeps all commits, and another one may lose the last ones.
    """

    def __init__(self, path: Path | None, *, durable: bool = False) -> None:
        self.path, self.is_durable = path, durable
        self._path = "The store" if path is None else os.path.realpath(path)
        self._lock = threading.RLock()
        is_there = path is not None and _check_path(Path(self._path))
        if is_there and os.path.exists(f"{self._path}-wal"):
            _check_unclosed(self._path)
        with _reporting(self._path):
            self._db = _connect(":memory:" if path is None else self._path)
        try:
            with _reporting(self._path):
                self._db.execute("PRAGMA locking_mode = EXCLUSIVE")
                if not is_there:
                    _create(self._db)
                self._contents = _load(self._db, self._path)
                self._db.execute("PRAGMA journal_mode = WAL")
                self._db.execute(f"PRAGMA synchronous = {'FULL' if durable else 'NORMAL'}")
                self._db.execute("BEGIN IMMEDIATE")  # an error if the file cannot be written
                self._db.execute("ROLLBACK")
            if path is not None:
                Path(f"{self._path}-shm").unlink(missing_ok=True)  # of readers; nobody else has the file open
        except BaseException:
            self._db.close()
            raise

    @property
    def name(self) -> str:
        """The name of the model, empty if it has none yet."""
        return self._contents.name

    @name.setter
    def name(self, name: str) -> None:
        with self._lock:
            old = self._contents
            if old.name == name:
                return
            new = replace(old, name=name)
            with self._transaction():
                self._write_meta(new)
            self._contents = new

    @property
    def revision(self) -> int:
        """The revision of the last commit, 0 for an empty model."""
        return self._contents.revision

    @property
    def chain(self) -> bytes:
        """The digest of all commits."""
        return self._contents.chain

    def operations(self) -> list[tuple[int, bytes, tuple[protocol.MeshContent, ...]]]:
        """Return the places, blobs and files of all operations, in order."""
        rows = self._rows("SELECT place, blob, files FROM operations ORDER BY place")
        return [(place, blob, _decode_files(files)) for place, blob, files in rows]

    def paths(self) -> dict[str, str]:
        """Return the paths of files by SHA-256; what is there now may be something else."""
        return dict(self._rows("SELECT sha256, path FROM paths"))

    def add_path(self, sha256: str, path: str) -> None:
        """Note where a file is; it is no part of the model."""
        row = sha256, path
        with self._lock:
            new = replace(self._contents)
            with self._transaction():
                old = self._db.execute(
                    "SELECT sha256, path FROM paths WHERE sha256 = ?", (sha256,)
                ).fetchall()
                new.total += _digest(*row) - sum(_digest(*one) for one in old)
                self._db.execute("INSERT OR REPLACE INTO paths VALUES (?, ?)", row)
                self._write_meta(new)
            self._contents = new

    def commit(self, batch: Sequence[StoredCommit]) -> None:
        """Store commits in one transaction.

        After an error, nothing of them is stored.
        """
        if not batch:
            return
        with self._lock:
            new = replace(self._contents, rows={})
            with self._transaction():
                for commit in batch:
                    self._write_commit(new, commit)
                self._write_meta(new)
            rows = self._contents.rows
            for tag, row in new.rows.items():
                if row is None:
                    rows.pop(tag, None)
                else:
                    rows[tag] = row
            self._contents = replace(new, rows=rows)

    def find_answer(self, client: str, number: int) -> tuple[int, bytes] | None:
        """Return the revision and the chain of an edit, None if no commit was made of it."""
        found = self._rows("SELECT revision, chain FROM log WHERE client = ? AND number = ?", client, number)
        return found[0] if found else None

    def last_number(self, client: str) -> int:
        """Return the highest number of a client's edits of which commits were made, -1 without any."""
        return int(self._rows("SELECT coalesce(max(number), -1) FROM log WHERE client = ?", client)[0][0])

    def commits_after(self, revision: int, chain: bytes, most: int) -> list[tuple[bytes, bytes]] | None:
        """Return the commits after a revision, each with its chain.

        None if the chain is not the one of that revision here, or if there are more than ``most``.
        """
        with self._lock:
            if not 0 <= revision <= self.revision <= revision + most or self._chain_at(revision) != chain:
                return None
            return self._rows("SELECT data, chain FROM log WHERE revision > ? ORDER BY revision", revision)

    def commit_of(self, revision: int) -> tuple[bytes, tuple[Replaced, ...]]:
        """Return the commit of a revision, and what its edit replaced."""
        found = self._rows("SELECT data, replaced FROM log WHERE revision = ?", revision)
        if not found:
            raise InvalidValueError(f"There is no revision {revision}; the last one is {self.revision}.")
        return found[0][0], _decode_replaced(found[0][1])

    def last_commits(self, most: int, before: int) -> list[bytes]:
        """Return the last commits of revisions less than ``before``, the newest first."""
        query = "SELECT data FROM log WHERE revision < ? ORDER BY revision DESC LIMIT ?"
        return [data for (data,) in self._rows(query, before, most)]

    def reload(self) -> None:
        """Read and check the file again, after an error."""
        with self._lock:
            self._contents = _load(self._db, self._path)

    def backup(self, path: Path) -> None:
        """Write a copy of the store into a new file; after an error there is none."""
        if _check_path(path):
            raise StoreError(f"{path} exists already. Name a new file for the backup.")
        try:
            with self._lock, _reporting(str(path)):
                self._db.execute("VACUUM INTO ?", (str(path),))
        except StoreError:
            path.unlink(missing_ok=True)
            raise

    def close(self) -> None:
        """Close the file."""
        with self._lock, _reporting(self._path):
            self._db.close()

    def _rows(self, query: str, *values: object) -> list[Any]:
        with self._lock, _reporting(self._path):
            return self._db.execute(query, values).fetchall()

    def _chain_at(self, revision: int) -> bytes:
        if revision == 0:
            return protocol.NO_CHAIN
        ((chain,),) = self._rows("SELECT chain FROM log WHERE revision = ?", revision)
        return bytes(chain)

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        with _reporting(self._path):
            try:
                self._db.execute("BEGIN IMMEDIATE")
                yield
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.rollback()
                raise

    def _write_commit(self, new: _Contents, one: StoredCommit) -> None:
        if (one.revision, one.chain) != (new.revision + 1, protocol.chain(new.chain, one.commit)):
            raise InvalidValueError(f"The commit {one.revision} does not follow revision {new.revision}.")
        files = _files_by_tag(one)
        for tag in {*one.removed, *(tag for tag, *_ in one.put if self._find(new, tag))}:
            known = self._find(new, tag)
            if known is None:
                raise InvalidValueError(f"The commit {one.revision} removes {tag!r}, which is not there.")
            self._db.execute("DELETE FROM operations WHERE place = ?", (known[0],))
            new.total -= known[1]
            new.rows[tag] = None
        for tag, place, blob in one.put:
            row = place, tag, blob, files.get(tag, _NO_FILES)
            self._db.execute("INSERT INTO operations VALUES (?, ?, ?, ?)", row)
            digest = _digest(*row)
            new.total += digest
            new.rows[tag] = place, digest
        logged = (one.revision, one.chain, one.client, one.number, one.commit, _ENCODE(one.replaced))
        self._db.execute("INSERT INTO log VALUES (?, ?, ?, ?, ?, ?)", logged)
        new.total += _digest(*logged)
        new.revision, new.chain = one.revision, one.chain

    def _find(self, new: _Contents, tag: str) -> tuple[int, int] | None:
        return new.rows[tag] if tag in new.rows else self._contents.rows.get(tag)

    def _write_meta(self, new: _Contents) -> None:
        """Write the row of new contents, whose total still has the digest of the old one."""
        old = self._contents
        new.total += _digest(new.name, new.revision, new.chain) - _digest(old.name, old.revision, old.chain)
        row = (new.name, new.revision, new.chain, _encode_total(new.total))
        self._db.execute("UPDATE meta SET name = ?, revision = ?, chain = ?, total = ?", row)


@dataclass(slots=True)
class _Contents:
    """Row of ``meta``, and the place and digest of each operation by its tag; None if it was removed."""

    name: str
    revision: int
    chain: bytes
    total: int
    rows: dict[str, tuple[int, int] | None]


def _files_by_tag(commit: StoredCommit) -> dict[str, bytes]:
    found: dict[str, list[protocol.MeshContent]] = {}
    for file in commit.files:
        found.setdefault(file.tag, []).append(file)
    return {tag: _ENCODE(files) for tag, files in found.items()}


def _digest(*row: object) -> int:
    """Return the digest of a row; the types of its values count."""
    return int.from_bytes(hashlib.sha256(_ENCODE(row)).digest())


def _encode_total(total: int) -> bytes:
    return (total % _MODULUS).to_bytes(32)


def _connect(address: str, **options: Any) -> sqlite3.Connection:
    db: sqlite3.Connection = sqlite3.connect(
        address, timeout=0, isolation_level=None, check_same_thread=False, **options
    )
    return db


def _check_path(path: Path) -> bool:
    """Return True if there is a file at a path, False if one can be made there."""
    try:
        size = path.stat().st_size if path.exists() else None
    except (OSError, ValueError) as error:
        raise StoreError(f"{path} cannot be opened: {getattr(error, 'strerror', error)}.") from None
    if not path.parent.is_dir():
        raise StoreError(f"{path} cannot be opened: there is no folder {path.parent}. Make it first.")
    if size is not None and not path.is_file():
        raise StoreError(f"{path} is no file. Name a file for the store.")
    for place in (path.parent, path):
        if place.exists() and not os.access(place, os.R_OK | os.W_OK):
            raise StoreError(f"{path} cannot be written: this user has no access to {place}.")
    if size == 0:
        raise StoreError(f"{path} is empty. Restore a backup of it, or remove it to start a new store.")
    if size is None and os.path.lexists(f"{path}-wal"):  # SQLite would remove it
        raise StoreError(
            f"{path} is missing, but {path}-wal is there, which has its newest commits. Restore the former, "
            "or remove the latter to start a new store."
        )
    return size is not None


def _check_unclosed(path: str) -> None:
    """Check a store whose server was killed, without a change.

    To close a file that may be written merges its log of writes (``-wal``) into it, a damaged one as well.
    """
    with _reporting(path):
        reader = _connect(f"{Path(path).as_uri()}?mode=ro", uri=True)
    try:
        _load(reader, path)
    finally:
        reader.close()


def _create(db: sqlite3.Connection) -> None:
    """Write an empty store into an empty file, in one transaction."""
    if db.execute("SELECT count(*) FROM sqlite_master").fetchone() != (0,):
        return
    db.execute("BEGIN IMMEDIATE")
    for statement in _SCHEMA:
        db.execute(statement)
    meta = ("", 0, protocol.NO_CHAIN)
    db.execute("INSERT INTO meta VALUES (?, ?, ?, ?)", (*meta, _encode_total(_digest(*meta))))
    db.execute(f"PRAGMA application_id = {_APPLICATION}")
    db.execute(f"PRAGMA user_version = {VERSION}")
    db.execute("COMMIT")


def _load(db: sqlite3.Connection, path: str) -> _Contents:
    with _reporting(path):
        try:
            return _read(db, path)
        except (TypeError, OverflowError, MemoryError) as error:  # damaged types and sizes of values
            raise _damaged(path, str(error)) from error


def _read(db: sqlite3.Connection, path: str) -> _Contents:
    (application,), (version,) = (
        db.execute(f"PRAGMA {name}").fetchone() for name in ("application_id", "user_version")
    )
    if application != _APPLICATION:
        raise StoreError(f"{path} is no store of a model server.")
    if version != VERSION:
        raise StoreError(
            f"{path} is a store of version {version}; Kineverse {__version__} reads version {VERSION}. "
            "Serve it with the Kineverse that wrote it, and dump the model to a document."
        )
    schema = tuple(
        sql for (sql,) in db.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL ORDER BY rowid")
    )
    if schema != _SCHEMA:
        raise _damaged(path, "other tables")
    fault = db.execute("PRAGMA integrity_check(1)").fetchone()[0]
    if fault != "ok":
        raise _damaged(path, fault.splitlines()[-1])
    found = db.execute("SELECT name, revision, chain, total FROM meta").fetchall()
    if len(found) != 1:
        raise _damaged(path, "no revision")
    name, revision, chain, stored = found[0]
    total, last, link = _digest(name, revision, chain), 0, protocol.NO_CHAIN
    for row in db.execute(
        "SELECT revision, chain, client, number, data, replaced FROM log ORDER BY revision"
    ):
        last, link = last + 1, protocol.chain(link, row[4])
        if row[:2] != (last, link):
            raise _damaged(path, f"commit {last} is not the one that was written")
        total += _digest(*row)
    if (last, link) != (revision, chain):
        raise _damaged(path, f"it is at revision {revision}, but the log ends at {last}")
    rows: dict[str, tuple[int, int] | None] = {}
    for place, tag, *rest in db.execute("SELECT place, tag, blob, files FROM operations"):
        digest = _digest(place, tag, *rest)
        rows[tag] = place, digest
        total += digest
    total += sum(_digest(*row) for row in db.execute("SELECT sha256, path FROM paths"))
    if _encode_total(total) != stored:
        raise _damaged(path, "the contents are not those that were written")
    return _Contents(name, revision, chain, total, rows)


def _damaged(path: str, what: str) -> StoreError:
    return StoreError(f"{path} is damaged: {what}. Restore a backup of it.")


_REASONS = {
    sqlite3.SQLITE_BUSY: "{path} is served by another process. Connect to that one, or name another file.",
    sqlite3.SQLITE_NOTADB: "{path} is no store of a model server, or damaged.",
    sqlite3.SQLITE_CONSTRAINT: "{path} has a row of the commit already: its place, or its client and number.",
    sqlite3.SQLITE_FULL: "{path} cannot be written: the disk is full.",
    sqlite3.SQLITE_READONLY: "{path} cannot be written: this user may only read it.",
    sqlite3.SQLITE_CANTOPEN: "{path} cannot be opened: the file or its folder is not open to this user.",
    sqlite3.SQLITE_IOERR: "{path} cannot be read or written: the disk refuses it, or is full.",
}


@contextlib.contextmanager
def _reporting(path: str) -> Iterator[None]:
    """Raise errors of SQLite as errors of the store."""
    try:
        yield
    except sqlite3.ProgrammingError as error:
        raise StoreError(f"{path} is closed.") from error
    except sqlite3.Error as error:
        # Errors of values that are no text have no code.
        code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF
        if code in _REASONS:
            raise StoreError(_REASONS[code].format(path=path)) from error
        raise _damaged(path, str(error)) from error
