"""Messages between a model server and its clients, in msgpack; ``docs/protocol.md`` says what they mean.

A message is the list of its fields. Operations are blobs, as in documents. A request goes to the key
``kineverse/NAME/edit`` if it changes the model, else to ``kineverse/NAME/ask``; that of a user with a
certificate to ``edit`` and ``ask`` below ``kineverse/NAME/user/USER``. The answer is one message. Commits are
published under ``kineverse/NAME/log``, and those that concern a part of the model under
``kineverse/NAME/view/ID``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Annotated, Any, Final, Generic, Literal, TypeAlias, TypeVar

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace

from kineverse.errors import FormatError
from kineverse.formats import entry_to_bytes, operation_from_bytes
from kineverse.model.commits.net_changes import NetChanges, PlacedEntry
from kineverse.model.history import HistoryEntry

PROTOCOL: Final = 1
MAX_BYTES: Final = 1 << 26  # largest message [byte]; files are sent in parts
MAX_OPERATIONS: Final = 100_000  # most operations in the changes of one edit
MAX_LISTED: Final = 10_000  # most commits in one listing

Id: TypeAlias = Annotated[str, Meta(pattern="^[0-9a-f]{32}$", max_length=32)]
Name: TypeAlias = Annotated[str, Meta(min_length=1, max_length=4096)]
Text: TypeAlias = Annotated[str, Meta(max_length=1 << 16)]
MAX_REVISION: Final = (1 << 62) - 1
Revision: TypeAlias = Annotated[int, Meta(ge=0, le=MAX_REVISION)]
Number: TypeAlias = Annotated[int, Meta(ge=0, lt=1 << 62)]
Seconds: TypeAlias = Annotated[float, Meta(ge=-1e300, le=1e300)]
Chain: TypeAlias = Annotated[bytes, Meta(min_length=32, max_length=32)]
Link: TypeAlias = Annotated[bytes, Meta(max_length=32)]
Sha256: TypeAlias = Annotated[str, Meta(pattern="^[0-9a-f]{64}$", max_length=64)]
Tags: TypeAlias = Annotated[tuple[Name, ...], Meta(max_length=MAX_OPERATIONS)]

_LONGEST_WHO: Final = 200  # letters of what the client of a user says of itself
NO_CHAIN: Final = bytes(32)  # digest before the first commit


class _Message(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Message or part of one."""


# -- commits -------------------------------------------------------------------------------------------------


class Placed(_Message, frozen=True):
    """Blob of an operation that is put, and its place: after an operation, and at the end of all if it was.

    ``after`` is the tag of the operation before it, empty at the beginning.
    """

    blob: bytes
    after: str = ""
    at_end: bool = False


class Changes(_Message, frozen=True):
    """Net changes of an edit, see :class:`kineverse.model.NetChanges`."""

    put: Annotated[tuple[Placed, ...], Meta(max_length=MAX_OPERATIONS)] = ()
    replaced: Tags = ()
    rerun: Tags = ()
    moved: Tags = ()
    removed: Tags = ()


class MeshContent(_Message, frozen=True):
    """Digest and size of the file of a mesh, by the operation and the place among its meshes."""

    tag: Name
    index: Number
    sha256: Sha256
    size: Number


class CommitMessage(_Message, frozen=True):
    """Commit of an edit, as it is kept in the log and published.

    ``previous`` is the revision of the last commit before it that the reader has got: of the log, or of its
    part of the model. ``client`` and ``number`` identify the edit, ``who`` names the client for people.
    """

    revision: Revision
    previous: Revision
    client: Id
    number: Number
    who: Text
    time: Seconds  # seconds since 1970 on the clock of the server
    changes: Changes
    files: tuple[MeshContent, ...] = ()


class Published(_Message, frozen=True):
    """Commit as bytes with the digest of all commits up to it, and the run of the server that made it.

    ``link`` is the digest of the commits of a part up to this one, since it is followed; empty for the whole.
    """

    epoch: Id
    chain: Chain
    commit: bytes
    link: Link = b""


# -- requests ------------------------------------------------------------------------------------------------


class EditRequest(_Message, frozen=True, tag="edit"):
    """Edit of a client, made at the revision ``base`` with its chain; asked twice, it is answered alike.

    A ``strict`` edit is refused if anything has changed since its base.
    """

    client: Id
    number: Number
    who: Text
    base: Revision
    chain: Chain
    changes: Changes
    strict: bool = False
    files: tuple[MeshContent, ...] = ()


class UndoRequest(_Message, frozen=True, tag="undo"):
    """Take back the commit of a revision, as an edit like any other."""

    client: Id
    number: Number
    who: Text
    revision: Revision


class JoinRequest(_Message, frozen=True, tag="join"):
    """Ask for the model, or for the part of it that frames and symbols need.

    One who has had the part, ``again``, gets what is left of it; otherwise unknown names are refused.
    """

    protocol: int
    library: Text  # version of Kineverse
    client: Id
    who: Text
    frames: tuple[Text, ...] = ()
    symbols: tuple[Text, ...] = ()
    bodies: bool = True
    is_part: bool = False
    again: bool = False


class Since(_Message, frozen=True, tag="since"):
    """Ask for the commits after a revision, to close a gap; ``view`` is empty for the whole model."""

    client: Id
    who: Text
    view: str
    revision: Revision
    chain: Chain


class GetStatus(_Message, frozen=True, tag="status"):
    """Ask how the server is."""


class GetHistory(_Message, frozen=True, tag="history"):
    """Ask for the last commits, newest first, from a revision on backwards."""

    most: Annotated[int, Meta(ge=1, le=MAX_LISTED)] = 20
    before: Revision = MAX_REVISION


class GetFile(_Message, frozen=True, tag="file"):
    """Ask for a part of a file by the digest of its content."""

    sha256: Sha256
    offset: Number = 0


class GetBackup(_Message, frozen=True, tag="backup"):
    """Ask for a part of a copy of the store, which is made at the offset 0 and kept until the last part.

    That is the first one with less than 2**24 bytes.
    """

    client: Id
    offset: Number = 0


class Announce(_Message, frozen=True, tag="announce"):
    """Announce a source of state: where it listens, the coordinates of its vectors, and its clock.

    ``offset`` is what is to be added to its stamps to get the time of the server. An empty endpoint ends it.
    """

    client: Id
    source: Name
    endpoint: Text
    coordinates: Tags
    offset: Seconds = 0.0


ChangeRequest: TypeAlias = EditRequest | UndoRequest
Request: TypeAlias = (
    ChangeRequest | JoinRequest | Since | GetStatus | GetHistory | GetFile | GetBackup | Announce
)


def name_asker(request: Request, user: str) -> Request:
    """Return a request under the identity and the name of a user, whatever it says of its sender."""
    named: dict[str, str] = {}
    if hasattr(request, "client"):
        named["client"] = identity_of(user, request.client)
    if hasattr(request, "who"):
        said = "".join(filter(str.isprintable, request.who))
        named["who"] = f"{user}, {said[:_LONGEST_WHO]}"
    return replace(request, **named)


def identity_of(user: str, client: str) -> str:
    """Return the identity of a client: its own, or of a user's, one that no other user's client can have."""
    return hashlib.sha256(f"{user}/{client}".encode()).hexdigest()[:32] if user else client


# -- answers -------------------------------------------------------------------------------------------------

Reason: TypeAlias = Literal[
    "conflict", "refused", "forbidden", "stale", "protocol", "malformed", "unknown", "failed"
]


class Committed(_Message, frozen=True, tag="committed"):
    """The edit is on disk as a revision; without an effect it is the present one."""

    revision: Revision
    chain: Chain


class Refused(_Message, frozen=True, tag="refused"):
    """Nothing was done.

    Reasons: ``conflict`` with a commit after the base (tag, path, revision and who made it are named),
    ``refused`` by the model, ``forbidden`` by the right of the user (tag and path are named), ``stale``: the
    server does not know the state of the client, which has to join again, another ``protocol``, a
    ``malformed`` message, an ``unknown`` name, or the server has ``failed``.
    """

    reason: Reason
    message: Text
    tag: str = ""
    path: str = ""
    revision: Revision = 0
    who: str = ""


class Joined(_Message, frozen=True, tag="joined"):
    """The model or a part of it, as a document in msgpack; ``view`` and ``link`` identify the part."""

    name: str
    library: Text
    epoch: Id
    revision: Revision
    chain: Chain
    view: str
    document: bytes
    files: tuple[MeshContent, ...] = ()
    link: Link = b""


class Missed(_Message, frozen=True, tag="missed"):
    """Commits after a revision, in order, and the present revision."""

    epoch: Id
    revision: Revision
    chain: Chain
    commits: tuple[Published, ...]


class StageTime(_Message, frozen=True):
    """Time of a stage of the server's work on an edit [s]: of 50 and 95 % of the last ones."""

    name: str
    p50: float
    p95: float


class ClientStatus(_Message, frozen=True):
    """Client of a server; ``revision`` is the last one that it has told of, ``seconds`` how long ago."""

    client: Id
    who: Text
    view: str
    revision: Revision
    seconds: float


class SourceStatus(_Message, frozen=True):
    """Source of state: where it listens, its coordinates, and the offset of its clock [s]."""

    source: str
    endpoint: str
    coordinates: tuple[str, ...]
    offset: float
    client: Id


class Refusal(_Message, frozen=True):
    """Edit that was refused: when, whose, and why."""

    time: Seconds
    who: Text
    message: Text


class Status(_Message, frozen=True, tag="status"):
    """State of a server, for people."""

    name: str
    library: str
    protocol: int
    epoch: Id
    process: int
    since: Seconds
    time: Seconds  # the clock of the server
    store: str  # path; empty if it is kept in memory only
    durable: bool
    revision: Revision
    chain: Chain
    operations: int
    frames: int
    edits: int  # accepted since the start
    rate: float  # accepted edits per second in the last minute
    stages: tuple[StageTime, ...]
    clients: tuple[ClientStatus, ...]
    sources: tuple[SourceStatus, ...]
    refusals: tuple[Refusal, ...]


class HistoryRow(_Message, frozen=True):
    """Commit in a listing."""

    revision: Revision
    time: Seconds
    who: Text
    added: tuple[str, ...]
    removed: tuple[str, ...]
    replaced: tuple[str, ...]
    moved: tuple[str, ...]
    rerun: tuple[str, ...]


class CommitList(_Message, frozen=True, tag="history"):
    """Commits, newest first."""

    rows: tuple[HistoryRow, ...]


class FilePart(_Message, frozen=True, tag="file"):
    """Part of a file, or of the copy of a store."""

    data: bytes


class Done(_Message, frozen=True, tag="done"):
    """The request was carried out; ``time`` is the clock of the server [s since 1970]."""

    time: Seconds


Answer: TypeAlias = Committed | Refused | Joined | Missed | Status | CommitList | FilePart | Done

# -- signals -------------------------------------------------------------------------------------------------


class Seen(_Message, frozen=True):
    """Revision that a client has got, told from time to time."""

    client: Id
    revision: Revision


class Beat(_Message, frozen=True):
    """Sign of life with the present revision and, by view, the last one that concerns it."""

    epoch: Id
    revision: Revision
    chain: Chain
    views: dict[str, Revision]
    sources: tuple[SourceStatus, ...] = ()


# -- bytes ---------------------------------------------------------------------------------------------------

_ENCODE = msgspec.msgpack.Encoder().encode

M = TypeVar("M")


def encode(message: Struct) -> bytes:
    """Return a message as bytes."""
    return _ENCODE(message)


class Decoder(Generic[M]):
    """Decoder of messages of a type, which refuses all others with one error."""

    def __init__(self, kind: Any, what: str) -> None:
        self._decode = msgspec.msgpack.Decoder(kind).decode
        self._what = what

    def __call__(self, data: bytes) -> M:
        """Return the message in some bytes.

        Raises
        ------
        FormatError
            If they are none of the type, or too many.
        """
        if len(data) > MAX_BYTES:
            raise FormatError(f"{self._what} of {len(data)} bytes; the most is {MAX_BYTES}.")
        try:
            return self._decode(data)  # type: ignore[no-any-return]
        except (msgspec.MsgspecError, ValueError, OverflowError, RecursionError) as error:
            raise FormatError(f"{self._what} that is no message of this protocol: {error}.") from None


decode_request: Decoder[Request] = Decoder(Request, "A request")
decode_answer: Decoder[Answer] = Decoder(Answer, "An answer")
decode_commit: Decoder[CommitMessage] = Decoder(CommitMessage, "A commit")
decode_published: Decoder[Published] = Decoder(Published, "A commit")
decode_beat: Decoder[Beat] = Decoder(Beat, "A sign of life")
decode_seen: Decoder[Seen] = Decoder(Seen, "A sign of life")


class _Tagged(Struct, frozen=True):
    tag: str


_decode_tag = msgspec.msgpack.Decoder(_Tagged).decode


def tag_of(placed: Placed) -> str:
    """Return the tag of an operation from a blob that was checked."""
    return _decode_tag(placed.blob).tag


def encode_changes(net: NetChanges, sequence: Sequence[HistoryEntry]) -> Changes:
    """Return net changes as a message; the sequence is that of the edited model."""
    put = tuple(Placed(entry_to_bytes(one.entry, sequence), one.after or "", one.at_end) for one in net.put)
    return Changes(put, net.replaced, net.rerun, net.moved, net.removed)


def decode_changes(changes: Changes) -> NetChanges:
    """Return the net changes in a message; a blob that is none is a FormatError."""
    put = tuple(PlacedEntry(operation_from_bytes(p.blob), p.after or None, p.at_end) for p in changes.put)
    return NetChanges(put, changes.replaced, changes.rerun, changes.moved, changes.removed)


def chain(previous: bytes, commit: bytes) -> bytes:
    """Return the digest of a sequence of commits with one more: equal only for equal sequences."""
    return hashlib.sha256(previous + commit).digest()
