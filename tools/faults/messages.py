"""Mutated messages to a model server, and to its clients, from a process that learns from real ones."""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections import Counter
from random import Random
from typing import Any
from uuid import uuid4

import msgspec
from fuzz import bytes_mutation, json_trees

import kineverse as kv
from kineverse.exchange import protocol
from kineverse.exchange.address import Address
from kineverse.exchange.transport import NoAnswerError, Transport

from .client import load
from .edits import do_something
from .processes import commands, tell
from .served import NAME

THREADS = 4
LEARNED = 100
"""Random edits by which real messages are learned."""
TOO_LATE = 20.0
_BLOB = "blob:"
_WORDS = (
    "edit",
    "undo",
    "join",
    "since",
    "status",
    "history",
    "file",
    "announce",
    "world",
    "part/lid",
    "counter",
)


# -- messages as trees, with the blobs in them ---------------------------------------------------------------


def _open(value: Any) -> Any:
    """Return a tree with blobs unpacked."""
    if isinstance(value, bytes) and len(value) > 32:
        try:
            inner = msgspec.msgpack.decode(value)
        except (ValueError, RecursionError):
            return value
        return {_BLOB: _open(inner)} if isinstance(inner, (dict, list)) else value
    if isinstance(value, list):
        return [_open(one) for one in value]
    return {key: _open(one) for key, one in value.items()} if isinstance(value, dict) else value


def _close(value: Any) -> Any:
    if isinstance(value, list):
        return [_close(one) for one in value]
    if isinstance(value, dict):
        if value.keys() == {_BLOB}:
            return msgspec.msgpack.encode(_close(value[_BLOB]))
        return {key: _close(one) for key, one in value.items()}
    return value


def _read(data: bytes) -> Any:
    try:
        return _open(msgspec.msgpack.decode(data))
    except (ValueError, RecursionError):
        return None


def _write(tree: Any) -> bytes:
    try:
        return msgspec.msgpack.encode(_close(tree))
    except (RecursionError, ValueError, OverflowError, TypeError):
        return b""


_mutate_tree = json_trees.mutator(_WORDS, json_trees.Notation(_read, _write))


def mutate(data: bytes, other: bytes, random: Random) -> bytes:
    """Return a message with something changed: bits, bytes, or fields."""
    kind = random.random()
    if kind < 0.2:
        changed = bytearray(data)
        for _ in range(random.choice((1, 1, 4))):
            changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
        return bytes(changed)
    return bytes_mutation.mutate(data, other, random) if kind < 0.3 else _mutate_tree(data, other, random)


# -- what is learned and sent --------------------------------------------------------------------------------


class Sender:
    """Connection that records the messages of live models, and sends mutated ones."""

    def __init__(self, seed: str) -> None:
        self.seed = seed
        endpoint, secret = Address.parse(f"live:{NAME}").find()
        self.transport = Transport.connect(endpoint, secret)
        self.requests: list[tuple[str, bytes]] = []
        self.published: list[tuple[str, bytes]] = []
        self.outcomes: Counter[str] = Counter()
        self.position = 0, protocol.NO_CHAIN
        for end in ("log", "view/*", "beat"):
            threading.Thread(target=self._listen, args=(end,), daemon=True).start()
        self._learn()

    def _listen(self, end: str) -> None:
        for number, data in enumerate(self.transport.subscribe(f"kineverse/{NAME}/{end}")):
            if number < 1000:
                # The keys of parts are learned from the clients.
                self.published.append((end, data))
            if end == "beat":
                try:
                    beat: protocol.Beat = protocol.decode_beat(data)
                except kv.errors.FormatError:
                    continue  # a mutated one
                self.position = beat.revision, beat.chain

    def _learn(self) -> None:
        """Edit and ask as users do, and keep the messages."""
        random = Random(self.seed)
        models = [load("whole"), load("0")]
        self.views = [models[1]._view]
        for model in models:
            ask = model.exchange.transport.ask

            def record(key: str, payload: bytes, *options: Any, ask: Any = ask, **named: Any) -> bytes:
                self.requests.append((key.rpartition("/")[2], payload))
                return ask(key, payload, *options, **named)  # type: ignore[no-any-return]

            model.exchange.transport.ask = record  # type: ignore[method-assign]
        for number in range(LEARNED):
            model = random.choice(models)
            try:
                with model.edit() as edit:
                    do_something(edit, random, f"{self.seed} {number}")
                if number % 10 == 0:
                    model.undo(model.version)
            except kv.KineverseError:
                continue
        for model in models:
            connection, client = model.exchange, model.exchange.client
            connection.history(5)
            connection.status()
            connection.join(model._wish)
            connection.ask_missed(model._view)
            for request in (
                protocol.GetFile("0" * 64),
                protocol.Announce(client, "joints", "unixsock-stream//tmp/joints", ("part/lid",), 0.5),
            ):
                connection._ask(request, 5.0)
            model.close()
        others = [one for one in self.requests if one[0] == "ask"]
        self.requests += others * (len(self.requests) // (2 * len(others)))  # they are few

    def make_request(self, random: Random) -> tuple[str, bytes]:
        """Return a key and a mutated request."""
        key, data = random.choice(self.requests)
        tree = msgspec.msgpack.decode(data)
        if key == "edit" and random.random() < 0.8:  # else it is known, and answered as before
            tree[1], tree[2] = random.choice((tree[1], uuid4().hex)), random.randrange(1 << 40)
            if tree[0] == "edit" and random.random() < 0.9:
                tree[4:6] = self.position
        data = mutate(msgspec.msgpack.encode(tree), random.choice(self.requests)[1], random)
        return (random.choice(("ask", "edit")) if random.random() < 0.05 else key), data

    def send_requests(self, count: int) -> None:
        """Ask mutated requests in several threads, and note how they were answered."""
        threads = [
            threading.Thread(target=self._send_requests, args=(f"{self.seed} {k}", count // THREADS))
            for k in range(THREADS)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def _send_requests(self, seed: str, count: int) -> None:
        for number in range(count):
            random = Random(f"{seed} {number}")
            key, data = self.make_request(random)
            begin = time.monotonic()
            try:
                answer = self._ask(key, data)
            except (NoAnswerError, kv.errors.FormatError):
                tell(violation=f"{number} of {seed} to {key}: {traceback.format_exc()} {data[:5000].hex()}")
                return
            outcome = answer.reason if isinstance(answer, protocol.Refused) else type(answer).__name__
            self.outcomes[outcome] += 1
            self.outcomes["longest ms"] = max(
                self.outcomes["longest ms"], round(1e3 * (time.monotonic() - begin))
            )
            if outcome == "failed":
                tell(violation=f"{number} of {seed} to {key}: {answer} {data[:5000].hex()}")
                return

    def _ask(self, key: str, data: bytes) -> protocol.Answer:
        """Return an answer, asked for again if the connection was lost, as clients do."""
        late = time.monotonic() + TOO_LATE
        while True:
            try:
                answer = self.transport.ask(f"kineverse/{NAME}/{key}", data, TOO_LATE)
                return protocol.decode_answer(answer)
            except NoAnswerError:
                self.outcomes["asked again"] += 1
                if time.monotonic() > late:
                    raise
                time.sleep(0.01)

    def publish(self, count: int) -> None:
        """Publish mutated commits and signs of life to the clients of the server."""
        random = Random(self.seed)
        known = [*self.published]
        for number in range(count):
            end, data = random.choice(known)
            self.outcomes[end] += 1
            if number % 10 == 0:
                status = protocol.encode(protocol.GetStatus())
                found: Any = self._ask("ask", status)
                revision = found.revision
            if end != "beat" and random.random() < 0.8:  # as the next commit, or all will leave it out
                tree = _open(msgspec.msgpack.decode(data))
                tree[2][_BLOB][:2] = revision + random.choice((1, 1, 2)), 0 if end == "view/*" else revision
                data = _write(tree)
            if random.random() < 0.7:
                data = mutate(data, random.choice(known)[1], random)
            end = end.replace("*", random.choice(self.views))
            self.transport.publish(f"kineverse/{NAME}/{end}", data)
            time.sleep(0.001)


def main() -> None:
    sender = Sender(sys.argv[1])
    tell(reply="ready")
    for words in commands():
        sender.outcomes.clear()
        if words[0] == "ask":
            sender.send_requests(int(words[1]))
        else:
            sender.publish(int(words[1]))
        tell(reply=sender.outcomes)


if __name__ == "__main__":
    main()
