"""The difference between any two models: by operation, by value."""

from __future__ import annotations

from collections.abc import Iterator

from .diff import Change, Diff, moved_tags
from .history import Entry
from .model import Model, Snapshot
from .operation import KINDS


def difference(before: Model | Snapshot, after: Model | Snapshot) -> Diff:
    """Return what leads from one model to another: what a commit would report that did it.

    Values are compared structurally, name by name. Operations are compared by tag and by what they write, so
    those of a document are those that it was made from. The tags in ``moved`` are as few as possible: the
    others come in the same order on both sides.

    Parameters
    ----------
    before, after
        The models; they need not have a history in common.
    """
    old, new = _snapshot(before), _snapshot(after)
    entries = {entry.tag: entry for entry in old._entries}
    later = {entry.tag: entry for entry in new._entries}
    common = [tag for tag in entries if tag in later]
    return Diff(
        version=new.version,
        changes=tuple(_changes(old, new)),
        added=tuple(tag for tag in later if tag not in entries),
        removed=tuple(tag for tag in entries if tag not in later),
        replaced=tuple(tag for tag in common if _write_otherwise(entries[tag], later[tag])),
        moved=moved_tags(common, list(later), entries),
    )


def _snapshot(model: Model | Snapshot) -> Snapshot:
    return model.snapshot() if isinstance(model, Model) else model


def _changes(old: Snapshot, new: Snapshot) -> Iterator[Change]:
    """Yield the changes kind by kind: what is gone or different in the old order, what is new in the new."""
    for kind in KINDS:
        before, after = old._ordered(kind), new._ordered(kind)
        for name, value in before.items():
            if name not in after:
                yield Change(kind, name, value, None)
            elif after[name] is not value and after[name] != value:
                yield Change(kind, name, value, after[name])
        for name, value in after.items():
            if name not in before:
                yield Change(kind, name, None, value)


def _write_otherwise(one: Entry, other: Entry) -> bool:
    return one is not other and one.writes != other.writes
