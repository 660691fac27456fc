"""Faults of model servers and networks, a little of each; ``make faults`` tries more."""

from __future__ import annotations

import os
import signal
from contextlib import ExitStack

import pytest

pytest.importorskip("zenoh")
pytest.importorskip("resource")
pytest.importorskip("cryptography")

from faults import edge
from faults import server as faults
from faults.processes import folder, start

BUSY = 5.0
"""Longest time of an edit on a machine that does other things as well [s]."""


def test_how_a_process_has_ended_is_said() -> None:
    with folder() as path, ExitStack() as running:
        faults.make_store(path / "home.db")
        server = start(running, "served", path / "home.db")
        os.kill(server.id, signal.SIGKILL)
        with pytest.raises(AssertionError, match="has ended, killed by SIGKILL"):
            server.ask("state")


def test_a_second_server_of_a_store_or_a_name_is_refused() -> None:
    faults.try_twice()


def test_a_damaged_store_is_refused_in_one_line() -> None:
    assert faults.try_damages(15, 1)["refused"]


def test_what_was_acknowledged_survives_kills_of_servers_and_clients() -> None:
    """Each edit is there once and whole, and all replicas are equal."""
    found = faults.try_kills(2, 1, processes=1)
    assert found["servers"] == 2
    assert found["clients"]
    assert found["made"]


def test_a_full_disk_refuses_edits_until_there_is_room() -> None:
    assert faults.try_full_disks(2, 1)["failed"] >= 2


def test_random_edits_end_in_the_same_model_everywhere_whatever_the_clock() -> None:
    found = faults.try_edits(200, 4, 1, "jump")
    assert found["made"] > 60
    assert found["conflict"] > 5


def test_nobody_is_held_up_by_a_process_that_stands_still() -> None:
    found = faults.try_freezing(1.3, 1, most=BUSY)
    assert found["made"] > 10


def test_nonsense_is_refused_and_harms_nobody() -> None:
    found = faults.try_messages(700, 100, 1, senders=1, most=BUSY)
    assert found["malformed"] > 150
    assert found["Committed"] > 5
    assert "failed" not in found


@pytest.mark.parametrize(
    "route",
    [pytest.param(route, marks=pytest.mark.long if route != "relay" else ()) for route in edge.ROUTES],
)
def test_what_was_acknowledged_survives_partitions(route: str) -> None:
    """Both kinds of cuts; clients notice it, edit again, and have what was edited at the server's side."""
    found = edge.try_partitions(2, 1.2, 1, route, most=BUSY)
    assert found["edits meanwhile"] > 10
    assert found["made"] > found["edits meanwhile"]


def test_a_second_relay_is_used_when_the_first_is_killed() -> None:
    assert edge.try_relays(1, 1, most=BUSY)["made"]


def test_a_slow_connection_holds_up_nobody() -> None:
    """A batch of 64 kB would take longer than the lease."""
    assert edge.try_slow(400e3, 1, most=BUSY)["kB"] > 200
