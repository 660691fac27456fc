"""Programs of benchmark ``exchange``: objects in processes of their own."""

from __future__ import annotations

import os
import statistics
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import parent_process
from pathlib import Path
from time import perf_counter

import numpy as np

import kineverse as kv
from kineverse.errors import KineverseError, OfflineError
from kineverse.exchange import protocol
from kineverse.exchange.address import Address
from kineverse.exchange.client import load_live
from kineverse.exchange.server import serve
from kineverse.exchange.state import StatePublisher, StateReader
from kineverse.exchange.transport import Transport
from kineverse.exchange.views import Wish
from kineverse.formats import operation_to_bytes
from kineverse.model import Diff, Edit

from .models import make_joints

_NAME, _ADDRESS = "bench", "live:bench"
_VALUES = tuple(f"joint {k}" for k in range(20))
PAUSE = 0.004  # before an edit, so that it finds everybody asleep [s]
_AT_ONCE = 64  # edits under way while they are streamed
_LARGE = "x" * 100_000
_LONG = 20.0  # longest time that anything is waited for [s]


def begin(name: str, value: str) -> None:
    """Set a variable of a process that ends with the one that has started it."""
    os.environ[name] = value
    _start(_end_with_parent)


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


class Remote:
    def pid(self) -> int:
        return os.getpid()


class ServerProgram(Remote):
    """Server of models, or of a number of joints, with a store."""

    def __init__(self, store: str, joints: int, *models: str) -> None:
        given = make_joints(joints) if joints and not Path(store).exists() else models
        start = perf_counter()
        self._server = serve(given, name=_NAME, store=store)
        self.seconds = perf_counter() - start
        _start(self._server.run)

    def times(self) -> tuple[float, float]:
        """Return the time until it served and the CPU time of the process [s]."""
        return self.seconds, time.process_time()


class EchoServer(Remote):
    """Server that publishes what it is asked."""

    def __init__(self, endpoint: str) -> None:
        self._transport = Transport.serve([endpoint])
        self._questions = self._transport.answers("relay/edit")
        _start(self._work)

    def _work(self) -> None:
        for question in self._questions:
            self._transport.publish("relay/log", question.payload)
            question.answer(b"")


class Subscriber(Remote):
    """Subscriber of all commits, and of the relay."""

    def __init__(self, relay: str = "") -> None:
        self._model, self._transport = load_live(_ADDRESS), _connect(relay)
        self._heard: dict[int, float] = {}
        self._relayed: list[float] = []
        self._model.listen(self._hear)
        _start(self._work, self._transport.subscribe("relay/log"))

    def _hear(self, diff: Diff) -> None:
        self._heard[diff.version] = perf_counter()

    def _work(self, messages: Iterable[bytes]) -> None:
        for _ in messages:
            self._relayed.append(perf_counter())

    def heard(self, versions: Sequence[int]) -> list[float]:
        _wait(lambda: versions[-1] in self._heard)
        return [self._heard[version] for version in versions]

    def relayed(self, count: int) -> list[float]:
        _wait(lambda: len(self._relayed) >= count)
        found, self._relayed = self._relayed, []
        return found


class Editor(Remote):
    """Client that edits and joins."""

    def __init__(self, relay: str = "") -> None:
        self._model, self._transport = load_live(_ADDRESS), _connect(relay)
        self._number, self._tag, self._asked = 0, "", 0.0
        connection = self._model.exchange
        ask = connection.ask_edit

        def ask_edit(edit: protocol.ChangeRequest) -> protocol.Committed | protocol.Refused:
            self._asked = perf_counter()
            return ask(edit)

        connection.ask_edit = ask_edit  # type: ignore[method-assign]

    def edit(self, kind: str, count: int, pause: float = PAUSE) -> list[tuple[int, float, float, float]]:
        """Make edits; return their versions, when they began, were asked for and were acknowledged."""
        made: list[tuple[int, float, float, float]] = []
        while len(made) < count:
            time.sleep(pause)
            start = perf_counter()
            try:
                with self._model.edit() as edit:
                    self._put(edit, kind)
            except OfflineError:
                continue
            made.append((self._model.version, start, self._asked, perf_counter()))
        return made

    def relay(self, kind: str, count: int) -> list[float]:
        """Ask the relay with the bytes of an edit, and return when."""
        data, starts = protocol.encode(self._request(kind, 1)), []
        for _ in range(count):
            time.sleep(PAUSE)
            starts.append(perf_counter())
            self._transport.ask("relay/edit", data, _LONG)
        return starts

    def stream(self, kind: str, count: int, size: int) -> None:
        requests = [self._request(kind, size) for _ in range(count)]
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            for answer in pool.map(self._model.exchange.ask_edit, requests):
                if isinstance(answer, protocol.Refused):
                    raise KineverseError(answer.message)

    def join(self, *frames: str) -> float:
        start = perf_counter()
        model = load_live(_ADDRESS, frames=frames or None)
        seconds = perf_counter() - start
        model.close()
        return seconds

    def _put(self, edit: Edit, kind: str) -> None:
        if kind == "remove":
            edit.remove(self._tag)
            return
        self._number += kind != "replace"
        name = f"edited/{self._model.exchange.client[:8]}/{self._number}"
        if kind == "frame":
            edit.add_frame(name, "world", kv.translation(0.1, 0.2, 0.3))
        elif kind in ("datum", "large"):
            edit.write(name, _LARGE if kind == "large" else 1.0)
        else:
            upper = 1.0 if kind == "joint" else 2.0
            made = kv.Revolute(name=name, parent="world", child=name, lower=-1.0, upper=upper, velocity=1.0)
            if kind == "joint":
                self._tag = edit.apply(made)
            else:
                edit.replace(self._tag, made)

    def _request(self, kind: str, size: int) -> protocol.EditRequest:
        model, connection = kv.Model(), self._model.exchange
        with model.edit() as edit:
            for _ in range(size):
                self._put(edit, kind)
        blobs = [operation_to_bytes(model, tag) for tag in model.history.tags]
        changes = protocol.Changes(tuple(protocol.Placed(blob, at_end=True) for blob in blobs))
        number, who = connection.next_number(), connection.who
        return protocol.EditRequest(connection.client, number, who, *connection.position, changes)


class Crowd(Remote):
    """Many subscribers of a part, each with a connection of its own."""

    def __init__(self, count: int, frame: str) -> None:
        self._model = load_live(_ADDRESS, frames=[frame])
        key = self._model.exchange.key(f"view/{Wish((frame,), bodies=False).id}")
        self._versions: list[list[int]] = [[] for _ in range(count)]
        self._transports = [_connect() for _ in range(count)]
        for transport, versions in zip(self._transports, self._versions, strict=True):
            _start(self._work, transport.subscribe(key), versions)

    def _work(self, messages: Iterable[bytes], versions: list[int]) -> None:
        for data in messages:
            versions += [protocol.decode_commit(protocol.decode_published(data).commit).revision]

    def got(self, versions: list[int]) -> int:
        """Return how many have got all of these versions, in order and once."""
        _wait(lambda: all(len(own) >= len(versions) for own in self._versions))
        return self._versions.count(versions)


class SourceProgram(Remote):
    """Source of vectors; the first value is when one was sent."""

    def __init__(self) -> None:
        self._publisher = StatePublisher(_NAME, "source", _VALUES)

    def endpoint(self) -> str:
        return self._publisher.endpoint

    def send(self, count: int, rate: float) -> float:
        """Send vectors at a rate, and return the rate that was reached [1/s]."""
        vector, start = np.zeros(len(_VALUES)), perf_counter()
        for number in range(count):
            while (now := perf_counter()) < start + number / rate:
                time.sleep(start + number / rate - now)
            vector[0] = now
            self._publisher.put(vector)
        return count / (perf_counter() - start)


class Reader(Remote):
    """Reader of the source, awake whenever a vector comes."""

    def __init__(self, endpoint: str) -> None:
        self._reader, self._delays = StateReader(_NAME, _VALUES), list[float]()
        self._reader.follow([protocol.SourceStatus("source", endpoint, _VALUES, 0.0, "0" * 32)])
        _start(self._work)

    def _work(self) -> None:
        vector = np.zeros(len(_VALUES))
        while True:
            if self._reader.wait(_LONG):
                self._reader.into(vector)
                self._delays.append(perf_counter() - vector[0])

    def take(self, count: int) -> tuple[int, float]:
        """Return how many vectors have come so far, and the median time of the last ones [s]."""
        late = time.monotonic() + 1.0
        while (come := self._reader.received["source"]) < count and time.monotonic() < late:
            time.sleep(0.001)
        delays, self._delays = self._delays, []
        return come, statistics.median(delays or [0.0])


def _connect(endpoint: str = "") -> Transport:
    return Transport.connect(endpoint or Address.parse(_ADDRESS).find()[0])


def _start(work: Callable[..., None], *arguments: object) -> None:
    threading.Thread(target=work, args=arguments, daemon=True).start()


def _wait(is_done: Callable[[], bool]) -> None:
    late = time.monotonic() + _LONG
    while not is_done():
        if time.monotonic() > late:
            raise KineverseError(f"What was waited for has not come within {_LONG:g} s.")
        time.sleep(0.001)
