"""Edits as data: net changes that another model adopts, savepoints, and undo of commits."""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from history_operations import Fresh, Next, Place, Put, Row, Sequenced, Sum, Watch, check, state_of
from hypothesis import given, settings
from hypothesis import strategies as st
from random_models import random_state, random_tree
from test_model_history import FRAMES, started, step, take

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.model import Edit, NetChanges, PlacedEntry
from kineverse.model.history import HistoryEntry
from kineverse.model.read_recorder import Reads

frame = st.sampled_from(FRAMES)
index = st.integers(0, 40)
action = st.one_of(
    step,
    st.tuples(st.just("move"), index, index),
    st.tuples(
        st.just("append"), st.builds(Row, frame, st.sampled_from(("a", "b", "g")), st.just("a")), index
    ),
    st.tuples(st.just("attach"), st.tuples(frame, st.sampled_from(("world", *FRAMES))), index),
)
actions = st.lists(action, min_size=1, max_size=5)


def do(edit: Edit, kind: str, what: Any, at: int, tag: str) -> None:
    """Do one thing in an edit, if it can be done."""
    tags = edit.model.history.tags
    try:
        if kind == "move" and tags:
            moved = tags[what % len(tags)]
            operation = edit.model.history.operation(moved)
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
    return changes, replace(diff, changes=(), reruns=0, **groups)


def poses_of(model: kv.Model) -> dict[str, Any]:
    return {name: model.fk(name) if name in model.frames else None for name in FRAMES}


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
    moved: list[kv.model.Diff] = []
    replica.listen(moved.append, frames=FRAMES)
    for number, steps in enumerate(transactions):
        before, order, poses = model.snapshot(), model.history.tags, poses_of(model)
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
        differ = tuple(name for name, pose in poses_of(replica).items() if poses[name] != pose)
        assert tuple(name for diff in moved for name in diff.poses) == differ
        assert not any(diff.poses == () for diff in moved)
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
        assert [diff.poses for diff in moved] == [differ] * 3 * bool(differ)
        moved.clear()
        assert [*map(plain, heard_there)] == [*map(plain, heard)]


@given(st.lists(st.tuples(actions, index), min_size=2, max_size=6))
@settings(max_examples=attempts(40), derandomize=True)
def test_undo_of_any_commit_equals_a_fold_or_is_refused(transactions: list[Any]) -> None:
    model, _ = started()
    for number, (steps, which) in enumerate(transactions):
        with contextlib.suppress(kv.KineverseError), model.edit() as edit:
            for k, one in enumerate(steps):
                do(edit, *one, f"t{number}.{k}")
        before = state_of(model)
        try:
            with model.edit() as edit:
                edit.undo(which % model.version + 1)
        except kv.KineverseError:
            assert state_of(model) == before
        history = model.history
        check(model, [(tag, history.operation(tag)) for tag in history.tags])


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
        except kv.KineverseError as error:
            results.append(str(error))
    assert results[0] == results[1]
    assert whole(model) == whole(twin)
    assert results[0] is None or state_of(model) == before
    assert [(plain(d), d.reruns) for d in heard] == [(plain(d), d.reruns) for d in heard_there]


class Client(kv.Model):
    """Model whose edits are done elsewhere: each is tried, taken back, and adopted from there."""

    def __init__(self, server: kv.Model) -> None:
        super().__init__(server.history.copy(), server.version)
        self.server, self.delivered = server, 0

    def edit(self, *, strict: bool = False) -> contextlib.AbstractContextManager[Edit]:
        return self._ask()

    @contextlib.contextmanager
    def _ask(self) -> Iterator[Edit]:
        taken: list[NetChanges] = []
        before, version = whole(self), self.version
        with self._transaction(lambda edit: taken.append(edit.net())) as edit:
            yield edit
        assert (whole(self), self.version) == (before, version)
        if not taken[0].is_empty:
            self.server.adopt(taken[0])
            self._adopt(taken[0], self.server.version)

    def _deliver(self) -> None:
        self.delivered += 1


@given(st.lists(actions, min_size=1, max_size=3))
@settings(max_examples=attempts(25), derandomize=True)
def test_edit_is_taken_back_and_adopted_as_a_version(transactions: list[Any]) -> None:
    model, _ = started()
    client = Client(model.copy())
    heard, heard_there = heard_by(model), heard_by(client)
    for number, steps in enumerate(transactions):
        errors = []
        for each in (model, client):
            try:
                with each.edit() as edit:
                    for k, one in enumerate(steps):
                        do(edit, *one, f"t{number}.{k}")
                errors.append("")
            except kv.KineverseError as error:
                errors.append(str(error))
        assert errors[0] == errors[1]
        assert whole(client) == whole(client.server) == whole(model)
        assert client.version == client.server.version == model.version
    assert heard_there == []  # until the client says so
    assert client.delivered >= len(heard)
    client._listeners.deliver()
    assert [*map(plain, heard_there)] == [*map(plain, heard)]


def test_commit_as_a_version_may_leave_some_out() -> None:
    """A part of a model has the versions that concern it, and takes note of those that do not."""
    home = build(Put("a", 1))
    replica = home.copy()
    heard = heard_by(replica)
    with home.edit() as edit:
        edit.apply(Put("b", 2))
        replica._adopt(edit.net(), 7)
    assert (replica.version, [diff.version for diff in heard]) == (7, [7])
    with kv.follow(replica, lambda snapshot: snapshot.version) as follower:
        replica._adopt(NetChanges(), 9)  # nobody hears of it, and who waits for it goes on
        assert follower.wait(9, 10.0)
    assert (replica.version, [diff.version for diff in heard]) == (9, [7])
    with replica.edit() as edit:
        edit.undo(7)
    assert (replica.version, list(replica.data)) == (10, ["a"])


def test_strict_is_a_flag_without_effect_on_a_local_model() -> None:
    model = build(Put("a", 1))
    with model.edit(strict=True) as edit:
        edit.apply(Put("b", 2))
    assert list(model.data) == ["a", "b"]
    with pytest.raises(kv.errors.InvalidValueError, match="strict= is True or False"):
        model.edit(strict="no")  # type: ignore[arg-type]


def build(*operations: kv.Operation) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        for number, operation in enumerate(operations):
            edit.apply(operation, str(number))
    return model


def net_of(model: kv.Model, change: Callable[[Edit], object]) -> NetChanges:
    """Return what an edit would change; it is rolled back."""
    with model.edit() as edit:
        start = edit.savepoint()
        change(edit)
        net = edit.net()
        start.roll_back()
    return net


def test_net_changes_name_what_is_put_with_its_anchor() -> None:
    model = build(Put("a", 1), Put("b"), Next("c", "a"), Put("d"))

    def change(edit: Edit) -> None:
        edit.replace("0", Put("a", 5))
        edit.insert(Put("x"), "x", before="0")
        edit.insert(Put("y"), "y", after="2")
        operation = edit.model.history.operation("1")
        edit.remove("1")
        edit.apply(operation, "1")
        edit.apply(Put("z"), "z")
        edit.remove("3")
        edit.apply(Put("never"), "never")
        edit.remove("never")

    before = state_of(model)
    net = net_of(model, change)
    assert state_of(model) == before
    placed = [(one.entry.tag, one.after, one.at_end) for one in net.put]
    assert placed == [
        *(("x", None, False), ("0", "x", False), ("2", "0", False)),
        *(("y", "2", True), ("1", "y", True), ("z", "1", True)),
    ]
    assert (net.added, net.replaced, net.moved) == (("x", "y", "z"), ("0", "1"), ("1",))
    assert (net.rerun, net.removed, net.is_empty) == (("2",), ("3",), False)
    with model.edit() as edit:  # what others have appended meanwhile comes first
        edit.apply(Put("other"), "other")
    model.adopt(net)
    assert model.history.tags == ["x", "0", "2", "other", "y", "1", "z"]
    last = PlacedEntry(entry("last", Put("last"), data__last=1), "gone", at_end=True)
    model.adopt(NetChanges((last,)))  # whatever became of what was before it
    assert model.history.tags[-1] == "last"


def test_an_edit_that_does_nothing_is_no_commit() -> None:
    model = build(Put("a", 1))
    heard = heard_by(model)
    with model.edit() as edit:
        start = edit.savepoint()
        edit.apply(Next("b", "a"))
        inner = edit.savepoint()
        edit.remove("0")
        start.roll_back()
        assert edit.net() == NetChanges()
        with pytest.raises(kv.errors.EditError, match="savepoint is gone"):
            inner.roll_back()
    model.adopt(NetChanges())
    assert (model.version, heard) == (1, [])
    with pytest.raises(kv.errors.EditError, match="over"):
        start.roll_back()


def entry(tag: str, operation: kv.Operation, reads: Reads | None = None, **writes: Any) -> HistoryEntry:
    cells = {tuple(name.split("__", 1)): value for name, value in writes.items()}
    return HistoryEntry(tag, operation, 0, reads or Reads(), cells)


def put(*entries: HistoryEntry, after: str | None = None, **more: Any) -> NetChanges:
    return NetChanges(tuple(PlacedEntry(one, after) for one in entries), **more)


FRAME = kv.model.Frame.from_transform
WRONG_READS = Reads()
WRONG_READS.listings.add("things")
WRONG: dict[str, tuple[Any, str]] = {
    "no changes": ("a", "adopts kv.model.NetChanges"),
    "a taken tag": (put(entry("0", Put("x"), data__x=1)), "'0' is taken"),
    "a missing tag": (put(entry("x", Put("x"), data__x=1), replaced=("x",)), "'x' is not there"),
    "a missing tag to remove": (NetChanges(removed=("x",)), "no operation 'x'"),
    "an unknown anchor": (put(entry("x", Put("x"), data__x=1), after="y"), "no operation 'y'"),
    "a missing parent": (
        put(entry("x", Place("x", "nothing"), frames__x=FRAME("nothing", kv.translation(1, 0, 0)))),
        "parent of frame 'x' is missing",
    ),
    "a cycle of frames": (
        put(
            entry("1", Place("f", "g"), frames__f=FRAME("g", kv.translation(1, 0, 0))),
            replaced=("1",),
        ),
        "parent of frame 'f' is missing",
    ),
    "a cycle of frames at the end": (
        put(entry("x", Place("f", "g"), frames__f=FRAME("g", kv.translation(1, 0, 0))), after="2"),
        "Cyclic frames",
    ),
    "a cycle of rates": (
        put(
            entry(
                "x",
                Row("a", "a", "q"),
                rates__a=(kv.position("a"), ((kv.velocity("a"), kv.array(2.0)),)),
            )
        ),
        "Cyclic rates",
    ),
    "a frame of others": (
        put(entry("x", Put("x"), frames__f=FRAME("world", kv.translation(1, 0, 0))), after="2"),
        "There is a frame 'f' already",
    ),
    "a reader that is left out": (NetChanges(removed=("0",)), "'3' reads data/a"),
    "a value of another type": (put(entry("x", Put("x"), frames__x=3)), "writes of wrong"),
    "an unknown kind": (put(entry("x", Put("x"), things__x=3)), "writes of wrong"),
    "a value that can be changed": (put(entry("x", Put("x"), data__x=[])), "writes of wrong"),
    "a value in another form": (put(entry("x", Put("x"), constraints__x=(0, 1, 2))), "writes of wrong"),
    "a rate of nothing": (put(entry("x", Put("x"), rates__x=(1, ()))), "writes of wrong"),
    "no entry": (NetChanges((PlacedEntry("x", None),)), "no entry"),
    "no operation": (put(entry("x", 3, data__x=1)), "no operation"),
    "a tag twice": (put(*[entry("x", Put("x"), data__x=1)] * 2), "twice"),
    "a move of nothing": (NetChanges(moved=("0",)), "is not put"),
    "no tuples": (NetChanges(None), "None is no tuple"),  # type: ignore[arg-type]
    "a text in place of tags": (NetChanges(removed="0"), "'0' is no tuple"),  # type: ignore[arg-type]
    "a tag that is none": (NetChanges(moved=([],)), "is no tag"),  # type: ignore[arg-type]
    "writes that are none": (
        NetChanges((PlacedEntry(HistoryEntry("x", Put("x"), 0, Reads(), 3), None),)),
        "writes of wrong",
    ),  # type: ignore[arg-type]
    "reads of an unknown kind": (put(entry("x", Put("x"), WRONG_READS)), "and its reads"),
    "a name that is none": (put(entry("x", Put("x"), **{"data__x//y": 1})), "not a name"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_changes_are_refused_and_nothing_happens(case: str) -> None:
    model = build(Put("a", 1), Place("f", "world"), Place("g", "f"), Next("b", "a"))
    before, heard = whole(model), heard_by(model)
    changes, message = WRONG[case]
    with pytest.raises(kv.errors.EditError, match=message) as info:
        model.adopt(changes)
    assert type(info.value) is kv.errors.EditError
    assert (whole(model), heard) == (before, [])
    with model.edit() as edit:
        edit.replace("0", Put("a", 2))
    assert model.data["b"] == 3


def test_changes_adopted_in_an_edit_run_what_reads_them() -> None:
    model = build(Put("a", 1), Next("b", "a"), Sum("c", ("b",)))
    net = net_of(model, lambda edit: edit.replace("0", Put("a", 5)))
    only = replace(net, put=net.put[:1], rerun=())  # of a client that does not know the others
    runs = model.history.runs
    with model.edit() as edit:
        edit.adopt(only)
    assert (dict(model.data), model.history.runs - runs) == ({"a": 5, "b": 6, "c": 6}, 2)
    with model.edit() as edit:  # what waits to be run is not forgotten
        edit.replace("0", Put("a", 1))
        edit.adopt(put(entry("x", Place("x", "world"), frames__x=FRAME("world", np.eye(4)))))
        edit.adopt(put(entry("y", Place("y", "x"), frames__y=FRAME("x", np.eye(4))), after="2"))
    assert dict(model.data) == {"a": 1, "b": 2, "c": 2}
    assert model.history.readers("frames/x") == ["y"]


def test_a_commit_is_taken_back_below_later_ones_and_not_through_them() -> None:
    model = build(Put("a", 1), Put("b", 1), Next("c", "a"))
    with model.edit() as edit:  # version 2
        edit.replace("0", Put("a", 5))
        edit.insert(Put("x", 1), "x", before="1")
    with model.edit() as edit:  # version 3
        edit.remove("1")
        edit.apply(Sum("s", ("c", "a")), "s")
    with model.edit() as edit:
        edit.undo(2)
    assert model.history.tags == ["0", "2", "s"]
    assert dict(model.data) == {"a": 1, "c": 2, "s": 3}
    with model.edit() as edit:
        edit.undo(4)
    assert dict(model.data) == {"a": 5, "c": 6, "s": 11, "x": 1}
    with model.edit() as edit:  # version 6
        edit.replace("0", Put("a", 7))
    before = state_of(model)
    for version, message in (
        (2, "Version 2 .*'0'.*version 6 since then. Undo version 6 first"),
        (1, "Version 1 .*'0'.*version 6"),
        (7, "Version 7 .*last 1000 commits .*1 to 6"),
        (0, "Version 0"),
    ):
        with pytest.raises(kv.errors.EditError, match=message), model.edit() as edit:
            edit.undo(version)
    for wrong in ("2", True, 1.0):
        with pytest.raises(kv.errors.InvalidValueError, match="version= is an integer"), model.edit() as edit:
            edit.undo(wrong)  # type: ignore[arg-type]
    with pytest.raises(kv.errors.EditError, match="this edit"), model.edit() as edit:
        edit.remove("s")
        edit.undo(3)
    assert state_of(model) == before
    branch = model.copy()
    with branch.edit() as edit:
        edit.undo(6)
        edit.undo(3)
    assert branch.history.tags == ["0", "x", "1", "2"]
    model = build(Put("a", 1), Next("b", "a"), Place("f", "world"))
    with model.edit() as edit:
        edit.replace("1", Put("b", 0))
    with model.edit() as edit:
        edit.replace("0", Put("a", 7))
    with model.edit() as edit:
        edit.undo(2)
    assert model.data["b"] == 8  # run again with what it reads now
    with model.edit() as edit:
        edit.apply(Place("g", "f"), "g")
        edit.undo(3)
    with pytest.raises(kv.errors.EditError, match="parent of frame 'g' is missing"), model.edit() as edit:
        edit.undo(1)


def test_only_the_last_commits_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kineverse.model.commits.undo.UNDO_LIMIT", 3)
    model = kv.Model()
    for number in range(5):
        with model.edit() as edit:
            edit.write("x", number, str(number))
    with pytest.raises(kv.errors.EditError, match=r"the last 3 commits .* 3 to 5"), model.edit() as edit:
        edit.undo(2)
    with model.edit() as edit:
        edit.undo(5)
    assert model.data["x"] == 3


@dataclass(frozen=True)
class Points(kv.Operation):
    """Has an array, which cannot be compared."""

    values: Any

    def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={"sum": float(self.values.sum())})


def test_what_was_changed_or_moved_again_is_not_moved_back() -> None:
    model = build(Put("a"), Put("b"), Put("c"))
    for after in ("2", "1"):
        with model.edit() as edit:
            operation = model.history.operation("0")
            edit.remove("0")
            for number in range(70):  # places are given out anew
                edit.insert(Put("x", number), f"x{after}{number}", after=after)
            edit.insert(operation, "0", after=after)
            assert edit.net().moved == ("0",)
    with model.edit() as edit:  # version 4
        edit.replace("1", Points(np.zeros(2)))
    with model.edit() as edit:
        edit.replace("1", Points(np.ones(2)))
    for version, message in ((2, "'0'.*version 3"), (4, "'1'.*version 5")):
        with pytest.raises(kv.errors.EditError, match=message), model.edit() as edit:
            edit.undo(version)


def test_what_a_savepoint_settled_is_checked_again() -> None:
    model = build(Fresh("f", "world"), Fresh("g", "world"), Place("h", "g"))
    for wrong, corrected, message in (
        (lambda edit: edit.replace("0", Fresh("g", "world")), "1", "There is a frame 'g' already"),
        (lambda edit: edit.apply(Place("g", "h"), "3"), "3", "Cyclic frames"),
    ):
        with pytest.raises(kv.errors.EditError, match=message), model.edit() as edit:
            wrong(edit)
            point = edit.savepoint()
            edit.remove(corrected)
            if corrected == "1":
                edit.apply(Place("g", "world"), "again")
                edit.remove("2")
            edit.net()
            point.roll_back()


def test_places_of_what_was_removed_survive_a_renumbering() -> None:
    model = build(Put("a"), Put("b"), Put("c"), Put("d"))
    with model.edit() as edit:
        edit.remove("1")
        edit.remove("2")
    operation = model.history.operation("0")
    with model.edit() as edit:
        edit.remove("0")
        edit.apply(operation, "0")
    for number in range(70):
        with model.edit() as edit:
            edit.insert(Put("x", number), f"x{number}", before="3")
    with model.edit() as edit:
        edit.undo(3)
        edit.undo(2)
    xs = [f"x{number}" for number in range(70)]
    tags = model.history.tags
    assert tags[0] == "0"
    assert [tag for tag in tags if tag[0] == "x"] == xs
    assert tags.index("1") < tags.index("2") < tags.index("3")


@pytest.mark.parametrize("seed", range(2))
def test_a_replica_of_a_document_has_equal_poses_and_an_equal_digest(seed: int) -> None:
    model = kv.load("articulations/garage_door") if seed else random_tree(seed)
    replica = kv.formats.from_bytes(kv.formats.to_bytes(model))
    frames = list(model.frames)
    for _ in range(2 * seed):  # the second one is remembered
        loaded = kv.load("articulations/garage_door")
        with loaded.edit() as edit:
            edit.undo(1)
        assert loaded.history.tags == []
    edits: list[Callable[[Edit], object]] = [
        lambda edit: edit.attach(frames[-1], "world", kv.translation(0, 1, seed)),
        lambda edit: edit.constrain("more", 0, kv.position("more"), 1),
        lambda edit: edit.insert(Watch("pose", frames[0]), before=edit.model.history.tags[-1]),
        lambda edit: edit.remove("constraint more"),
        lambda edit: edit.undo(edit.model.version),
    ]
    for change in edits:
        with model.edit() as edit:
            change(edit)
            net = edit.net()
        replica.adopt(net)
        assert replica.history.tags == model.history.tags
        assert kv.formats.document_hash(replica) == kv.formats.document_hash(model)
    with model.edit() as edit:  # what was missing when an operation was run is missing for its copies
        for tag in edit.model.history.tags:
            edit.replace(tag, pickle.loads(pickle.dumps(edit.model.history.operation(tag))))
    values = kv.State(random_state(model, seed))
    poses = [kv.compile([each.fk(name) for name in frames])(values) for each in (model, replica)]
    for one, other in zip(*poses, strict=True):
        assert (one == other).all()
