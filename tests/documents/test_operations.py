"""Operations as blobs, each alone: the same bytes whoever writes them, and a first run that believes nothing."""

from __future__ import annotations

import hashlib
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from document_models import Doubled, rich_model
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from trace_models import Custom, build

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse import gallery
from kineverse.formats.document import OpaqueOperation
from kineverse.formats.document.parameters import find_class
from kineverse.geometry.mesh_files import read_mesh
from kineverse.model.body import Body, Box, Mesh, Shape
from kineverse.model.history import HistoryEntry
from kineverse.model.read_recorder import Reads

MODEL = rich_model()
BLOB = kv.formats.operation_to_bytes(MODEL, "the arm")


def branching(model: kv.model.ReadRecorder) -> kv.model.Writes:
    return kv.model.Writes(data={"sign": 1 if model.data["number"] > 0 else -1})


def sent(model: kv.Model, tag: str) -> HistoryEntry:
    """Return an operation as another process gets it."""
    return kv.formats.operation_from_bytes(kv.formats.operation_to_bytes(model, tag))


def of_number(value: float) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.write("number", value)
    return model


FROZEN = sent(build(branching), "custom")
TRACED = sent(build(lambda m: kv.model.Writes(data={"twice": 2 * m.data["number"]})), "custom")


def test_blob_is_that_of_the_snapshot_and_of_an_open_edit() -> None:
    assert kv.formats.operation_to_bytes(MODEL.snapshot(), "the arm") == BLOB
    model = of_number(1.0)
    with model.edit() as edit:
        edit.replace("data number", kv.model.SetData("number", 2.0))
        blob = kv.formats.operation_to_bytes(model, "data number")
    assert blob == kv.formats.operation_to_bytes(of_number(2.0), "data number")
    for view in (MODEL, MODEL.snapshot()):
        with pytest.raises(kv.errors.UnknownNameError, match="There is no operation 'the harm'"):
            kv.formats.operation_to_bytes(view, "the harm")
    with pytest.raises(kv.errors.FormatError, match="bytes, not a str"):
        kv.formats.operation_from_bytes("text")  # type: ignore[arg-type]


@settings(max_examples=attempts(200), suppress_health_check=list(HealthCheck), deadline=None)
@given(place=st.integers(0, len(BLOB) - 1), byte=st.integers(0, 255), length=st.integers(0, len(BLOB)))
def test_changed_blob_is_another_operation_or_refused(place: int, byte: int, length: int) -> None:
    for data in (BLOB[:place] + bytes([byte]) + BLOB[place + 1 :], BLOB[:length]):
        try:
            entry = kv.formats.operation_from_bytes(data)
        except kv.errors.FormatError:
            continue
        assert entry.blob in (data, None)


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (b"\x91" * 1_000_000 + b"\x01", "nested too deeply"),
        (b"\x91" * 150 + b"\x01", "nested too deeply"),
        (b"\xdd\xff\xff\xff\xff", "truncated"),
        (b"\xdf\xff\xff\xff\xff", "truncated"),
        (b"\xdb\xff\xff\xff\xff", "truncated"),
        (b"\x82\xa1a\x01\xa1a\x01", "a key twice"),
        (b"\x81\x90\x01", "has one key"),
        (b"\xcb\x7f\xf8" + bytes(6), "is infinite"),
        (b"\xd6\xff" + bytes(4), "has one key"),
        (b"\xa1\xff", "utf-8"),
        (b"\xcf" + b"\xff" * 8, "more than 64 bits"),
    ],
)
def test_hostile_value_is_one_error(value: bytes, reason: str) -> None:
    """Bounded in time and memory: what a length claims is not believed."""
    blob = kv.formats.operation_to_bytes(of_number(0.5), "data number")
    end = blob.rindex(b"\xcb")
    with pytest.raises(kv.errors.FormatError, match=reason):
        kv.formats.operation_from_bytes(blob[:end] + value)


def test_operation_below_a_prefix_is_that_of_the_document() -> None:
    whole = kv.formats.from_bytes(kv.formats.to_bytes(MODEL), "left")
    for tag in MODEL.history.tags:
        if tag == "dressed":
            continue  # the folder of its mesh is in the document
        alone = kv.formats.operation_from_bytes(kv.formats.operation_to_bytes(MODEL, tag), "left")
        assert alone.operation == whole.history.operation(alone.tag)


def test_first_run_takes_what_is_there_as_what_was_read() -> None:
    """With a trace it computes where the values differ from the author's; without one it writes what it wrote."""
    traced = of_number(3.0)
    with traced.edit() as edit:
        edit.apply(Doubled("number", "twice"), "mine")
    entry = sent(traced, "mine")
    assert isinstance(entry.operation, OpaqueOperation)
    other = of_number(5.0)
    with other.edit() as edit:
        edit.apply(entry.operation, entry.tag)
    assert other.data["twice"] == 10.0
    with other.edit() as edit:
        edit.replace("data number", kv.model.SetData("number", 7.0))
    assert other.data["twice"] == 14.0
    frozen = sent(build(branching), "custom")
    other = of_number(0.25)
    with other.edit() as edit:
        edit.apply(frozen.operation, frozen.tag)
    assert other.data["sign"] == 1
    with pytest.raises(kv.errors.EditError, match="data/number has changed"), other.edit() as edit:
        edit.replace("data number", kv.model.SetData("number", -1.0))


@settings(max_examples=attempts(25), deadline=None)
@given(numbers=st.lists(st.floats(-4, 4), min_size=2, max_size=4), is_frozen=st.booleans())
def test_operation_is_a_value_that_many_models_can_have(numbers: list[float], is_frozen: bool) -> None:
    """What one model has read with it is nothing to another: it does there what it does decoded anew."""
    entry = FROZEN if is_frozen else TRACED
    before = repr(entry.operation)
    for number in numbers:
        model, fresh = of_number(number), of_number(number)
        with model.edit() as edit:
            edit.apply(entry.operation, entry.tag)
        with fresh.edit() as edit:
            edit.apply(kv.formats.operation_from_bytes(entry.blob or b"").operation, entry.tag)
        assert model.snapshot() == fresh.snapshot()
        for each in (model, fresh):
            if is_frozen:
                with pytest.raises(kv.errors.EditError, match="data/number has changed"), each.edit() as edit:
                    edit.replace("data number", kv.model.SetData("number", number + 1))
            else:
                with each.edit() as edit:
                    edit.replace("data number", kv.model.SetData("number", number + 1))
                assert each.data["twice"] == 2 * (number + 1)
    assert repr(entry.operation) == before
    assert entry.reads.seen is None


def test_linked_entry_keeps_what_it_read_where_it_is_run() -> None:
    """A document is linked into a model that has other values: code that decided by them is refused."""
    document = kv.formats.to_bytes(build(branching))
    model = of_number(-1.0)
    with pytest.raises(kv.errors.ModelError, match="data/number has changed"), model.edit() as edit:
        for entry in kv.formats.entries_from_bytes(document):
            if entry.tag != "data number":
                edit.link(entry)
    assert model.snapshot() == of_number(-1.0).snapshot()
    (*_, alone) = kv.formats.entries_from_bytes(document)
    with model.edit() as edit:  # the operation without its entry is one that comes alone
        edit.apply(alone.operation, alone.tag)
    assert model.data["sign"] == 1


def test_operation_that_replaces_another_has_not_read_what_that_has() -> None:
    model = kv.formats.from_bytes(kv.formats.to_bytes(build(branching)))
    other = model.copy()
    with model.edit() as edit:
        edit.replace("data number", kv.model.SetData("number", -1.0))
        edit.replace("custom", FROZEN.operation)
    assert model.data["sign"] == 1
    for each, number in ((model, 1.5), (other, -1.0)):  # and the copy refers to what it has read
        with pytest.raises(kv.errors.EditError, match="data/number has changed"), each.edit() as edit:
            edit.replace("data number", kv.model.SetData("number", number))
    with model.edit() as edit:
        edit.undo(model.version)
    assert model.snapshot() == other.snapshot()
    with pytest.raises(kv.errors.EditError, match="data/number has changed"), model.edit() as edit:
        edit.replace("data number", kv.model.SetData("number", -1.0))


@pytest.mark.parametrize("way", ["model", "snapshot", "pickle"])
def test_entries_alone_know_what_they_have_read_once_they_are_in_a_model(way: str) -> None:
    home = build(branching)
    model = kv.Model([sent(home, tag) for tag in home.history.tags])
    if way == "snapshot":
        model = model.snapshot().model()
    elif way == "pickle":
        read = kv.formats.from_bytes(kv.formats.to_bytes(home))
        model = pickle.loads(pickle.dumps(read))
    assert model.snapshot() == home.snapshot()
    assert model.history.runs == 0
    with pytest.raises(kv.errors.EditError, match="data/number has changed"), model.edit() as edit:
        edit.replace("data number", kv.model.SetData("number", -1.0))


def test_first_run_is_that_of_the_fold() -> None:
    """What it reads is replaced in the same edit: the value at the end of the edit is what it has read."""
    model = kv.formats.from_bytes(kv.formats.to_bytes(build(branching)))
    with model.edit() as edit:
        edit.replace("data number", kv.model.SetData("number", 0.5))
        edit.replace("custom", sent(build(branching), "custom").operation)
    assert model.data["sign"] == 1
    with pytest.raises(kv.errors.EditError, match="data/number has changed"), model.edit() as edit:
        edit.replace("data number", kv.model.SetData("number", 1.5))


def test_linked_operation_runs_again_when_what_it_read_changes() -> None:
    model = build(lambda m: kv.model.Writes(data={"twice": 2 * m.data["number"]}))
    read = kv.formats.from_bytes(kv.formats.to_bytes(model))
    assert read.history.runs == 0
    with read.edit() as edit:
        edit.replace("data number", kv.model.SetData("number", 5.0))
    assert read.data["twice"] == 10.0


@pytest.mark.parametrize(
    "name", [name for name in gallery.names() if name not in ("delta_robot", "jansen_leg")]
)
@pytest.mark.sampled(4)
def test_every_operation_of_the_library_is_made_again_from_kind_and_parameters(name: str) -> None:
    shipped = kv.load(f"articulations/{name}", prefix="")
    # Fits of splines and loops have other last bits on other processors.
    here = _made_again(shipped)
    state = here.default_state()
    assert here.history.tags == shipped.history.tags
    for frame in here.frames:
        np.testing.assert_allclose(here.fk(frame)(state), shipped.fk(frame)(state), rtol=0, atol=1e-9)
    again = _made_again(kv.formats.from_bytes(kv.formats.to_bytes(here)))
    assert kv.formats.document_hash(again) == kv.formats.document_hash(here)


def _made_again(model: kv.Model) -> kv.Model:
    again = kv.Model()
    with again.edit() as edit:
        for tag in model.history.tags:
            operation = model.history.operation(tag)
            assert isinstance(operation, OpaqueOperation)
            edit.apply(find_class(operation.kind)(**operation.parameters), tag)
    return again


def test_no_blob_depends_on_a_folder() -> None:
    """The folders are in the document, outside of all digests."""

    def model(*folders: str) -> kv.Model:
        shapes = [Shape(Box((1.0, 1.0, 1.0)))] + [Shape(Mesh("cup.stl", folder=folder)) for folder in folders]
        result = kv.Model()
        with result.edit() as edit:
            edit.add_frame("cup", "world", np.eye(4), Body(tuple(shapes), tuple(shapes[1:])))
            edit.apply(kv.model.SetData("note", 1))
        return result

    one, other, mixed = model("/a", "/a"), model("/b", "/b"), model("/a", "/b")
    assert len({kv.formats.document_hash(each) for each in (one, other, mixed)}) == 1
    for each in (one, other, mixed):
        for read in (
            kv.formats.from_bytes(kv.formats.to_bytes(each)),
            kv.formats.from_bytes(kv.formats.to_bytes(each), "left"),
        ):
            (body,) = read.bodies.values()
            assert body == each.bodies["cup"]
            assert {mesh.geometry.root for mesh in body.collisions} == {""}  # type: ignore[union-attr]
    alone = sent(one, "frame cup").writes["bodies", "cup"]
    assert {mesh.geometry.folder for mesh in alone.collisions} == {""}
    assert b"/a" not in kv.formats.operation_to_bytes(one, "frame cup")


def test_operation_of_a_class_and_without_it_have_the_same_blob() -> None:
    model = build(lambda m: kv.model.Writes(frames={"knob": ("car", kv.translation(m.data["number"], 0, 0))}))
    assert isinstance(model.history.operation("custom"), Custom)
    read = kv.Model()
    with read.edit() as edit:
        for tag in model.history.tags:
            edit.apply(sent(model, tag).operation, tag)
    assert read.history.entry("custom").blob is None
    assert kv.formats.operation_to_bytes(read, "custom") == kv.formats.operation_to_bytes(model, "custom")


def test_mesh_is_fetched_by_its_content(tmp_path: Path) -> None:
    """The document says digest and size; what a resolver has is checked by them, and files go before it."""
    triangle = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    digest = hashlib.sha256(triangle).hexdigest()
    here, store = tmp_path / "here", tmp_path / "store"
    here.mkdir()
    store.mkdir()
    (here / "flag.obj").write_bytes(triangle)
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("flag", "world", np.eye(4), Body((Shape(Mesh("flag.obj", folder=str(here))),)))
    data = kv.formats.to_bytes(model, resources=True)
    assert kv.formats.document_hash(kv.formats.from_bytes(data)) == kv.formats.document_hash(model)
    (here / "flag.obj").unlink()
    mesh = (
        kv.formats.from_bytes(kv.formats.to_bytes(kv.formats.from_bytes(data)))
        .bodies["flag"]
        .visuals[0]
        .geometry
    )
    assert isinstance(mesh, Mesh)
    assert mesh.content == (digest, len(triangle))
    resolver = kv.formats.FolderResolver(store)
    kv.formats.add_resolver(resolver)
    try:
        with pytest.raises(kv.errors.FormatError):
            read_mesh(mesh)
        for wrong in (triangle[:-1], triangle.replace(b"1 0 0", b"2 0 0"), triangle + b"#"):
            (store / digest).write_bytes(wrong)
            with pytest.raises(kv.errors.FormatError, match="what was fetched is not the file"):
                read_mesh(mesh)
        (store / digest).write_bytes(triangle)
        assert read_mesh(mesh).vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    finally:
        kv.formats.remove_resolver(resolver)


def test_resolvers_are_asked_until_one_has_the_file() -> None:
    """One that fails or is wrong hinders no other, and no name of a file is taken from a document."""
    content = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"

    class Resolver:
        def __init__(self, answer: Any) -> None:
            self.answer = answer

        def fetch(self, sha256: str, size: int) -> Any:
            return self.answer[:size]

    known = (hashlib.sha256(content).hexdigest(), len(content))
    good, wrong = Resolver(content), [Resolver(answer) for answer in ("text", b"x", None, 7)]
    for resolver in (good, *wrong):
        kv.formats.add_resolver(resolver)
    try:
        assert len(read_mesh(Mesh("tent.obj", content=known)).faces) == 1
        for uri in ("tent." + "o" * 300, "tent.\0"):
            with pytest.raises((kv.errors.FormatError, OSError), match=r"(?i)not supported|cannot be read"):
                read_mesh(Mesh(uri, content=known))
        kv.formats.remove_resolver(good)
        with pytest.raises(kv.errors.FormatError, match=r"a resolver failed with TypeError|what was fetched"):
            read_mesh(Mesh("tent.stl", content=known))
    finally:
        for resolver in (good, *wrong):
            kv.formats.remove_resolver(resolver)


def test_no_texture_outside_of_a_root_is_measured(tmp_path: Path) -> None:
    secret = tmp_path / "secret.png"
    secret.write_text("secret")
    model = kv.Model()
    with model.edit() as edit:
        shape = Shape(Box((1.0, 1.0, 1.0)), texture=str(secret))
        edit.add_frame("box", "world", np.eye(4), Body((shape,)))
    read = kv.formats.from_bytes(kv.formats.to_bytes(model, resources=True))
    assert b"resources" not in kv.formats.to_bytes(read, resources=True)


@pytest.mark.parametrize(("before", "after"), [(1.0, 1), (1, True), (0.0, -0.0), ((1,), (1.0,))])
def test_equal_numbers_of_other_types_are_other_values(before: Any, after: Any) -> None:
    """An edit leaves what a model made at once has, bit by bit; a trace takes an integer for a number."""

    def model(value: Any) -> kv.Model:
        result = kv.Model()
        with result.edit() as edit:
            edit.write("number", value)
            edit.apply(Custom(lambda m: kv.model.Writes(data={"same": m.data["number"]})), "copy")
        return result

    edited, fresh = model(before), model(after)
    kv.formats.to_bytes(edited)
    read = kv.formats.from_bytes(kv.formats.to_bytes(edited))
    with edited.edit() as edit:
        edit.replace("data number", kv.model.SetData("number", after))
    assert kv.formats.to_bytes(edited) == kv.formats.to_bytes(fresh)
    if before == 1.0 and type(before) is float:
        with read.edit() as edit:
            edit.replace("data number", kv.model.SetData("number", after))
        assert kv.formats.from_bytes(kv.formats.to_bytes(read)).data["same"] == after


def test_net_changes_with_operations_from_elsewhere_are_adopted() -> None:
    """A replica that has no code holds the same blobs, and follows what changes later."""
    home = build(lambda m: kv.model.Writes(data={"twice": 2 * m.data["number"]}))
    replica = kv.formats.from_bytes(kv.formats.to_bytes(home))
    with home.edit() as edit:
        edit.replace("data number", kv.model.SetData("number", 5.0))
        edit.apply(Doubled("number", "again"), "mine")
        net = edit.net()
    put = tuple(replace(placed, entry=sent(home, placed.entry.tag)) for placed in net.put)
    runs = replica.history.runs
    replica.adopt(replace(net, put=put))
    assert replica.history.runs == runs
    assert kv.formats.document_hash(replica) == kv.formats.document_hash(home)
    assert replica.data["again"] == 10.0
    with replica.edit() as edit:
        edit.replace("data number", kv.model.SetData("number", 7.0))
    assert (replica.data["again"], replica.data["twice"]) == (14.0, 14.0)


def test_adopting_changes_nothing_of_what_is_given() -> None:
    """Two replicas take the same changes, each with what it has itself."""
    home = of_number(1.0)
    with home.edit() as edit:
        edit.adopt(alone := changes_of(FROZEN, frame_without_reads()))
    other = of_number(-1.0)
    other.adopt(alone)
    for each, number in ((home, -1.0), (other, 1.0)):
        assert each.data["sign"] == 1
        with pytest.raises(kv.errors.EditError, match="data/number has changed"), each.edit() as edit:
            edit.replace("data number", kv.model.SetData("number", number))
        with (
            pytest.raises(kv.errors.EditError, match="parent of frame 'box' is missing"),
            each.edit() as edit,
        ):
            edit.remove("frame table")
    assert [placed.entry.reads.seen for placed in alone.put] == [None, None, None]
    assert alone.put[-1].entry.reads.cells == {}


def changes_of(*entries: HistoryEntry) -> kv.model.NetChanges:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("table", "world")
        (table,) = edit.net().put
    return kv.model.NetChanges(
        (table, *(kv.model.PlacedEntry(entry, None, at_end=True) for entry in entries))
    )


def frame_without_reads() -> HistoryEntry:
    operation = kv.model.AddFrame("box", kv.model.Frame.from_transform("table", np.eye(4)))
    return HistoryEntry("box", operation, 0, Reads(), {("frames", "box"): operation.frame})


def test_entry_of_an_open_edit_has_the_blob_of_its_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    model = of_number(3.0)
    with model.edit() as edit:
        edit.apply(Doubled("number", "twice"), "mine")
        edit.add_frame("box", "world")
        with monkeypatch.context() as patch:  # the cost does not grow with the model
            patch.setattr(kv.Model, "snapshot", None)
            entries = [placed.entry for placed in edit.net().put]
            blobs = [kv.formats.entry_to_bytes(entry, model.history.sequence) for entry in entries]
        assert [entry.blob for entry in entries] == blobs
    assert blobs == [kv.formats.operation_to_bytes(model, entry.tag) for entry in entries]
    again = of_number(3.0)
    with again.edit() as edit:
        edit.apply(Doubled("number", "twice"), "mine")
        edit.add_frame("box", "world")
    assert blobs == [kv.formats.operation_to_bytes(again, entry.tag) for entry in entries]


def test_model_is_restored_as_of_a_version() -> None:
    home = build(branching)
    for version in (1, 7):
        model = kv.Model()
        model._restore(kv.formats.entries_from_bytes(kv.formats.to_bytes(home)), version)
        assert (model.version, model.history.runs) == (version, 0)
        assert kv.formats.document_hash(model) == kv.formats.document_hash(home)
        with pytest.raises(kv.errors.EditError, match="none yet"), model.edit() as edit:
            edit.undo(version)
        with model.edit() as edit:
            edit.write("more", 1.0)
        assert model.version == version + 1
    entry = kv.formats.entries_from_bytes(kv.formats.to_bytes(of_number(1.0)))[0]
    with pytest.raises(kv.errors.DuplicateNameError):
        kv.Model()._restore([entry, entry], 1)
