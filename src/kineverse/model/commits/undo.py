"""Undo of commits: what is kept of each, and how an edit takes one back."""

from __future__ import annotations

from collections.abc import Iterable
from operator import attrgetter
from typing import TYPE_CHECKING

from kineverse._checks import as_count
from kineverse.errors import EditError

if TYPE_CHECKING:
    from kineverse.model.history import CommitRecord, History, TouchedEntry
    from kineverse.model.operation import Operation

UNDO_LIMIT = 1000
"""Number of commits of a model that can be taken back: those before the last ones are forgotten."""

_PLACE = attrgetter("place")


def keep_commit(history: History, version: int, touched: Iterable[TouchedEntry]) -> None:
    """Keep what it takes to undo the transaction: the entries before and after it of what it has put."""
    commits = history.commits
    commits[version] = {
        (before or now).tag: (before, now)  # type: ignore[union-attr]  # one of them is there
        for before, now, is_given in touched
        if is_given
    }
    while len(commits) > UNDO_LIMIT:
        del commits[next(iter(commits))]


def take_back(history: History, version: int) -> None:
    """Restore the operations that the commit of a version has put, moved or removed, and mark them to run."""
    commit = _find_commit(history, version)
    with history.step():
        for tag, (before, after) in commit.items():
            now = history.entries.get(tag)
            is_moved = before is not None and after is not None and before.place != after.place
            if now is None or after is None:
                is_kept = now is after
            else:
                # What was adopted after it was run again elsewhere may be an equal operation.
                is_kept = _are_equal(now.operation, after.operation) and (
                    now.place == after.place or not is_moved
                )
            if not is_kept:
                raise _later_error(history, version, tag)
            if after is not None and (before is None or is_moved):
                history.remove(tag)
        restored = [before for before, _ in commit.values() if before is not None]
        for tag in [entry.tag for entry in sorted(restored, key=_PLACE)]:
            # Looked up again, since places are given out anew when there is no room between two.
            entry, now = history.commits[version][tag][0], history.entries.get(tag)
            assert entry is not None
            history.note_given(tag)
            history.put(entry.at(history.free_place(entry.place) if now is None else now.place))
            history.mark_outdated(tag)


def _are_equal(one: Operation, other: Operation) -> bool:
    try:
        return one is other or bool(one == other)
    except Exception:  # arrays among the fields of an operation have no truth value
        return False


def _find_commit(history: History, version: int) -> CommitRecord:
    version, commits = as_count("version", version, 0), history.commits
    if version not in commits:
        kept = f"those of versions {min(commits)} to {max(commits)}" if commits else "none yet"
        raise EditError(
            f"Version {version} cannot be taken back. A model keeps the last {UNDO_LIMIT} commits for that, "
            f"here {kept}."
        )
    return commits[version]


def _later_error(history: History, version: int, tag: str) -> EditError:
    later = [v for v, commit in history.commits.items() if v > version and tag in commit]
    when = f"version {later[-1]}" if later else "this edit"
    advice = f"Undo version {later[-1]} first." if later else "Undo it before that."
    return EditError(
        f"Version {version} cannot be taken back: it has changed {tag!r}, and so has {when} since then. "
        f"{advice}"
    )
