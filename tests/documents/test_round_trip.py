"""A model that was saved and loaded is the same model, to the last bit, with none of the classes that made it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from document_models import Doubled, rich_model

import kineverse as kv
from kineverse.formats.document import OpaqueOperation, to_json

MODELS = {"rich": rich_model, **{name: lambda name=name: kv.load(name) for name in kv.shipped_models()}}


@pytest.fixture(params=MODELS)
def model(request):
    return MODELS[request.param]()


def saved(model, folder, prefix=None):
    path = folder / "model.kv.json"
    model.save(path)
    return kv.load(path, prefix)


def everything(model):
    """Return all expressions of a model in a fixed order, gradients of both kinds included."""
    expressions = [model.fk(frame) for frame in model.frames]
    for constraint in model.constraints.values():
        expressions += [constraint.lower, constraint.expression, constraint.upper]
    return [
        part
        for e in map(kv.array, expressions)
        for part in (e, *e.gradient().values(), *e.gradient(heuristic=False).values())
    ]


def test_round_trip_preserves_the_model(model, tmp_path):
    read = saved(model, tmp_path)
    assert read.snapshot() == model.snapshot()
    assert read.history.tags == model.history.tags
    assert all(isinstance(read.history.entry(tag).operation, OpaqueOperation) for tag in read.history.tags)
    assert list(read.frames) == list(model.frames)
    assert read.symbols == model.symbols
    assert read.degrees_of_freedom == model.degrees_of_freedom
    assert read.default_state() == model.default_state()


@pytest.mark.sampled(2)
def test_round_trip_preserves_every_bit_of_values_and_gradients(model, tmp_path):
    ours, theirs = everything(model), everything(saved(model, tmp_path))
    inputs = sorted({s for e in ours for s in e.symbols}, key=lambda s: s.sort_key)
    assert sorted({s for e in theirs for s in e.symbols}, key=lambda s: s.sort_key) == inputs
    points = np.random.default_rng(3).uniform(-0.4, 1.1, (20, len(inputs)))
    f, g = (kv.compile(e, inputs, tier="interpreter") for e in (ours, theirs))
    for x in points:
        for mine, other in zip(f(x), g(x), strict=True):
            assert mine.shape == other.shape
            assert np.asarray(mine).tobytes() == np.asarray(other).tobytes()


def test_document_text_is_canonical(model, tmp_path):
    read = saved(model, tmp_path)
    assert to_json(read) == to_json(model) == to_json(model.snapshot())
    assert (tmp_path / "model.kv.json").read_text(encoding="utf-8") == to_json(model)


def test_document_text_is_equal_in_another_process():
    script = (
        "import sys; sys.path.insert(0, sys.argv[1]); from document_models import rich_model;"
        "from kineverse.formats.document import to_json; sys.stdout.buffer.write(to_json(rich_model()).encode())"
    )
    command = [sys.executable, "-c", script, str(Path(__file__).parent)]
    environment = {**os.environ, "PYTHONHASHSEED": "7"}
    other = subprocess.run(command, capture_output=True, check=True, env=environment)
    assert other.stdout.decode() == to_json(rich_model())


def test_document_is_read_without_the_classes_that_made_it(tmp_path):
    """A process that imports nothing of ours but the package loads a user's operations."""
    rich_model().save(tmp_path / "rich.kv.json")
    script = (
        "import sys, kineverse as kv; m = kv.load(sys.argv[1]); assert 'document_models' not in sys.modules;"
        "print(m.data['twice'], m.history.entry('mine').operation.kind)"
    )
    command = [sys.executable, "-c", script, tmp_path / "rich.kv.json"]
    assert subprocess.run(command, capture_output=True, check=True, text=True).stdout == "42 Doubled\n"


def test_document_is_read_under_a_prefix(tmp_path):
    model = rich_model()
    read = saved(model, tmp_path, "there")
    assert set(read.frames) == {f if f == "world" else f"there/{f}" for f in model.frames}
    assert {str(s) for s in read.symbols} == {f"there/{s}" for s in model.symbols}
    state = {str(s): 0.1 for s in model.fk("bent").symbols}
    assert np.array_equal(
        read.fk("there/bent")({f"there/{name}": value for name, value in state.items()}),
        model.fk("bent")(state),
    )
    twice, path = kv.Model(), tmp_path / "model.kv.json"
    twice.include(path, prefix="left")
    twice.include(path, prefix="right")
    assert len(twice.constraints) == 2 * len(model.constraints)
    with pytest.raises(kv.errors.DuplicateNameError):
        twice.include(path, prefix="left")


def test_reads_of_loaded_operations_still_bind(tmp_path):
    """Taking away what a frozen operation was made from is refused and names it; the rest can be edited."""
    read = saved(rich_model(), tmp_path)
    before = read.snapshot()
    (number,) = read.history.writers("data/number")
    with (
        pytest.raises(kv.errors.EditError, match=r"mine.*data/number|data/number.*mine"),
        read.edit() as edit,
    ):
        edit.remove(number)
    assert read.snapshot() == before
    with read.edit() as edit:
        edit.remove("mine")
        edit.remove(number)
    assert "number" not in read.data


def test_frozen_operation_is_replaced_by_a_live_one(tmp_path):
    read = saved(rich_model(), tmp_path)
    with read.edit() as edit:
        edit.insert(Doubled("number", "more"), before="mine")
        edit.replace("mine", Doubled("more", "twice"))
    assert read.data["twice"] == 84


def test_snapshot_is_saved_as_it_was(tmp_path):
    model = kv.load("shelf_door")
    snapshot = model.snapshot()
    with model.edit() as edit:
        edit.write("later", 1)
    snapshot.save(tmp_path / "s.kv.json")
    assert kv.load(tmp_path / "s.kv.json").snapshot() == snapshot


def test_empty_model_survives_a_round_trip(tmp_path):
    read = saved(kv.Model(), tmp_path)
    assert read.snapshot() == kv.Model().snapshot()
    assert json.loads(to_json(read)) == {
        "format": "kineverse",
        "version": 2,
        "operations": [],
        "sha256": kv.formats.document_hash(read),
    }
