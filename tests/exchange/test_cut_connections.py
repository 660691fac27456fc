"""Questions whose connection is cut: none is waited for, and each is asked anew when the server is seen."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zenoh")
pytest.importorskip("resource")
pytest.importorskip("cryptography")

from faults.edge import HOST, find_port
from faults.proxy import CUTS, Proxy

import kineverse as kv
from kineverse.exchange import protocol
from kineverse.exchange.address import Address
from kineverse.exchange.connection import Connection
from kineverse.exchange.server import Server, serve
from kineverse.exchange.transport import LONGEST, NoAnswerError, Question, Transport

LONG = 20.0
"""Longest time that anything is waited for [s]; a question without an answer would take longer."""


@pytest.fixture
def running(sockets: Path) -> Iterator[ExitStack]:
    """Stack of what is closed after a test."""
    with ExitStack() as opened:
        yield opened


@pytest.mark.parametrize("how", CUTS)
@pytest.mark.parametrize("is_relayed", [False, True])
def test_a_question_ends_when_a_connection_on_its_way_is_cut(
    running: ExitStack, how: str, is_relayed: bool
) -> None:
    port = find_port()
    server = running.enter_context(closing(Transport.serve([f"tcp/{HOST}:{port}"])))
    questions, _presence = server.answers("k/ask"), server.alive("k/alive/1")
    proxy = running.enter_context(closing(Proxy(port)))
    endpoint = f"tcp/{HOST}:{proxy.port}"
    if is_relayed:
        relay = f"tcp/{HOST}:{find_port()}"
        running.enter_context(closing(Transport.serve([relay], servers=[endpoint])))
        endpoint = relay
    client = running.enter_context(closing(Transport.connect(endpoint, timeout=LONG)))
    signs = iter(client.watch_alive("k/alive/*"))
    assert next(signs) == ("k/alive/1", True)
    is_cut = threading.Event()

    def ask() -> None:
        while not is_cut.is_set():  # for moments after a connection was made, nobody is known who answers
            with pytest.raises(NoAnswerError):
                client.ask("k/ask", b"", 10 * LONG)

    asker = threading.Thread(target=ask, daemon=True)
    asker.start()
    (held,) = questions.take(1, LONG)  # it is there, and gets no answer
    is_cut.set()
    proxy.cut(how)
    asker.join(LONG)
    assert not asker.is_alive()
    assert next(signs) == ("k/alive/1", False)
    held.answer(b"too late, which harms nobody")
    proxy.heal()  # else those who try to connect hold up the end


@pytest.fixture
def server(running: ExitStack) -> tuple[Server, Proxy]:
    """Server, and a proxy that leads to it."""
    port, model = find_port(), kv.Model()
    with model.edit() as edit:
        edit.add_frame("base", "world")
    opened = running.enter_context(serve(model, name="home", listen=[f"tcp/{HOST}:{port}"]))
    return opened, running.enter_context(closing(Proxy(port)))


@pytest.mark.parametrize("part", [{}, {"frames": ["world"]}])
def test_what_was_missed_is_asked_for_anew_after_each_cut(
    running: ExitStack,
    server: tuple[Server, Proxy],
    load: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
    part: dict[str, Any],
) -> None:
    """Answers are lost with the first two connections, whose questions end with them."""
    home, proxy = server
    far, near = load(f"live:tcp/{HOST}:{proxy.port}/home", **part), load()
    answer, lost, is_lost = Question.answer, list[Question](), threading.Semaphore(0)

    def lose(question: Question, payload: bytes) -> None:
        request = protocol.decode_request(question.payload)
        if isinstance(request, protocol.Since) and request.client == far.exchange.client and len(lost) < 2:
            lost.append(question)
            is_lost.release()
        else:
            answer(question, payload)

    for cut in range(3):
        proxy.cut("reset")
        assert far.exchange.wait_for(lambda: not far.exchange.is_online, LONG)
        if cut == 0:
            monkeypatch.setattr(Question, "answer", lose)
        with near.edit() as edit:
            edit.add_frame(f"shelf {cut}", "world")
        proxy.heal()
        if cut < 2:
            assert is_lost.acquire(timeout=LONG)
    assert far.wait(near.version, LONG)
    for question in lost:
        answer(question, b"too late")
    with far.edit() as edit:
        edit.add_frame("last", "world")
    assert near.wait(home.revision, LONG)
    assert "last" in near.frames
    assert len(lost) == 2


@pytest.mark.parametrize(
    "ask",
    [
        lambda one: one.join(protocol.JoinRequest(protocol.PROTOCOL, "", "", "")),
        lambda one: one.ask_missed(""),
        lambda one: one.fetch_part("0" * 64, 0),
    ],
    ids=["join", "missed", "file"],
)
def test_a_long_answer_is_asked_for_once(
    server: tuple[Server, Proxy], monkeypatch: pytest.MonkeyPatch, ask: Callable[[Connection], object]
) -> None:
    """It takes long on a slow connection, where asking again would only let it begin anew."""
    timeouts: list[float] = []

    def be_slow(_transport: Transport, _key: str, _payload: bytes, timeout: float, **_: object) -> bytes:
        timeouts.append(timeout)
        raise TimeoutError

    with closing(Connection(Address.parse("live:home"))) as connection:
        monkeypatch.setattr(Transport, "ask", be_slow)
        with pytest.raises(TimeoutError):
            ask(connection)
        monkeypatch.undo()
    assert len(timeouts) == 1
    assert timeouts[0] >= LONGEST
