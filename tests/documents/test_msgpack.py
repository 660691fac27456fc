"""Documents as msgpack: the same models with the same hash, strictly read."""

from __future__ import annotations

import json
import sys
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
        (b"\xc0", "no map"),
        (DATA + b"\xc0", "not msgpack"),
        (b"\xdd\xff\xff\xff\xff", "not msgpack"),
        (b"\xdf\xff\xff\xff\xff", "not msgpack"),
        (b"\x91" * 100_000, "nested too deeply"),
        ((b"\xdd" + (1 << 18).to_bytes(4, "big")) * 900 + b"\xc0" * (1 << 18), "not msgpack"),
        (b"\x90" * 10_000_001, "more than 10,000,000 lists"),
        (b"\x82\xa1a\x01\xa1a\x02", "a key twice"),
        (b"\x81\xa1a\xca\x3f\x80\x00\x00", "less than 64 bits"),
        (b"\x81\xa1a\xcc\x01", "shortest form"),
        (pack({1: 2}), "does not begin with"),
        (pack({**TREE, 7: 1}), "unknown key '7'"),
        (pack({**TREE, "nodes": [["constant", float("nan")]]}), "JSON has no place for"),
        (pack({**TREE, "nodes": [["constant", b"1"]]}), "JSON has no place for"),
        (pack({**TREE, "nodes": []}), "not what 'sha256' says"),
        (to_json(MODEL).encode(), "not msgpack"),
        ("text", "bytes, not a str"),
    ],
)
def test_invalid_msgpack_is_refused(data: Any, reason: str) -> None:
    assert reason in refusal(data)


def without_hash(**changes: Any) -> bytes:
    return pack({"format": "kineverse", "version": 1, "nodes": [], "operations": [], **changes})


@pytest.mark.parametrize(
    "data",
    [
        without_hash(nodes=[["constant", float("nan")]]),
        without_hash(nodes=[["constant", float("inf")]]),
        without_hash(nodes=[["constant", b"1"]]),
        without_hash(nodes=[["symbol", b"a", 0, "dof"]]),
        *(
            without_hash(operations=[{"tag": "t", "kind": "k", "reads": {}, "writes": {}, **part}])
            for part in (
                {"tag": b"t"},
                {1: 2},
                {"writes": {"data": {"x": b"1"}}},
                {"writes": {"data": {1: 1}}},
                {"writes": {"data": {"x": {1: 1}}}},
                {"writes": {"data": {"x": float("nan")}}},
                {"writes": {"data": {"x": 2**63}}},
                {"parameters": {1: 1}},
                {"parameters": {"x": {1: 1}}},
                {"parameters": {"x": b"1"}},
            )
        ),
    ],
)
def test_values_that_json_lacks_are_refused(data: bytes) -> None:
    """It has bytes, NaN and keys of any type; a document has not."""
    assert len(refusal(data)) < 300


def test_missing_msgspec_is_a_clear_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "m.kv.msgpack"
    path.write_bytes(DATA)
    monkeypatch.setitem(sys.modules, "msgspec.msgpack", None)
    monkeypatch.setitem(sys.modules, "msgspec", None)
    for use in (
        lambda: kv.formats.to_bytes(MODEL),
        lambda: kv.formats.from_bytes(DATA),
        lambda: kv.load(path),
        lambda: MODEL.save(tmp_path / "n.kv.msgpack"),
    ):
        with pytest.raises(kv.errors.MissingDependencyError, match=r"pip install -e '.*\[exchange\]'"):
            use()
    assert not (tmp_path / "n.kv.msgpack").exists()
