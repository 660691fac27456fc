"""The cache of loaded files: a file that is loaded again is not parsed again."""

import pickle

import numpy as np
import pytest
from urdf_texts import chain

import kineverse as kv
from kineverse.formats import loader
from kineverse.formats.urdf import operations


@pytest.fixture
def parses(monkeypatch):
    """Names of the descriptions that were parsed, in an empty memory."""
    names = []

    def parse_urdf(content, source, *further):
        names.append(source)
        return original(content, source, *further)

    original = operations.parse_urdf
    monkeypatch.setattr(operations, "parse_urdf", parse_urdf)
    monkeypatch.setattr(loader, "_REMEMBERED", type(loader._REMEMBERED)())
    return names


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "r.urdf"
    path.write_text(chain(3))
    return path


def test_load_reads_a_file_once(file, parses):
    first, second = kv.load(file), kv.load(file)
    assert parses == ["r.urdf"]
    assert first.snapshot() == second.snapshot()
    assert first.history.tags == second.history.tags
    assert first.version == second.version
    state = {"j0": 0.1, "j1": 0.2, "j2": 0.3}
    assert np.array_equal(first.fk("l3")(state), second.fk("l3")(state))


def test_cached_models_are_independent(file, parses):
    first = kv.load(file)
    pose = first.fk("l3")
    with first.edit() as edit:
        edit.remove("joint j2")
        edit.write("mine", 1)
        edit.replace("joint j0", kv.Fixed(name="j0", parent="l0", child="l1"))
    second = kv.load(file)
    assert parses == ["r.urdf"]
    assert "mine" not in second.data
    assert second.fk("l3") == pose
    assert len(second.degrees_of_freedom) == 3
    assert len(first.degrees_of_freedom) == 1


def test_changed_files_are_read_again(file, parses):
    kv.load(file)
    file.write_text(chain(2))
    assert len(kv.load(file).degrees_of_freedom) == 2
    file.write_text(chain(3))
    assert len(kv.load(file).degrees_of_freedom) == 3
    assert len(parses) == 2


def test_cache_distinguishes_prefix_and_folder(file, parses, tmp_path):
    other = tmp_path / "deeper"
    other.mkdir()
    (other / "r.urdf").write_text(chain(3))
    assert next(iter(kv.load(file, "a").frames)).startswith("a/")
    assert next(iter(kv.load(file, "b").frames)).startswith("b/")
    kv.load(other / "r.urdf", "a")
    assert len(parses) == 3


def test_cache_holds_few_and_small_files(parses, tmp_path, monkeypatch):
    monkeypatch.setattr(loader, "MOST_REMEMBERED", 2)
    files = [tmp_path / f"r{i}.urdf" for i in range(3)]
    for path in files:
        path.write_text(chain(1))
        kv.load(path)
    kv.load(files[2])
    kv.load(files[0])
    assert parses == ["r0.urdf", "r1.urdf", "r2.urdf", "r0.urdf"]
    monkeypatch.setattr(loader, "LARGEST_REMEMBERED", 10)
    files[1].write_text(chain(2))
    kv.load(files[1])
    kv.load(files[1])
    assert parses[4:] == ["r1.urdf", "r1.urdf"]


def test_errors_are_not_cached(file, parses):
    file.write_text(chain(3)[:-20])
    for _ in range(2):
        with pytest.raises(kv.errors.FormatError):
            kv.load(file)
    assert parses == ["r.urdf"] * 2


def test_cached_motions_are_ordinary_expressions():
    """A one-axis transform that is built lazily equals its expression, also when pickled."""
    q = kv.position("q")
    lazy = kv.rotation_y(q * 2)
    c, s = np.cos(q * 2), np.sin(q * 2)
    assert lazy == kv.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])
    assert pickle.loads(pickle.dumps(lazy)) == lazy
    assert hash(pickle.loads(pickle.dumps(kv.rotation_y(q * 2)))) == hash(lazy)
    assert kv.rotation_z(q).symbols == (q,)
    assert not kv.rotation_z(q).is_constant
    assert kv.rotation_z(0.5).is_constant
    with pytest.raises(AttributeError, match="nothing"):
        lazy.nothing  # noqa: B018
    with pytest.raises(kv.errors.ShapeError, match="scalar"):
        kv.rotation_x([1, 2])
