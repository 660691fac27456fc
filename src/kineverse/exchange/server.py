"""Model server: serves a model, takes edits in turn, keeps them, and publishes what changed."""

from __future__ import annotations

import gc
import logging
import os
import threading
import time
from collections import defaultdict, deque
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from msgspec import structs

from kineverse._checks import as_entries, as_tolerance, check_flag
from kineverse._runtime import Closing
from kineverse._version import __version__
from kineverse.errors import FormatError, InvalidValueError, KineverseError, UnknownNameError
from kineverse.formats import entry_to_bytes
from kineverse.formats.document.encoding import pack_document
from kineverse.model.edit import Edit
from kineverse.model.model import Model, Snapshot

from . import protocol
from .access import make_grants
from .address import Claim, check_endpoint, check_protected
from .authority import Authority, Result
from .conflicts import RefusedError
from .connection import describe_client
from .meshes import MAX_PART
from .rights import EVERYTHING, Right, Rights
from .state import THROUGH_SERVER
from .store import Store
from .transport import SERVER, Question, Questions, Transport
from .views import MOST_MISSED, View, Views, Wish

if TYPE_CHECKING:
    from .keys import Keys

_LOG = logging.getLogger(__name__)

Source: TypeAlias = str | os.PathLike[str] | Model

MOST_TOGETHER, LONGEST_WAIT = 200, 0.002
"""Most edits that are stored together, and the longest time for which waiting ones are collected [s]."""
BEAT = 0.5  # time between two signs of life [s]
STAGES = ("receive", "decode", "check", "fold", "encode", "persist", "publish", "answer")
"""Stages of an edit, in order; their times are in the status."""
_COLLECTION = 5.0  # time between two collections of garbage [s]
_KEPT_REFUSALS = 20
_KEPT_TIMES = 1000
_LONGEST_MESSAGE = 10_000
_MINUTE = 60.0
_BACKUP = "store"


def serve(
    models: Source | Iterable[Source] = (),
    *,
    name: str | None = None,
    store: str | os.PathLike[str] | None = None,
    listen: Iterable[str] = (),
    durable: bool = False,
    keys: str | os.PathLike[str] | None = None,
    insecure: bool = False,
) -> Server:
    """Serve a model to other processes, in threads of this one.

    Parameters
    ----------
    models
        Models, or their files and names, that an empty store begins with. A store that has a model keeps it.
    name
        Name of the server: by default that in the store, of the store's file, or of the first model.
    store
        SQLite file that keeps the model and all edits. Without one, they end with the server.
    listen
        Further endpoints: ``tls/HOST:PORT`` for users with a certificate, who may do what the rights say, or
        ``tcp/127.0.0.1:PORT`` for everybody on this computer. By default only processes of this user on this
        computer are served.
    durable
        True to acknowledge an edit only when it survives a loss of power; otherwise it survives the end of
        the process at any time.
    keys
        Folder with the keys of the server and ``rights.toml``, for endpoints of TLS; ``kineverse keys`` makes
        one.
    insecure
        True to listen at endpoints of TCP that other computers reach, for everybody.

    Returns
    -------
    Server
        The server, which runs until it is closed.

    Raises
    ------
    InvalidValueError
        For an invalid name or argument, and for keys that are missing, expired, or can be read by others.
    DuplicateNameError
        If another server has the name.
    FormatError
        For a model or rights that cannot be loaded, or a store that is damaged, in use or of another version.
    MissingDependencyError
        Without the extra ``exchange``.

    Examples
    --------
    >>> server = kv.exchange.serve("kitchen", name="doc-kitchen", store="kitchen.kvs")
    >>> server.address, server.revision
    ('live:doc-kitchen', 1)
    >>> server.snapshot()
    <Snapshot: 54 frames, 23 DoF, 46 constraints (version 1)>
    >>> server.close()
    """
    check_flag("durable", durable)
    check_flag("insecure", insecure)
    if durable and store is None:
        raise InvalidValueError("Without a store= nothing is kept, so durable=True needs one.")
    given = as_entries("models=", models, (str, os.PathLike, Model), "models, or their files and names")
    endpoints = [check_endpoint(one) for one in as_entries("listen=", listen, str, "endpoints")]
    check_protected(endpoints, keys, insecure)
    found, rights = (None, Rights()) if keys is None else _read_keys(keys)
    path = None if store is None else Path(store)
    with ExitStack() as opened:
        kept = opened.enter_context(closing(Store(path, durable=durable)))
        chosen = name or kept.name or (path.stem if path else "") or _name_of(given)
        claim = Claim(chosen)
        opened.callback(claim.release)
        authority = Authority(kept)
        if authority.revision and given:
            _LOG.warning("%s has a model already, which is served. Nothing else is read.", store)
        elif given:
            authority.fill(lambda edit: _include(edit, given), describe_client())
        kept.name = chosen
        grants = make_grants(chosen, rights)
        transport = Transport.serve([claim.endpoint, *endpoints], claim.secret, keys=found, grants=grants)
        opened.callback(transport.close)
        return Server(chosen, authority, kept, transport, opened.pop_all(), rights)


def _read_keys(folder: str | os.PathLike[str]) -> tuple[Keys, Rights]:
    from .keys import read_listening  # for those who have no need of the package cryptography

    return read_listening(folder, SERVER)


def _name_of(given: Sequence[Source]) -> str:
    first = given[0] if given else None
    if first is None or isinstance(first, Model):
        raise InvalidValueError("A server has a name: give it one with name=.")
    stem = Path(first).name
    return stem.partition(".")[0] or stem


def _include(edit: Edit, given: Sequence[Source]) -> None:
    for source in given:
        if isinstance(source, Model):
            for entry in source.snapshot().entries:
                edit.apply(entry.operation, entry.tag)
        else:
            edit.include(source)


class Server(Closing):
    """Running model server, from :func:`serve`.

    Attributes
    ----------
    name
        Name; clients load ``live:NAME``.

    See Also
    --------
    kineverse.exchange.serve
    """

    def __init__(
        self,
        name: str,
        authority: Authority,
        store: Store,
        transport: Transport,
        opened: ExitStack,
        rights: Rights,
    ) -> None:
        self.name, self._rights = name, rights
        self._authority, self._store, self._transport, self._opened = authority, store, transport, opened
        self._since = time.time()
        self._views = Views(authority.model)
        self._sources: dict[str, protocol.SourceStatus] = {}
        self._backups: dict[str, TemporaryDirectory[str]] = {}
        self._clients: dict[str, _Client] = {}
        self._present: set[str] = set()  # clients whose signs of life are there
        self._absent: set[str] = set()  # those that were not, at the last beat
        self._refusals: deque[protocol.Refusal] = deque(maxlen=_KEPT_REFUSALS)
        self._times: defaultdict[str, deque[float]] = defaultdict(lambda: deque(maxlen=_KEPT_TIMES))
        self._accepted: deque[float] = deque(maxlen=100_000)
        self._edits = 0
        self._lock = threading.RLock()  # of the model, the views and the lists above
        self._editing = threading.Lock()  # edits are made, published and answered in turn
        self._closed = threading.Event()
        ways = ("", "user/*/")  # of this computer, and of users with a certificate
        edits, user_edits = (transport.answers(self._key(f"{way}edit")) for way in ways)
        questions, user_questions = (transport.answers(self._key(f"{way}ask")) for way in ways)
        presence = transport.watch_alive(self._key("client/*"))
        seen = transport.subscribe(self._key("seen"))
        # Last, for those who wait for a server to ask it.
        self._token = transport.alive(self._key(f"alive/{authority.epoch}"))
        for task, work in (
            ("edits", lambda: self._take_edits(edits)),
            ("user-edits", lambda: self._take_edits(user_edits)),
            ("questions", lambda: self._answer_questions(questions)),
            ("user-questions", lambda: self._answer_questions(user_questions)),
            ("presence", lambda: self._watch_clients(presence)),
            ("seen", lambda: self._note_seen(seen)),
            ("beat", self._beat),
        ):
            threading.Thread(target=work, name=f"kineverse-server-{task}", daemon=True).start()

    # -- for users -----------------------------------------------------------------------------------------

    @property
    def address(self) -> str:
        """Address for :func:`kineverse.load`."""
        return f"live:{self.name}"

    @property
    def revision(self) -> int:
        """Number of commits of the model."""
        return self._authority.revision

    def snapshot(self) -> Snapshot:
        """Return the present model."""
        with self._lock:
            return self._authority.model.snapshot()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the server is closed; False if it is not after a time [s]."""
        return self._closed.wait(None if timeout is None else as_tolerance(timeout, "A timeout"))

    def run(self) -> None:
        """Wait until the server is closed, in a process that does nothing else.

        What is there stays, so the collector of garbage need not visit it, and it only runs now and then.
        """
        gc.disable()
        while True:
            gc.collect()
            gc.freeze()
            if self.wait(_COLLECTION):
                break
        gc.unfreeze()
        gc.enable()

    def close(self) -> None:
        """Stop serving; what was acknowledged is kept. A second call has no effect."""
        if not self._closed.is_set():
            self._closed.set()
            with self._lock:
                for client in [*self._backups]:
                    self._drop_backup(client)
                self._opened.close()

    # -- rights --------------------------------------------------------------------------------------------

    def _admit(self, question: Question) -> tuple[protocol.Request, Right]:
        """Return what is asked, under the identity of who asks, and the right of that user.

        The user is a part of the key, which access control gives to the certificate with that name alone.
        Clients of this computer ask under keys without a user. A request that the right does not cover is a
        RefusedError; what an edit may change is known once it is made.
        """
        request = protocol.decode_request(question.payload)
        if question.key in (self._key("edit"), self._key("ask")):
            return request, EVERYTHING
        user, _, end = question.key.removeprefix(self._key("user/")).partition("/")
        right = self._rights.users.get(user) if end in ("edit", "ask") else None
        if right is None:
            message = f"{user!r} is no user of {self.name!r}. Who runs the server enters users in its rights."
            raise RefusedError("forbidden", message, who=user)
        request = protocol.name_asker(request, user)
        if isinstance(request, protocol.ChangeRequest) and not right.may_edit:
            raise RefusedError("forbidden", f"{right}.", who=request.who)
        if isinstance(request, protocol.GetBackup | protocol.Announce) and not right.may_edit_all:
            raise RefusedError(
                "forbidden", f"{right}, and this takes the right to edit everything.", who=user
            )
        if isinstance(request, protocol.Announce) and request.endpoint not in ("", THROUGH_SERVER):
            raise FormatError(f"A source of another computer sends through the server: {THROUGH_SERVER!r}.")
        return request, right

    # -- edits ---------------------------------------------------------------------------------------------

    def _take_edits(self, requests: Questions) -> None:
        while not self._closed.is_set():
            waiting = requests.take(MOST_TOGETHER, LONGEST_WAIT)
            if not waiting:
                return  # the transport is closed
            begin = time.perf_counter()
            edits, rights, given = [], [], []
            for request in waiting:
                try:
                    asked, right = self._admit(request)
                    if not isinstance(asked, protocol.ChangeRequest):
                        raise FormatError("This is no edit, and is asked under another key.")
                except FormatError as error:
                    self._refuse(request, "malformed", error)
                    continue
                except RefusedError as error:
                    self._note_refusal(error.answer.who, error.answer)
                    request.answer(protocol.encode(error.answer))
                    continue
                edits.append(asked)
                rights.append(right)
                given.append(request)
            self._note_time("receive", begin)
            if edits:
                with self._editing:
                    self._process(edits, rights, given)

    def _process(
        self,
        edits: Sequence[protocol.ChangeRequest],
        rights: Sequence[Right],
        requests: Sequence[Question],
    ) -> None:
        epoch = self._authority.epoch
        try:
            with self._lock:
                results = self._authority.process(edits, rights)
                if self._authority.epoch != epoch:
                    self._begin_again()
                for_parts = self._follow_views(results)
        except Exception as error:  # a defect of this package must not end the server
            _LOG.exception("Edits could not be processed.")
            for request in requests:
                self._refuse(request, "failed", error)
            return
        begin = time.perf_counter()
        for result in results:
            if result.commit is not None:
                self._transport.publish(self._key("log"), protocol.encode(result.commit.published))
        for view, commit in for_parts:
            self._transport.publish(self._key(f"view/{view}"), protocol.encode(commit))
        self._note_time("publish", begin)
        begin = time.perf_counter()
        for request, edit, result in zip(requests, edits, results, strict=True):
            self._note(edit, result)  # first, for who asks for the status as soon as the answer is there
            request.answer(protocol.encode(result.answer))
        self._note_time("answer", begin)

    def _begin_again(self) -> None:
        """Follow a model that was loaded again from its store: parts are asked for anew, and clients join."""
        self._views, self._clients = Views(self._authority.model), {}
        before = self._token
        self._token = self._transport.alive(self._key(f"alive/{self._authority.epoch}"))
        before.close()  # later, so that clients do not take the server for gone

    def _follow_views(self, results: Sequence[Result]) -> list[tuple[str, protocol.Published]]:
        try:
            return self._commit_views(results)
        except Exception:  # a defect of this package; the edits are made, and clients of parts join again
            _LOG.exception("Parts of the model could not follow it.")
            self._views = Views(self._authority.model)
            return []

    def _commit_views(self, results: Sequence[Result]) -> list[tuple[str, protocol.Published]]:
        made = [result.commit for result in results if result.commit is not None]
        if not made:
            return []
        authority, last = self._authority, made[-1].message
        commits = []
        for view, changes in self._views.commit(*(commit.diff for commit in made)):
            put = {*map(protocol.tag_of, changes.put)}
            files = authority.files.find([entry for entry in view.entries if entry.tag in put])
            commit = structs.replace(last, previous=view.log.last, changes=changes, files=files)
            commits.append((view.id, view.log.add(authority.epoch, authority.chain, commit)))
        return commits

    def _note(self, edit: protocol.ChangeRequest, result: Result) -> None:
        with self._lock:
            for stage, seconds in result.seconds.items():
                self._times[stage].append(seconds)
            if isinstance(result.answer, protocol.Refused):
                self._note_refusal(edit.who, result.answer)
            elif result.commit is not None:
                self._edits += 1
                self._accepted.append(time.monotonic())

    def _note_refusal(self, who: str, answer: protocol.Refused) -> None:
        with self._lock:
            self._refusals.append(protocol.Refusal(time.time(), who, answer.message))
        _LOG.info("Refused an edit of %s: %s", who, answer.message)

    def _note_time(self, stage: str, begin: float) -> None:
        self._times[stage].append(time.perf_counter() - begin)

    def _refuse(self, request: Question, reason: protocol.Reason, error: Exception) -> None:
        request.answer(protocol.encode(protocol.Refused(reason, str(error)[:_LONGEST_MESSAGE])))

    # -- questions -----------------------------------------------------------------------------------------

    def _answer_questions(self, requests: Questions) -> None:
        for request in requests:
            try:
                answer = self._answer(self._admit(request)[0])
            except RefusedError as error:
                request.answer(protocol.encode(error.answer))
            except UnknownNameError as error:
                self._refuse(request, "unknown", error)
            except KineverseError as error:
                self._refuse(request, "malformed", error)
            except Exception as error:  # a defect of this package must not end the server
                _LOG.exception("A question could not be answered.")
                self._refuse(request, "failed", error)
            else:
                request.answer(protocol.encode(answer))

    def _answer(self, question: protocol.Request) -> protocol.Answer:
        match question:
            case protocol.JoinRequest():
                return self._join(question)
            case protocol.Since():
                return self._list_missed(question)
            case protocol.GetStatus():
                return self._status()
            case protocol.GetHistory():
                return self._list_history(question)
            case protocol.GetFile():
                data = self._authority.files.read(question.sha256, question.offset)
                if data is None:
                    return protocol.Refused("unknown", f"There is no file with SHA-256 {question.sha256}.")
                return protocol.FilePart(data)
            case protocol.GetBackup():
                return self._read_backup(question)
            case protocol.Announce():
                return self._announce(question)
            case _:
                raise FormatError("This is an edit, and is asked under another key.")

    def _join(self, join: protocol.JoinRequest) -> protocol.Answer:
        if join.protocol != protocol.PROTOCOL:
            return protocol.Refused(
                "protocol",
                f"{self.name!r} is served by Kineverse {__version__} (protocol {protocol.PROTOCOL}), and "
                f"this client is of {join.library} (protocol {join.protocol}). Update the older one.",
            )
        authority = self._authority
        with self._lock:
            if join.is_part:
                view = self._views.add(Wish(join.frames, join.symbols, join.bodies), again=join.again)
                entries, part, link = view.entries, view.id, view.log.link
            else:
                view, entries, part, link = None, tuple(authority.model.history.sequence), "", b""
            revision, chain, epoch = authority.revision, authority.chain, authority.epoch
            self._forget_client(join.client)
            self._clients[join.client] = _Client(join.who, view, revision)
        files = authority.files.find(entries)
        # Without folders, which are of no use elsewhere.
        document = pack_document([entry_to_bytes(entry, entries) for entry in entries])
        return protocol.Joined(self.name, __version__, epoch, revision, chain, part, document, files, link)

    def _list_missed(self, since: protocol.Since) -> protocol.Answer:
        authority = self._authority
        with self._lock:
            epoch, revision, chain = authority.epoch, authority.revision, authority.chain
            found: list[protocol.Published] | None = None
            if since.view:
                view = self._views.get(since.view) if since.client in self._clients else None
                if view is not None and authority.knows(since.revision, since.chain):
                    found = view.log.find_after(since.revision)
            else:
                stored = self._store.commits_after(since.revision, since.chain, MOST_MISSED)
                if stored is not None:
                    found = [protocol.Published(epoch, link, commit) for commit, link in stored]
            if found is None:
                return protocol.Refused("stale", "The server does not know this state; join again.")
            if since.client not in self._clients:
                self._clients[since.client] = _Client(since.who, None, since.revision)
            self._clients[since.client].note(since.revision)
        return protocol.Missed(epoch, revision, chain, tuple(found))

    def _status(self) -> protocol.Status:
        authority, now, ticks = self._authority, time.time(), time.monotonic()
        with self._lock:
            stages = [
                protocol.StageTime(stage, *np.percentile([*self._times[stage]], (50, 95)).tolist())
                for stage in STAGES
                if stage in self._times
            ]
            return protocol.Status(
                name=self.name,
                library=__version__,
                protocol=protocol.PROTOCOL,
                epoch=authority.epoch,
                process=os.getpid(),
                since=self._since,
                time=now,
                store=str(self._store.path or ""),
                durable=self._store.is_durable,
                revision=authority.revision,
                chain=authority.chain,
                operations=len(authority.model.history.sequence),
                frames=len(authority.model.frames),
                edits=self._edits,
                rate=sum(ticks - then < _MINUTE for then in self._accepted) / _MINUTE,
                stages=tuple(stages),
                clients=tuple(
                    protocol.ClientStatus(client, known.who, known.part, known.revision, ticks - known.heard)
                    for client, known in self._clients.items()
                ),
                sources=tuple(self._sources.values()),
                refusals=tuple(self._refusals),
            )

    def _list_history(self, question: protocol.GetHistory) -> protocol.CommitList:
        with self._lock:
            found = self._store.last_commits(question.most, question.before)
        rows = []
        for commit in map(protocol.decode_commit, found):
            changes = commit.changes
            put = [protocol.tag_of(placed) for placed in changes.put]
            known = {*changes.replaced, *changes.rerun}
            rows.append(
                protocol.HistoryRow(
                    commit.revision,
                    commit.time,
                    commit.who,
                    tuple(tag for tag in put if tag not in known),
                    changes.removed,
                    changes.replaced,
                    changes.moved,
                    changes.rerun,
                )
            )
        return protocol.CommitList(tuple(rows))

    def _read_backup(self, question: protocol.GetBackup) -> protocol.Answer:
        with self._lock:
            if not question.offset:
                self._drop_backup(question.client)
                beside = None if self._store.path is None else Path(self._store.path).parent
                folder = self._backups[question.client] = TemporaryDirectory(prefix=".backup-", dir=beside)
                self._store.backup(Path(folder.name, _BACKUP))
            if question.client not in self._backups:
                return protocol.Refused("unknown", "There is no copy of the store any more. Ask again.")
            with open(Path(self._backups[question.client].name, _BACKUP), "rb") as file:
                file.seek(question.offset)
                data = file.read(MAX_PART)
            if len(data) < MAX_PART:
                self._drop_backup(question.client)
        return protocol.FilePart(data)

    def _drop_backup(self, client: str) -> None:
        folder = self._backups.pop(client, None)
        if folder is not None:
            folder.cleanup()

    # -- who is there --------------------------------------------------------------------------------------

    def _announce(self, new: protocol.Announce) -> protocol.Done:
        with self._lock:
            self._sources.pop(new.source, None)
            if new.endpoint:
                about = new.source, new.endpoint, new.coordinates, new.offset, new.client
                self._sources[new.source] = protocol.SourceStatus(*about)
        self._publish_beat()
        return protocol.Done(time.time())

    def _watch_clients(self, presence: Iterable[tuple[str, bool]]) -> None:
        for key, is_there in presence:
            client = key.rpartition("/")[2]
            with self._lock:
                if is_there:
                    self._present.add(client)
                else:
                    self._present.discard(client)

    def _forget_absent(self) -> None:
        """Forget those without a sign of life at two beats: it may come late, or be lost shortly."""
        with self._lock:
            sources = {source.client for source in self._sources.values()}
            absent = {*self._clients, *self._backups, *sources} - self._present
            for client in absent & self._absent:
                self._forget(client)
            self._absent = absent

    def _forget(self, client: str) -> None:
        self._forget_client(client)
        self._drop_backup(client)
        for name in [s.source for s in self._sources.values() if s.client == client]:
            del self._sources[name]

    def _forget_client(self, client: str) -> None:
        known = self._clients.pop(client, None)
        if known is not None and known.view is not None:
            self._views.release(known.view)

    def _note_seen(self, messages: Iterable[bytes]) -> None:
        for data in messages:
            with suppress(FormatError):
                seen = protocol.decode_seen(data)
                with self._lock:
                    if seen.client in self._clients:
                        self._clients[seen.client].note(seen.revision)

    def _beat(self) -> None:
        while not self._closed.wait(BEAT):
            self._forget_absent()
            self._publish_beat()

    def _publish_beat(self) -> None:
        authority = self._authority
        with self._lock:
            beat = protocol.Beat(
                authority.epoch,
                authority.revision,
                authority.chain,
                {view.id: view.log.last for view in self._views},
                tuple(self._sources.values()),
            )
        self._transport.publish(self._key("beat"), protocol.encode(beat))

    def _key(self, end: str) -> str:
        return f"kineverse/{self.name}/{end}"


class _Client:
    """Client that has joined, the part that it has, and the revision that it has told of."""

    def __init__(self, who: str, view: View | None, revision: int) -> None:
        self.who, self.view = who, view
        self.note(revision)

    @property
    def part(self) -> str:
        """Identifier of the part; empty for the whole model."""
        return "" if self.view is None else self.view.id

    def note(self, revision: int) -> None:
        """Note a revision that the client has got."""
        self.revision, self.heard = revision, time.monotonic()
