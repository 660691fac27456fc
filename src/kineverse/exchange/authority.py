"""The model of a server: checks edits, makes them, and stores them before they are answered.

Nothing that a client sends is trusted. Blobs are decoded anew, and the model is their fold: traces are run
and compared with the writes, and operations that read what changes are run again here. There is no network
and no thread in it. The reader of documents bounds the size of an edit; nothing bounds the time it takes.
"""

from __future__ import annotations

import logging
import secrets
import time
from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import repeat
from operator import attrgetter
from time import perf_counter
from typing import Any, Final, NamedTuple, TypeAlias

from kineverse._runtime import no_collection
from kineverse.errors import EditError, FormatError, KineverseError, suggest
from kineverse.formats import entry_to_bytes, operation_from_bytes
from kineverse.formats.document import OpaqueOperation
from kineverse.model import Diff, Edit, Model, NetChanges, PlacedEntry
from kineverse.model.history import History, HistoryEntry
from kineverse.model.operation import Cell
from kineverse.model.read_recorder import ABSENT, Read, Reads, differs

from . import protocol
from .conflicts import KEPT, RefusedError, Revisions
from .meshes import ServedFiles, put_contents
from .protocol import CommitMessage, Committed, Published, Refused
from .rights import EVERYTHING, Right, check_right, find_forbidden
from .store import Replaced, Store, StoredCommit
from .views import LOAD_THE_WHOLE, is_partial

_LOG = logging.getLogger(__name__)

ANSWERS: Final = 10_000
"""Number of answers that are kept in memory, to answer an edit that is asked twice alike."""
_LONGEST_TAG: Final = 4096

EditAnswer: TypeAlias = Committed | Refused


class MadeCommit(NamedTuple):
    """Commit of the model: its message, as it is published, and its diff."""

    message: CommitMessage
    published: Published
    diff: Diff


@dataclass(slots=True)
class Result:
    """Outcome of a request: the answer, and the commit if one was made.

    ``seconds`` has the times of the stages decode, check, fold, encode and, of the whole batch, persist [s].
    """

    answer: EditAnswer
    commit: MadeCommit | None = None
    seconds: dict[str, float] = field(default_factory=dict)


class Authority:
    """Model of a server with its store. One thread uses it.

    The version of ``model`` is the revision, and ``files`` are those of its meshes. ``epoch`` identifies this
    run; after an error of the store there is another one, and another model. A store with operations that are
    no model is a FormatError.
    """

    def __init__(self, store: Store) -> None:
        self._store, self.files = store, ServedFiles(store)
        self._answers: OrderedDict[tuple[str, int], EditAnswer] = OrderedDict()
        self._numbers: dict[str, int] = {}  # highest number by client
        self._batch: list[StoredCommit] = []
        self._load()

    def _load(self) -> None:
        with no_collection():
            stored = self._store.operations()
            entries = [operation_from_bytes(blob).at(place) for place, blob, _ in stored]
            put_contents(entries, (file for *_, files in stored for file in files))
            self.model = Model(entries, self._store.revision)
        self.model.history.commits.clear()
        self.chain = self._store.chain
        self.epoch = secrets.token_hex(16)
        self._start = self.revision
        self._revisions = Revisions(self.revision, self.chain)
        self._diffs: list[Diff] = []
        self.model.listen(self._diffs.append)
        self._is_lost = False

    @property
    def revision(self) -> int:
        """The revision of the last commit, 0 for an empty model."""
        return self.model.version

    def knows(self, revision: int, chain: bytes) -> bool:
        """Return whether the model has been at a revision with this chain, in this run and not long ago."""
        return self._revisions.chain_at(revision) == chain

    def fill(self, build: Callable[[Edit], None], who: str) -> None:
        """Make the first commit of an empty store, by an edit of an empty model; ``who`` is its author.

        A store that is not empty and an edit that is refused are an EditError, content that has no place in a
        document and an error of the store a FormatError. Errors of the edit pass.
        """
        if self.revision:
            raise EditError(f"The store is at revision {self.revision}; only an empty one is filled.")
        source = Model()
        with source.edit() as edit:
            build(edit)
        entries = source.history.sequence
        net = NetChanges(tuple(PlacedEntry(entry, None, at_end=True) for entry in entries))
        changes, files = protocol.encode_changes(net, entries), self.files.measure(entries)
        request = protocol.EditRequest("0" * 32, 0, who, 0, self.chain, changes, files=files)
        (result,) = self.process([request])
        if isinstance(result.answer, Refused):
            kind = FormatError if result.answer.reason in ("failed", "malformed") else EditError
            raise kind(result.answer.message)
        # Nobody has an earlier state.
        self._start, self._revisions = self.revision, Revisions(self.revision, self.chain)

    # -- requests ------------------------------------------------------------------------------------------

    def process(
        self, requests: Sequence[protocol.ChangeRequest], rights: Iterable[Right] = repeat(EVERYTHING)
    ) -> list[Result]:
        """Make edits, store their commits in one transaction, and return the results in order.

        Each has the right of its user. An edit is made whole or not at all, and others are made if one is
        refused. If the store fails, all of them are refused, and the model is what the store has, under a new
        epoch.
        """
        new: list[tuple[str, int]] = []
        results = []
        try:
            if self._is_lost:
                self._recover()
            for request, right in zip(requests, rights, strict=False):
                key = request.client, request.number
                answer = self._find_answer(key)
                if answer is not None:
                    results.append(Result(answer))
                    continue
                if isinstance(request, protocol.UndoRequest):
                    self._persist()  # it may need all commits of the store
                results.append(self._answer(request, right))
                self._answers[key] = results[-1].answer
                if len(self._answers) > ANSWERS:
                    self._answers.popitem(last=False)
                new.append(key)
            begin = perf_counter()
            self._persist()
            seconds = perf_counter() - begin
        except Exception as error:
            if not isinstance(error, KineverseError | OSError):
                _LOG.exception("Edits were taken back.")
            for key in new:
                self._answers.pop(key, None)
            self._is_lost = True
            refused = RefusedError("failed", f"The server has failed, and nothing was done. {error}").answer
            try:
                self._recover()
                return [Result(self._find_answer((one.client, one.number)) or refused) for one in requests]
            except (KineverseError, OSError):  # it is tried again before the next edit
                return [Result(refused) for _ in requests]
        for result in results:
            if result.commit is not None:
                result.seconds["persist"] = seconds
        return results

    def _recover(self) -> None:
        """Go back to what the store has, under a new epoch."""
        self._batch.clear()
        self._store.reload()
        self._load()

    def _persist(self) -> None:
        if self._batch:
            self._store.commit(self._batch)
            self._batch.clear()

    def _find_answer(self, key: tuple[str, int]) -> EditAnswer | None:
        known = self._answers.get(key)
        if known is not None:
            return known
        client, number = key
        last = self._numbers[client] if client in self._numbers else self._store.last_number(client)
        self._numbers[client] = max(last, number)
        if number > last:
            return None
        stored = self._store.find_answer(*key)
        return None if stored is None else Committed(*stored)

    def _answer(self, request: protocol.ChangeRequest, right: Right) -> Result:
        revision = self.revision
        self._seconds = dict[str, float]()
        try:
            with no_collection():
                if isinstance(request, protocol.UndoRequest):
                    commit = self._undo(request, right)
                else:
                    commit = self._make(request, right)
        except Exception as error:
            if self.revision > revision:  # what was made is not stored
                raise
            return Result(_as_answer(error, request.who), seconds=self._seconds)
        return Result(Committed(self.revision, self.chain), commit, self._seconds)

    def _make(self, request: protocol.EditRequest, right: Right) -> MadeCommit | None:
        begin = perf_counter()
        self._check_base(request)
        changes, history = request.changes, self.model.history
        put = _decode(request)
        # What the client has run again on the present model is taken, so that loops are not closed once more.
        # What it has run again on an older one, or without a right to edit it, is run here.
        is_newest = request.base == self.revision
        taken = _choose_reruns(put, changes, history, right) if is_newest else set[str]()
        dropped = {placed.entry.tag for placed in put}.intersection(changes.rerun) - taken
        put = tuple(placed for placed in put if placed.entry.tag not in dropped)
        rerun = tuple(tag for tag in changes.rerun if tag not in dropped)
        net = NetChanges(put, changes.replaced, rerun, changes.moved, changes.removed)
        self._seconds["decode"] = perf_counter() - begin
        begin = perf_counter()
        own = _find_own(net)
        check_right(right, (*map(history.entries.get, own), *(placed.entry for placed in put)))
        if not is_newest:
            entries = [placed.entry for placed in put]
            self._revisions.check(request.base, entries, changes.moved, changes.removed, history)
        self._check_tags(net, request.base)
        self._seconds["check"] = perf_counter() - begin
        return self._fold(request, right, lambda edit: self._adopt(edit, net), own)

    def _check_base(self, request: protocol.EditRequest) -> None:
        base, now = request.base, self.revision
        if request.strict and base < now:
            who = self._revisions.who_made(now)
            message = f"Revision {now}, by {who}, has changed the model meanwhile. Try again."
            raise RefusedError("conflict", message, revision=now, who=who)
        if base < self._start and self._store.commits_after(base, request.chain, KEPT) is not None:
            message = f"The server was started again after revision {base}. Try again at revision {now}."
            raise RefusedError("conflict", message, revision=now)
        if self._revisions.chain_at(base) != request.chain:
            message = f"Revision {base} is not known to the server, which is at revision {now}. Join again."
            raise RefusedError("stale", message)

    def _check_tags(self, changes: NetChanges, base: int) -> None:
        """Check that the operations are there that an edit replaces, removes, or puts others after."""
        entries = self.model.history.entries
        gone, put = {*changes.removed, *changes.moved}, set[str]()
        for tag in (*changes.removed, *changes.replaced):
            if tag not in entries:
                raise self._missing_error(tag, tag, base)
        for placed in changes.put:
            tag, after = placed.entry.tag, placed.after
            is_placed = tag not in entries or tag in gone
            if is_placed and not placed.at_end and after is not None and after not in put:
                if after not in entries or after in gone:
                    raise self._missing_error(tag, after, base)
                if self._revisions.last("moved", after) > base:
                    raise self._revisions.conflict_about(tag, after, "has moved")
            put.add(tag)

    def _missing_error(self, tag: str, missing: str, base: int) -> RefusedError:
        if self._revisions.last("changed", missing) > base:
            return self._revisions.conflict_about(tag, missing, "has removed")
        message = f"There is no operation {missing!r}. {suggest(missing, self.model.history.entries, 'tag')}"
        return RefusedError("refused", message, tag)

    # -- the fold ------------------------------------------------------------------------------------------

    def _adopt(self, edit: Edit, changes: NetChanges) -> None:
        """Put the entries of an edit, and run those that compute with values that they read.

        They are run when all before them have their new values. A trace that leads to other values than the
        writes counts, and what an operation without one finds then is what it has read.
        """
        history = self.model.history
        edit.adopt(replace(changes, put=tuple(_unlinked(placed) for placed in changes.put)))
        run = [placed.entry for placed in changes.put if _computes(placed.entry)]
        for entry in run:
            history.mark_outdated(entry.tag)
        history.settle()
        for given in run:
            now = history.entries[given.tag]
            is_equal = now.reads.cells == given.reads.cells and now.reads.listings == given.reads.listings
            if is_equal and now.writes is given.writes:
                now.blob = given.blob

    def _fold(
        self,
        request: protocol.ChangeRequest,
        right: Right,
        act: Callable[[Edit], None],
        own: Iterable[str],
    ) -> MadeCommit | None:
        """Make an edit, and a commit of it to be stored and published; None if it does nothing.

        ``own`` is what it puts or removes itself.
        """
        history = self.model.history
        begin = perf_counter()
        sequence = history.sequence
        replaced = tuple(self._find_replaced(tag) for tag in own)
        with self.model.edit() as edit:
            act(edit)
            net = edit.net()
            self._check_done(right)
            self._seconds["fold"] = perf_counter() - begin
            if net.is_empty:
                return None
            begin = perf_counter()
            entries = [placed.entry for placed in net.put]
            commit = CommitMessage(
                revision=self.revision + 1,
                previous=self.revision,
                client=request.client,
                number=request.number,
                who=request.who,
                time=time.time(),
                changes=protocol.encode_changes(net, history.sequence),
                files=self.files.find(entries),
            )
            data = protocol.encode(commit)
            if len(data) > protocol.MAX_BYTES or len(entries) > protocol.MAX_OPERATIONS:
                raise EditError(
                    f"The edit leads to a commit of {len(entries)} operations in {len(data)} bytes; the most "
                    f"is {protocol.MAX_OPERATIONS} in {protocol.MAX_BYTES}. Make several smaller edits."
                )
            touched = list(history.touched())
        self._seconds["encode"] = perf_counter() - begin
        self.chain = protocol.chain(self.chain, data)
        self._revisions.note(commit.revision, self.chain, commit.who, touched, history)
        files = commit.files
        put = [history.entries[entry.tag] for _, entry, _ in touched if entry is not None]
        if history.sequence is not sequence:  # all have new places
            put, files = history.sequence, self.files.find(history.sequence)
        self._batch.append(
            StoredCommit(
                commit.revision,
                self.chain,
                commit.client,
                commit.number,
                data,
                [(entry.tag, entry.place, entry_to_bytes(entry, history.sequence)) for entry in put],
                commit.changes.removed,
                replaced,
                files,
            )
        )
        return MadeCommit(commit, Published(self.epoch, self.chain, data), self._diffs.pop())

    def _check_done(self, right: Right) -> None:
        """Refuse an edit that has done what a right does not cover, whatever it said.

        What the user may edit has to stay so where it is run again, by this edit or by a later one of others.
        """
        if right.may_edit_all:
            return
        for before, now, is_given in self.model.history.touched():
            if not is_given and (before is None or find_forbidden(right, before.tag, before.writes)):
                continue
            check_right(right, (before, now))
            if now is not None and (before is None or now.operation is not before.operation):
                self._check_parameters(right, now)  # it is from the client, or from the store

    def _check_parameters(self, right: Right, entry: HistoryEntry) -> None:
        """Refuse an operation that would write elsewhere, or nothing, if it were made anew.

        One without a trace is made from its parameters when it is run again, and these need not fit what it
        says that it has written.
        """
        operation, reads = entry.operation, entry.reads
        if not isinstance(operation, OpaqueOperation) or operation.trace is not None:
            return
        if reads.cells or reads.listings:
            try:
                anew = operation.run_anew(self.model.history.reader_at(entry.place, Reads()))
                writes = entry.writes if anew is None else anew.writes()
            except Exception as error:
                message = f"{entry.tag!r} has other parameters than it was made from: {error}"
                raise RefusedError("refused", message, entry.tag) from None
            check_right(right, (replace(entry, writes=writes),))

    def _find_replaced(self, tag: str) -> Replaced:
        history = self.model.history
        entry = history.entries.get(tag)
        if entry is None:
            return Replaced(tag, None, "", 0)
        index = history.index(tag)
        after = history.sequence[index - 1].tag if index else ""
        return Replaced(tag, entry_to_bytes(entry, history.sequence), after, entry.place)

    # -- undo ----------------------------------------------------------------------------------------------

    def _undo(self, request: protocol.UndoRequest, right: Right) -> MadeCommit | None:
        """Take back a commit: by the model if it has it, else by what the store has kept of it."""
        revision, kept = request.revision, self.model.history.commits
        if not 0 < revision <= self.revision:
            message = f"There is no revision {revision}; the model is at revision {self.revision}."
            raise RefusedError("unknown", message)
        if revision in kept:
            commit = kept[revision]
            check_right(right, (entry for pair in commit.values() for entry in pair))
            return self._fold(request, right, lambda edit: self._take_back(edit, revision), commit)
        net = _find_inverse(self._store, self.model.history, revision)
        return self._fold(request, right, lambda edit: self._adopt(edit, net), _find_own(net))

    def _take_back(self, edit: Edit, revision: int) -> None:
        try:
            edit.undo(revision)
        except EditError as error:
            tag = max(self.model.history.commits[revision], key=partial(self._revisions.last, "changed"))
            later = self._revisions.last("changed", tag)
            raise RefusedError(
                "conflict", str(error), tag, "", later, self._revisions.who_made(later)
            ) from None


def _decode(request: protocol.EditRequest) -> tuple[PlacedEntry, ...]:
    """Return the operations that an edit puts, decoded from their blobs."""
    try:
        put = protocol.decode_changes(request.changes).put
    except FormatError as error:
        raise RefusedError("malformed", str(error)) from None
    entries = [placed.entry for placed in put]
    for entry in entries:
        tag, operation = entry.tag, entry.operation
        if len(tag) > _LONGEST_TAG:
            raise RefusedError("malformed", f"A tag has {len(tag)} letters; the most is {_LONGEST_TAG}.")
        if is_partial(entry):
            message = f"Of the operation {tag!r} the client has only a part. {LOAD_THE_WHOLE}"
            raise RefusedError("refused", message, tag)
        if isinstance(operation, OpaqueOperation) and operation.frozen and not _computes(entry):
            message = f"The operation {tag!r} is frozen, and does not say by what it has read."
            raise RefusedError("malformed", message, tag)
    put_contents(entries, request.files)
    return put


def _unlinked(placed: PlacedEntry) -> PlacedEntry:
    """Return an entry that does not take what there is when it is linked as what it has read."""
    entry = placed.entry
    if not _computes(entry):
        return placed
    other = HistoryEntry(entry.tag, entry.operation, entry.place, entry.reads, dict(entry.writes))
    return replace(placed, entry=other)


def _choose_reruns(
    put: Sequence[PlacedEntry], changes: protocol.Changes, history: History, right: Right
) -> set[str]:
    """Return the tags of operations that a client has run again, because they read what the edit changes.

    The others may only be as they were: read what was there for a while within the edit. Those that the user
    has no right to edit are left out.
    """
    again, taken = {*changes.rerun}, set[str]()
    tags = {*changes.removed, *(placed.entry.tag for placed in put)} - again
    known = [history.entries[tag] for tag in tags if tag in history.entries]
    new = [placed.entry for placed in put if placed.entry.tag in tags]
    changed = {cell for entry in (*known, *new) for cell in entry.writes}
    for entry in (placed.entry for placed in put if placed.entry.tag in again):
        old = history.entries.get(entry.tag)
        is_same = (
            old is not None
            and isinstance(old.operation, OpaqueOperation)
            and isinstance(entry.operation, OpaqueOperation)
            and old.operation.kind == entry.operation.kind
            and old.operation.given == entry.operation.given
            and old.operation.scope == entry.operation.scope
        )
        if old is not None and old.blob == entry.blob and not _reads_any(old, changed):
            continue
        if old is None or not is_same or not _reads_any(old, changed):
            message = f"The operation {entry.tag!r} is not one that the edit leads to be run again."
            raise RefusedError("refused", message, entry.tag)
        changed |= old.writes.keys() | entry.writes.keys()
        if not any(find_forbidden(right, entry.tag, writes) for writes in (old.writes, entry.writes)):
            taken.add(entry.tag)
    return taken


def _reads_any(entry: HistoryEntry, cells: set[tuple[str, str]]) -> bool:
    kinds = {kind for kind, _ in cells}
    return not (cells.isdisjoint(entry.reads.cells) and kinds.isdisjoint(entry.reads.listings))


def _find_own(changes: NetChanges) -> list[str]:
    again = {*changes.rerun}
    return [
        *changes.removed,
        *(placed.entry.tag for placed in changes.put if placed.entry.tag not in again),
    ]


def _as_answer(error: Exception, who: str) -> Refused:
    """Return the answer to an edit that has failed and is rolled back."""
    match error:
        case RefusedError():
            return error.answer
        case EditError() if error.failures:
            tag, failure = next(iter(error.failures.items()))
            error = RefusedError("refused", f"{tag!r}: {failure}", tag)
        case KineverseError():
            error = RefusedError("refused", str(error))
        case RecursionError():
            error = RefusedError("refused", "The edit has expressions or data that are nested too deeply.")
        case MemoryError():
            error = RefusedError("refused", "There is not enough memory for the edit.")
        case _:
            _LOG.error("An edit of %r failed.", who, exc_info=error)
            message = f"The edit has failed in the server, with {type(error).__name__}: {error}"
            error = RefusedError("failed", message)
    return error.answer


# -- undo, by what the store has kept of commits -------------------------------------------------------------

_PLACE = attrgetter("place")
_UNKNOWN: Final = object()


def _find_inverse(store: Store, history: History, revision: int) -> NetChanges:
    """Return the changes that take back a commit of a store, which has all commits of a model.

    If a later commit has changed one of its operations, or what a frozen one had read, it is in conflict with
    that (RefusedError).
    """
    data, replaced = store.commit_of(revision)
    commit: CommitMessage = protocol.decode_commit(data)
    changes = commit.changes
    messages = store.last_commits(store.revision - revision, store.revision + 1)
    later: list[CommitMessage] = [protocol.decode_commit(one) for one in messages]  # the newest first
    put: list[PlacedEntry] = []
    removed = {old.tag for old in replaced if old.blob is None}
    gone = {*removed, *changes.moved}
    for old in sorted(replaced, key=_PLACE):
        _check_unchanged(history, revision, old.tag, old.tag in changes.removed, later)
        if old.blob is not None:
            entry = operation_from_bytes(old.blob)
            if _computes(entry) and not _has_trace(entry):
                _check_unread(store, history, entry, later)
            put.append(PlacedEntry(entry, _find_anchor(history, old, put, gone)))
    again = tuple(placed.entry.tag for placed in put if placed.entry.tag in history.entries)
    moved = tuple(tag for tag in changes.moved if tag in again)
    return NetChanges(tuple(put), again, (), moved, tuple(sorted(removed)))


def _computes(entry: HistoryEntry) -> bool:
    """Return whether an operation depends on more of what it reads than on its being there."""
    kinds = {*entry.reads.cells.values()}
    return _has_trace(entry) or bool(entry.reads.listings or kinds - {Read.EXISTENCE})


def _has_trace(entry: HistoryEntry) -> bool:
    return isinstance(entry.operation, OpaqueOperation) and entry.operation.trace is not None


def _check_unchanged(
    history: History, revision: int, tag: str, was_removed: bool, later: Sequence[CommitMessage]
) -> None:
    for one in later:
        of = one.changes
        if tag in of.removed or tag in of.replaced or tag in of.moved:
            raise _conflict(one, tag, "", f"has changed {tag!r} after revision {revision}, which did so too")
    if was_removed == (tag in history.entries):
        raise _conflict(later[0], tag, "", f"is after another {tag!r} than that of revision {revision}")


def _check_unread(
    store: Store, history: History, entry: HistoryEntry, later: Sequence[CommitMessage]
) -> None:
    """Check that a frozen operation finds what it has read; it does not know that itself."""
    # The value before the first commit that touched it, and that commit.
    then: dict[Cell, tuple[Any, CommitMessage]] = {}
    for one in later[::-1]:
        _, replaced = store.commit_of(one.revision)
        old: dict[Cell, Any] = {}
        for blob in (was.blob for was in replaced if was.blob is not None):
            old.update(operation_from_bytes(blob).writes)
        for now in (operation_from_bytes(placed.blob) for placed in one.changes.put):
            # What an operation wrote before it was run again is not kept.
            unknown = _UNKNOWN if now.tag in one.changes.rerun else ABSENT
            old.update({cell: unknown for cell in now.writes if cell not in old})
        then.update({cell: (value, one) for cell, value in old.items() if cell not in then})
    for cell, (value, one) in then.items():
        how = entry.reads.cells.get(cell)
        now = history.head[cell[0]].get(cell[1], ABSENT)
        is_changed = how is not None and (value is _UNKNOWN or differs(how, value, now))
        if is_changed or cell[0] in entry.reads.listings:
            path = "/".join(cell)
            raise _conflict(one, entry.tag, path, f"has changed {path}, from which {entry.tag!r} was made")


def _conflict(later: CommitMessage, tag: str, path: str, what: str) -> RefusedError:
    message = f"Revision {later.revision}, by {later.who}, {what}. Undo it first."
    return RefusedError("conflict", message, tag, path, later.revision, later.who)


def _find_anchor(history: History, old: Replaced, put: Sequence[PlacedEntry], gone: set[str]) -> str | None:
    """Return the tag after which an operation goes back: that of before, else the one at its place."""
    put_tags = {placed.entry.tag for placed in put}
    if old.after in put_tags or (old.after in history.entries and old.after not in gone):
        return old.after
    if not old.after:
        return None
    index = bisect_left(history.sequence, old.place, key=_PLACE)
    earlier = (entry.tag for entry in history.sequence[:index][::-1] if entry.tag not in gone)
    return next(earlier, None)
