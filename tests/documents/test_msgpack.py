"""Documents as msgpack: the same models with the same hash, strictly read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest
from document_models import rich_model
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.formats.document import to_json

MODEL = rich_model()
DATA = kv.formats.to_bytes(MODEL)
TREE = json.loads(to_json(MODEL))
SMALL = kv.formats.to_bytes(kv.load("shelf_door"))

pack = msgspec.msgpack.encode


def refusal(data: bytes) -> str:
    with pytest.raises(kv.errors.FormatError) as caught:
        kv.formats.from_bytes(data)
    return str(caught.value)


def test_msgpack_holds_the_same_model_and_the_same_tree() -> None:
    read = kv.formats.from_bytes(DATA)
    text = kv.formats.document.to_json(read)
    assert kv.formats.from_bytes(f" {text}".encode()).snapshot() == read.snapshot()
    assert read.snapshot() == MODEL.snapshot()
    assert to_json(read) == to_json(MODEL)
    assert kv.formats.document_hash(read) == kv.formats.document_hash(MODEL) == TREE["sha256"]
    assert msgspec.msgpack.decode(DATA) == TREE
    assert kv.formats.to_bytes(read) == kv.formats.to_bytes(MODEL.snapshot()) == DATA == pack(TREE)


def test_msgpack_files_are_saved_and_loaded(tmp_path: Path) -> None:
    path = tmp_path / "model.kv.msgpack"
    MODEL.save(path)
    assert path.read_bytes() == DATA
    assert kv.load(path).snapshot() == MODEL.snapshot()
    left = kv.load(path, prefix="left")
    assert left.snapshot() == kv.formats.from_bytes(DATA, prefix="left").snapshot()
    assert set(left.frames) == {f if f == "world" else f"left/{f}" for f in MODEL.frames}
    for wrong in ("a//b", "a/", 7):
        with pytest.raises(kv.errors.FormatError, match="prefix"):
            kv.formats.from_bytes(DATA, prefix=wrong)
    room = kv.Model()
    room.include(path, prefix="left")
    assert room.snapshot() == left.snapshot()


def test_integers_of_any_length_survive_msgpack(tmp_path: Path) -> None:
    model = kv.Model()
    data = (2**63 - 1, -(2**63) + 1, 2**63, -(2**64), 10**3000, True, 1, 1.0)
    with model.edit() as edit:
        edit.write("numbers", data)
    read = kv.formats.from_bytes(kv.formats.to_bytes(model)).data["numbers"]
    assert read == data
    assert list(map(type, read)) == list(map(type, data))


def test_truncated_msgpack_is_refused() -> None:
    for length in range(len(SMALL)):
        assert "the document" in refusal(SMALL[:length]), length


@settings(max_examples=attempts(300), suppress_health_check=list(HealthCheck), deadline=None)
@given(place=st.integers(0, len(SMALL) - 1), byte=st.integers(0, 255))
def test_any_changed_byte_is_detected(place: int, byte: int) -> None:
    changed = SMALL[:place] + bytes([byte]) + SMALL[place + 1 :]
    if changed != SMALL:
        refusal(changed)


@settings(max_examples=attempts(300))
@given(st.binary(max_size=60))
def test_arbitrary_bytes_are_read_or_refused(data: bytes) -> None:
    refusal(data)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "not msgpack"),
        (b"\xc0", "does not begin with"),
        (DATA + b"\xc0", "not msgpack"),
        (b"\xdd\xff\xff\xff\xff", "does not begin with"),
        (b"\xdf\xff\xff\xff\xff", "not msgpack"),
        (b"\x81\xa1x" + b"\x91" * 1_000_000, "nested too deeply"),
        (b"\x90" * 10_000_001, "more than 10,000,000 lists"),
        (pack({1: 2}), "does not begin with"),
        (pack({**TREE, "version": 1}), "version 1, and this Kineverse reads version 2 alone"),
        (pack({**TREE, 7: 1}), "does not begin with"),
        (DATA[:1] + pack("version") + b"\x02" + DATA[1:], "not msgpack"),
        (b"\x86" + DATA[1:] + pack("version") + b"\x02", "a key twice"),
        (DATA.replace(pack("version") + b"\x02", pack("version") + b"\xcc\x02"), "shortest form"),
        (pack({**TREE, "operations": []}), "not what 'sha256' says"),
        ("text", "bytes, not a str"),
    ],
)
def test_invalid_msgpack_is_refused(data: Any, reason: str) -> None:
    assert reason in refusal(data)


def of_operation(**changes: Any) -> bytes:
    """Return a document of one operation, its members in the order of the format."""
    order = ("tag", "kind", "nodes", "parameters", "writes", "frozen")
    given = {"tag": "t", "kind": "k", "writes": {}, **changes}
    ordered = {key: given[key] for key in order if key in given}
    return pack({"format": "kineverse", "version": 2, "operations": [ordered]})


def test_operation_in_its_shortest_form_is_accepted() -> None:
    """What the refusals below differ from."""
    assert kv.formats.from_bytes(of_operation(nodes=[["constant", 1.0]])).history.tags == ["t"]


@pytest.mark.parametrize(
    "data",
    [
        of_operation(nodes=[["constant", 1]]),
        of_operation(nodes=[["constant", float("nan")]]),
        of_operation(nodes=[["constant", float("inf")]]),
        of_operation(nodes=[["constant", b"1"]]),
        of_operation(nodes=[["symbol", b"a", 0, "dof"]]),
        of_operation(frozen=""),
        of_operation(tag=b"t"),
        of_operation(writes={"data": {"x": b"1"}}),
        of_operation(writes={"data": {1: 1}}),
        of_operation(writes={"data": {"x": {1: 1}}}),
        of_operation(writes={"data": {"x": float("nan")}}),
        of_operation(writes={"data": {"x": 2**63}}),
        of_operation(parameters={1: 1}),
        of_operation(parameters={"x": {1: 1}}),
        of_operation(parameters={"x": b"1"}),
    ],
)
def test_values_in_another_form_or_that_json_lacks_are_refused(data: bytes) -> None:
    """It has bytes, NaN, keys of any type and several forms of a number; a document has not."""
    assert len(refusal(data)) < 300
