"""The model is the fold of its operations, whatever was done to them; and no more is run than must be."""

from __future__ import annotations

from typing import Any

import pytest
from history_operations import (
    Capped,
    Count,
    Exists,
    Fold,
    Fragile,
    Fresh,
    Limit,
    Listing,
    Next,
    Pick,
    Place,
    Put,
    Row,
    Sequenced,
    Sum,
    Watch,
    changed,
    check,
    holds,
    state_of,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts

MANY = attempts(50)
NAMES = ("a", "b", "c", "d")
FRAMES = ("f", "g", "h", "i")
name = st.sampled_from(NAMES)
frame = st.sampled_from(FRAMES)
parent = st.sampled_from(("world", *FRAMES))
value = st.integers(0, 5)

operations = st.one_of(
    st.builds(Put, name, value),
    st.builds(Sum, name, st.lists(name, min_size=1, max_size=3).map(tuple)),
    st.builds(Next, name, name),
    st.builds(Capped, name, name),
    st.builds(Exists, name, name),
    st.builds(Count, name),
    st.builds(Listing, name),
    st.builds(Pick, name, name, name),
    st.builds(Fragile, name, name),
    st.builds(Place, frame, parent, value.map(float), st.booleans()),
    st.builds(Fresh, frame, parent, value.map(float), st.booleans()),
    st.builds(Watch, name, frame, parent),
    st.builds(Limit, name, name),
    st.builds(Row, name, name, name),
)
index = st.integers(0, 40)
step = st.one_of(
    st.tuples(st.just("append"), operations, index),
    st.tuples(st.just("append"), operations, index),
    st.tuples(st.sampled_from(["before", "after", "to_affect"]), operations, index),
    st.tuples(st.just("replace"), operations, index),
    st.tuples(st.just("remove"), st.none(), index),
)
# Something to begin with, so that edits early in the sequence have dependents.
START: tuple[kv.Operation, ...] = (
    Put("a", 1),
    Put("b", 2),
    Place("f", "world"),
    Place("g", "f"),
    Sum("c", ("a", "b")),
    Capped("d", "c"),
    Watch("d", "g"),
    Limit("c", "d"),
)


def take(
    edit: kv.model.Edit, sequence: list[Sequenced], kind: str, operation: Any, at: int, tag: str
) -> None:
    if kind == "append" or not sequence:
        edit.apply(operation, tag)
        sequence.append((tag, operation))
        return
    at %= len(sequence)
    target = sequence[at][0]
    if kind == "remove":
        edit.remove(target)
        del sequence[at]
    elif kind == "replace":
        edit.replace(target, operation)
        sequence[at] = (target, operation)
    else:
        edit.insert(operation, tag, **{kind: target})
        sequence.insert(at + (kind == "after"), (tag, operation))


def started() -> tuple[kv.Model, list[Sequenced]]:
    model = kv.Model()
    sequence = [(f"start {i}", operation) for i, operation in enumerate(START)]
    with model.edit() as edit:
        for tag, operation in sequence:
            edit.apply(operation, tag)
    return model, sequence


@given(st.lists(step, min_size=1, max_size=12))
@settings(max_examples=MANY, derandomize=True)
def test_single_steps_equal_a_fold_from_the_empty_model(steps: list[Any]) -> None:
    model, sequence = started()
    expected = check(model, sequence)
    for number, (kind, operation, at) in enumerate(steps):
        before, runs, wanted = state_of(model), model.history.runs, list(sequence)
        try:
            with model.edit() as edit:
                take(edit, wanted, kind, operation, at, f"t{number}")
        except kv.KineverseError:
            if wanted == sequence:  # it was refused at once: take the step on the list
                take(_Anything(), wanted, kind, operation, at, f"t{number}")
            assert not holds(wanted)
            assert state_of(model) == before
            continue
        result, itself = check(model, wanted), kind != "remove" or not sequence
        assert model.history.runs - runs == itself + _dependents(expected, result, sequence, wanted)
        sequence, expected = wanted, result


class _Anything:
    def __getattr__(self, name: str) -> Any:
        return lambda *_, **__: None


def _dependents(before: Fold, after: Fold, old: list[Sequenced], new: list[Sequenced]) -> int:
    """Return how many operations see something else, of those that were not exchanged themselves."""
    same = [tag for tag, operation in new if (tag, operation) in old and dict(old)[tag] is operation]
    return len(changed(before, after, same))


@given(st.lists(st.lists(st.tuples(step, st.booleans()), min_size=1, max_size=5), min_size=1, max_size=5))
@settings(max_examples=MANY, derandomize=True)
def test_transactions_equal_a_fold_though_failed_steps_are_caught_inside(transactions: list[Any]) -> None:
    model, sequence = started()
    number = 0
    for transaction in transactions:
        before, wanted = state_of(model), list(sequence)
        try:
            with model.edit() as edit:
                for (kind, operation, at), look in transaction:
                    number += 1
                    try:
                        take(edit, wanted, kind, operation, at, f"t{number}")
                        if look:
                            len(model.data)
                    except kv.KineverseError:
                        pass
        except kv.KineverseError:
            assert not holds(wanted)
            assert state_of(model) == before
            continue
        check(model, wanted)
        sequence = wanted
    check(model.copy(), sequence)


def build(*operations: kv.Operation) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        for i, operation in enumerate(operations):
            edit.apply(operation, str(i))
    return model


def runs(model: kv.Model, tag: str, operation: kv.Operation) -> int:
    before = model.history.runs
    with model.edit() as edit:
        edit.replace(tag, operation)
    return model.history.runs - before


def test_only_dependents_are_run_again_and_it_stops_where_writes_come_out_equal() -> None:
    model = build(Put("a", 1), Next("b", "a"), Capped("c", "b"), Next("d", "c"), Put("x", 5), Next("y", "x"))
    assert runs(model, "0", Put("a", 1)) == 1  # equal: nobody else
    assert runs(model, "0", Put("a", 0)) == 4  # b = 1, c = 1, d = 2
    assert runs(model, "0", Put("a", 7)) == 4
    assert runs(model, "0", Put("a", 8)) == 3  # c stays 2, so d is not run
    assert dict(model.data) == {"a": 8, "b": 9, "c": 2, "d": 3, "x": 5, "y": 6}


def test_an_absence_is_read_too() -> None:
    model = build(Put("x"), Sum("s", ("a",)), Exists("e", "a"))
    before = model.history.runs
    with model.edit() as edit:
        edit.insert(Put("a", 4), before="1")
    assert (model.data["s"], model.data["e"], model.history.runs - before) == (4, 1, 3)
    assert runs(model, "put a", Put("a", 5)) == 2  # whoever looked at the existence is not concerned
    with model.edit() as edit:
        edit.remove("put a")
    assert (model.data["s"], model.data["e"]) == (0, 0)


def test_a_write_after_a_reader_does_not_run_it_again() -> None:
    model = build(Sum("s", ("a",)), Listing("n"), Count("k"))
    before = model.history.runs
    with model.edit() as edit:
        edit.apply(Put("a", 4))
        edit.apply(Place("f", "world"))
    assert model.history.runs - before == 2
    assert (model.data["s"], model.data["n"], model.data["k"]) == (0, 1, 0)


def test_a_listing_is_run_again_when_names_change_and_not_when_values_do() -> None:
    model = build(Place("f", "world"), Count("n"))
    assert runs(model, "0", Place("f", "world", 1.0)) == 1
    with model.edit() as edit:
        edit.insert(Place("g", "world"), before="0")
    assert model.data["n"] == 2
    with model.edit() as edit:
        edit.insert(Place("g", "f"), "again", after="0")  # the name was there already
    assert model.history.runs == 2 + 1 + 2 + 1


def test_a_pose_is_run_again_when_a_frame_up_its_chain_changes_and_not_otherwise() -> None:
    model = build(
        Place("base", "world"),
        Place("arm", "base"),
        Place("hand", "arm"),
        Place("finger", "hand"),
        Place("head", "base"),
        Watch("w", "hand"),
        Watch("v", "hand", "arm"),
        Watch("u", "finger", "head"),
    )
    assert runs(model, "3", Place("finger", "hand", 1.0)) == 1 + 1  # u
    assert runs(model, "4", Place("head", "base", 1.0)) == 1 + 1  # u
    assert runs(model, "1", Place("arm", "base", 1.0)) == 1 + 2  # w, u
    assert runs(model, "0", Place("base", "world", 1.0)) == 1 + 1  # only w is about the world
    assert runs(model, "2", Place("hand", "base", 1.0)) == 1 + 3


def test_rates_are_read_through_fk() -> None:
    class Columns(kv.Operation):
        def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
            return kv.model.Writes(data={"columns": tuple(map(str, model.fk("f").gradient()))})

    model = build(Place("f", "world"), Row("other", "wheel", "k"), Columns())
    assert model.data["columns"] == ("f:velocity",)
    before = model.history.runs
    with model.edit() as edit:
        edit.insert(Row("f", "wheel", "k"), before="2")
    assert (model.data["columns"], model.history.runs - before) == (("wheel:velocity",), 2)
    assert runs(model, "1", Row("other", "engine", "k")) == 1
    assert model.history.readers("rates/f") == ["2"]
    assert model.history.readers("frames/f") == ["2"]


def test_a_read_finds_the_last_writer_before_it() -> None:
    model = build(Put("a", 1), Next("b", "a"), Put("a", 10), Next("c", "a"), Next("a", "a"))
    assert dict(model.data) == {"a": 11, "b": 2, "c": 11}
    assert model.history.writers("data/a") == ["0", "2", "4"]
    assert model.history.readers("data/a") == ["1", "3", "4"]
    assert runs(model, "0", Put("a", 2)) == 2  # b; c and the last one see the 10
    with model.edit() as edit:
        edit.remove("2")
    assert dict(model.data) == {"a": 3, "b": 3, "c": 3}


def test_replacing_the_last_operation_does_not_apply_it_to_its_own_result() -> None:
    model = build(Put("a", 1), Next("a", "a"))
    for _ in range(3):
        with model.edit() as edit:
            edit.replace("1", Next("a", "a"))
        assert model.data["a"] == 2


@pytest.mark.parametrize("count", [60, 700])
@pytest.mark.parametrize("where", ["before", "after", "to_affect"])
def test_many_insertions_at_one_place(count: int, where: str) -> None:
    model = build(Put("a"), Next("b", "a"), Put("z"))
    kept, expected = model.snapshot(), []
    for i in range(count):
        with model.edit() as edit:
            edit.insert(Put("a", i), f"i{i}", **{where: "0" if where == "after" else "1"})
        expected.insert(0 if where == "after" else i, f"i{i}")
    assert model.history.tags == ["0", *expected, "1", "2"]
    last = 0 if where == "after" else count - 1
    assert dict(model.data) == {"a": last, "b": last + 1, "z": 0}
    assert kept.model().history.tags == ["0", "1", "2"]
    assert dict(kept.model().data) == {"a": 0, "b": 1, "z": 0}


def test_many_insertions_in_one_edit_of_which_some_are_taken_back() -> None:
    model = build(Put("a"), Next("b", "a"), Next("c", "b"))
    before = state_of(model)
    with pytest.raises(ZeroDivisionError), model.edit() as edit:
        edit.replace("1", Next("b", "a"))
        edit.replace("0", Put("a", 4))
        for i in range(200):
            edit.insert(Next("a", "a"), f"i{i}", before="1")
        edit.remove("2")
        for i in range(200):
            edit.insert(Put("q", i), f"j{i}", after="0")
        raise ZeroDivisionError
    assert state_of(model) == before
    assert runs(model, "0", Put("a", 5)) == 3
    assert dict(model.data) == {"a": 5, "b": 6, "c": 7}


def test_a_snapshot_from_before_a_renumbering_keeps_its_order() -> None:
    model = build(Put("a"), Next("b", "a"), Next("c", "b"))
    kept = model.snapshot()
    with model.edit() as edit:
        edit.replace("1", Next("b", "a"))  # the snapshot holds an entry the model does not
    for i in range(100):
        with model.edit() as edit:
            edit.insert(Put("x", i), f"x{i}", before="0")
    restored = kept.model()
    assert restored.history.tags == ["0", "1", "2"]
    with restored.edit() as edit:
        edit.replace("0", Put("a", 5))
    assert dict(restored.data) == {"a": 5, "b": 6, "c": 7}


def test_to_affect_takes_a_frame() -> None:
    model = build(Place("f", "world"), Place("g", "f"), Place("g", "world"))
    with model.edit() as edit:
        edit.insert(Place("f", "world", 2.0), "new", to_affect="g")
    assert model.history.tags == ["0", "1", "new", "2"]


def test_a_failed_operation_does_not_burn_its_tag_and_leaves_no_trace_inside_the_edit() -> None:
    model = build(Put("a", 5))
    with model.edit() as edit:
        with pytest.raises(kv.errors.UnknownNameError):
            edit.apply(Next("b", "nothing"), "t")
        with pytest.raises(kv.errors.EditError, match="5 is too much"):
            edit.apply(Fragile("b", "a"), "t")
        with pytest.raises(kv.KineverseError):
            edit.insert(Next("b", "a"), "t", before="0")
        edit.apply(Next("b", "a"), "t")
        with pytest.raises(kv.errors.EditError):
            edit.replace("t", Fragile("b", "a"))
    check(model, [("0", Put("a", 5)), ("t", Next("b", "a"))])


def test_a_refused_edit_lists_every_failed_operation() -> None:
    model = build(
        Put("a", 1), Next("b", "a"), Next("c", "a"), Fragile("d", "e"), Place("f", "world"), Place("g", "f")
    )
    before = state_of(model)
    with pytest.raises(kv.errors.EditError) as info, model.edit() as edit:
        edit.remove("0")
        edit.insert(Put("e", 9), before="3")
        edit.remove("4")
    text = str(info.value)
    assert [line.split(":")[0].strip() for line in text.splitlines()[1:]] == ["'1'", "'2'", "'3'", "'5'"]
    assert text.count("There is no datum 'a'") == 2
    assert "9 is too much" in text
    assert "The parent of frame 'g' is missing" in text
    assert state_of(model) == before
    assert runs(model, "0", Put("a", 2)) == 3


def test_a_failure_inside_an_edit_can_be_corrected_and_else_fails_at_its_end() -> None:
    model = build(Put("a", 1), Next("b", "a"))
    before = state_of(model)
    with pytest.raises(kv.errors.EditError, match="no datum 'a'"), model.edit() as edit:
        edit.remove("0")
        with pytest.raises(kv.errors.EditError):
            len(model.data)
    assert state_of(model) == before
    with model.edit() as edit:
        edit.remove("0")
        with pytest.raises(kv.errors.EditError):
            len(model.data)
        edit.insert(Put("a", 6), "0", before="1")
    assert dict(model.data) == {"a": 6, "b": 7}


def test_names_of_constraints_may_depend_on_reads() -> None:
    model = build(Put("a", 0), Put("b", 1), Limit("l", "a"), Limit("l", "b"))
    assert list(model.constraints) == ["l/0", "l/1"]
    with model.edit() as edit:
        edit.replace("0", Put("a", 1))
        edit.replace("1", Put("b", 2))
    assert list(model.constraints) == ["l/1", "l/2"]
    before = state_of(model)
    with (
        pytest.raises(kv.errors.EditError, match=r"'3': There is a constraint 'l/1' already, made by '2'"),
        model.edit() as edit,
    ):
        edit.replace("1", Put("b", 1))
    assert state_of(model) == before


def test_a_constraint_may_take_the_name_of_a_later_one_that_gets_another() -> None:
    model = build(Put("a", 2), Put("b", 2), Capped("d", "b"), Limit("c", "d"))
    with model.edit() as edit:
        edit.replace("1", Limit("c", "a"))  # c/2; without b, the other is called c/0
    assert list(model.constraints) == ["c/2", "c/0"]
    before = state_of(model)
    with (
        pytest.raises(kv.errors.EditError, match="'3': There is a constraint 'c/2' already, made by '1'"),
        model.edit() as edit,
    ):
        edit.insert(Put("b", 7), before="2")
    assert state_of(model) == before


def test_constraints_live_and_die_with_their_operation() -> None:
    model = build(Put("a", 0), Limit("l", "a"))
    with model.edit() as edit:
        edit.remove("1")
    assert not model.constraints
    assert model.constraints_for([kv.position("l")]) == {}
    with model.edit() as edit:
        edit.apply(Limit("l", "a"), "1")
    assert list(model.constraints) == ["l/0"]


def test_removing_and_adding_a_frame_in_one_edit_runs_its_children_once() -> None:
    model = build(Place("f", "world"), Place("g", "f"), Place("h", "f"))
    before = model.history.runs
    with model.edit() as edit:
        edit.remove("0")
        edit.insert(Place("f", "world", 3.0), "0", before="1")
    assert model.history.runs - before <= 3
    assert model.fk("g")({"f": 0, "g": 0})[1, 3] == 3


def test_an_operation_that_raises_half_way() -> None:
    class HalfWay(kv.Operation):
        def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
            len(model.frames)
            model.fk("f")
            raise RuntimeError("half way")

    model = build(Place("f", "world"))
    before = state_of(model)
    with pytest.raises(kv.errors.EditError, match="'x' raised RuntimeError: half way"), model.edit() as edit:
        edit.apply(Place("g", "f"))
        edit.apply(HalfWay(), "x")
    assert state_of(model) == before
    with model.edit() as edit:
        edit.apply(Place("g", "f"))
        with pytest.raises(kv.errors.EditError):
            edit.apply(HalfWay(), "x")
        edit.apply(Place("h", "g"), "x")
    check(model, [("0", Place("f", "world")), ("place g", Place("g", "f")), ("x", Place("h", "g"))])


def test_appending_costs_the_same_runs_however_long_the_model_is() -> None:
    model = build(*(Place(f"f{i}", "world") for i in range(2000)))
    before = model.history.runs
    with model.edit() as edit:
        edit.apply(Place("new", "f7"))
    assert model.history.runs - before == 1
    assert runs(model, "7", Place("f7", "world", 2.0)) == 1


def test_copies_and_snapshots_do_not_see_places_given_out_anew() -> None:
    model, sequence = started()
    copied, snapshot = model.copy(), model.snapshot()
    own = list(sequence)
    with pytest.raises(KeyError), model.edit() as edit:
        for i in range(80):  # halves the gap between two places until there is none
            edit.insert(Put("a", i), f"n{i}", after="start 0")
        assert model.data["c"] == 2  # the last one that stands before the sum is the first one inserted
        raise KeyError
    check(model, sequence)
    with model.edit() as edit:
        for i in range(80):
            edit.insert(Put("a", i), f"n{i}", after="start 0")
            sequence.insert(1, (f"n{i}", Put("a", i)))
    check(model, sequence)
    for other in (copied, snapshot.model(), copied.copy()):
        check(other, own)
        with other.edit() as edit:
            edit.replace("start 1", Put("b", 7))
            edit.insert(Next("e", "b"), "e", after="start 1")
        check(other, [*own[:1], ("start 1", Put("b", 7)), ("e", Next("e", "b")), *own[2:]])
    check(model, sequence)
