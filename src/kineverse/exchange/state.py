"""State beside the model: vectors of values that sources send and readers merge, without a server's work.

A source has a layout, the coordinates of its vectors. A message is a header, with the digest of the layout,
the values as doubles, and a note: bytes for what is no number. Readers know layouts from the server's list of
sources, or ask the source for them.
On the server's computer a source listens at a socket of its own, ``NAME@SOURCE.sock`` beside the server's, so
its stream goes on when the server ends. Everybody else sends and reads through the server, and waits for it.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import secrets
import struct
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from kineverse._checks import as_entries, as_tolerance, finite_number
from kineverse._runtime import Closing
from kineverse.errors import (
    DuplicateNameError,
    InvalidValueError,
    KineverseError,
    OfflineError,
    ShapeError,
)
from kineverse.lie import Array
from kineverse.state import State
from kineverse.symbols import Symbol, parse_symbol_name

from .address import UNIX_SOCKETS, Claim, check_server_name
from .protocol import SourceStatus
from .transport import Messages, NoAnswerError, Questions, Transport

THROUGH_SERVER: Final = "server"  # endpoint of sources that send through the model server only

_HEADER: Final = struct.Struct("<QQQdd")  # layout, run, number, stamp, time of sending
_VALUE: Final = np.dtype("<f8")
_RETRY_SECONDS: Final = 0.1
_ASK_SECONDS: Final = 1.0
_MOST_LAYOUTS: Final = 16


class StatePublisher(Closing):
    """Source of state: it sends vectors of values.

    Parameters
    ----------
    name
        Name of the model server.
    source
        Name of the source: letters, digits, ``_``, ``.`` and ``-``.
    coordinates
        Symbols, or their names, of the values in a vector.
    server
        Connection to the model server, by which its other clients are reached.
    direct
        Whether the server is on this computer, so that a socket beside it can be found.
    announce
        Function that tells the server of this source: called with it when there are other coordinates, and
        when it is closed.
    offset
        What is to be added to its stamps to get the time of the server [s].
    answer
        Function that answers questions of readers, see :meth:`StateReader.ask`; it is called in a thread of
        its own with bytes, and returns bytes.

    Attributes
    ----------
    source, offset, is_closed
        Name of the source, offset of its clock [s], and whether it has ended.
    endpoint
        Where it listens, to be announced to the server; :data:`THROUGH_SERVER` without a socket of its own.
        The stream then ends with the server, and goes on when that is back.

    Raises
    ------
    DuplicateNameError
        If a coordinate is given twice, or another process of this computer sends under the same name.
    InvalidValueError
        For a source that cannot have that name, or that has neither a server nor a socket.

    Examples
    --------
    >>> server = kv.exchange.serve("kitchen", name="doc-publisher")
    >>> model = kv.load(server.address)
    >>> source = model.exchange.publisher("encoders", ["kitchen/fridge_door", "kitchen/oven_door"])
    >>> source.put([0.5, 0.0], stamp=12.0)
    >>> model.close()
    >>> server.close()
    """

    def __init__(
        self,
        name: str,
        source: str,
        coordinates: Iterable[Symbol | str],
        *,
        server: Transport | None = None,
        direct: bool = True,
        announce: Callable[[StatePublisher], None] = lambda _: None,
        offset: float = 0.0,
        answer: Callable[[bytes], bytes] | None = None,
    ) -> None:
        self.source, self.offset, self.is_closed, self._announce = source, offset, False, announce
        self._layout = _Layout.make(coordinates)
        self._key = _key(name, check_server_name(source, "source"))
        self._run, self._number, self._lock = secrets.randbits(64), 0, threading.Lock()
        self._claim = Claim(name, source) if direct and UNIX_SOCKETS else None
        self._own: Transport | None = None
        self.endpoint = THROUGH_SERVER
        if self._claim is not None:
            self.endpoint = self._claim.endpoint
            try:
                self._own = Transport.serve([self.endpoint])
            except BaseException:
                self._claim.release()
                raise
        elif server is None:
            raise InvalidValueError(f"The source {source!r} has neither a socket nor a server to send by.")
        self._transports = [transport for transport in (self._own, server) if transport is not None]
        answers: dict[str, Callable[[bytes], bytes]] = {"layout": self._tell_layout}
        if answer is not None:
            answers["ask"] = answer
        self._asked: list[Questions] = []
        for (end, function), transport in product(answers.items(), self._transports):
            self._asked.append(requests := transport.answers(f"{self._key}/{end}"))
            threading.Thread(target=_answer, args=(requests, function), daemon=True).start()

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the values in a vector, in order."""
        return self._layout.names

    def set_coordinates(self, coordinates: Iterable[Symbol | str]) -> None:
        """Send other values from the next vector on; readers take them over with it.

        Raises
        ------
        DuplicateNameError
            If one is given twice.
        """
        self._layout = _Layout.make(coordinates)
        self._announce(self)

    def put(self, values: ArrayLike, stamp: float | None = None, note: bytes = b"") -> None:
        """Send a vector; it waits for nobody.

        Parameters
        ----------
        values
            Values of the coordinates, shape (n,): [m], [rad] and their rates by time.
        stamp
            Time of the values by the source's clock [s]; the time of this computer unless given.
        note
            What else is to be said, in an encoding of the source's own.

        Raises
        ------
        ShapeError
            If there are more or fewer values than coordinates.
        InvalidValueError
            If a value, or the stamp, is NaN or infinite.
        OfflineError
            If the source has ended: a source ends with its model.
        """
        if self.is_closed:
            raise OfflineError(f"The source {self.source!r} was closed, or its model was. Make another one.")
        layout, now = self._layout, time.time()
        vector = np.asarray(values, dtype=_VALUE)
        if vector.shape != (len(layout.names),):
            raise ShapeError(
                f"The vector has shape {vector.shape}, and the source {len(layout.names)} coordinates."
            )
        finite = np.isfinite(vector)
        if not finite.all():
            bad = [f"'{layout.names[index]}'" for index in np.flatnonzero(~finite)[:12]]
            raise InvalidValueError(f"The value of {', '.join(bad)} is NaN or infinite; nothing is sent.")
        time_of_values = now if stamp is None else finite_number(stamp)
        if time_of_values is None:
            raise InvalidValueError(f"The stamp of a vector is a time in seconds, not {stamp!r}.")
        body = vector.tobytes() + note
        with self._lock:
            self._number += 1
            message = _HEADER.pack(layout.digest, self._run, self._number, time_of_values, now) + body
            for transport in self._transports:
                transport.publish(self._key, message)

    def close(self) -> None:
        """End the stream, and give the name of the source back. A second call has no effect."""
        if self.is_closed:
            return
        self.is_closed, self._transports = True, []
        for requests in self._asked:
            requests.close()
        if self._own is not None and self._claim is not None:
            self._own.close()
            self._claim.release()
        self._announce(self)

    def _tell_layout(self, _: bytes) -> bytes:
        return msgspec.msgpack.encode(self._layout.names)


class Newest(NamedTuple):
    """Newest vector of a source.

    See Also
    --------
    kineverse.exchange.StateReader
    """

    names: tuple[str, ...]  # of its coordinates
    values: Array  # their values (n,): [m], [rad] and their rates by time
    stamp: float  # time of the values by the source's clock [s]
    note: bytes  # what the source has said beside it
    arrival: float  # time at which it came in, by the clock that only counts [s]

    @property
    def named(self) -> dict[str, float]:
        """The values by name."""
        return dict(zip(self.names, self.values.tolist(), strict=True))


class StateReader(Closing):
    """Newest values of all sources that it follows, merged by coordinate.

    If several sources have a coordinate, the newest value by the server's time counts. Values of a source
    that has fallen silent stay, and :attr:`age` tells. Each source has a thread here that only stores.

    Parameters
    ----------
    name
        Name of the model server.
    coordinates
        Symbols, or their names, of the vectors that :meth:`into` fills.
    server
        Connection to the model server, for sources that send through it.
    direct
        Whether the server is on this computer, so that the sockets of its sources are.

    Raises
    ------
    DuplicateNameError
        If a coordinate is given twice.

    Examples
    --------
    >>> server = kv.exchange.serve("kitchen", name="doc-reader")
    >>> model = kv.load(server.address)
    >>> reader = model.exchange.reader()
    >>> source = model.exchange.publisher("encoders", ["kitchen/fridge_door"])
    >>> while "encoders" not in reader.age:
    ...     source.put([0.5])
    ...     heard = reader.wait(0.05)
    >>> reader.state["kitchen/fridge_door"]
    0.5
    >>> reader.close()
    >>> model.close()
    >>> server.close()
    """

    def __init__(
        self,
        name: str,
        coordinates: Iterable[Symbol | str] = (),
        *,
        server: Transport | None = None,
        direct: bool = True,
    ) -> None:
        self.coordinates: tuple[str, ...] = _Layout.make(coordinates).names
        self.is_closed = False
        self._name, self._server, self._direct = name, server, direct
        self._streams: dict[str, _Stream] = {}  # replaced, never changed
        self._news = threading.Condition()
        self._arrived = self._noticed = 0

    def follow(self, sources: Iterable[SourceStatus]) -> None:
        """Read from these sources, and from no others.

        May be called as often as the list comes in. Values of sources that are in it no longer are forgotten.
        """
        streams: dict[str, _Stream] = {}
        for status in sources:
            there = self._streams.get(status.source)
            if there is None or there.endpoint != status.endpoint:
                through = not self._direct or status.endpoint == THROUGH_SERVER
                if through and self._server is None:
                    continue
                there = _Stream(
                    self, _key(self._name, status.source), status.endpoint, self._server if through else None
                )
            there.announce(status)
            streams[status.source] = there
        before, self._streams = self._streams, streams
        for source, stream in before.items():
            if streams.get(source) is not stream:
                stream.close()

    def into(self, vector: Array) -> int:
        """Fill a vector with the newest values, and return for how many of its coordinates there is one.

        Parameters
        ----------
        vector
            Doubles of shape (n,), in the order of the coordinates; those without a value stay as they are.

        Raises
        ------
        ShapeError
            If it has another shape.
        InvalidValueError
            If it is not of floating-point numbers, so that values would be rounded.
        """
        if vector.dtype.kind != "f":
            raise InvalidValueError(f"The vector has {vector.dtype}; values need floating-point numbers.")
        if vector.shape != (len(self.coordinates),):
            raise ShapeError(
                f"The vector has shape {vector.shape}, and the reader {len(self.coordinates)} coordinates."
            )
        filled = np.zeros(len(vector), dtype=bool)
        for _, latest in self._in_order():
            layout = latest.layout
            vector[layout.targets] = latest.values[layout.picks]
            filled[layout.targets] = True
        return int(np.count_nonzero(filled))

    @property
    def state(self) -> State:
        """Newest values of all coordinates that the sources have; the stamp is the newest, in server time."""
        values: dict[Symbol, float] = {}
        found = self._in_order()
        for _, latest in found:
            values.update(zip(latest.layout.symbols, latest.values.tolist(), strict=True))
        names = sorted(name for (_, name), _ in found)
        return State(values, stamp=found[-1][0][0] if found else None, source=", ".join(names))

    def newest(self, source: str) -> Newest | None:
        """Return the newest vector of a source with the note beside it; None if none has come in."""
        stream = self._streams.get(source)
        if stream is None or (latest := stream.latest) is None:
            return None
        return Newest(latest.layout.names, latest.values, latest.stamp, latest.note, latest.arrival)

    def ask(self, source: str, question: bytes, timeout: float) -> bytes:
        """Return the answer of a source to a question.

        Raises
        ------
        OfflineError
            If there is no such source, or it does not answer within the time-out [s].
        """
        seconds, stream = as_tolerance(timeout, "A timeout"), self._streams.get(source)
        transport = None if stream is None else stream.transport
        if stream is not None and transport is not None:
            with contextlib.suppress(NoAnswerError):
                return transport.ask(f"{stream.key}/ask", question, seconds)
        raise OfflineError(f"'{source}' does not answer.")

    @property
    def age(self) -> dict[str, float]:
        """Time since the newest vector of each source came in [s]; of those that have sent any."""
        now = time.monotonic()
        return {source: now - latest.arrival for source, latest in self._latest()}

    @property
    def received(self) -> dict[str, int]:
        """Number of vectors that came in, by source."""
        return {source: stream.received for source, stream in self._streams.items()}

    @property
    def lost(self) -> dict[str, int]:
        """Number of vectors that a source has sent meanwhile and that did not come in, by source."""
        return {source: stream.lost for source, stream in self._streams.items()}

    def wait(self, timeout: float) -> bool:
        """Wait until a vector comes in [s]; return True if one has since the last call.

        A reader of some coordinates waits for vectors with any of them.
        """
        seconds = as_tolerance(timeout, "A timeout")
        with self._news:
            self._news.wait_for(lambda: self._arrived != self._noticed, seconds)
            before, self._noticed = self._noticed, self._arrived
            return before != self._noticed

    def close(self) -> None:
        """Read nothing more."""
        self.follow(())
        self.is_closed = True

    def _latest(self) -> list[tuple[str, _Vector]]:
        return [(name, s.latest) for name, s in self._streams.items() if s.latest is not None]

    def _in_order(self) -> list[tuple[tuple[float, str], _Vector]]:
        """Return the newest vector of each source by time of the server and name, the oldest first."""
        streams = self._streams
        found = [((v.stamp + streams[name].offset, name), v) for name, v in self._latest() if name in streams]
        return sorted(found, key=lambda item: item[0])

    def _notify(self) -> None:
        with self._news:
            self._arrived += 1
            self._news.notify_all()


class _Vector(NamedTuple):
    """Vector that has come in; ``arrival`` is by the clock that only counts."""

    layout: _Layout
    values: Array
    stamp: float
    note: bytes
    arrival: float


@dataclass(frozen=True)
class _Layout:
    """Coordinates of vectors; ``targets`` are places in a reader's vector, ``picks`` those in this one."""

    names: tuple[str, ...]
    symbols: tuple[Symbol, ...]
    digest: int
    picks: Array
    targets: Array

    @classmethod
    def make(cls, coordinates: Iterable[Symbol | str], wanted: Sequence[str] = ()) -> _Layout:
        given = as_entries("coordinates=", coordinates, (Symbol, str), "symbols, or their names")
        names = tuple(map(str, given))
        symbols = tuple(Symbol(*parse_symbol_name(name)) for name in names)
        place: Mapping[str, int] = {name: index for index, name in enumerate(names)}
        if len(place) < len(names):
            twice = next(name for index, name in enumerate(names) if place[name] != index)
            raise DuplicateNameError(f"The coordinate '{twice}' is given twice.")
        digest = hashlib.sha256(msgspec.msgpack.encode(names)).digest()
        targets = [index for index, name in enumerate(wanted) if name in place]
        picks = [place[wanted[index]] for index in targets]
        return cls(
            names,
            symbols,
            int.from_bytes(digest[:8], "little"),
            np.array(picks, dtype=np.intp),
            np.array(targets, dtype=np.intp),
        )


class _Stream:
    """Subscription of a reader to a source, in a thread of its own."""

    def __init__(self, reader: StateReader, key: str, endpoint: str, server: Transport | None) -> None:
        self.endpoint, self.offset = endpoint, 0.0
        self.latest: _Vector | None = None
        self.received = self.lost = 0
        self.key = key
        self.transport: Transport | None = None
        self._reader, self._server = reader, server
        self._open: list[Messages | Transport] = []
        self._layouts: dict[int, _Layout] = {}
        self._announced: tuple[str, ...] | None = None
        self._run = self._number = 0
        self._ask_again = 0.0
        self._closed = threading.Event()
        threading.Thread(target=self._read, daemon=True).start()

    def announce(self, status: SourceStatus) -> None:
        """Take over what the server says about the source."""
        self.offset = status.offset
        if status.coordinates != self._announced:
            self._announced = status.coordinates
            self._learn(status.coordinates)

    def close(self) -> None:
        self._closed.set()
        for one in self._open:
            one.close()

    def _learn(self, coordinates: Iterable[str]) -> None:
        if len(self._layouts) >= _MOST_LAYOUTS:
            self._layouts = {}
        with contextlib.suppress(KineverseError):
            layout = _Layout.make(coordinates, self._reader.coordinates)
            self._layouts[layout.digest] = layout

    def _read(self) -> None:
        while not self._closed.is_set():
            try:
                transport = self._server or Transport.connect(self.endpoint)
                messages = transport.subscribe(self.key)
            except NoAnswerError:
                self._closed.wait(_RETRY_SECONDS)
                continue
            self.transport = transport
            self._open = [messages] if transport is self._server else [messages, transport]
            if self._closed.is_set():
                self.close()
            for message in messages:
                self._take(message, transport)
            return

    def _take(self, message: bytes, transport: Transport) -> None:
        if len(message) < _HEADER.size:
            return
        digest, run, number, stamp, _ = _HEADER.unpack_from(message)
        layout = self._layouts.get(digest) or self._ask(digest, transport)
        if layout is None or len(message) < (end := _HEADER.size + _VALUE.itemsize * len(layout.names)):
            return
        values = np.frombuffer(message[:end], _VALUE, offset=_HEADER.size)
        if not (math.isfinite(stamp) and np.isfinite(values).all()):
            return
        if run == self._run:
            if number <= self._number:
                return
            self.lost += number - self._number - 1
        self._run, self._number = run, number
        self.received += 1
        self.latest = _Vector(layout, values, stamp, message[end:], time.monotonic())
        if len(layout.targets) or not self._reader.coordinates:
            self._reader._notify()

    def _ask(self, digest: int, transport: Transport) -> _Layout | None:
        """Return the layout that the source has now if it is that of the digest."""
        now = time.monotonic()
        if now < self._ask_again:
            return None
        with contextlib.suppress(NoAnswerError, msgspec.MsgspecError, UnicodeDecodeError):
            answer = transport.ask(f"{self.key}/layout", b"", _ASK_SECONDS)
            self._learn(msgspec.msgpack.decode(answer, type=tuple[str, ...]))
        if digest not in self._layouts:
            self._ask_again = time.monotonic() + _RETRY_SECONDS
        return self._layouts.get(digest)


def _answer(requests: Questions, function: Callable[[bytes], bytes]) -> None:
    for request in requests:
        request.answer(function(request.payload))


def _key(name: str, source: str) -> str:
    return f"kineverse/{name}/state/{source}"
