"""Results that are kept for a version of a model."""

import gc
import weakref
from functools import partial

import pytest

import kineverse as kv
from kineverse.model.symbolic_view import cached_for_version


def _frames(model):
    return cached_for_version(model, "frames", lambda: tuple(model.frames))


def test_a_result_is_computed_once_for_each_version_and_key():
    model, calls = kv.Model(), []
    for key in ("a", "a", "b"):
        cached_for_version(model, key, partial(calls.append, key))
    assert calls == ["a", "b"]
    with model.edit() as edit:
        edit.add_frame("one", "world")
    cached_for_version(model, "a", lambda: calls.append("again"))
    assert calls == ["a", "b", "again"]


def test_no_result_outlives_an_edit_or_its_failure():
    model = kv.Model()
    assert _frames(model) == ()
    with pytest.raises(ZeroDivisionError), model.edit() as edit:
        edit.add_frame("lost", "world")
        assert _frames(model) == ("lost",)
        raise ZeroDivisionError
    assert _frames(model) == ()
    with model.edit() as edit:
        edit.add_frame("kept", "world")
    assert _frames(model) == ("kept",)


def test_a_result_of_an_old_version_is_not_entered_late():
    model = kv.Model()

    def edits_meanwhile():
        found = tuple(model.frames)
        with model.edit() as edit:
            edit.add_frame("new", "world")
        return found

    assert cached_for_version(model, "frames", edits_meanwhile) == ()
    assert _frames(model) == ("new",)


def test_a_result_may_refer_to_its_model_and_dies_with_it():
    model = kv.Model()
    cached_for_version(model, "itself", partial(list, (model,)))
    seen = weakref.ref(model)
    del model
    gc.collect()
    assert seen() is None
