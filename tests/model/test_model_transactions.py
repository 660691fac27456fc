"""Edits happen whole or not at all, are heard of once, and readers see before or after."""

from __future__ import annotations

import copy
import logging
import pickle
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from history_operations import Next, Place, Put, Sum, state_of

import kineverse as kv

a, b = kv.position("a"), kv.position("b")


def door() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("door", "world", kv.rotation_z(a))
        edit.add_frame("door/handle", "door", kv.translation(0.8, 0, 1))
        edit.constrain("door/range", 0, a, 1.5)
        edit.write("colour", "red")
    return model


def recorded(model: kv.Model, **filters: Any) -> list[kv.model.Diff]:
    heard: list[kv.model.Diff] = []
    model.listen(heard.append, **filters)
    return heard


# -- transactions --------------------------------------------------------------------------------------


def test_an_edit_commits_whole_and_counts_a_version() -> None:
    model = kv.Model()
    assert model.version == 0
    with model.edit() as edit:
        assert edit.apply(Put("x", 1)) == "put x"
        edit.apply(Next("y", "x"), tag="t")
    assert (model.version, dict(model.data)) == (1, {"x": 1, "y": 2})


@pytest.mark.parametrize("error", [ValueError, kv.errors.ModelError, KeyboardInterrupt, GeneratorExit])
def test_any_exception_in_the_block_undoes_the_edit(error: type[BaseException]) -> None:
    model = door()
    before = state_of(model)
    with pytest.raises(error), model.edit() as edit:
        edit.apply(Put("x", 1))
        edit.remove("data colour")
        edit.add_frame("door", "world", np.eye(4), tag="again", override=True)
        assert model.fk("door") == kv.array(np.eye(4))
        raise error
    assert state_of(model) == before


def test_the_model_shows_the_edit_so_far_inside_the_block() -> None:
    model, x = door(), kv.position("x")
    assert model.symbols == (a,)
    with model.edit() as edit:
        edit.add_frame("slider", "door", kv.translation(x, 0, 0))
        assert model.symbols == (a, x)
        assert model.speeds == (a.derivative(), x.derivative())
        assert set(model.fk("slider").symbols) == {a, x}
        edit.constrain("lock", 0, x.derivative(), 1 - a)
        assert list(model.constraints_for([x])) == ["lock"]
        assert model.limits("x:velocity") == (0, 1)
        edit.replace("frame slider", Place("slider", "world", 5.0, moving=False))
        assert model.fk("slider")()[1, 3] == 5
        assert model.symbols == (a, x)
        edit.remove("constraint lock")
        assert model.symbols == (a,)
        assert len(model.constraints) == 1
    assert model.version == 2


def test_an_edit_is_over_at_the_end_of_its_block() -> None:
    model = door()
    with model.edit() as edit:
        pass
    for call in (
        lambda: edit.apply(Put("x")),
        lambda: edit.remove("data colour"),
        lambda: edit.replace("data colour", Put("x")),
    ):
        with pytest.raises(kv.errors.EditError, match="over"):
            call()


def test_one_edit_at_a_time() -> None:
    model = door()
    before = state_of(model)
    with pytest.raises(kv.errors.EditError, match="edited already"), model.edit() as edit:
        edit.apply(Put("x"))
        with model.edit():
            pass
    assert state_of(model) == before
    with model.edit() as edit:
        edit.apply(Put("x"))


# -- diffs ---------------------------------------------------------------------------------------------


def test_a_diff_has_exactly_the_structural_changes() -> None:
    model = kv.Model()
    heard = recorded(model)
    with model.edit() as edit:
        for operation in (Put("x", 1), Next("y", "x"), Put("z", 0), Place("f", "world")):
            edit.apply(operation)
    with model.edit() as edit:
        edit.replace("put x", Put("x", 2))
        edit.apply(Put("new", 1))
        edit.remove("put z")
        edit.apply(Put("gone", 1))
        edit.remove("put gone")
    first, second = heard
    assert first.paths == ("data/x", "data/y", "data/z", "frames/f")
    assert all(c.before is None for c in first.changes)
    assert first.added == ("put x", "next y", "put z", "place f")
    assert {c.path: (c.before, c.after) for c in second.changes} == {
        "data/x": (1, 2),
        "data/y": (2, 3),
        "data/new": (None, 1),
        "data/z": (0, None),
    }
    assert (second.version, second.added, second.removed, second.replaced) == (
        2,
        ("put new",),
        ("put z",),
        ("put x",),
    )
    assert second.reruns == 3


def test_an_equal_rewrite_changes_nothing() -> None:
    model = door()
    heard = recorded(model)
    with model.edit() as edit:
        entry = model.history.entry("frame door")
        edit.replace("frame door", entry.operation)
        edit.replace("constraint door/range", model.history.entry("constraint door/range").operation)
    assert heard[0].changes == ()
    assert heard[0].replaced == ("frame door", "constraint door/range")
    with model.edit() as edit:  # there and back
        edit.replace("data colour", Put("colour", "blue"))
        edit.replace("data colour", Put("colour", "red"))
    assert heard[1].changes == ()


def test_removing_and_adding_under_one_tag_is_a_replacement() -> None:
    model = door()
    heard = recorded(model)
    with model.edit() as edit:
        edit.remove("data colour")
        edit.apply(Put("colour", "blue"), "data colour")
    (diff,) = heard
    assert (diff.added, diff.removed, diff.replaced) == ((), (), ("data colour",))
    assert [(c.path, c.before, c.after) for c in diff.changes] == [("data/colour", "red", "blue")]


# -- listeners -----------------------------------------------------------------------------------------


def test_listeners_get_each_relevant_diff_once() -> None:
    model = door()
    everything, root = recorded(model), recorded(model, paths=[""])
    handle, below = recorded(model, paths=["frames/door/handle"]), recorded(model, paths=["frames/door"])
    about_a, about_b = recorded(model, symbols=[a.derivative()]), recorded(model, symbols=[b])
    tagged = recorded(model, tags=["constraint lock", "data colour"])
    single = recorded(model, paths="data")
    with model.edit() as edit:
        edit.constrain("lock", -b, a.derivative(), b)
        edit.add_frame("door/lamp", "door", np.eye(4))
        edit.apply(Put("colour/shade", 3))
    assert [d.paths for d in everything] == [("constraints/lock", "data/colour/shade", "frames/door/lamp")]
    assert [d.paths for d in root] == [("constraints/lock", "data/colour/shade", "frames/door/lamp")]
    assert handle == []
    assert [d.paths for d in below] == [("frames/door/lamp",)]
    assert [d.paths for d in about_a] == [d.paths for d in about_b] == [("constraints/lock",)]
    assert [(d.paths, d.added) for d in tagged] == [((), ("constraint lock",))]
    assert [d.paths for d in single] == [("data/colour/shade",)]
    with model.edit() as edit:
        edit.remove("constraint lock")
    assert [d.paths for d in about_b] == [("constraints/lock",)] * 2
    assert tagged[1].removed == ("constraint lock",)


def test_recomputed_dependents_and_deletions_are_heard_of() -> None:
    model = kv.Model()
    with model.edit() as edit:
        for operation in (Put("x", 1), Next("y", "x"), Sum("s", ("y", "x"))):
            edit.apply(operation)
    heard = recorded(model, paths=["data/s"])
    with model.edit() as edit:
        edit.replace("put x", Put("x", 5))
    with model.edit() as edit:
        edit.remove("sum s")
    assert [(c.before, c.after) for d in heard for c in d.changes] == [(3, 11), (11, None)]


def test_a_refused_edit_is_not_heard_of() -> None:
    model = door()
    heard = recorded(model)
    with pytest.raises(kv.errors.EditError), model.edit() as edit:
        edit.remove("frame door")
    assert heard == []


def test_a_listener_that_raises_is_logged_and_others_still_hear(caplog: pytest.LogCaptureFixture) -> None:
    model = door()

    def raising(_: kv.model.Diff) -> None:
        raise RuntimeError("of my own")

    model.listen(raising)
    heard = recorded(model)
    with caplog.at_level(logging.ERROR), model.edit() as edit:
        edit.apply(Put("x"))
    with model.edit() as edit:
        edit.apply(Put("y"))
    assert [d.version for d in heard] == [2, 3]
    assert "of my own" in caplog.text


def test_a_listener_may_edit_the_model_and_everyone_hears_in_order() -> None:
    model = kv.Model()
    first: list[int] = []
    second: list[tuple[int, tuple[str, ...]]] = []

    def react(diff: kv.model.Diff) -> None:
        first.append(diff.version)
        if diff.version < 4:
            with model.edit() as edit:
                edit.apply(Put(f"r{diff.version}", 0))

    model.listen(react)
    model.listen(lambda diff: second.append((diff.version, diff.paths)))
    with model.edit() as edit:
        edit.apply(Put("x"))
    assert first == [1, 2, 3, 4]
    assert second == [(1, ("data/x",)), (2, ("data/r1",)), (3, ("data/r2",)), (4, ("data/r3",))]


def test_closing_a_listener() -> None:
    model = kv.Model()
    heard: list[str] = []
    late = None

    def closing(_: kv.model.Diff) -> None:
        heard.append("closing")
        assert late is not None
        late.close()

    first = model.listen(closing)
    late = model.listen(lambda _: heard.append("late"))
    with model.listen(lambda _: heard.append("block")), model.edit() as edit:
        edit.apply(Put("x"))
    first.close()
    first.close()
    with model.edit() as edit:
        edit.apply(Put("y"))
    assert heard == ["closing", "block"]


def test_wrong_filters() -> None:
    with pytest.raises(kv.errors.ExpressionError):
        kv.Model().listen(print, symbols=["a"])


# -- snapshots and copies ------------------------------------------------------------------------------


def test_a_snapshot_never_changes_and_compares_by_value() -> None:
    model = door()
    kept, again = model.snapshot(), model.snapshot()
    assert kept == again
    assert hash(kept) == hash(again)
    with model.edit() as edit:
        edit.replace("frame door", Place("door", "world", 2.0, moving=False))
        edit.constrain("more", 0, b, 1)
    assert kept == again != model.snapshot()
    assert kept.symbols == (a,)
    assert kept.fk("door/handle") != model.fk("door/handle")
    assert kept.version == 1
    assert kept.tags == ["frame door", "frame door/handle", "constraint door/range", "data colour"]
    with model.edit() as edit:
        edit.remove("constraint more")
        edit.replace("frame door", kept.model().history.entry("frame door").operation)
    assert model.snapshot() == kept
    assert (kept == 3) is False


@pytest.mark.parametrize(
    "how", [copy.copy, copy.deepcopy, kv.Model.copy, lambda m: pickle.loads(pickle.dumps(m))]
)
def test_copies_go_their_own_way(how: Any) -> None:
    model = door()
    heard, other = recorded(model), how(model)
    assert other.snapshot() == model.snapshot()
    assert (other.version, other.history.runs) == (1, 0)
    with other.edit() as edit:
        edit.replace("data colour", Put("colour", "blue"))
        edit.apply(Put("n", 1))
    assert (model.data["colour"], other.data["colour"]) == ("red", "blue")
    assert "n" not in model.data
    assert heard == []
    assert model.fk("door/handle") == other.fk("door/handle")
    with pytest.raises(kv.errors.EditError), other.edit() as edit:
        edit.remove("frame door")


def test_a_model_with_rates_and_augmented_expressions_survives_pickling() -> None:
    model = kv.load("fetch")
    other = pickle.loads(pickle.dumps(model))
    assert other.snapshot() == model.snapshot()
    frame = list(model.frames)[-1]
    assert other.jacobian(frame) == model.jacobian(frame)
    assert dict(other.constraints) == dict(model.constraints)


@dataclass(frozen=True)
class Doubled(kv.Operation):
    name: str

    def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={self.name: 2 * model.data["x"]})


def test_a_model_reaches_another_process(tmp_path: Path) -> None:
    model = door()
    with model.edit() as edit:
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="base", parent="world", child="base", radius=0.1, track=0.4
            )
        )
        edit.apply(Put("x", 2))
        edit.apply(Next("y", "x"))
        edit.constrain("logic", 0, a.augment({b.derivative(): 2 * a}), 1)
    sent, back = tmp_path / "sent", tmp_path / "back"
    sent.write_bytes(pickle.dumps((model, model.snapshot())))
    program = f"""
import pickle, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from history_operations import Put
with open({str(sent)!r}, "rb") as file:
    model, snapshot = pickle.load(file)
assert model.snapshot() == snapshot
with model.edit() as edit:
    edit.replace("put x", Put("x", 5))
with open({str(back)!r}, "wb") as file:
    pickle.dump(model, file)
"""
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True)
    other = pickle.loads(back.read_bytes())
    with model.edit() as edit:
        edit.replace("put x", Put("x", 5))
    assert other.snapshot() == model.snapshot()
    assert (other.version, other.data["y"]) == (3, 6)
    assert other.fk("base").gradient() == model.fk("base").gradient()


# -- threads -------------------------------------------------------------------------------------------


def test_readers_in_other_threads_see_before_or_after_and_never_between() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(Put("x", 0))
        edit.apply(Put("y", 0))
        edit.apply(Place("f", "world", 0.0, moving=False))
        edit.apply(Place("g", "f", 0.0, moving=False))
    wrong: list[Any] = []
    done = threading.Event()

    def read() -> None:
        while not done.is_set():
            snapshot, values = model.snapshot(), dict(model.data.items())
            pose = model.fk("g")()[1, 3]
            if snapshot.data["x"] != snapshot.data["y"] or values["x"] != values["y"]:
                wrong.append(values)
            if pose != 0 or snapshot.fk("g")()[1, 3] != 0:
                wrong.append(pose)

    readers = [threading.Thread(target=read) for _ in range(3)]
    for reader in readers:
        reader.start()
    for i in range(1, 150):
        try:
            with model.edit() as edit:
                edit.replace("put x", Put("x", i))
                edit.replace("place f", Place("f", "world", float(i), moving=False))
                len(model.data)
                edit.replace("place g", Place("g", "f", float(-i), moving=False))
                edit.replace("put y", Put("y", i))
                if i % 3 == 0:
                    raise ZeroDivisionError
        except ZeroDivisionError:
            pass
    done.set()
    for reader in readers:
        reader.join()
    assert wrong == []


def test_edits_in_many_threads_are_all_made_and_heard_of_in_order() -> None:
    model = kv.Model()
    heard: list[int] = []
    model.listen(lambda diff: heard.append(diff.version))

    def write(k: int) -> None:
        for i in range(40):
            with model.edit() as edit:
                edit.apply(Put(f"{k}/{i}", i))

    threads = [threading.Thread(target=write, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert model.version == len(model.data) == 160
    assert heard == list(range(1, 161))


def test_an_edit_context_may_be_used_again() -> None:
    model = kv.Model()
    again = model.edit()
    for name in ("a", "b"):
        with again as edit:
            edit.write(name, 1)
    assert (list(model.data), model.version) == (["a", "b"], 2)
    with again as edit:
        edit.write("c", 1)
        with pytest.raises(kv.errors.EditError, match="being edited already"), again:
            pass
        edit.write("d", 1)
    assert (list(model.data), model.version) == (["a", "b", "c", "d"], 3)
