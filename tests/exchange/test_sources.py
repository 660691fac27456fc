"""Sources of state of a live model: announced, found by readers, and independent of the server."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import kineverse as kv
from kineverse.exchange.client import LiveModel
from kineverse.exchange.server import serve

pytest.importorskip("zenoh")
pytestmark = pytest.mark.usefixtures("sockets")

LONG = 10.0  # longest time that anything is waited for [s]


def load() -> LiveModel:
    model = kv.load("live:home")
    assert isinstance(model, LiveModel)
    return model


def until(is_so: Callable[[], bool]) -> bool:
    end = time.monotonic() + LONG
    while time.monotonic() < end:
        if is_so():
            return True
        time.sleep(0.01)
    return False


def test_a_source_is_found_by_readers_from_before_and_after() -> None:
    with serve(kv.Model(), name="home"), load() as robot, load() as other:
        early, vector = other.exchange.reader(["b", "a"]), np.zeros(2)
        publisher = robot.exchange.publisher("arm", [kv.position("a"), "b"], offset=0.5)
        late = other.exchange.reader(["b"])
        (status,) = other.exchange.status().sources
        assert (status.source, status.coordinates, status.offset) == ("arm", ("a", "b"), 0.5)

        def is_filled() -> bool:
            publisher.put([1.0, 2.0], stamp=7.0)
            return early.into(vector) == 2 and late.into(np.zeros(1)) == 1

        assert until(is_filled)
        assert vector.tolist() == [2.0, 1.0]
        assert early.state.stamp == 7.5
        publisher.set_coordinates(["c"])
        assert other.exchange.status().sources[0].coordinates == ("c",)
        publisher.close()
        assert other.exchange.status().sources == ()
        assert until(lambda: early.into(vector) == 0)
        with pytest.raises(kv.errors.InvalidValueError, match="source"):
            robot.exchange.publisher("an arm", ["a"])


def test_a_reader_is_not_woken_by_what_it_does_not_read() -> None:
    with serve(kv.Model(), name="home"), load() as model:
        reader, all_of_it = model.exchange.reader(["a"]), model.exchange.reader()
        publisher = model.exchange.publisher("arm", ["b"])
        assert until(lambda: publisher.put([1.0]) or all_of_it.wait(0.01))
        assert until(lambda: publisher.put([1.0]) or reader.received.get("arm", 0) > 0)
        assert not reader.wait(0)


def test_a_stream_survives_the_server_which_hears_of_it_again(tmp_path: Path) -> None:
    store = tmp_path / "home.db"
    server = serve(kv.Model(), name="home", store=store)
    with load() as robot, load() as other:
        publisher, reader, vector = (
            robot.exchange.publisher("arm", ["a"]),
            other.exchange.reader(["a"]),
            np.zeros(1),
        )
        sent = 0.0

        def is_read_on() -> bool:
            begin = sent
            return until(lambda: send() and reader.into(vector) == 1 and vector[0] > begin)

        def send() -> bool:
            nonlocal sent
            sent += 1
            publisher.put([sent])
            return reader.wait(0.02)

        assert is_read_on()
        server.close()
        assert until(lambda: not other.exchange.is_online)
        assert is_read_on()
        with pytest.raises(kv.errors.OfflineError):
            other.exchange.reader(["a"])
        with serve(store=store):
            fresh, found = load(), []

            def is_known_again() -> bool:
                found.append(reader.into(vector))
                return bool(fresh.exchange.status().sources)

            with fresh:
                assert until(is_known_again)
            assert is_read_on()
            assert set(found) == {1}
