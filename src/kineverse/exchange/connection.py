"""Connection of a client to a model server: requests, their answers, and signs of life."""

from __future__ import annotations

import getpass
import os
import socket
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterable
from contextlib import closing, suppress
from functools import cache
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from msgspec.structs import replace

from kineverse._checks import as_count, finite_number
from kineverse.errors import (
    DuplicateNameError,
    ForbiddenError,
    FormatError,
    InvalidValueError,
    OfflineError,
    UnknownNameError,
)
from kineverse.symbols import Symbol

from . import protocol
from .address import Address, list_endpoints
from .meshes import MAX_PART
from .state import StatePublisher, StateReader
from .store import Store
from .transport import LONGEST, SLOWEST, NoAnswerError, Transport, check_not_forked

if TYPE_CHECKING:
    from .keys import Keys

PATIENCE = 10.0  # time that an edit waits for a server that went away, before it is given up [s]
_ASK_TIMEOUT = 5.0
_PAUSE = 0.005
_ROUTING = 0.5
_LOOKING = 2.0  # longest time to find out whether a server that does not answer is there [s]
_SETTLING = 1.0  # time in which sources announce themselves to a server that has started [s]

A = TypeVar("A")


class Connection:
    """Connection of a live model to its server, under the identity of one client: ``model.exchange``.

    Attributes
    ----------
    address
        Address of the server.
    user
        Name of the user in the certificate; empty on the server's computer.
    client
        Identity of this client, 32 hexadecimal digits.
    who
        Name of this client for people: user, computer, program and process.
    epoch
        Identity of the present run of the server.
    revision, chain
        Revision up to which the model has everything, and the digest of all commits up to it.
    is_online
        False while the server is away.
    sources
        Sources of state that the server has announced.

    Examples
    --------
    >>> server = kv.exchange.serve("kitchen", name="doc-connection")
    >>> model = kv.load(server.address)
    >>> model.exchange.is_online, model.exchange.revision == model.version
    (True, True)
    >>> [row.revision for row in model.exchange.history(most=1)]
    [1]
    >>> model.close()
    >>> server.close()
    """

    def __init__(self, address: Address) -> None:
        self.address = address
        self.client = uuid.uuid4().hex
        self.who = describe_client()
        self.epoch, self.revision, self.chain = "", 0, protocol.NO_CHAIN
        self.is_online, self.is_closed = True, False
        self.sources: tuple[protocol.SourceStatus, ...] = ()
        self._publishers: list[StatePublisher] = []
        self._readers: list[StateReader] = []
        self._heard, self._settled = "", 0.0
        self._numbers = count(1)
        self._told = -1
        self._changed = threading.Condition()
        self._keys: Keys | None = None
        if address.is_secured:
            from .keys import Keys  # for those who have no need of the package cryptography

            self._keys = Keys.read()
        self.user = "" if self._keys is None else self._keys.user
        self.transport = self._connect()
        self._identity = protocol.identity_of(self.user, self.client)  # to the server
        self._presence = self.transport.alive(self.key(f"client/{self._identity}"))

    def _connect(self) -> Transport:
        endpoint, secret = self.address.find()
        try:
            return Transport.connect(endpoint, secret, keys=self._keys)
        except NoAnswerError:
            pass
        if self._keys is None:
            raise OfflineError(
                f"No model server answers at {endpoint}. Start it, or mend the address {str(self.address)!r}."
            )
        from .keys import explain_refusal

        reasons = "; ".join(explain_refusal(one, self._keys) for one in list_endpoints(endpoint))
        raise OfflineError(f"There is no connection with {self.address}. {reasons}.")

    def close(self) -> None:
        """End the connection; the model can still be read. A second call has no effect."""
        self.is_closed = True
        self.note_presence(False)
        for reader in self._readers:
            reader.close()
        for publisher in list(self._publishers):
            publisher.close()
        self.transport.close()

    # -- questions to the server ---------------------------------------------------------------------------

    def status(self) -> protocol.Status:
        """Return how the server is: rates, times, clients, sources and the last refusals."""
        return self.ask(protocol.GetStatus(), protocol.Status)

    def history(self, most: int = 20, before: int | None = None) -> tuple[protocol.HistoryRow, ...]:
        """Return the last commits, newest first, from before a revision if one is given."""
        number = min(as_count("most", most, 1), protocol.MAX_LISTED)
        end = protocol.MAX_REVISION if before is None else as_count("before", before, 0)
        asked = protocol.GetHistory(number, min(end, protocol.MAX_REVISION))
        return self.ask(asked, protocol.CommitList).rows

    def backup(self, path: str | os.PathLike[str]) -> Store:
        """Write a copy of the server's store into a new file, checked, and return it, closed.

        Raises
        ------
        DuplicateNameError
            If there is a file already.
        FormatError
            If the file cannot be written, or the server cannot make a copy.
        """
        path = Path(path)
        if os.path.lexists(path):
            raise DuplicateNameError(f"{path} exists already. Name a new file for the backup.")
        part = path.with_name(f".{path.name[:100]}.{uuid.uuid4().hex}")
        try:
            with part.open("xb") as file:
                size = MAX_PART
                while size == MAX_PART:
                    asked = protocol.GetBackup(self.client, file.tell())
                    size = file.write(self.ask(asked, protocol.FilePart, LONGEST).data)
                file.flush()
                os.fsync(file.fileno())
            with closing(Store(part)) as store:
                pass
            part.rename(path)
            return store
        except OSError as error:
            raise FormatError(f"{path} cannot be written: {error.strerror}.") from None
        finally:
            part.unlink(missing_ok=True)

    # -- state ---------------------------------------------------------------------------------------------

    def publisher(
        self,
        source: str,
        coordinates: Iterable[Symbol | str],
        *,
        offset: float = 0.0,
        answer: Callable[[bytes], bytes] | None = None,
    ) -> StatePublisher:
        """Return a new source of state, which the readers of all clients find. It ends with this connection.

        Parameters and errors are those of :class:`.StatePublisher`; the model need not have the coordinates.
        A server that is away is an OfflineError, and an offset that is no finite number an InvalidValueError.
        """
        self.check_online()
        seconds = finite_number(offset)
        if seconds is None:
            raise InvalidValueError(f"The offset of a source is a time in seconds, not {offset!r}.")
        publisher = StatePublisher(
            self.address.name,
            source,
            coordinates,
            server=self.transport,
            direct=not self.address.endpoint,
            announce=self._announce,
            offset=seconds,
            answer=answer,
        )
        self._publishers.append(publisher)
        try:
            self._announce(publisher)
        except BaseException:
            publisher.close()
            raise
        return publisher

    def reader(self, coordinates: Iterable[Symbol | str] = ()) -> StateReader:
        """Return a reader of the newest state of all sources, those that come later included.

        Coordinates and errors are those of :class:`.StateReader`. A server that is away is an OfflineError.
        """
        self.check_online()
        reader = StateReader(
            self.address.name, coordinates, server=self.transport, direct=not self.address.endpoint
        )
        reader.follow(self.status().sources)
        self._readers.append(reader)
        return reader

    def _announce(self, publisher: StatePublisher) -> None:
        """Tell the server of a source, or that it has ended; one who is away is told when it is back."""
        source, endpoint = publisher.source, publisher.endpoint
        if publisher.is_closed:
            self._publishers.remove(publisher)
            endpoint = ""
        with suppress(OfflineError):
            self.ask(
                protocol.Announce(self.client, source, endpoint, publisher.coordinates, publisher.offset),
                protocol.Done,
            )

    def _take_sources(self, beat: protocol.Beat) -> None:
        """Follow the sources that the server knows; one that has just started does not know them all yet."""
        now, listed = time.monotonic(), {status.source for status in beat.sources}
        if beat.epoch != self._heard:
            self._heard, self._settled = beat.epoch, now + _SETTLING
        kept = [] if now > self._settled else [one for one in self.sources if one.source not in listed]
        self.sources = (*kept, *beat.sources)
        self._readers = [reader for reader in self._readers if not reader.is_closed]
        for reader in self._readers:
            reader.follow(self.sources)
        for publisher in list(self._publishers):
            if publisher.source not in listed:
                self._announce(publisher)

    # -- for the live model --------------------------------------------------------------------------------

    @property
    def position(self) -> tuple[int, bytes]:
        """Revision and digest, together."""
        with self._changed:
            return self.revision, self.chain

    def key(self, end: str) -> str:
        """Return a key of the server."""
        return f"kineverse/{self.address.name}/{end}"

    def next_number(self) -> int:
        """Return the number of a new edit of this client."""
        return next(self._numbers)

    def check_open(self) -> None:
        """Raise an OfflineError if the connection was closed, or is that of the parent of a fork."""
        check_not_forked()
        if self.is_closed:
            raise OfflineError(
                f"The connection to {self.address} was closed, or its model was not kept; load it again."
            )

    def check_online(self) -> None:
        """Raise an OfflineError if the server is away."""
        self.check_open()
        if not self.is_online:
            if self._keys is not None and self._keys.has_ended:
                raise OfflineError(f"{self._keys.certificate} has expired: ask for new keys, and load again.")
            raise OfflineError(
                f"The server of {self.address} is away. The model can be read, and edited when it is back."
            )

    def join(self, wish: protocol.JoinRequest) -> protocol.Joined:
        """Join and return the model, or the part that is wished for."""
        return self.ask(replace(wish, client=self.client, who=self.who), protocol.Joined, LONGEST)

    def ask_missed(self, view: str) -> protocol.Missed | None:
        """Ask for the commits after the present revision; None if the server does not know this state."""
        answer = self._ask(protocol.Since(self.client, self.who, view, *self.position), LONGEST)
        if isinstance(answer, protocol.Missed):
            return answer
        if isinstance(answer, protocol.Refused) and answer.reason == "stale":
            return None
        raise refusal_error(answer, self.address)

    def fetch_part(self, sha256: str, offset: int) -> bytes | None:
        """Return a part of a file; None if the server does not have it."""
        try:
            return self.ask(protocol.GetFile(sha256, offset), protocol.FilePart, LONGEST).data
        except UnknownNameError:
            return None

    def accept(self, joined: protocol.Joined) -> None:
        """Take over where the model is that the server has sent."""
        self.epoch = joined.epoch
        self.advance(joined.revision, joined.chain)
        self.note_presence(True)

    def advance(self, revision: int, chain: bytes) -> None:
        """Note the revision that the model has."""
        with self._changed:
            self.revision, self.chain = revision, chain
            self._changed.notify_all()

    def note_presence(self, is_online: bool) -> None:
        """Note whether the server is there."""
        with self._changed:
            self.is_online = is_online and not self.is_closed
            self._changed.notify_all()

    def hear(self, beat: protocol.Beat) -> None:
        """Take the sources of state from a sign of life, and tell the server what this client has."""
        self._take_sources(beat)
        if self.revision != self._told:
            self._told = self.revision
            self.transport.publish(
                self.key("seen"), protocol.encode(protocol.Seen(self._identity, self._told))
            )

    def wait_for(self, is_done: Callable[[], bool], timeout: float | None) -> bool:
        """Wait until something is so, which is looked at when the model or the connection changes."""
        with self._changed:
            return self._changed.wait_for(is_done, timeout)

    def wait_to_follow(self, revision: int) -> None:
        """Wait until the model is at a revision, as long as the server is there."""
        self.wait_for(lambda: self.revision >= revision or not self.is_online, None)

    def ask(self, request: protocol.Request, kind: type[A], timeout: float = _ASK_TIMEOUT) -> A:
        """Ask once and return the answer, which is of a kind.

        Raises
        ------
        OfflineError
            Without an answer in time.
        UnknownNameError
            For a name that the server does not know.
        FormatError
            For any other refusal, or an answer that is none.
        """
        answer = self._ask(request, timeout)
        if isinstance(answer, kind):
            return answer
        raise refusal_error(answer, self.address)

    def ask_edit(self, edit: protocol.ChangeRequest) -> protocol.Committed | protocol.Refused:
        """Ask for an edit until it is answered: under its number it is done once.

        Raises
        ------
        OfflineError
            If the server stays away: the edit may be stored, or not.
        """
        end = time.monotonic() + PATIENCE
        while True:
            try:
                answer = self._ask(edit, _ASK_TIMEOUT)
            except OfflineError:
                if self.is_online:  # it is still at work
                    end = time.monotonic() + PATIENCE
                if self.is_closed or time.monotonic() >= end:
                    raise OfflineError(
                        f"The server {self.address.name!r} has not answered for {PATIENCE:g} s. Whether the "
                        "edit is stored is not known: look at the model when the server is back."
                    ) from None
                time.sleep(_PAUSE)
                continue
            if isinstance(answer, (protocol.Committed, protocol.Refused)):
                return answer
            raise refusal_error(answer, self.address)

    def _ask(self, request: protocol.Request, timeout: float) -> protocol.Answer:
        self.check_open()
        changes_model = isinstance(request, (protocol.EditRequest, protocol.UndoRequest))
        data = protocol.encode(request)
        if len(data) > protocol.MAX_BYTES:
            raise FormatError(
                f"This takes a message of {len(data) / 1e6:.0f} MB, and the most is "
                f"{protocol.MAX_BYTES / 1e6:.0f} MB. Split it into several edits."
            )
        way = f"user/{self.user}/" if self.user else ""
        key, end = (
            self.key(way + ("edit" if changes_model else "ask")),
            time.monotonic() + min(timeout, _ROUTING),
        )
        # So that edits overtake what is long, on the slow connection of a site as well.
        gives_way = not changes_model or len(data) > MAX_PART
        while True:
            try:
                answer = self.transport.ask(key, data, timeout + len(data) / SLOWEST, gives_way=gives_way)
                return protocol.decode_answer(answer)
            except NoAnswerError:
                # For moments after a connection was made it is not known who answers.
                if not self.is_online or time.monotonic() >= end:
                    raise OfflineError(self._explain_silence()) from None
                time.sleep(_PAUSE)

    def _explain_silence(self) -> str:
        server = f"The server {self.address.name!r}"
        end = time.monotonic() + (_LOOKING if self.user and self.is_online else 0.0)
        is_there = False
        # For moments after a connection was made, nobody is seen.
        while not is_there and time.monotonic() < end:
            is_there = self.transport.is_alive(self.key("alive/*"), _LOOKING)
            time.sleep(0.0 if is_there else _PAUSE)
        if is_there:
            return (
                f"{server} is there, and does not answer the user {self.user!r}: rights.toml of the server, "
                "or of the relay, does not name this user, or has been changed since the start."
            )
        return f"{server} does not answer. Look if it runs, by that name."


def refusal_error(answer: object, address: Address) -> Exception:
    """Return the error for an answer that is a refusal, or of another kind than was asked for."""
    if not isinstance(answer, protocol.Refused):
        return FormatError(f"{address} answered with a {type(answer).__name__}, which was not asked for.")
    kinds: dict[str, type[Exception]] = {"unknown": UnknownNameError, "forbidden": ForbiddenError}
    return kinds.get(answer.reason, FormatError)(answer.message)


@cache
def describe_client() -> str:
    """Return the name of this process for people: user, computer, program and number."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):
        user = str(os.getuid()) if hasattr(os, "getuid") else "somebody"
    path = Path(sys.argv[0] if sys.argv and sys.argv[0] != "-c" else "")
    program = (path.parent if path.name == "__main__.py" else path).name or "python"
    return f"{user}@{socket.gethostname()} {program} {os.getpid()}"
