"""Programs of benchmark ``exchange``: each is an object in a process of its own, called by standard input."""

from __future__ import annotations

import json
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
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
from kineverse.model import Edit

from .models import make_joints

ADDRESS = "live:bench"
_RELAY, _SOURCE = "relay", "arm"
_VALUES = tuple(f"arm/joint {k}" for k in range(20))
_PAUSE = 0.004  # between edits, so that everybody sleeps when one comes [s]
_AT_ONCE = 64  # edits under way while they are streamed
_LARGE = "x" * 100_000
_LONG = 20.0  # longest time that anything is waited for [s]


def run(program: object) -> None:
    """Call methods of an object: standard input has a list of name and arguments in each line."""
    print("null", flush=True)
    for line in sys.stdin:
        name, *arguments = json.loads(line)
        print(json.dumps(getattr(program, name)(*arguments)), flush=True)


class Server:
    """Model server, of models or of a number of joints."""

    def __init__(self, store: str, *models: str, joints: int = 0) -> None:
        given = make_joints(joints) if joints and not Path(store).exists() else models
        start = perf_counter()
        self._server = serve(given, name="bench", store=store)
        self._seconds = perf_counter() - start

    def start_time(self) -> float:
        """Return the time that it took to serve [s]."""
        return self._seconds

    def cpu_time(self) -> float:
        """Return the CPU time of this process [s]."""
        return time.process_time()


class Relay:
    """Server that publishes what it is asked."""

    def __init__(self, endpoint: str) -> None:
        self._transport = Transport.serve([endpoint])
        self._questions = self._transport.answers(f"{_RELAY}/edit")
        threading.Thread(target=self._relay, daemon=True).start()

    def _relay(self) -> None:
        for question in self._questions:
            self._transport.publish(f"{_RELAY}/log", question.payload)
            question.answer(b"")


class Follower:
    """Subscriber of all commits, and of the relay."""

    def __init__(self, endpoint: str) -> None:
        self._heard: dict[int, float] = {}
        self._relayed: list[float] = []
        self._model = load_live(ADDRESS)
        self._model.listen(lambda diff: self._heard.setdefault(diff.version, perf_counter()))
        self._transport = Transport.connect(endpoint)
        self._messages = self._transport.subscribe(f"{_RELAY}/log")
        threading.Thread(target=self._follow, daemon=True).start()

    def _follow(self) -> None:
        for _ in self._messages:
            self._relayed.append(perf_counter())

    def heard(self, versions: Sequence[int]) -> list[float]:
        """Return when hooks were called."""
        wait_for(lambda: versions[-1] in self._heard)
        return [self._heard[version] for version in versions]

    def relayed(self, count: int) -> list[float]:
        """Return when messages came from the relay."""
        wait_for(lambda: len(self._relayed) >= count)
        found, self._relayed = self._relayed, []
        return found


class Editor:
    """Client that edits."""

    def __init__(self, endpoint: str = "") -> None:
        self._number = 0
        self._model = load_live(ADDRESS)
        self._transport = Transport.connect(endpoint) if endpoint else self._model.exchange.transport

    def edit(self, kind: str, count: int, pause: float = _PAUSE) -> list[tuple[int, float]]:
        """Make edits, and return their versions and when they began."""
        made = []
        for _ in range(count):
            time.sleep(pause)
            start = perf_counter()
            with self._model.edit() as edit:
                self._put(edit, kind)
            made.append((self._model.version, start))
        return made

    def relay(self, kind: str, count: int) -> list[float]:
        """Ask the relay with the bytes of edits, and return when."""
        data = protocol.encode(self._requests(kind, 1, 1)[0])
        starts = []
        for _ in range(count):
            time.sleep(_PAUSE)
            starts.append(perf_counter())
            self._transport.ask(f"{_RELAY}/edit", data, _LONG)
        return starts

    def stream(self, kind: str, count: int, size: int) -> None:
        """Make edits of so many operations, many at once."""
        requests = self._requests(kind, count, size)
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            answers = list(pool.map(self._model.exchange.ask_edit, requests))
        refused = [answer.message for answer in answers if isinstance(answer, protocol.Refused)]
        if refused:
            raise KineverseError(refused[0])

    def keep_editing(self, seconds: float) -> int:
        """Edit for some time, and return how often."""
        end, count = time.monotonic() + seconds, 0
        while time.monotonic() < end:
            self.edit("frame", 1)
            count += 1
        return count

    def edit_again(self) -> float:
        """Return when the first edit is acknowledged by a server that starts."""
        while True:
            try:
                self.edit("frame", 1, 0.001)
                return perf_counter()
            except OfflineError:
                continue

    def touch(self, count: int) -> dict[str, float]:
        """Return the times of appending, replacing and removing a joint [s]."""
        times: dict[str, list[float]] = {"append": [], "replace": [], "remove": []}
        for _ in range(count):
            self._number += 1
            name = f"touched {self._number}"
            tag = ""
            for what, seconds in times.items():
                time.sleep(_PAUSE)
                start = perf_counter()
                with self._model.edit() as edit:
                    if what == "append":
                        tag = edit.apply(_joint(name, 1.0))
                    elif what == "replace":
                        edit.replace(tag, _joint(name, 2.0))
                    else:
                        edit.remove(tag)
                seconds.append(perf_counter() - start)
        return {what: statistics.median(seconds) for what, seconds in times.items()}

    def _put(self, edit: Edit, kind: str) -> None:
        self._number += 1
        name = f"edited/{self._model.exchange.client[:8]}/{self._number}"
        if kind == "frame":
            edit.add_frame(name, "world", kv.translation(0.1, 0.2, 0.3))
        elif kind == "joint":
            edit.apply(_joint(name, 1.0))
        else:
            edit.write(name, _LARGE if kind == "large" else 1.0)

    def _requests(self, kind: str, count: int, size: int) -> list[protocol.Edit]:
        connection, requests = self._model.exchange, []
        for _ in range(count):
            model = kv.Model()
            with model.edit() as edit:
                for _ in range(size):
                    self._put(edit, kind)
            put = tuple(
                protocol.Placed(operation_to_bytes(model, tag), at_end=True) for tag in model.history.tags
            )
            number, changes = connection.next_number(), protocol.Changes(put)
            requests.append(
                protocol.Edit(connection.client, number, connection.who, *connection.position, changes)
            )
        return requests


def _joint(name: str, upper: float) -> kv.Revolute:
    return kv.Revolute(name=name, parent="world", child=name, lower=-1.0, upper=upper, velocity=1.0)


class Joiner:
    """Client that joins again and again."""

    def join(self, frame: str | None) -> float:
        """Return the time of loading the whole model, or the part of a frame [s]."""
        start = perf_counter()
        model = load_live(ADDRESS, frames=None if frame is None else [frame])
        seconds = perf_counter() - start
        model.close()
        return seconds

    def frame(self, end: str) -> str:
        """Return the frame of a name with some prefix."""
        with load_live(ADDRESS) as model:
            return next(name for name in model.frames if f"/{name}".endswith(f"/{end}"))


class Crowd:
    """Many subscribers of one part, each with a connection of its own."""

    def __init__(self, count: int, frame: str) -> None:
        self._model = load_live(ADDRESS, frames=[frame])
        self._numbers: list[list[int]] = [[] for _ in range(count)]
        endpoint, _ = Address.parse(ADDRESS).find()
        key = self._model.exchange.key(f"view/{Wish((frame,), bodies=False).id}")
        self._transports = [Transport.connect(endpoint) for _ in range(count)]
        for transport, numbers in zip(self._transports, self._numbers, strict=True):
            messages = transport.subscribe(key)
            threading.Thread(target=self._follow, args=(messages, numbers), daemon=True).start()

    def _follow(self, messages: Iterable[bytes], numbers: list[int]) -> None:
        for data in messages:
            numbers.append(protocol.decode_commit(protocol.decode_published(data).commit).revision)

    def in_order(self, versions: list[int]) -> int:
        """Return how many got all of these versions, in order and once."""
        late = time.monotonic() + _LONG
        while any(len(n) < len(versions) for n in self._numbers) and time.monotonic() < late:
            time.sleep(0.001)
        return sum(numbers == versions for numbers in self._numbers)


class Source:
    """Source of vectors; the first value is the time of sending."""

    def __init__(self) -> None:
        self._publisher = StatePublisher("bench", _SOURCE, _VALUES)

    def endpoint(self) -> str:
        """Return where it listens."""
        return self._publisher.endpoint

    def send(self, count: int, rate: float) -> float:
        """Send vectors at a rate [1/s], and return the rate that was reached."""
        vector, start = np.zeros(len(_VALUES)), perf_counter()
        for number in range(count):
            due = start + number / rate
            while (now := perf_counter()) < due:
                time.sleep(max(0.0, due - now))
            vector[0] = now
            self._publisher.put(vector)
        return count / (perf_counter() - start)


class Reader:
    """Reader of a source, awake whenever a vector comes."""

    def __init__(self, endpoint: str) -> None:
        self._reader = StateReader("bench", _VALUES)
        self._reader.follow([protocol.SourceStatus(_SOURCE, endpoint, _VALUES, 0.0, "0" * 32)])
        self._delays: list[float] = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        vector = np.zeros(len(_VALUES))
        while True:
            if self._reader.wait(_LONG):
                self._reader.into(vector)
                self._delays.append(perf_counter() - vector[0])

    def taken(self, count: int) -> tuple[int, float]:
        """Return how many of all vectors did not come, and the median time that one took [s]."""
        late = time.monotonic() + 1.0
        while self._received() < count and time.monotonic() < late:
            time.sleep(0.001)
        delays, self._delays = self._delays, []
        return count - self._received(), statistics.median(delays)

    def _received(self) -> int:
        return self._reader.received[_SOURCE]


def wait_for(is_done: Callable[[], bool]) -> None:
    """Wait until something is so."""
    late = time.monotonic() + _LONG
    while not is_done():
        if time.monotonic() > late:
            raise KineverseError(f"What was waited for has not come within {_LONG:g} s.")
        time.sleep(0.001)
