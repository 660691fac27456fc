"""Questions, messages and signs of life between processes, also when some are killed, frozen, or just end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zenoh")

from kineverse.errors import InvalidValueError
from kineverse.exchange.address import Claim
from kineverse.exchange.transport import Channel, NoAnswerError, Question, Transport

LATE = 10.0
"""Time after which a test fails [s]; what is awaited comes within milliseconds."""

SERVER = """
import os, sys, threading
from kineverse.exchange.transport import Transport
server = Transport.serve(sys.argv[1:])
requests = server.answers("k/ask")
token = server.alive(f"k/alive/{os.getpid()}")
print("ready", flush=True)
for request in requests:
    request.answer(request.payload)
"""

READER = """
import sys
from kineverse.exchange.transport import Transport
messages = Transport.connect(sys.argv[1]).subscribe("k/log")
print("ready", flush=True)
for message in messages:
    pass
"""

CARELESS = """
import sys, threading, time
from kineverse.exchange.transport import NoAnswerError, Transport

client = Transport.connect(sys.argv[1])
def use(channel):
    for _ in channel:
        pass
def publish():
    while True:
        client.publish("k/log", bytes(100))
def ask():
    while True:
        try:
            client.ask("k/silent", b"", 60.0)
        except NoAnswerError:
            time.sleep(.001)
token = client.alive("k/client/1")
for channel in (client.subscribe("k/log"), client.answers("k/mine"), client.watch_alive("k/alive/*")):
    threading.Thread(target=use, args=(channel,), daemon=True).start()
for work in (publish, ask):
    threading.Thread(target=work, daemon=True).start()
print("ready", flush=True)
sys.stdin.readline()
"""


@pytest.fixture
def endpoint(sockets: Path) -> str:
    return f"unixsock-stream/{sockets}/s.sock"


@pytest.fixture
def pair(endpoint: str) -> Generator[tuple[Transport, Transport]]:
    server = Transport.serve([endpoint])
    client = Transport.connect(endpoint)
    yield server, client
    client.close()
    server.close()


def in_thread(work: Callable[[], Any]) -> threading.Thread:
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return thread


def echo(server: Transport, key: str = "k/ask") -> threading.Thread:
    requests = server.answers(key)

    def work() -> None:
        for request in requests:
            request.answer(request.payload)

    return in_thread(work)


def until(holds: Callable[[], bool]) -> None:
    late = time.monotonic() + LATE
    while not holds():
        assert time.monotonic() < late
        time.sleep(0.005)


def answered(client: Transport) -> bool:
    try:
        return client.ask("k/ask", b"there?", 1.0) == b"there?"
    except NoAnswerError:
        return False


def collect(channel: Any) -> list[Any]:
    """Return a list that grows by what arrives."""
    found: list[Any] = []
    in_thread(lambda: deque(map(found.append, channel), 0))
    return found


@pytest.mark.parametrize("size", [0, 1, 65_535, 65_536, 20_000_000])
def test_an_answer_has_the_bytes_that_were_sent(pair: tuple[Transport, Transport], size: int) -> None:
    server, client = pair
    echo(server)
    sent = os.urandom(size)
    assert client.ask("k/ask", sent, LATE) == sent


def test_nobody_is_waited_for_who_is_not_there_or_drops_the_request(
    pair: tuple[Transport, Transport],
) -> None:
    server, client = pair
    start = time.monotonic()
    with pytest.raises(NoAnswerError, match="Nobody"):
        client.ask("k/ask", b"", 60.0)
    requests = server.answers("k/ask")
    in_thread(lambda: requests.take(1, 0.0))
    with pytest.raises(NoAnswerError):
        client.ask("k/ask", b"", 60.0)
    assert time.monotonic() - start < LATE


def test_a_request_without_an_answer_ends_after_its_timeout(pair: tuple[Transport, Transport]) -> None:
    server, client = pair
    waiting = server.answers("k/ask")
    with pytest.raises(NoAnswerError, match=r"within 0\.05 s"):
        client.ask("k/ask", b"", 0.05)
    (request,) = waiting.take(10, 0.0)
    request.answer(b"too late")


def test_requests_are_taken_in_batches(pair: tuple[Transport, Transport]) -> None:
    server, client = pair
    requests = server.answers("k/ask")
    askers = [in_thread(lambda n=n: client.ask("k/ask", bytes([n]), LATE)) for n in range(5)]
    taken: list[Question] = []
    sizes = []
    while len(taken) < 5:
        batch = requests.take(2, 1.0)
        sizes.append(len(batch))
        taken += batch
    assert max(sizes) <= 2
    assert sorted(request.payload for request in taken) == [bytes([n]) for n in range(5)]
    for request in taken:
        request.answer(b"")
    for asker in askers:
        asker.join(LATE)
        assert not asker.is_alive()


def test_messages_come_in_order_and_whole(pair: tuple[Transport, Transport]) -> None:
    server, client = pair
    found = collect(client.subscribe("k/log"))
    sent = [number.to_bytes(4, "big") * (1 + number % 7) for number in range(999)]
    for number, message in enumerate(sent, 1):
        server.publish("k/log", message)
        if number % 37 == 0:  # a reader that gets no time loses messages
            until(lambda number=number: len(found) == number)
    until(lambda: len(found) == 999)
    assert found == sent
    # One so large may be dropped where the reader gets no time on a busy machine.
    server.publish("k/log", bytes(20_000_000))
    late = time.monotonic() + 1.0
    while len(found) == 999:
        time.sleep(0.005)
        if time.monotonic() > late:
            late += 1.0
            server.publish("k/log", bytes(20_000_000))
    assert found[999] == bytes(20_000_000)


def test_a_slow_reader_gets_the_newest_messages(pair: tuple[Transport, Transport]) -> None:
    server, client = pair
    slow, quick = client.subscribe("k/log", 3), collect(client.subscribe("k/log"))
    for number in range(256):  # what is sent before the subscriptions are known is lost
        server.publish("k/log", bytes([number]))
        late = time.monotonic() + 1.0
        while quick[-1:] != [bytes([number])] and time.monotonic() < late:
            time.sleep(0.001)
        if len(quick) >= 10 and quick[-1] == bytes([number]):
            break
    found = collect(slow)
    until(lambda: found[-1:] == quick[-1:])
    assert found[-3:] == quick[-3:]
    assert len(found) < 5


def test_a_taken_endpoint_is_refused(pair: tuple[Transport, Transport], endpoint: str) -> None:
    with pytest.raises(InvalidValueError, match="Cannot listen at"):
        Transport.serve([endpoint])
    with pytest.raises(InvalidValueError, match="nothing to listen at"):
        Transport.serve(["udp/127.0.0.1:1"])


def test_without_the_secret_there_is_no_answer(sockets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kineverse.exchange.address.UNIX_SOCKETS", False)
    claim = Claim("home")
    server = Transport.serve([claim.endpoint], claim.secret)
    echo(server)
    for wrong in ("", "wrong", claim.secret.upper() + "0"):
        with pytest.raises(NoAnswerError):
            Transport.connect(claim.endpoint, wrong)
    client = Transport.connect(claim.endpoint, claim.secret)
    assert answered(client)
    client.close()
    server.close()
    claim.release()


def test_no_server_is_an_error_at_once(endpoint: str) -> None:
    start = time.monotonic()
    with pytest.raises(NoAnswerError, match="No server"):
        Transport.connect(endpoint)
    with pytest.raises(NoAnswerError):
        Transport.connect("tcp/127.0.0.1:9")
    assert time.monotonic() - start < 1.0


def test_a_server_is_waited_for_if_that_is_wanted(endpoint: str) -> None:
    servers: list[Transport] = []
    timer = threading.Timer(0.1, lambda: servers.append(Transport.serve([endpoint])))
    timer.start()
    client = Transport.connect(endpoint, timeout=LATE)
    timer.join()
    client.close()
    servers[0].close()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_no_port_is_opened(endpoint: str) -> None:
    before = list_ports()
    server, client = Transport.serve([endpoint]), Transport.connect(endpoint)
    assert list_ports() <= before
    client.close()
    server.close()


def list_ports() -> set[str]:
    """Return the addresses at which this process can be reached by the network."""
    folder = Path("/proc/self/fd")
    mine = {os.readlink(folder / name) for name in os.listdir(folder) if (folder / name).is_symlink()}
    rows = [
        line.split()
        for kind in ("tcp", "tcp6", "udp", "udp6")
        for line in Path("/proc/net", kind).read_text().splitlines()[1:]
    ]
    return {row[1] for row in rows if f"socket:[{row[9]}]" in mine}


def test_closed_is_closed(pair: tuple[Transport, Transport]) -> None:
    server, client = pair
    echo(server)
    channels: list[Channel] = [
        client.subscribe("k/log"),
        client.answers("k/x"),
        client.watch_alive("k/alive/*"),
    ]
    threads = [in_thread(lambda channel=channel: deque(channel, 0)) for channel in channels]  # type: ignore[call-overload, misc]
    channels[0].close()
    threads[0].join(LATE)
    assert not threads[0].is_alive()
    unanswered = server.answers("k/silent")

    def ask() -> None:
        with pytest.raises(NoAnswerError):
            client.ask("k/silent", b"", 60.0)

    asker = in_thread(ask)
    requests = unanswered.take(1, 0.0)
    assert len(requests) == 1
    client.close()
    for thread in threads:
        thread.join(LATE)
        assert not thread.is_alive()
    asker.join(LATE)
    assert not asker.is_alive()
    client.publish("k/log", b"")
    for call in (
        lambda: client.ask("k/ask", b"", 1.0),
        lambda: client.subscribe("k/log"),
        lambda: client.alive("k/a"),
    ):
        with pytest.raises(NoAnswerError):
            call()
    for channel in channels:
        channel.close()
    client.close()


def test_a_connection_is_made_again_after_a_kill(start: Any, endpoint: str) -> None:
    first = start(SERVER, endpoint)
    client = Transport.connect(endpoint)
    signs = collect(client.watch_alive("k/alive/*"))
    until(lambda: signs == [(f"k/alive/{first.pid}", True)])
    assert answered(client)
    first.kill()
    until(lambda: signs[1:] == [(f"k/alive/{first.pid}", False)])
    assert not answered(client)
    with pytest.raises(NoAnswerError):
        Transport.connect(endpoint)
    second = start(SERVER, endpoint)
    until(lambda: signs[2:] == [(f"k/alive/{second.pid}", True)])
    assert answered(client)
    client.close()


def test_a_frozen_server_counts_as_gone_until_it_goes_on(start: Any, endpoint: str) -> None:
    server = start(SERVER, endpoint)
    key = f"k/alive/{server.pid}"
    client = Transport.connect(endpoint)
    signs = collect(client.watch_alive("k/alive/*"))
    until(lambda: signs == [(key, True)])
    server.send_signal(signal.SIGSTOP)
    until(lambda: signs[1:] == [(key, False)])
    server.send_signal(signal.SIGCONT)
    until(lambda: signs[2:] == [(key, True)])
    until(lambda: answered(client))
    client.close()


def test_a_frozen_reader_holds_up_nobody(
    start: Any, pair: tuple[Transport, Transport], endpoint: str
) -> None:
    server, client = pair
    found = collect(client.subscribe("k/log"))
    frozen = start(READER, endpoint)
    frozen.send_signal(signal.SIGSTOP)
    begin = time.monotonic()
    for number in range(100):
        server.publish("k/log", number.to_bytes(4, "big") * 5_000)
        until(lambda number=number: len(found) > number)
    assert time.monotonic() - begin < 4.0  # one who waits for it waits for 5 s


@pytest.mark.parametrize("end", ["", "raise RuntimeError", "raise KeyboardInterrupt", "wait"])
def test_a_script_ends_that_has_closed_nothing(
    start: Any, pair: tuple[Transport, Transport], endpoint: str, end: str, hears_ctrl_c: None
) -> None:
    server, _ = pair
    unanswered = server.answers("k/silent")
    held = in_thread(lambda: [*unanswered])
    last = 'list(client.subscribe("k/nothing"))' if end == "wait" else end
    script = start(f"{CARELESS}\n{last}\n", endpoint)
    script.stdin.write("\n")
    script.stdin.flush()
    if end == "wait":
        time.sleep(0.05)
        script.send_signal(signal.SIGINT)
    begin = time.monotonic()
    _, errors = script.communicate(timeout=LATE)
    assert time.monotonic() - begin < 2.0, errors
    assert script.returncode == {"": 0, "raise RuntimeError": 1}.get(end, -signal.SIGINT)
    if not end:
        assert errors == ""
    unanswered.close()
    held.join(LATE)


def test_it_can_be_missing() -> None:
    program = """
import sys
sys.modules["zenoh"] = None
from kineverse.exchange.transport import Transport
try:
    Transport.connect("tcp/127.0.0.1:1")
except ImportError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "eclipse-zenoh" in done.stdout
