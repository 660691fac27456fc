"""Clients of an authority without a network, and operations for their edits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import kineverse as kv
from kineverse.exchange import protocol
from kineverse.exchange.authority import Authority, Result
from kineverse.formats import entry_to_bytes, operation_from_bytes
from kineverse.model import Edit
from kineverse.model.read_recorder import ReadRecorder

Act = Callable[[Edit], object]


@dataclass(frozen=True)
class Exists(kv.Operation):
    """Looks whether a datum is there."""

    name: str
    source: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={self.name: int(self.source in model.data)})


class Replica:
    """Client with a model that follows the commits of an authority."""

    def __init__(self, authority: Authority, client: str = "a") -> None:
        self.client, self.number = 32 * client, 0
        entries = authority.model.history.sequence
        blobs = [entry_to_bytes(entry, entries) for entry in entries]
        self.model = kv.Model([operation_from_bytes(blob) for blob in blobs], authority.revision)
        self.revision, self.chain = authority.revision, authority.chain

    def draft(self, act: Act, *, strict: bool = False) -> protocol.EditRequest:
        """Return the request for an edit; the model stays as it is."""
        with self.model.edit() as edit:
            start = edit.savepoint()
            act(edit)
            changes = protocol.encode_changes(edit.net(), self.model.history.sequence)
            start.roll_back()
        return self.request(changes, strict=strict)

    def request(self, changes: protocol.Changes, *, strict: bool = False) -> protocol.EditRequest:
        """Return the request for changes, with the next number."""
        self.number += 1
        return protocol.EditRequest(
            self.client, self.number, f"client {self.client[0]}", self.revision, self.chain, changes, strict
        )

    def undo(self, revision: int) -> protocol.UndoRequest:
        """Return the request to take back a commit."""
        self.number += 1
        return protocol.UndoRequest(self.client, self.number, f"client {self.client[0]}", revision)

    def follow(self, results: Sequence[Result]) -> None:
        """Adopt what was published."""
        for result in results:
            if result.commit is not None:
                self.adopt(result.commit.published.commit)

    def adopt(self, data: bytes) -> None:
        """Adopt one commit."""
        commit: protocol.CommitMessage = protocol.decode_commit(data)
        assert commit.previous == self.revision
        self.model.adopt(protocol.decode_changes(commit.changes))
        self.revision, self.chain = commit.revision, protocol.chain(self.chain, data)


def content(model: kv.Model) -> tuple[str, list[str]]:
    """Return what equal models have in common."""
    return kv.formats.document_hash(model), model.history.tags
