"""Traces below prefixes, in documents of documents, beside loops, and what they cost."""

from __future__ import annotations

import gc

import numpy as np
import pytest
from trace_models import KNOB, LIFT, Custom, build, build_scene, reloaded

import kineverse as kv
from kineverse.formats.document import OpaqueOperation, read_operations, to_json
from kineverse.model.traces import ReadNode


def derived(model: kv.model.ReadRecorder) -> kv.model.Writes:
    """Differentiate and substitute in what is read."""
    place = model.fk("car").substitute({LIFT: KNOB})[:3, 3] + model.fk("car")[:3, 3].jacobian([LIFT])[:, 0]
    driver = model.constraints["range"].expression
    return kv.model.Writes(frames={"knob": ("car", kv.translation(*place) @ kv.rotation_x(driver))})


def branching(model: kv.model.ReadRecorder) -> kv.model.Writes:
    """Decide by a number."""
    return kv.model.Writes(data={"said": 2.0 if model.data["number"] > 1 else 3.0})


def test_nested_prefixes_follow() -> None:
    text, model = to_json(build(derived)), kv.Model()
    for prefix in ("a", "b/c", None):
        _include(model, text, prefix)
    outer = kv.Model()
    _include(outer, to_json(model), "z")
    lift = kv.position("z/a/lift")
    car = kv.model.Frame.from_transform("world", kv.translation(0.3, 0, lift**2) @ kv.rotation_z(lift))
    with outer.edit() as edit:
        edit.replace("z/a/frame car", kv.model.AddFrame("z/a/car", car))
    live = build(derived, car=kv.translation(0.3, 0, LIFT**2) @ kv.rotation_z(LIFT))
    at = {"lift": 0.3, "knob": -0.4}
    for name, twin in (("z/a", live), ("z/b/c", build(derived)), ("z", build(derived))):
        got = outer.fk(f"{name}/knob")({f"{name}/{k}": v for k, v in at.items()})
        np.testing.assert_allclose(got, twin.fk("knob")(at), rtol=1e-13, atol=1e-14)
    again = kv.Model()
    _include(again, to_json(outer), None)
    assert again.snapshot() == outer.snapshot()
    assert to_json(again) == to_json(outer)


def _include(model: kv.Model, text: str, prefix: str | None) -> None:
    with model.edit() as edit:
        for entry in kv.formats.entries_from_bytes(text.encode(), prefix):
            edit.link(entry)


def test_saving_keeps_nothing_of_the_model_alive() -> None:
    model = build(derived)
    assert to_json(model) == to_json(model)
    gc.collect()
    assert not [o for o in gc.get_objects() if isinstance(o, ReadNode) and o.arguments]


def test_a_trace_is_made_once_for_each_run() -> None:
    runs = []

    def code(m: kv.model.ReadRecorder) -> kv.model.Writes:
        runs.append(m)
        return kv.model.Writes(data={"twice": 2 * m.data["number"]})

    model = build(code)
    to_json(model)
    count = len(runs)
    assert to_json(model) == to_json(model)
    assert len(runs) == count
    with model.edit() as edit:
        edit.replace("data number", kv.model.SetData("number", 5.0))
    assert reloaded(model).data["twice"] == 10.0
    assert len(runs) > count + 1


def test_a_loop_is_closed_again_when_what_it_reads_changes() -> None:
    model = build_scene("four_bar")
    read, below = reloaded(model), kv.Model()
    _include(below, to_json(model), "left")
    board = kv.translation(0, 0, 0.01) @ model.fk("board")
    again = kv.formats.from_bytes(kv.formats.to_bytes(below))
    deeper = kv.formats.from_bytes(kv.formats.to_bytes(below), "room")
    read_models = ((read, ""), (below, "left/"), (again, "left/"), (deeper, "room/left/"))
    for other, prefix in ((model, ""), *read_models):
        moved = kv.model.AddFrame(f"{prefix}board", kv.model.Frame.from_transform("world", board))
        with other.edit() as edit:
            edit.replace(f"{prefix}frame board", moved)
    crank = str(model.symbols[0])
    wanted = model.fk("rocker_end")({crank: 0.4})
    for other, prefix in read_models:
        assert isinstance(other.history.operation(f"{prefix}loop four_bar"), OpaqueOperation)
        pose = other.fk(f"{prefix}rocker_end")({f"{prefix}{crank}": 0.4})
        np.testing.assert_allclose(pose, wanted, rtol=1e-12, atol=1e-12)


def test_loop_without_a_solution_is_named_with_its_prefix() -> None:
    model = kv.load("articulations/parallel_gripper", prefix="left")
    with pytest.raises(kv.errors.NoSolutionError, match="'left/left_parallelogram' has no solution at left/"):
        model.fk("left/left_finger")({"left/left_inner": -9.0})


def test_below_a_prefix_the_error_names_the_missing_prefix() -> None:
    read = kv.Model()
    _include(read, to_json(build(branching)), "shelf")
    with pytest.raises(kv.errors.EditError, match=r"in names that lack 'shelf/'"), read.edit() as edit:
        edit.replace("shelf/data number", kv.model.SetData("shelf/number", 0.5))


def test_equal_operations_without_a_class_have_equal_hashes() -> None:
    """An operation without a class at hand equals itself read again, and hashes."""
    text = to_json(build(derived))
    one, other = ([o for _, o in read_operations(text)] for _ in range(2))
    assert one == other
    assert [hash(o) for o in one] == [hash(o) for o in other]
    assert not any(isinstance(o, Custom) for o in one)
