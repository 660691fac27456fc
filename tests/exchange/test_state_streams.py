"""Streams of state: every value arrives by its name, the newest counts, and sources come and go."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zenoh")

import kineverse as kv
from kineverse.errors import DuplicateNameError, InvalidValueError, ShapeError
from kineverse.exchange.address import UNIX_SOCKETS
from kineverse.exchange.protocol import SourceStatus
from kineverse.exchange.state import THROUGH_SERVER, StatePublisher, StateReader
from kineverse.exchange.transport import Transport

pytestmark = pytest.mark.usefixtures("sockets")

LATE = 10.0
WAYS = ["direct", "server"]

SOURCE = """
import sys, time
from kineverse.exchange.state import StatePublisher
with StatePublisher("home", "camera", sys.argv[1:]) as source:
    print("ready", flush=True)
    number = 0
    while True:
        number += 1
        source.put([number] * (len(sys.argv) - 1), stamp=number)
        time.sleep(.002)
"""

CARELESS = """
import sys, threading
from kineverse.exchange.protocol import SourceStatus
from kineverse.exchange.state import StatePublisher, StateReader
mine = StatePublisher("home", "mine", ["b"])
reader = StateReader("home", ["a", "b"])
places = [("mine", mine.endpoint), ("camera", mine.endpoint.replace("mine", "camera"))]
reader.follow([SourceStatus(name, place, (), 0.0, 32 * "0") for name, place in places])
def send():
    while True:
        mine.put([1.0])
for work in (send, lambda: [None for _ in iter(lambda: reader.wait(10.0), None)]):
    threading.Thread(target=work, daemon=True).start()
while set(reader.age) != {"mine", "camera"}:
    reader.wait(1.0)
print("ready", flush=True)
sys.stdin.readline()
"""


@pytest.fixture
def server(sockets: Path) -> Generator[Transport]:
    transport = Transport.serve([f"unixsock-stream/{sockets}/home.sock"])
    yield transport
    transport.close()


@pytest.fixture
def connect(sockets: Path, server: Transport) -> Generator[Callable[[str], dict[str, Any]]]:
    """Function that returns how to reach a source: by its socket, or through the server."""
    clients: list[Transport] = []

    def choose(way: str) -> dict[str, Any]:
        if way == "direct":
            if not UNIX_SOCKETS:
                pytest.skip("there are no sockets")
            return {}
        clients.append(Transport.connect(f"unixsock-stream/{sockets}/home.sock"))
        return {"server": clients[-1], "direct": False}

    yield choose
    for client in clients:
        client.close()


def status(publisher: StatePublisher, source: str = "camera", offset: float = 0.0) -> SourceStatus:
    return SourceStatus(source, publisher.endpoint, publisher.coordinates, offset, 32 * "0")


def until(holds: Callable[[], bool]) -> None:
    late = time.monotonic() + LATE
    while not holds():
        assert time.monotonic() < late
        time.sleep(0.002)


def put_until(
    publisher: StatePublisher, values: list[float], stamp: float, holds: Callable[[], bool]
) -> None:
    """Send a vector again and again until it is there: a reader that has just begun may miss the first."""

    def there() -> bool:
        publisher.put(values, stamp)
        return holds()

    until(there)


@pytest.mark.parametrize("way", WAYS)
def test_values_arrive_by_name_to_the_bit(connect: Any, way: str) -> None:
    rng = np.random.default_rng(3)
    names = ["kitchen/fridge_door", "kitchen/fridge_door:velocity", "a%3Ab", "z"]
    with (
        StatePublisher("home", "camera", names, **connect(way)) as source,
        StateReader("home", ["z", "unknown", "kitchen/fridge_door"], **connect(way)) as reader,
    ):
        assert source.endpoint.startswith("unixsock-stream/") == (way == "direct")
        reader.follow([status(source)])
        put_until(source, [1.0, 2.0, 3.0, 4.0], 0.5, lambda: reader.received["camera"] > 0)
        vector = np.full(3, -7.0)
        assert reader.into(vector) == 2
        assert vector.tolist() == [4.0, -7.0, 1.0]
        assert reader.state == kv.State(
            dict(zip(names, [1.0, 2.0, 3.0, 4.0], strict=True)), stamp=0.5, source="camera"
        )
        for number in range(100):
            values = rng.normal(size=4) * 10.0 ** rng.integers(-300, 300)
            source.put(values, stamp=number)
            until(lambda number=number: reader.state.stamp == number)  # type: ignore[misc]
            assert [*reader.state.values()] == values.tolist()
        assert reader.lost == {"camera": 0}


@pytest.mark.parametrize("way", WAYS)
def test_a_reader_gets_every_vector_that_is_sent_meanwhile(connect: Any, way: str) -> None:
    with (
        StatePublisher("home", "camera", ["a"], **connect(way)) as source,
        StateReader("home", ["a"], **connect(way)) as reader,
    ):
        reader.follow([status(source)])
        put_until(source, [0.0], 0.0, lambda: reader.received["camera"] > 0)
        before = reader.received["camera"]
        for number in range(1, 1_001):
            source.put([number])
            if number % 10 == 0:
                time.sleep(0.0005)
        until(lambda: reader.state["a"] == 1_000)
        assert reader.received["camera"] - before >= 1_000
        assert reader.lost == {"camera": 0}


def test_one_who_comes_late_learns_the_layout_from_the_source(connect: Any) -> None:
    """Also where the server's list is older than the source's vectors."""
    with (
        StatePublisher("home", "camera", ["a", "b"], **connect("direct")) as source,
        StateReader("home", ["b"], **connect("direct")) as reader,
    ):
        old = SourceStatus("camera", source.endpoint, ("x",), 0.0, 32 * "0")
        reader.follow([old])
        put_until(source, [1.0, 2.0], 0.0, lambda: reader.received["camera"] > 0)
        assert dict(reader.state) == {kv.position("a"): 1.0, kv.position("b"): 2.0}
        # A new layout comes whole with its first vector, and what is no longer in it is gone.
        for round_ in range(20):
            names = [f"c{round_}", "b", "d"][: 2 + round_ % 2]
            source.set_coordinates(names)
            put_until(
                source,
                [float(round_)] * len(names),
                1.0,
                lambda names=names: [*map(str, reader.state)] == names,
            )  # type: ignore[misc]
            assert {*reader.state.values()} == {float(round_)}
            assert reader.into(np.zeros(1)) == 1


def test_the_newest_value_counts_in_time_of_the_server(connect: Any) -> None:
    with (
        StatePublisher("home", "one", ["a", "b"], **connect("direct")) as one,
        StatePublisher("home", "two", ["b", "c"], **connect("direct")) as two,
        StateReader("home", ["a", "b", "c"], **connect("direct")) as reader,
    ):
        for offset, expected in ((5.0, [1.0, 2.0, 4.0]), (-5.0, [1.0, 3.0, 4.0])):
            reader.follow([status(one, "one", offset), status(two, "two")])
            put_until(one, [1.0, 2.0], 10.0, lambda: reader.received["one"] > 0)
            put_until(two, [3.0, 4.0], 12.0, lambda: reader.received["two"] > 0)
            vector = np.zeros(3)
            assert reader.into(vector) == 3
            assert vector.tolist() == expected
            assert reader.state.vector([kv.position(n) for n in "abc"]).tolist() == expected
            assert reader.state.stamp == max(10.0 + offset, 12.0)
        reader.follow([status(two, "two")])
        assert reader.into(np.zeros(3)) == 2
        assert set(reader.age) == {"two"}


@pytest.mark.skipif(not UNIX_SOCKETS, reason="there are no sockets")
def test_a_source_may_be_killed_and_come_back_otherwise(start: Any) -> None:
    first = start(SOURCE, "a")
    with pytest.raises(DuplicateNameError, match="'camera'"):
        StatePublisher("home", "camera", ["a"])
    with StateReader("home", ["a", "b"]) as reader:
        assert not reader.wait(0.0)
        assert reader.into(np.zeros(2)) == 0
        with StatePublisher("home", "other", ["x"]) as other:
            endpoint = other.endpoint.replace("other", "camera")
        reader.follow([SourceStatus("camera", endpoint, ("a",), 0.0, 32 * "0")])
        assert reader.wait(LATE)
        first.send_signal(signal.SIGSTOP)
        until(lambda: reader.age["camera"] > 0.05)
        first.send_signal(signal.SIGCONT)
        until(lambda: reader.age["camera"] < 0.05)
        first.kill()
        first.wait()
        until(lambda: reader.age["camera"] > 0.05)
        assert reader.into(np.zeros(2)) == 1
        start(SOURCE, "b", "a")
        until(lambda: reader.into(np.zeros(2)) == 2)
        assert reader.lost == {"camera": 0}


@pytest.mark.skipif(not UNIX_SOCKETS, reason="there are no sockets")
def test_a_stream_outlives_the_server_and_begins_before_it(sockets: Path, server: Transport) -> None:
    endpoint = f"unixsock-stream/{sockets}/home.sock"
    mine, yours, far = (Transport.connect(endpoint) for _ in range(3))
    with (
        StatePublisher("home", "camera", ["a"], server=mine) as source,
        StateReader("home", ["a"], server=yours) as near,
        StateReader("home", ["a"], server=far, direct=False) as through,
    ):
        for reader in (near, through):
            reader.follow([status(source)])
            put_until(source, [1.0], 1.0, lambda reader=reader: reader.received["camera"] > 0)  # type: ignore[misc]
        server.close()
        source.put([2.0], 2.0)
        until(lambda: near.state["a"] == 2.0)
        assert through.state["a"] == 1.0
        again = Transport.serve([endpoint])
        put_until(source, [3.0], 3.0, lambda: through.state["a"] == 3.0)
        again.close()
    for client in (mine, yours, far):
        client.close()


def test_what_is_no_value_is_not_sent(connect: Any) -> None:
    with (
        StatePublisher("home", "camera", ["a", "b"], **connect("direct")) as source,
        StateReader("home", ["a", "b"], **connect("direct")) as reader,
    ):
        reader.follow([status(source)])
        put_until(source, [1.0, 2.0], 1.0, lambda: reader.received["camera"] > 0)
        for bad in (math.nan, math.inf, -math.inf):
            with pytest.raises(InvalidValueError, match="'b' is NaN or infinite"):
                source.put([1.0, bad])
            with pytest.raises(InvalidValueError, match="stamp"):
                source.put([1.0, 2.0], stamp=bad)
        for wrong in ([1.0], [1.0, 2.0, 3.0], [[1.0, 2.0]], 1.0):
            with pytest.raises(ShapeError):
                source.put(wrong)
        with pytest.raises(ShapeError):
            reader.into(np.zeros(3))
        with pytest.raises(DuplicateNameError, match="'a' is given twice"):
            source.set_coordinates(["a", "b", "a"])
        source.put([5.0, 6.0], 2.0)
        until(lambda: reader.state.stamp == 2.0)
        assert reader.lost == {"camera": 0}


def test_what_is_no_vector_is_not_taken(sockets: Path, server: Transport, connect: Any) -> None:
    way = connect("server")
    with (
        StatePublisher("home", "camera", ["a"], **way) as source,
        StateReader("home", ["a"], **connect("server")) as reader,
    ):
        reader.follow([status(source)])
        put_until(source, [1.0], 1.0, lambda: reader.received["camera"] > 0)
        rng = np.random.default_rng(5)
        for size in (0, 1, 39, 40, 41, 47, 48, 49, 1_000):
            for fill in (bytes(size), b"\xff" * size, rng.bytes(size)):
                way["server"].publish("kineverse/home/state/camera", fill)
        put_until(source, [2.0], 2.0, lambda: reader.state.stamp == 2.0)
        assert reader.state["a"] == 2.0


def test_waiting_ends_with_a_vector_or_in_time(connect: Any) -> None:
    with (
        StatePublisher("home", "camera", ["a"], **connect("direct")) as source,
        StateReader("home", **connect("direct")) as reader,
    ):
        reader.follow([status(source)])
        assert not reader.wait(0.01)
        timer = threading.Timer(
            0.05, lambda: put_until(source, [1.0], 1.0, lambda: reader.received["camera"] > 0)
        )
        timer.start()
        assert reader.wait(LATE)
        timer.join()
        while reader.wait(0.01):
            pass
        assert not reader.wait(0.0)


def test_a_source_needs_a_way() -> None:
    with pytest.raises(InvalidValueError, match="neither a socket nor a server"):
        StatePublisher("home", "camera", ["a"], direct=False)
    with pytest.raises(InvalidValueError, match="no name of a source"):
        StatePublisher("home", "a/b", ["a"])
    with StateReader("home") as reader:
        reader.follow([SourceStatus("camera", THROUGH_SERVER, ("a",), 0.0, 32 * "0")])
        assert reader.received == {}
        assert reader.state == kv.State({}, source="")


@pytest.mark.skipif(not UNIX_SOCKETS, reason="there are no sockets")
def test_a_script_ends_that_has_closed_nothing(start: Any) -> None:
    start(SOURCE, "a")
    script = start(CARELESS)
    begin = time.monotonic()
    _, errors = script.communicate("\n", timeout=LATE)
    assert time.monotonic() - begin < 2.0
    assert (script.returncode, errors) == (0, "")
