"""Recordings of runs, read from MCAP files: values over time, contacts, observations, phases, outcome."""

from __future__ import annotations

import io
import math
import os
import struct
import zlib
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

import msgspec
import numpy as np

from kineverse.errors import (
    ExpressionError,
    FormatError,
    KineverseError,
    MissingDependencyError,
    UnknownNameError,
    suggest,
)
from kineverse.formats.document.reader import entries_from_bytes
from kineverse.formats.files import read_file
from kineverse.formats.root_folder import find_root
from kineverse.lie import Array
from kineverse.model.model import Model, Snapshot
from kineverse.state import State
from kineverse.symbols import Symbol, parse_symbol_name

from .recorder import TOPICS, import_mcap
from .robot_interface import Observation
from .simulated_world import Contact

MAX_CHUNK = 1 << 28  # largest chunk [byte], uncompressed
MAX_TOTAL = 1 << 30  # largest content of a file [byte], uncompressed

_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _METADATA, _DATA_END = 1, 2, 3, 4, 5, 6, 12, 15


class McapMessage(NamedTuple):
    """Message: its topic, encoding, name of its schema, log time [s] and content."""

    topic: str
    encoding: str
    schema: str
    time: float
    data: bytes


class McapFile:
    """Content of an MCAP file."""

    def __init__(self, path: Path) -> None:
        self._name, self._records = path.name, import_mcap("mcap.records")
        self._streams = import_mcap("mcap.data_stream")
        data = read_file(path)
        if data[:8] != _MAGIC:
            what = "it is empty" if not data else f"it begins with {data[:8]!r}"
            raise FormatError(f"{self._name}: not an MCAP file: {what}.")
        self.messages: list[McapMessage] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self.complete = False
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Any] = {}
        self._total = 0
        finished = len(data) > 16 and data[-8:] == _MAGIC
        for code, body in self._split(memoryview(data)[8:], finished):
            if code == _CHUNK:
                self._read_chunk(body)
            elif code in (_DATA_END, _FOOTER):
                self.complete = True
                break
            else:
                self._read_record(code, body)
        if finished and not self.complete:
            raise self._damaged("the records end without an end of data")

    def find(self, topic: str) -> list[McapMessage]:
        """Return the messages of a topic of a recording: those of its schema, as JSON."""
        kind = "json", f"kineverse.{TOPICS[topic][0]}"
        return [m for m in self.messages if m.topic == topic and (m.encoding, m.schema) == kind]

    def _split(self, data: memoryview, finished: bool) -> Iterator[tuple[int, bytes]]:
        """Yield the code and body of records; of a cut file, those that are whole."""
        place = 0
        while place < len(data):
            if place + 9 > len(data):
                break
            code, size = data[place], struct.unpack_from("<Q", data, place + 1)[0]
            if place + 9 + size > len(data):
                break
            yield code, bytes(data[place + 9 : place + 9 + size])
            place += 9 + size
        else:
            return
        if finished:
            raise self._damaged(f"a record at byte {place + 8} is longer than the file")

    def _read_chunk(self, body: bytes) -> None:
        chunk = self._parse(self._records.Chunk.read, body, "chunk")
        if len(body) < 32 + len(chunk.compression.encode()) or chunk.uncompressed_size > MAX_CHUNK:
            raise self._damaged(
                f"a chunk states {chunk.uncompressed_size} bytes; at most {MAX_CHUNK} are read"
            )
        plain = self._decompress(chunk)
        checksum = chunk.uncompressed_crc
        if len(plain) != chunk.uncompressed_size or (checksum and zlib.crc32(plain) != checksum):
            raise self._damaged(f"a chunk's content does not match its checksum, after {self._last()}")
        self._total += len(plain)
        if self._total > MAX_TOTAL:
            raise FormatError(
                f"{self._name}: more than {MAX_TOTAL} bytes of messages, the most that are read."
            )
        for code, record in self._split(memoryview(plain), finished=True):
            self._read_record(code, record)

    def _decompress(self, chunk: Any) -> bytes:
        """Return the content of a chunk, which is not longer than it states by more than a byte."""
        most = chunk.uncompressed_size + 1
        try:
            if chunk.compression == "zstd":
                zstandard = import_mcap("zstandard")
                with zstandard.ZstdDecompressor().stream_reader(io.BytesIO(chunk.data)) as stream:
                    return bytes(stream.read(most))
            if chunk.compression == "lz4":
                return bytes(import_mcap("lz4.frame").LZ4FrameDecompressor().decompress(chunk.data, most))
        except MissingDependencyError:
            raise
        except Exception as error:  # of the two libraries
            raise self._damaged(f"a chunk cannot be decompressed after {self._last()}: {error}") from None
        if chunk.compression:
            raise FormatError(
                f"{self._name}: compressed by {chunk.compression!r:.40}; zstd and lz4 are read."
            )
        return bytes(chunk.data)

    def _read_record(self, code: int, body: bytes) -> None:
        records = self._records
        if code == _HEADER:
            self._parse(records.Header.read, body, "header")
        elif code == _SCHEMA:
            schema = self._parse(records.Schema.read, body, "schema")
            self._schemas[schema.id] = schema.name
        elif code == _CHANNEL:
            channel = self._parse(records.Channel.read, body, "channel")
            self._channels[channel.id] = channel
        elif code == _METADATA:
            result = self._parse(records.Metadata.read, body, "metadata")
            self.metadata[result.name] = dict(result.metadata)
        elif code == _MESSAGE:
            if len(body) < 22:
                raise self._damaged("a message is too short")
            number, _, time = struct.unpack_from("<HIQ", body)
            channel = self._channels.get(number)
            if channel is None:
                raise self._damaged(f"a message is of channel {number}, which is not declared before")
            schema = self._schemas.get(channel.schema_id, "")
            self.messages.append(
                McapMessage(channel.topic, channel.message_encoding, schema, time / 1e9, body[22:])
            )

    def _parse(self, read: Callable[[Any], Any], body: bytes, noun: str) -> Any:
        try:
            return read(self._streams.ReadDataStream(io.BytesIO(body)))
        except Exception as error:  # of the library: struct.error, EndOfFile, UnicodeDecodeError
            raise self._damaged(f"a {noun} cannot be read ({type(error).__name__})") from None

    def _last(self) -> str:
        return f"{self.messages[-1].time:.3f} s" if self.messages else "no message"

    def _damaged(self, reason: str) -> FormatError:
        return FormatError(f"{self._name}: a damaged MCAP file: {reason}.")


MAX_VALUES = 1 << 26  # most numbers of one table of values over time

Entry = TypeVar("Entry")


@dataclass(frozen=True, slots=True, eq=False)
class ValuesOverTime:
    """Values of symbols over time."""

    times: Array  # (T,) increasing [s]
    symbols: tuple[Symbol, ...]  # n symbols, the columns
    values: Array  # (T, n) [m], [rad] and per second; NaN where a symbol had no value

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, symbol: Symbol | str) -> Array:
        """Return the values (T,) of a symbol, given itself or by name."""
        names = list(map(str, self.symbols))
        if str(symbol) not in names:
            raise UnknownNameError(
                f"Nothing is recorded of '{symbol}'. {suggest(str(symbol), names, 'symbol')}"
            )
        return np.asarray(self.values[:, names.index(str(symbol))])

    def at(self, time: float) -> State:
        """Return the state at a time [s], linear between records; at the ends the first and the last one."""
        if not len(self.times):
            return State({}, stamp=float(time))
        k = min(max(bisect_right(self.times, time) - 1, 0), len(self.times) - 1)
        row = self.values[k]
        if k + 1 < len(self.times) and time > self.times[k]:
            share = (time - self.times[k]) / (self.times[k + 1] - self.times[k])
            row = np.where(
                np.isfinite(self.values[k + 1]), (1 - share) * row + share * self.values[k + 1], row
            )
        known = {s: v for s, v in zip(self.symbols, row.tolist(), strict=True) if math.isfinite(v)}
        return State(known, stamp=float(time))


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """Things that were recorded at some times."""

    times: Array  # (T,) not decreasing [s]
    entries: tuple[Any, ...]  # T records

    def __len__(self) -> int:
        return len(self.entries)

    def last(self, time: float) -> Any:
        """Return the last thing at or before a time [s]; None before the first."""
        k = bisect_right(self.times, time + 1e-9) - 1
        return self.entries[k] if k >= 0 else None


@dataclass(frozen=True, slots=True, eq=False)
class RunRecording:
    """Run of a robot.

    Attributes
    ----------
    path
        File that it was read from.
    states, beliefs, commands
        True state, believed state, and commanded speeds over time. There are no true states of a robot of
        which nobody knows the truth.
    belief_poses
        World poses (4, 4) by frame that the believed values alone do not give.
    contacts
        At each time, a tuple of :class:`.Contact`.
    observations
        :class:`.Observation` at the times of their arrival.
    phases
        Names of phases, at the times at which they begin.
    vectors
        At each time, the vectors of the controller by name: pairs of origin (3,) and vector (3,).
    outcome
        Result of the skill; None if it was not recorded.
    about
        Texts about the run.
    complete
        False if the file was cut, as after the process that wrote it was killed.

    See Also
    --------
    kineverse.worlds.Recorder
    """

    path: Path
    model: Snapshot
    states: ValuesOverTime
    beliefs: ValuesOverTime
    commands: ValuesOverTime
    belief_poses: Recorded
    contacts: Recorded
    observations: Recorded
    phases: Recorded
    vectors: Recorded
    outcome: Mapping[str, Any] | None
    about: Mapping[str, str] = field(default_factory=dict)
    complete: bool = True

    @property
    def motion(self) -> ValuesOverTime:
        """The true states; without any, the believed ones."""
        return self.states if len(self.states) else self.beliefs

    @property
    def times(self) -> Array:
        """Times (T,) of the states [s]."""
        return self.motion.times

    @property
    def duration(self) -> float:
        """Time of the last state [s]."""
        return float(self.times[-1]) if len(self.times) else 0.0

    def __repr__(self) -> str:
        cut = "" if self.complete else ", cut"
        return f"<recording {self.path.name}: {self.duration:.4g} s, {len(self.times)} states{cut}>"


def read_run_recording(
    path: str | os.PathLike[str], *, root: str | os.PathLike[str] | None = None
) -> RunRecording:
    """Return the run in a file. Runs no code; a file that was cut is read up to there.

    Parameters
    ----------
    path
        Path of an MCAP file that :class:`.Recorder` wrote.
    root
        Folder below which the model may open meshes, as for :func:`kineverse.load`.

    Raises
    ------
    FormatError
        For a file that cannot be read, is damaged, or is no recording of a world.
    MissingDependencyError
        If the extra ``recording`` is not installed.

    See Also
    --------
    kineverse.worlds.Recorder
    """
    path = Path(path)
    file = McapFile(path)
    models = file.find("/model")
    if not models:
        topics = sorted({message.topic for message in file.messages})
        text = f"its topics are {', '.join(topics[:12])}" if topics else "it has no messages"
        raise FormatError(
            f"{path.name}: no recording of a world, which has a /model of the schema kineverse.Model; {text}"
            f"{'' if file.complete else '; the file was cut'}."
        )
    model = _read_model(models[0].data, path, root)
    decoder = _Decoder(file, path.name, model)
    decode, name_values = decoder.decode, decoder.name_values
    beliefs = [(time, name_values(m.values), _as_arrays(m.poses)) for time, m in decode("/belief", _Belief)]
    outcomes = [content for _, content in decode("/outcome", dict[str, Any])]
    return RunRecording(
        path,
        model,
        _tabulate([(time, name_values(m.values)) for time, m in decode("/state", _State)], path.name),
        _tabulate([(time, values) for time, values, _ in beliefs], path.name),
        _tabulate([(time, name_values(m.speeds)) for time, m in decode("/command", _Command)], path.name),
        _as_recorded((time, poses) for time, _, poses in beliefs),
        _as_recorded(
            (time, tuple(map(_make_contact, m.contacts))) for time, m in decode("/contacts", _Contacts)
        ),
        _as_recorded(
            (time, Observation(m.stamp, name_values(m.joints), _as_arrays(m.poses), frozenset(m.touching)))
            for time, m in decode("/observation", _Readings)
        ),
        _as_recorded((time, m.phase) for time, m in decode("/phase", _Phase)),
        _as_recorded(
            (time, {name: (np.array(one.origin), np.array(one.vector)) for name, one in m.vectors.items()})
            for time, m in decode("/controller", _Controller)
        ),
        outcomes[-1] if outcomes else None,
        file.metadata.get("run", {}),
        file.complete,
    )


def _read_model(data: bytes, path: Path, root: str | os.PathLike[str] | None) -> Snapshot:
    model = Model()
    entries = entries_from_bytes(data, root=find_root(path.parent, root), source=f"{path.name}, /model")
    try:
        with model.edit() as edit:
            for entry in entries:
                edit.link(entry)
    except KineverseError as error:
        raise FormatError(f"{path.name}: the model cannot be built: {error}") from error
    return model.snapshot()


def _tabulate(rows: Sequence[tuple[float, dict[Symbol, float]]], source: str) -> ValuesOverTime:
    """Return rows as a table; of several at one time, the last."""
    latest = dict(sorted(rows, key=lambda row: row[0]))
    symbols = tuple(dict.fromkeys(symbol for row in latest.values() for symbol in row))
    if len(latest) * len(symbols) > MAX_VALUES:
        raise FormatError(
            f"{source}: values of {len(symbols)} symbols at {len(latest)} times, more than the "
            f"{MAX_VALUES} numbers that are read."
        )
    values = np.array([[row.get(s, math.nan) for s in symbols] for row in latest.values()])
    return ValuesOverTime(
        np.array(list(latest), dtype=float), symbols, values.reshape(len(latest), len(symbols))
    )


def _as_recorded(rows: Iterable[tuple[float, Any]]) -> Recorded:
    ordered = sorted(rows, key=lambda row: row[0])
    return Recorded(np.array([time for time, _ in ordered], dtype=float), tuple(one for _, one in ordered))


_Vector: TypeAlias = tuple[float, float, float]
_Row: TypeAlias = tuple[float, float, float, float]
_Poses: TypeAlias = dict[str, tuple[_Row, _Row, _Row, _Row]]


class _State(msgspec.Struct):
    values: dict[str, float]


class _Belief(_State):
    poses: _Poses


class _Command(msgspec.Struct):
    speeds: dict[str, float]


class _Touch(msgspec.Struct):
    a: str
    b: str
    point: _Vector
    normal: _Vector
    distance: float
    force: float | None = None


class _Contacts(msgspec.Struct):
    contacts: list[_Touch]


class _Readings(msgspec.Struct):
    stamp: float
    joints: dict[str, float]
    poses: _Poses
    touching: list[str]


class _Phase(msgspec.Struct):
    phase: str


class _Arrow(msgspec.Struct):
    origin: _Vector
    vector: _Vector


class _Controller(msgspec.Struct):
    vectors: dict[str, _Arrow]


class _Decoder:
    """Decoder of the messages of one file, which checks all types, shapes and numbers."""

    def __init__(self, file: McapFile, source: str, model: Snapshot) -> None:
        self._file, self._source, self._place = file, source, ""
        self._symbols: dict[str, Symbol] = {str(s): s for s in (*model.speeds, *model.default_state())}

    def decode(self, topic: str, kind: type[Entry]) -> Iterator[tuple[float, Entry]]:
        """Yield the messages of a topic with their log times [s]."""
        decoder = msgspec.json.Decoder(kind)
        for message in self._file.find(topic):
            self._place = f"{self._source}: {topic} at {message.time:.3f} s"
            try:
                content = decoder.decode(message.data)
            except (ValueError, RecursionError) as error:
                raise FormatError(f"{self._place}: {error}.") from None
            yield message.time, content

    def name_values(self, values: Mapping[str, float]) -> dict[Symbol, float]:
        """Return values by symbol; a belief may have others than the model."""
        for name in values.keys() - self._symbols.keys():
            try:
                self._symbols[name] = Symbol(*parse_symbol_name(name))
            except ExpressionError as error:
                raise FormatError(f"{self._place}: {name!r:.80} is no name of a symbol: {error}.") from None
        return {self._symbols[name]: value for name, value in values.items()}


def _as_arrays(poses: _Poses) -> dict[str, Array]:
    return {name: np.array(rows) for name, rows in poses.items()}


def _make_contact(one: _Touch) -> Contact:
    force = math.nan if one.force is None else one.force
    return Contact(one.a, one.b, np.array(one.point), np.array(one.normal), one.distance, force)
