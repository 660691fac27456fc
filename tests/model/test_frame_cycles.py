"""Frames form a tree at every place of the sequence, not only at its end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from history_operations import Place, Sequenced, check, holds, state_of
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts

FRAMES = ("f", "g", "h", "i")
step = st.tuples(
    st.sampled_from(["append", "insert", "insert", "replace", "remove"]),
    st.integers(0, 30),
    st.sampled_from(FRAMES),
    st.sampled_from(("world", *FRAMES)),
)


@given(st.lists(st.lists(step, min_size=1, max_size=4), min_size=1, max_size=8))
@settings(max_examples=attempts(100), derandomize=True)
def test_random_edits_are_refused_exactly_when_some_part_of_the_sequence_has_a_circle(
    edits: list[Any],
) -> None:
    model, sequence = kv.Model(), [(name, Place(name, "world", moving=False)) for name in FRAMES]
    with model.edit() as edit:
        for name, place in sequence:
            edit.apply(place, name)
    for number, steps in enumerate(edits):
        before, wanted = state_of(model), list[Sequenced](sequence)
        refused = False
        try:
            with model.edit() as edit:
                for k, (kind, at, frame, parent) in enumerate(steps):
                    take(edit, wanted, kind, at % max(len(wanted), 1), f"{number}.{k}", Place(frame, parent))
        except kv.KineverseError:
            refused = True
        if refused:
            assert state_of(model) == before
        else:
            check(model, wanted)
            sequence = wanted  # type: ignore[assignment]
            continue
        # What was refused at once may have left the rest of the edit out.
        left = steps[len([tag for tag, _ in wanted if tag.startswith(f"{number}.")]) :]
        assert left or not holds(wanted)


def take(edit: kv.model.Edit, wanted: list[Sequenced], kind: str, at: int, tag: str, place: Place) -> None:
    if kind == "append" or not wanted:
        wanted.append((tag, place))
        edit.apply(place, tag)
        return
    target = wanted[at][0]
    if kind == "insert":
        wanted.insert(at, (tag, place))
        edit.insert(place, tag, before=target)
    elif kind == "replace":
        wanted[at] = (target, place)
        edit.replace(target, place)
    else:
        del wanted[at]
        edit.remove(target)


def test_a_circle_that_a_later_operation_would_undo() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("a", "world", np.eye(4))
        edit.add_frame("b", "a", np.eye(4))
    with pytest.raises(kv.errors.EditError) as error, model.edit() as edit:
        edit.attach("a", "b", np.eye(4), tag="closes it")
        edit.attach("a", "world", np.eye(4), tag="opens it")
    assert "  'closes it': Cyclic frames: a -> b -> a." in str(error.value)
    with model.edit() as edit:  # who comes to be in a circle because another one is gone
        edit.attach("b", "world", np.eye(4), tag="b away")
        edit.attach("a", "b", np.eye(4), tag="a to b")
        edit.attach("a", "world", np.eye(4), tag="a away")
    with pytest.raises(kv.errors.EditError) as error, model.edit() as edit:
        edit.remove("b away")
    assert "  'a to b': Cyclic frames: " in str(error.value)
    with model.edit() as edit:
        edit.remove("a to b")
        edit.remove("b away")
    assert model.history.tags == ["frame a", "frame b", "a away"]


def test_a_circle_after_places_have_been_given_out_anew() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("a", "world", np.eye(4))
        edit.add_frame("b", "a", np.eye(4))
        edit.attach("b", "world", np.eye(4), tag="away")
        edit.attach("a", "b", np.eye(4))
        edit.attach("b", "world", np.eye(4), tag="still away")
    with pytest.raises(kv.errors.EditError, match="'attach a to b': Cyclic frames"), model.edit() as edit:
        edit.remove("away")
        for k in range(70):  # halves the gap between two places until there is none
            edit.insert(kv.model.SetData(f"x{k}", k), after="frame b")
