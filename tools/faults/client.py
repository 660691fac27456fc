"""Clients of a model server in a process of their own, which edit as users do and tell what they hear."""

from __future__ import annotations

import logging
import sys
import threading
import time
import traceback
from collections.abc import Callable
from itertools import count
from random import Random
from typing import Any

import kineverse as kv
from kineverse.errors import ConflictError, EditError, OfflineError
from kineverse.exchange import protocol
from kineverse.exchange.client import LiveModel
from kineverse.formats import document_hash

from .edits import PARTS, add_chain, add_constraints, count_on, do_something, remove_chain
from .processes import commands, tell
from .served import NAME

PAUSE = 0.02
"""Longest time between two edits of one who edits until it is stopped [s]."""
STILL = 20.0
"""Time in which a model that does not have the newest revision gets a newer one [s]."""


class Client:
    """Live model, and the thread that edits it: a number of random edits, 0: chains, or -1: for ever.

    What it loads is one of the kinds, or ``KIND@ENDPOINT``.
    """

    def __init__(self, name: str, what: str, seed: str, edits: int) -> None:
        self.name, self.edits = name, edits
        self.kind, _, endpoint = what.partition("@")
        kind = self.kind
        self.add = add_constraints if kind == "1" else add_chain
        self.unknown, self.committed, self.longest = 0, 0, 0.0
        self.random = Random(seed)
        self.model = load(kind, endpoint)
        self.stopped, self.turn = threading.Event(), threading.Lock()
        self.outcomes: dict[str, int] = {}
        self._record()
        work = self._make_chains if not edits else self._make_anything
        self.thread = threading.Thread(target=self._work, args=(work,), daemon=True)
        threading.Thread(target=self._watch, daemon=True).start()

    def _record(self) -> None:
        """Tell what is asked for and answered, before those who wait for the answer see it."""
        connection = self.model.exchange
        ask = connection.ask_edit

        def ask_edit(edit: Any) -> Any:
            self.unknown += 1
            begin = time.monotonic()
            answer = ask(edit)
            self.unknown -= 1
            took = time.monotonic() - begin
            self.longest = max(self.longest, took)
            if took > 0.3:
                tell(slow=took, edit=repr(edit)[:300], answer=repr(answer)[:300])
            if isinstance(answer, protocol.Committed):
                self.committed += 1
                tell(
                    client=connection.client,
                    number=edit.number,
                    revision=answer.revision,
                    chain=answer.chain.hex(),
                )
            return answer

        connection.ask_edit = ask_edit  # type: ignore[method-assign]

    def _watch(self) -> None:
        """Tell when the server goes away and is back."""
        connection = self.model.exchange
        while True:
            is_online = connection.is_online
            connection.wait_for(lambda: connection.is_online != is_online, None)  # noqa: B023
            tell(client=self.name, online=not is_online, at=time.monotonic())

    def _work(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception:
            tell(violation=traceback.format_exc())

    def _try(self, act: Callable[[], object], *, slow: float = 1.0) -> str:
        """Edit, and return how that ended."""
        unknown, committed = self.unknown, self.committed
        try:
            act()
            outcome = "made"
        except ConflictError:
            outcome = "conflict"
        except OfflineError as error:
            if self.committed > committed:
                raise AssertionError("an edit was acknowledged, and raised an error") from error
            outcome = "unknown" if self.unknown > unknown else "offline"
        except EditError as error:
            outcome = "failed" if "has failed" in str(error) else "refused"
        self.outcomes[outcome] = self.outcomes.get(outcome, 0) + 1
        if outcome == "offline":
            self.model.exchange.wait_for(lambda: self.model.exchange.is_online, slow)
        return outcome

    def _make_chains(self) -> None:
        """Count on, add and remove chains until it is stopped."""
        model, mine, number = self.model, list[str](), 0
        while not self.stopped.wait(self.random.uniform(0, PAUSE)):
            with self.turn:
                if self.random.random() < 0.3 and not self.model._wish.is_part:
                    outcome = self._try(lambda: model.transact(count_on, attempts=3))
                    tell(counted=outcome)
                elif len(mine) > 10 or (mine and self.random.random() < 0.3):
                    name = mine.pop(self.random.randrange(len(mine)))
                    outcome = self._try(lambda name=name: self._edit(lambda edit: remove_chain(edit, name)))  # type: ignore
                    tell(chain=name, removed=outcome)
                else:
                    number += 1
                    name = f"part/{self.name}/{number}"
                    outcome = self._try(lambda name=name: self._edit(lambda edit: self.add(edit, name)))  # type: ignore
                    tell(chain=name, added=outcome)
                    if outcome == "made" and model.exchange.is_online:
                        if f"{name}/2" not in model.history.tags:
                            raise AssertionError(f"{name} was acknowledged, and is not in the model")
                        mine.append(name)
                if outcome == "refused":
                    raise AssertionError("an edit was refused that could be made")

    def refuses(self) -> bool:
        """Return whether an edit is an error at once, as the server is away."""
        try:
            with self.model.edit():
                return False
        except OfflineError:
            return True

    def follow(self, wanted: int) -> None:
        """Wait until the model has a revision; one that stands still on the way is a violation.

        One that catches up slowly is none: where other work leaves it no time of the processor, it adopts a
        few commits in a second.
        """
        model = self.model
        before = model.version
        while not model.wait(wanted, STILL):
            if model.version == before:
                state = "online" if model.exchange.is_online else "offline"
                tell(violation=f"{self.name} stands at {before}, {state}, and is not at {wanted}")
                return
            before = model.version

    def _edit(self, act: Callable[[kv.model.Edit], None]) -> None:
        with self.model.edit() as edit:
            act(edit)

    def _make_anything(self) -> None:
        """Make a number of random edits, or some until it is stopped."""
        model, random = self.model, self.random
        for number in range(self.edits) if self.edits > 0 else count():
            if self.edits < 0 and self.stopped.wait(PAUSE):
                return
            if random.random() < 0.03 and model.version > 2:
                self._try(lambda: model.undo(random.randint(max(1, model.version - 20), model.version)))
                continue

            def act(edit: kv.model.Edit, number: int = number) -> None:
                for k in range(random.choice((1, 1, 1, 2, 3))):
                    do_something(edit, random, f"{self.name} {number} {k}")

            self._try(lambda act=act: self._edit(act))  # type: ignore[misc]


def load(kind: str, endpoint: str = "") -> LiveModel:
    """Load the whole model, or one of the parts."""
    address = f"live:{endpoint}/{NAME}" if endpoint else f"live:{NAME}"
    model = kv.load(address, frames=None if kind == "whole" else [PARTS[int(kind)]])
    assert isinstance(model, LiveModel)
    return model


def main() -> None:
    name, seed, edits = sys.argv[1], sys.argv[2], int(sys.argv[3])
    threading.excepthook = lambda what: tell(violation=f"{what.thread}: {what.exc_value!r}")
    logging.disable(logging.CRITICAL)  # servers that are killed are no news
    clients = [Client(f"{name}{k}", kind, f"{seed} {name}{k}", edits) for k, kind in enumerate(sys.argv[4:])]
    for client in clients if edits <= 0 else ():
        client.thread.start()
    tell(reply="ready")
    for words in commands():
        if words[0] == "stop":
            for client in clients:
                if edits <= 0:
                    client.stopped.set()
                else:  # when all are there
                    client.thread.start()
            for client in clients:
                client.thread.join()
            tell(reply=[(client.outcomes, client.longest) for client in clients])
        elif words[0] == "longest":  # since this was asked before
            tell(reply=[(client.outcomes, client.longest) for client in clients])
            for client in clients:
                client.longest = 0.0
        elif words[0] == "state":
            wanted = int(words[1])
            for client in clients:
                client.follow(wanted)
            tell(reply=[(client.kind, document_hash(client.model)) for client in clients])
        elif words[0] == "pause":  # after the edits that are under way
            for client in clients:
                client.turn.acquire()
            tell(reply="ready")
        elif words[0] == "resume":
            for client in clients:
                client.turn.release()
            tell(reply="ready")
        elif words[0] == "follow":
            for client in clients:
                client.follow(int(words[1]))
            tell(reply=time.monotonic())
        elif words[0] == "online":
            tell(reply=any(client.model.exchange.is_online for client in clients))
        elif words[0] == "refuses":
            tell(reply=[client.refuses() for client in clients])
        elif words[0] == "read":
            tell(reply=[len(client.model.frames) for client in clients])
        elif words[0] == "hook":  # one that takes long
            seconds = float(words[1])
            for client in clients:
                client.model.listen(lambda _, seconds=seconds: time.sleep(seconds))  # type: ignore[misc]
            tell(reply="ready")


if __name__ == "__main__":
    main()
