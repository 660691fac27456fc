"""The hash of a document: the same for the same content, however it is laid out, and no other content has it."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from document_models import rich_model
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.formats.document import read_operations, to_json

MODEL = rich_model()
TEXT = to_json(MODEL)
HASH = kv.formats.document_hash(MODEL)
NAMED = ("parameters", "record", "frames", "bodies", "articulations", "constraints", "rates", "data")


def shuffled(value: Any, random: Any, named: bool = False) -> Any:
    """Return a value of JSON with the members that the format names in another order."""
    if isinstance(value, list):
        return [shuffled(item, random, named) for item in value]
    if not isinstance(value, dict):
        return value
    keys = list(value)
    if not named:
        random.shuffle(keys)
    return {key: shuffled(value[key], random, key in NAMED and not named) for key in keys}


def test_hash_is_sha256_of_the_digests_of_the_operations() -> None:
    """As anybody computes it who has the file and the documentation."""
    tree = json.loads(TEXT)
    claim = tree.pop("sha256")
    blobs = [msgspec.msgpack.encode(operation) for operation in tree["operations"]]
    assert blobs == [kv.formats.operation_to_bytes(MODEL, tag) for tag in MODEL.history.tags]
    digests = [hashlib.sha256(blob) for blob in blobs]
    assert [d.hexdigest() for d in digests] == [
        kv.formats.operation_digest(MODEL, t) for t in MODEL.history.tags
    ]
    assert hashlib.sha256(b"".join(d.digest() for d in digests)).hexdigest() == claim == HASH


@given(
    random=st.randoms(use_true_random=False), indent=st.sampled_from([None, 0, 2]), ascii_only=st.booleans()
)
@settings(max_examples=attempts(8), deadline=None)
def test_hash_ignores_the_layout_of_json(random: Any, indent: int | None, ascii_only: bool) -> None:
    text = json.dumps(shuffled(json.loads(TEXT), random), indent=indent, ensure_ascii=ascii_only)
    assert read_operations(text) == read_operations(TEXT)


def leaves_of(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths to all that is no list and no object."""
    if not isinstance(value, (list, dict)):
        return [path]
    items = enumerate(value) if isinstance(value, list) else value.items()
    return [found for key, item in items for found in leaves_of(item, (*path, key))]


LEAVES = leaves_of(json.loads(TEXT))


@given(st.data())
@settings(max_examples=attempts(50), deadline=None)
def test_hash_detects_any_change_of_a_value(data: st.DataObject) -> None:
    tree = json.loads(TEXT)
    *path, last = data.draw(st.sampled_from([p for p in LEAVES if p[0] == "operations"]))
    place = tree
    for key in path:
        place = place[key]
    old = place[last]
    other = {str: f"{old}x", bool: old is False, float: None, int: None, type(None): 0}[type(old)]
    if isinstance(old, float):
        other = float(np.nextafter(old, 7.0))  # one bit
    elif type(old) is int:
        other = old + 1
    place[last] = other
    with pytest.raises(kv.errors.FormatError):  # whether it would be a document otherwise or not
        read_operations(json.dumps(tree))


def test_hash_detects_a_change_of_the_text() -> None:
    """The place of a digit, in what is laid out as it was written."""
    place = TEXT.index("0.30000000000000004")
    with pytest.raises(kv.errors.FormatError, match="delete the member 'sha256'"):
        read_operations(TEXT[:place] + "0.30000000000000014" + TEXT[place + 19 :])


def test_document_without_hash_is_accepted() -> None:
    tree = json.loads(to_json(kv.load("shelf_door")))
    del tree["sha256"]
    assert read_operations(json.dumps(tree)) == read_operations(to_json(kv.load("shelf_door")))


@pytest.mark.parametrize("wrong", [None, 7, "", "0" * 63, "0" * 65, "G" * 64, HASH.upper(), [HASH]])
def test_malformed_hash_is_refused(wrong: Any) -> None:
    with pytest.raises(kv.errors.FormatError, match="sha256: expected a text"):
        read_operations(json.dumps({**json.loads(TEXT), "sha256": wrong}))


def test_hash_is_preserved_by_save_and_load(tmp_path: Path) -> None:
    MODEL.save(tmp_path / "m.kv.json")
    read = kv.load(tmp_path / "m.kv.json")
    assert kv.formats.document_hash(read) == kv.formats.document_hash(read.snapshot()) == HASH
    assert (tmp_path / "m.kv.json").read_text().endswith(f'"sha256":"{HASH}"}}\n')


def test_hash_is_equal_in_another_process() -> None:
    script = (
        "import sys; sys.path.insert(0, sys.argv[1]); import kineverse as kv;"
        "from document_models import rich_model; print(kv.formats.document_hash(rich_model()))"
    )
    command = [sys.executable, "-c", script, str(Path(__file__).parent)]
    environment = {**os.environ, "PYTHONHASHSEED": "11"}
    other = subprocess.run(command, capture_output=True, check=True, text=True, env=environment)
    assert other.stdout == f"{HASH}\n"


def test_hash_depends_on_operations_and_names() -> None:
    """Whole and real numbers of equal value make equal shapes; another tag makes another document."""
    made = []
    for size, tag in (((1, 2, 3), "t"), ((1.0, 2.0, 3.0), "t"), ((1, 2, 3), "u")):
        body = kv.model.Body((kv.model.Shape(kv.model.body.Box(size)),))
        model = kv.Model()
        with model.edit() as edit:
            edit.add_frame("a", parent="world", transform=np.eye(4), body=body, tag=tag)
        made.append(kv.formats.document_hash(model))
    assert made[0] == made[1] != made[2]


def test_hash_does_not_depend_on_files_loaded_before(tmp_path: Path) -> None:
    """Here since poses were remembered by numbers, of which -0.0 and 0.0 are equal."""
    robot = '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="fixed"><origin xyz="{}"/>'
    robot += '<parent link="a"/><child link="b"/></joint></robot>'
    hashes = []
    for k, xyz in enumerate(("-0 0.25 7.125", "0 0.25 7.125")):
        (tmp_path / f"{k}.urdf").write_text(robot.format(xyz))
        hashes.append(kv.formats.document_hash(kv.load(tmp_path / f"{k}.urdf")))
    assert hashes[0] != hashes[1]
