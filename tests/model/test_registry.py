"""Tests of the registry of readers and writers."""

import subprocess
import sys

import pytest

import kineverse as kv
from kineverse.model import registry


@pytest.fixture
def scheme(monkeypatch):
    """An address scheme whose models have one frame, named after the address."""
    entry = registry.Scheme(load=f"{__name__}:load_frame", include=f"{__name__}:include_frame")
    monkeypatch.setattr(registry, "_SCHEMES", {"memory": entry})
    return "memory"


class Served(kv.Model):
    """Model that came by its address, and the part that was asked for."""

    part: dict


def load_frame(source, **part):
    model = Served()
    model.part = part
    model.include(source)
    return model


def include_frame(edit, source, prefix):
    name = source.partition(":")[2]
    return [edit.add_frame(f"{prefix}/{name}" if prefix else name, parent="world")]


def test_include_reads_an_address_by_its_scheme(scheme):
    model = kv.Model()
    assert model.include(f"{scheme}:door", prefix="kitchen") == ["frame kitchen/door"]
    assert list(model.frames) == ["kitchen/door"]


def test_load_returns_the_model_of_an_address(scheme):
    model = kv.load(f"{scheme}:door", frames=["door"], bodies=True)
    assert isinstance(model, Served)
    assert list(model.frames) == ["door"]
    assert model.part == {"frames": ["door"], "symbols": None, "bodies": True}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"prefix": "a"}, "A live model keeps its names"),
        ({"root": "."}, "root= is about reading a file"),
        ({"strict": True}, "strict= is about reading a file"),
        ({"loops": "refuse"}, "loops= is about reading a file"),
        ({"arguments": {"side": "left"}}, "arguments= is about reading a file"),
    ],
)
def test_options_of_files_are_refused_for_an_address(scheme, options, message):
    with pytest.raises(kv.errors.InvalidValueError, match=message):
        kv.load(f"{scheme}:door", **options)
    if options.keys() <= {"root", "strict", "loops"}:
        with pytest.raises(kv.errors.InvalidValueError, match=message):
            kv.Model().include(f"{scheme}:door", **options)


@pytest.mark.parametrize("part", [{"frames": []}, {"symbols": ["kitchen/fridge_door"]}, {"bodies": False}])
def test_a_file_is_loaded_as_a_whole(part):
    with pytest.raises(kv.errors.InvalidValueError, match=r"choose a part of a live model, live:NAME"):
        kv.load("kitchen", **part)


def test_a_path_with_an_unknown_scheme_is_a_file(scheme, tmp_path):
    with pytest.raises(kv.errors.UnknownNameError, match="other:door"):
        kv.load("other:door")


def test_each_suffix_has_one_reader_for_a_content():
    contents = {".xml": (b"<mujoco/>", b"<robot/>")}
    for suffix in registry.readable_suffixes():
        for content in contents.get(suffix, (b"",)):
            found = registry.find_format(f"model{suffix}", content)
            assert found is not None
            assert suffix in found.suffixes
    assert registry.find_format("model.xml", b"<mujoco/>").name == "MJCF"
    assert registry.find_format("model.xml", b"<robot/>").name == "URDF"
    assert registry.find_format("model.step", b"") is None


def test_each_written_suffix_can_be_read():
    assert set(registry.writable_suffixes()) <= set(registry.readable_suffixes())


def test_every_entry_can_be_imported():
    entries = [*registry._SHORTHANDS.values(), *registry._SERVICES.values()]
    for scheme in registry._SCHEMES.values():
        entries += [scheme.load, scheme.include]
    for one in registry.COLLECTIONS.values():
        entries += filter(None, (one.list_names, one.build, one.find_document, one.accept))
    entries += [registry._FORMATS]
    entries += [text for one in registry.list_formats() for text in (one.read, one.write) if text]
    for entry in entries:
        assert callable(registry.import_entry(entry))


def test_an_unknown_shorthand_is_refused_with_similar_names():
    with pytest.raises(kv.errors.UnknownNameError, match="close_loop"):
        registry.make_shorthand("close_lop")


def test_importing_the_model_alone_fills_the_registry():
    program = "from kineverse.model import Model; m = Model(); m.include('kitchen'); print(len(m.frames))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert int(done.stdout) > 0


def test_registration_imports_no_reader():
    program = (
        "import sys, kineverse; print([name for name in sys.modules if name.startswith(('kineverse.gallery', "
        "'kineverse.formats.document', 'kineverse.formats.mjcf', 'kineverse.formats.sdf', 'kineverse.geometry'))])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
