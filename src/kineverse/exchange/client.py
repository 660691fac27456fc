"""Live models: a server keeps them, their edits are asked of it, and they follow all commits.

A client runs an edit on its replica, takes the net changes, rolls back and asks the server. The replica
adopts only what the server publishes, its own edits included, so a refused edit needs no repair.
"""

from __future__ import annotations

import logging
import random
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from queue import SimpleQueue
from typing import Any, TypeVar

from msgspec.structs import replace

from kineverse._checks import as_count, as_entries, as_tolerance, check_flag
from kineverse._rich_display import Html, element, join_html
from kineverse._runtime import Closing
from kineverse._version import __version__
from kineverse.errors import ConflictError, EditError, ForbiddenError, OfflineError
from kineverse.formats import entries_from_bytes
from kineverse.formats.resources import add_resolver, remove_resolver
from kineverse.model.changes import find_moved_tags
from kineverse.model.commits.net_changes import NetChanges, PlacedEntry
from kineverse.model.edit import Edit
from kineverse.model.history import HistoryEntry
from kineverse.model.model import EditContext, Model
from kineverse.model.operation import RATES
from kineverse.model.read_recorder import ABSENT, Read
from kineverse.symbols import Symbol

from . import protocol
from .address import Address
from .connection import Connection
from .meshes import FetchedFiles, find_known_files, put_contents
from .transport import Channel
from .views import EVERY_FRAME, LOAD_THE_WHOLE, is_partial

_LOG = logging.getLogger(__name__)

_OWN_COMMIT = 0.05
"""Time in which the publication of an own edit is waited for before the server is asked for it [s]."""

_BACK_OFF = 0.002  # longest pause after the first conflict of a repeated edit [s]

R = TypeVar("R")


def load_live(
    source: str,
    *,
    frames: Iterable[str] | None = None,
    symbols: Iterable[Symbol | str] | None = None,
    bodies: bool | None = None,
) -> LiveModel:
    """Connect to a model server and return its model, or a part of it; see :func:`kineverse.load`.

    An unknown server, frame or coordinate is an UnknownNameError with similar names, an endpoint where nobody
    answers an OfflineError, and a server of another version a FormatError.
    """
    is_part = frames is not None or symbols is not None
    if bodies is None:
        bodies = not is_part
    check_flag("bodies", bodies)
    wish = protocol.JoinRequest(
        protocol.PROTOCOL,
        __version__,
        "",
        "",
        _parse_frames(frames) if is_part else EVERY_FRAME,
        tuple(map(str, as_entries("symbols=", symbols or (), (Symbol, str), "symbols, or their names"))),
        bodies,
        is_part or not bodies,
    )
    return LiveModel(Connection(Address.parse(source)), wish)


def _parse_frames(frames: Iterable[str] | None) -> tuple[str, ...]:
    """Return frames for a wish, in which ``kitchen/`` stands for ``kitchen/*``."""
    names = as_entries("frames=", frames or (), str, "names of frames")
    return tuple(name[:-1] if name == "*" or name.endswith("/*") else name for name in names)


def include_live(edit: Edit, source: str, prefix: str | None = None) -> list[str]:
    """Append the present operations of a server's model to an edit of another one, and return their tags."""
    with closing(Connection(Address.parse(source))) as connection:
        joined = connection.join(protocol.JoinRequest(protocol.PROTOCOL, __version__, "", ""))
    return [edit.link(entry) for entry in entries_from_bytes(joined.document, prefix)]


class LiveModel(Model, Closing):
    """Model that a server keeps, from ``kv.load("live:NAME")``.

    It reads like any model and is edited like any: ``with model.edit() as edit:`` ends when the edit is
    stored, or raises and nothing has happened. Commits of others arrive in the background. Listeners are
    called in a thread of their own, in order, and may edit. The version is the server's revision. While the
    server is away, reading goes on and edits raise; afterwards the model catches up.

    Examples
    --------
    >>> server = kv.exchange.serve("kitchen", name="doc-live")
    >>> model = kv.load(server.address)  # usually in another process
    >>> with model.edit() as edit:
    ...     edit.add_frame("lamp", parent="kitchen/sink_area", transform=kv.translation(0, 0, 1))
    'frame lamp'
    >>> "lamp" in server.snapshot().frames
    True
    >>> model.close()
    >>> server.close()
    >>> with model.edit() as edit:
    ...     edit.add_frame("bulb", parent="lamp")
    Traceback (most recent call last):
        ...
    kineverse.errors.OfflineError: The connection to live:doc-live was closed, or its model was not ...
    """

    def __init__(self, connection: Connection, wish: protocol.JoinRequest) -> None:
        self.exchange = connection
        self._wish = wish
        self._following = threading.RLock()
        self._deliveries: SimpleQueue[bool] = SimpleQueue()
        self._announced = 0  # last revision that concerns this model, as the last sign of life had it
        # The last revision that was adopted, and its digest; later ones concern nothing of a part.
        self._last, self._link = 0, b""
        log = None if wish.is_part else connection.transport.subscribe(connection.key("log"))
        try:
            joined = connection.join(wish)
            super().__init__()
            self._restore(_entries(joined), joined.revision)
        except BaseException:
            connection.close()
            raise
        self._start(log, joined)

    # -- edits ---------------------------------------------------------------------------------------------

    def edit(self, *, strict: bool = False) -> AbstractContextManager[Edit]:
        """Open a transaction, which the server is asked for at the end of its ``with`` block.

        Parameters
        ----------
        strict
            True to be refused if anything has been changed meanwhile: for edits whose code has read values of
            the model by hand. Otherwise edits of others are merged if neither's operations read or write what
            the other's write.

        Raises
        ------
        ConflictError
            If another edit was first: the error names tags, paths, revision and who. Nothing has happened;
            :meth:`transact` tries again.
        ForbiddenError
            If it writes what this user may not edit; it is an EditError.
        EditError
            If the model refuses the edit, as for any model, or the part does not have what the edit needs.
        OfflineError
            If the server is away.
        """
        check_flag("strict", strict)
        return EditContext(lambda: self._ask_for_edit(strict))

    def transact(self, change: Callable[[Edit], R], *, attempts: int = 10, strict: bool = False) -> R:
        """Edit the model by a function, which is called again on the newest model after a conflict.

        Parameters
        ----------
        change
            Function of an edit; it must depend on nothing else that it changes.
        attempts
            Most calls.
        strict
            As for :meth:`edit`.

        Returns
        -------
        object
            What the function has returned.

        Raises
        ------
        ConflictError
            If the last attempt was in conflict as well.

        Examples
        --------
        >>> server = kv.exchange.serve("kitchen", name="doc-transact")
        >>> model = kv.load(server.address)
        >>> model.transact(lambda edit: edit.write("owner", "Ada"))
        'data owner'
        >>> model.close()
        >>> server.close()
        """
        for done in range(as_count("attempts", attempts, 1)):
            try:
                with self.edit(strict=strict) as edit:
                    return change(edit)
            except ConflictError as error:
                if done + 1 == attempts:
                    raise
                self.exchange.wait_to_follow(error.revision)
                # Clients that meet again and again give each other time.
                time.sleep(random.uniform(0.0, _BACK_OFF * 2 ** min(done, 6)))
        raise AssertionError

    def adopt(self, changes: NetChanges) -> None:
        """Make the net changes of an edit of an equal model, in an edit that the server is asked for.

        Operations that read what they change, and are not among them, are run again.

        Raises
        ------
        EditError, OfflineError
            As :meth:`edit`; also if the changes do not belong to this model.
        """
        with self.edit() as edit:
            edit.adopt(changes)

    def undo(self, revision: int) -> None:
        """Take back the commit of a revision, also one from before this process has joined.

        Raises
        ------
        ConflictError
            If a later commit has changed what it would change.
        EditError
            If there is no such revision, or this thread edits the model.
        OfflineError
            If the server is away.

        Examples
        --------
        >>> server = kv.exchange.serve("kitchen", name="doc-undo")
        >>> model = kv.load(server.address)
        >>> with model.edit() as edit:
        ...     edit.write("owner", "Ada")
        'data owner'
        >>> model.undo(model.version)
        >>> "owner" in model.data
        False
        >>> model.close()
        >>> server.close()
        """
        connection = self.exchange
        wanted = as_count("revision", revision, 1)
        if wanted > protocol.MAX_REVISION:
            raise EditError(f"There is no revision {wanted}; the model is at revision {self.version}.")
        self._check_not_edited()
        connection.check_online()
        number = connection.next_number()
        self._finish_edit(
            connection.ask_edit(protocol.UndoRequest(connection.client, number, connection.who, wanted))
        )

    def wait(self, version: int, timeout: float | None = None) -> bool:
        """Wait until the model is at a version or a later one; False if it is not after a time [s].

        A listener is called after the model has its version, so hooks of that version may still run.

        Raises
        ------
        EditError
            If this thread edits the model.
        OfflineError
            If the connection was closed, or is meanwhile, and the model does not have the version.

        Examples
        --------
        >>> server = kv.exchange.serve("kitchen", name="doc-wait")
        >>> one, other = kv.load(server.address), kv.load(server.address)
        >>> with one.edit() as edit:
        ...     edit.write("owner", "Ada")
        'data owner'
        >>> other.wait(one.version, timeout=60)
        True
        >>> other.data["owner"]
        'Ada'
        >>> one.close()
        >>> other.close()
        >>> server.close()
        """
        wanted, connection = as_count("version", version, 0), self.exchange
        self._check_not_edited()
        if connection.revision < wanted:
            connection.check_open()
            if self._wish.is_part and connection.is_online:
                self._close_gap()  # the commits may be none of its
        is_over = connection.wait_for(
            lambda: connection.revision >= wanted or connection.is_closed,
            None if timeout is None else as_tolerance(timeout, "A timeout"),
        )
        if connection.revision < wanted:
            connection.check_open()
        return is_over

    def _repr_html_(self) -> str:
        connection = self.exchange
        state = "closed" if connection.is_closed else "online" if connection.is_online else "server away"
        own = element("p", element("b", str(connection.address)), f": revision {self.version}, {state}")
        return join_html(own, Html(super()._repr_html_()))

    def close(self) -> None:
        """End the connection; reading goes on. A second call has no effect, and a script need not call it."""
        self._finish()

    def _check_not_edited(self) -> None:
        """Raise an EditError if this thread edits the model, which gets no commits meanwhile."""
        if self._edit is not None and self._lock.acquire(blocking=False):
            self._lock.release()
            raise EditError("A model gets no commits while it is edited: do that after the edit.")

    @contextmanager
    def _ask_for_edit(self, strict: bool) -> Iterator[Edit]:
        connection = self.exchange
        connection.check_online()
        proposed: list[protocol.EditRequest] = []
        with self._transaction(lambda edit: proposed.extend(self._propose(edit, strict))) as edit:
            yield edit
        for request in proposed:
            self._finish_edit(connection.ask_edit(request))

    def _propose(self, edit: Edit, strict: bool) -> list[protocol.EditRequest]:
        changes, connection = edit.net(), self.exchange
        if changes.is_empty:
            return []
        if self._wish.is_part:
            _check_part(self, changes)
        return [
            protocol.EditRequest(
                connection.client,
                connection.next_number(),
                connection.who,
                *connection.position,
                protocol.encode_changes(changes, self._history.sequence),
                strict,
                find_known_files(placed.entry for placed in changes.put),
            )
        ]

    def _finish_edit(self, answer: protocol.Committed | protocol.Refused) -> None:
        """Wait until the replica has an edit that was committed, or raise the error of one that was not."""
        if isinstance(answer, protocol.Refused):
            if answer.reason == "stale":
                self._close_gap()
            if answer.reason in ("conflict", "stale"):
                named = (filter(None, [answer.tag]), filter(None, [answer.path]))
                raise ConflictError(answer.message, *named, answer.revision, answer.who)
            kind = ForbiddenError if answer.reason == "forbidden" else EditError
            raise kind(answer.message)
        connection = self.exchange
        first = 0.0 if self._wish.is_part else _OWN_COMMIT  # a part may have nothing of it
        while not connection.wait_for(lambda: connection.revision >= answer.revision, first):
            if not connection.is_online:
                return  # it is stored, and comes when the server is back
            self._close_gap()
            first = _OWN_COMMIT

    # -- following -----------------------------------------------------------------------------------------

    def _start(self, log: Channel | None, joined: protocol.Joined) -> None:
        connection, model = self.exchange, weakref.ref(self)
        self._accept(joined)
        self._view = joined.view
        transport = connection.transport
        self._pump(log or transport.subscribe(connection.key(f"view/{joined.view}")), LiveModel._receive)
        self._pump(transport.subscribe(connection.key("beat"), most=2), LiveModel._hear)
        self._pump(transport.watch_alive(connection.key("alive/*")), LiveModel._notice)
        threading.Thread(
            target=_call_hooks, args=(self._deliveries, model), name="kineverse-hooks", daemon=True
        ).start()
        fetched = FetchedFiles(connection.fetch_part)
        add_resolver(fetched)
        self._finish = weakref.finalize(self, _finish, connection, self._deliveries, fetched)
        if log is None:
            self._close_gap()  # what came before the subscription

    def _pump(self, channel: Channel, method: Callable[[LiveModel, Any], None]) -> None:
        threading.Thread(
            target=_pump, args=(channel, weakref.ref(self), method), name="kineverse-follow", daemon=True
        ).start()

    def _receive(self, data: bytes) -> None:
        published = protocol.decode_published(data)
        commit = protocol.decode_commit(published.commit)
        with self._following:
            connection = self.exchange
            if published.epoch != connection.epoch or commit.previous > self._last:
                self._close_gap()
            elif commit.revision > self._last:
                self._adopt_commit(published, commit)

    def _adopt_commit(self, published: protocol.Published, commit: protocol.CommitMessage) -> None:
        connection = self.exchange
        link = protocol.chain(self._link, published.commit)
        if link != (published.link if self._wish.is_part else published.chain):
            self._join_again()
            return
        try:
            changes = protocol.decode_changes(commit.changes)
            put_contents((placed.entry for placed in changes.put), commit.files)
            self._adopt(changes, commit.revision)
        except Exception:
            _LOG.exception("A commit of %s cannot be adopted; its model is joined again.", connection.address)
            self._join_again()
            return
        self._last, self._link = commit.revision, link
        connection.advance(commit.revision, published.chain)

    def _close_gap(self) -> None:
        connection = self.exchange
        with self._following:
            while True:
                try:
                    answer = connection.ask_missed(self._view)
                    if answer is None:
                        self._join_again()
                        return
                except OfflineError:
                    return  # when the server is back, it says so
                connection.epoch = answer.epoch
                for published in answer.commits:
                    commit = protocol.decode_commit(published.commit)
                    if commit.revision > self._last:
                        self._adopt_commit(published, commit)
                if connection.revision >= answer.revision or not answer.commits:
                    break
            if connection.revision < answer.revision:
                self._pass_by(answer.revision, answer.chain)
            connection.note_presence(True)

    def _pass_by(self, revision: int, chain: bytes) -> None:
        """Take the version of commits that concern nothing of a part."""
        self._adopt(NetChanges(), revision)
        self.exchange.advance(revision, chain)

    def _join_again(self) -> None:
        """Take the model anew, as one commit, if the server does not know the state that this one is in."""
        connection = self.exchange
        joined = connection.join(replace(self._wish, again=True))
        self._adopt(_find_changes(self._history.sequence, _entries(joined)), joined.revision)
        if joined.view != self._view:
            self._view = joined.view
            self._pump(
                connection.transport.subscribe(connection.key(f"view/{joined.view}")), LiveModel._receive
            )
        self._accept(joined)

    def _accept(self, joined: protocol.Joined) -> None:
        """Take over where the model is that the server has sent."""
        self._last = joined.revision
        self._link = joined.link if self._wish.is_part else joined.chain
        self.exchange.accept(joined)

    def _hear(self, data: bytes) -> None:
        """Note a sign of life: what it tells of and has not come until the next one was lost."""
        beat = protocol.decode_beat(data)
        connection = self.exchange
        with self._following:
            last = beat.views.get(self._view) if self._wish.is_part else beat.revision
            is_lost = last is None or connection.revision > beat.revision  # to the server, or to a false sign
            if beat.epoch != connection.epoch or is_lost or self._last < self._announced:
                self._close_gap()
            elif last is not None and last <= self._last and connection.revision < beat.revision:
                self._pass_by(beat.revision, beat.chain)
            self._announced = last or 0
        connection.hear(beat)

    def _notice(self, sign: tuple[str, bool]) -> None:
        key, is_there = sign
        connection = self.exchange
        if is_there:
            self._close_gap()
        elif key.endswith(connection.epoch):
            connection.note_presence(False)

    def _deliver(self) -> None:
        self._deliveries.put(True)


def _entries(joined: protocol.Joined) -> list[HistoryEntry]:
    entries = entries_from_bytes(joined.document)
    put_contents(entries, joined.files)
    return entries


def _find_changes(old: Sequence[HistoryEntry], new: Sequence[HistoryEntry]) -> NetChanges:
    """Return the changes between two sequences; operations that may read what changes are put as well."""
    known = {entry.tag: entry for entry in old}
    tags = dict.fromkeys(entry.tag for entry in new)
    moved = find_moved_tags([*known], [*tags])
    put, last = [], None
    for entry in new:
        is_equal = entry.tag in known and known[entry.tag].blob == entry.blob and entry.tag not in moved
        if not is_equal or entry.reads.cells or entry.reads.listings:
            put.append(PlacedEntry(entry, last))
        last = entry.tag
    replaced = tuple(placed.entry.tag for placed in put if placed.entry.tag in known)
    removed = tuple(tag for tag in known if tag not in tags)
    return NetChanges(tuple(put), replaced, (), moved, removed)


def _check_part(model: LiveModel, changes: NetChanges) -> None:
    """Refuse an edit that would depend on what is not in a part of a model."""
    history, symbols = model.history, {*map(str, model.symbols)}
    for entry in (placed.entry for placed in changes.put):
        if is_partial(entry):
            raise EditError(f"Only a part of the operation {entry.tag!r} is here. {LOAD_THE_WHOLE}")
        missing = sorted(f"all {kind}" for kind in entry.reads.listings)
        for cell, how in entry.reads.cells.items():
            found, last = history.value_at(cell, entry.place), history.head[cell[0]].get(cell[1], ABSENT)
            # Coordinates of a part come with their rates. What was overwritten is not in it.
            is_missing = found is ABSENT and not (cell[0] == RATES and cell[1] in symbols)
            if is_missing or (how & Read.VALUE and found is not last):
                missing.append("/".join(cell))
        if missing:
            raise EditError(
                f"The edit needs more than this part of the model: {entry.tag!r} reads {missing[0]}. Name it "
                f"when the part is loaded, or load the whole, {str(model.exchange.address)!r}."
            )


def _pump(channel: Any, model: weakref.ref[LiveModel], method: Callable[[LiveModel, Any], None]) -> None:
    """Hand over what arrives to a method of a model, as long as both are there."""
    for item in channel:
        target = model()
        if target is None or target.exchange.is_closed:
            return
        try:
            method(target, item)
        except Exception:  # the next sign of life shows what is missing
            _LOG.exception("A message of %s is left out.", target.exchange.address)
        del target


def _call_hooks(deliveries: SimpleQueue[bool], model: weakref.ref[LiveModel]) -> None:
    while deliveries.get():
        target = model()
        if target is None:
            return
        target._listeners.deliver(BaseException)  # sys.exit() would end this thread, and nobody would know
        del target


def _finish(connection: Connection, deliveries: SimpleQueue[bool], fetched: FetchedFiles) -> None:
    connection.close()
    deliveries.put(False)
    remove_resolver(fetched)
