"""What a commit says it did: added, removed, replaced, moved, run again; and who hears of it."""

from __future__ import annotations

from typing import Any

import pytest
from history_operations import Next, Put, Sum
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts


def chain() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(Put("a", 1), "a")
        edit.apply(Put("b", 1), "b")
        edit.apply(Sum("c", ("a",)), "c")
        edit.apply(Next("d", "c"), "d")
    return model


def test_an_operation_that_was_removed_and_applied_again_has_moved() -> None:
    model, heard = chain(), list[kv.model.Diff]()
    model.listen(heard.append)
    with model.edit() as edit:
        edit.remove("b")
        edit.apply(Put("b", 1), "b")
    assert model.history.tags == ["a", "c", "d", "b"]
    assert (heard[-1].replaced, heard[-1].moved, heard[-1].changes) == (("b",), ("b",), ())
    assert heard[-1].tags == {"b"}
    with model.edit() as edit:  # back to the very place where it was taken from is no move
        edit.remove("b")
        edit.insert(Put("b", 2), "b", after="d")
    assert (heard[-1].replaced, heard[-1].moved) == (("b",), ())
    assert not heard[-1].is_empty


def test_operations_that_were_run_again_are_named_and_heard_of() -> None:
    model, all_of_it, of_c, of_b = (
        chain(),
        list[kv.model.Diff](),
        list[kv.model.Diff](),
        list[kv.model.Diff](),
    )
    model.listen(all_of_it.append)
    model.listen(of_c.append, tags=["c"])
    model.listen(of_b.append, tags="b")
    with model.edit() as edit:
        edit.replace("a", Put("a", 5))
    assert (all_of_it[-1].replaced, all_of_it[-1].rerun) == (("a",), ("c", "d"))
    assert all_of_it[-1].tags == {"a", "c", "d"}
    assert all_of_it[-1].reruns == 3
    assert (of_c[-1].replaced, of_c[-1].rerun, of_c[-1].changes) == ((), ("c",), ())
    assert of_b == []
    with model.edit() as edit:  # what was removed afterwards has not been run, as far as anybody can see
        edit.replace("a", Put("a", 7))
        assert model.data["d"] == 8
        edit.remove("d")
        edit.replace("c", Sum("c", ("a", "b")))
    assert (all_of_it[-1].rerun, all_of_it[-1].removed, all_of_it[-1].replaced) == ((), ("d",), ("a", "c"))
    with pytest.raises(kv.errors.EditError), model.edit() as edit:
        edit.apply(Next("e", "b"), "e")
        edit.remove("b")
    with model.edit() as edit:
        edit.write("other", 1)
    assert all_of_it[-1].rerun == ()


order = st.lists(st.tuples(st.integers(0, 20), st.integers(0, 20)), max_size=5)


@given(order, st.booleans())
@settings(max_examples=attempts(100))
def test_moved_tags_of_a_commit_equal_those_of_a_comparison(steps: Any, with_others: bool) -> None:
    model = kv.Model()
    with model.edit() as edit:
        for k in range(6):
            edit.apply(Put(f"x{k}"), str(k))
    before, heard = model.snapshot(), list[kv.model.Diff]()
    model.listen(heard.append)
    again = set()
    with model.edit() as edit:
        for number, (which, to) in enumerate(steps):
            tags = model.history.tags
            tag = tags[which % len(tags)]
            operation = model.history.operation(tag)
            if with_others:
                edit.insert(Put(f"new{number}"), f"new{number}", before=tags[to % len(tags)])
            edit.remove(tag)
            if len(tags) > 1:
                target = model.history.tags[to % len(model.history.tags)]
                edit.insert(operation, tag, before=target)
                again.add(tag)
    (diff,) = heard or [kv.model.Diff(0, ())]
    found = kv.model.compare_models(before, model)
    assert set(diff.moved) <= again & set(diff.replaced)
    # Several sets of moves may explain an order; all others stand as they did, and no set is smaller.
    still = [tag for tag in before.tags if tag not in diff.moved]
    assert [tag for tag in model.history.tags if tag in still] == still
    assert len(diff.moved) >= len(found.moved)
    assert bool(diff.moved) == bool(found.moved)
