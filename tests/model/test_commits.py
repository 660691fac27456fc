"""Edits as data: net changes that another model adopts, savepoints, and undo of commits."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from history_operations import Fragile, Next, Place, Put, Row, Sequenced, Sum, Watch, state_of
from hypothesis import given, settings
from hypothesis import strategies as st
from test_model_history import FRAMES, started, step, take

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.model import Edit, NetChanges, PlacedEntry
from kineverse.model.history import HistoryEntry
from kineverse.model.read_recorder import ABSENT, Read, Reads

frame = st.sampled_from(FRAMES)
index = st.integers(0, 40)
action = st.one_of(
    step,
    st.tuples(st.just("move"), index, index),
    st.tuples(st.just("attach"), st.tuples(frame, st.sampled_from(("world", *FRAMES))), index),
)
actions = st.lists(action, min_size=1, max_size=5)


def do(edit: Edit, kind: str, what: Any, at: int, tag: str) -> None:
    """Do one thing in an edit, if it can be done."""
    tags = edit.model.history.tags  # type: ignore[attr-defined]
    try:
        if kind == "move" and tags:
            moved = tags[what % len(tags)]
            operation = edit.model.history.operation(moved)  # type: ignore[attr-defined]
            others = [one for one in tags if one != moved]
            edit.remove(moved)
            if others:
                edit.insert(operation, moved, before=others[at % len(others)])
            else:
                edit.apply(operation, moved)
        elif kind == "attach":
            edit.attach(*what, kv.translation(0, 0, at), tag=tag)
        elif kind != "move":
            sequence: list[Sequenced] = [(one, Put("a")) for one in tags]
            take(edit, sequence, kind, what, at, tag)
    except kv.KineverseError:
        pass


def heard_by(model: kv.Model) -> list[kv.model.Diff]:
    heard: list[kv.model.Diff] = []
    model.listen(heard.append)
    return heard


def plain(diff: kv.model.Diff) -> Any:
    """Return a diff without the order of its changes and of the edit, and without the number of runs."""
    changes = {c.path: (c.before, c.after) for c in diff.changes}
    groups = {name: tuple(sorted(getattr(diff, name))) for name in ("added", "removed", "replaced")}
    return changes, replace(diff, changes=(), reruns=0, **groups)  # type: ignore[arg-type]


def whole(model: kv.Model) -> Any:
    """Return everything about a model, with what each operation read."""
    history = model.history
    reads = [(t, history.entry(t).reads.cells, history.entry(t).reads.listings) for t in history.tags]
    return state_of(model), reads


@given(st.lists(actions, min_size=1, max_size=3), index)
@settings(max_examples=attempts(60), derandomize=True)
def test_net_changes_and_undo_on_the_model_and_on_a_replica(transactions: list[Any], salt: int) -> None:
    model, _ = started()
    replica = model.copy()
    heard, heard_there = heard_by(model), heard_by(replica)
    for number, steps in enumerate(transactions):
        before, order = model.snapshot(), model.history.tags
        try:
            with model.edit() as edit:
                for k, one in enumerate(steps):
                    do(edit, *one, f"t{number}.{k}")
                net = edit.net()
        except kv.KineverseError:
            continue
        runs = replica.history.runs
        replica.adopt(net)
        assert replica.history.runs == runs
        assert whole(replica) == whole(model)
        assert [*map(plain, heard_there)] == [*map(plain, heard)]
        if net.is_empty:
            continue
        after, version = model.snapshot(), model.version
        with model.edit() as edit:
            edit.undo(version)
            back = edit.net()
        assert (model.history.tags, model.snapshot()) == (order, before)
        replica.adopt(back)
        assert whole(replica) == whole(model)
        with (model if salt % 2 else replica).edit() as edit:
            edit.undo(version + 1)
            again = edit.net()
        (replica if salt % 2 else model).adopt(pickle.loads(pickle.dumps(again)) if salt % 3 == 0 else again)
        assert model.snapshot() == replica.snapshot() == after
        assert [*map(plain, heard_there)] == [*map(plain, heard)]


@given(actions, actions, actions)
@settings(max_examples=attempts(40), derandomize=True)
def test_a_savepoint_that_is_rolled_back_leaves_no_trace(first: Any, undone: Any, last: Any) -> None:
    model, _ = started()
    twin = model.copy()
    heard, heard_there = heard_by(model), heard_by(twin)
    before, results = state_of(model), []
    for each, trial in ((model, undone), (twin, None)):
        try:
            with each.edit() as edit:
                for k, one in enumerate(first):
                    do(edit, *one, f"t{k}")
                if trial is not None:
                    point = edit.savepoint()
                    for _ in range(2):
                        for k, one in enumerate(trial):
                            do(edit, *one, f"u{k}")
                        point.roll_back()
                for k, one in enumerate(last):
                    do(edit, *one, f"v{k}")
            results.append(None)
        except kv.errors.EditError as error:
            results.append(str(error))
    assert results[0] == results[1]
    assert whole(model) == whole(twin)
    assert results[0] is None or state_of(model) == before
    assert [(plain(d), d.reruns) for d in heard] == [(plain(d), d.reruns) for d in heard_there]
