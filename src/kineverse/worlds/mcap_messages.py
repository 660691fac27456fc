"""Messages of an MCAP file, with bounds on all sizes; a file that was cut is read up to there."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from kineverse.errors import FormatError, MissingDependencyError
from kineverse.formats.files import read_file

from .recorder import import_mcap

MAX_CHUNK = 1 << 28
"""Largest chunk [byte], uncompressed."""

MAX_TOTAL = 1 << 30
"""Largest content of a file [byte], uncompressed."""

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
        if len(plain) != chunk.uncompressed_size or not _matches(plain, chunk.uncompressed_crc):
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
            found = self._parse(records.Metadata.read, body, "metadata")
            self.metadata[found.name] = dict(found.metadata)
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


def _matches(data: bytes, checksum: int) -> bool:
    return not checksum or zlib.crc32(data) == checksum
