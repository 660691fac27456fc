"""Errors for invalid files and prefixes."""

import logging
import os

import pytest
from urdf_texts import chain

import kineverse as kv
from kineverse.formats.reader_warnings import collect_warnings


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "r.urdf"
    path.write_text(chain(3))
    return path


@pytest.mark.parametrize("prefix", [5, b"x", ["x"], ("x",), 0, False])
def test_prefix_that_is_no_string_is_refused(file, prefix):
    for load in (kv.load, kv.Model().include):
        with pytest.raises(kv.errors.FormatError, match="A prefix is a text"):
            load(file, prefix=prefix)


@pytest.mark.parametrize("prefix", ["a/", "/a", "a//b", "/", "a\n", "\ud800"])
def test_prefix_that_is_no_path_is_refused(file, tmp_path, prefix):
    kv.load(file).save(tmp_path / "r.kv.json")
    for source in (file, tmp_path / "r.kv.json", "shelf_door"):
        with pytest.raises(kv.errors.FormatError, match="The prefix") as caught:
            kv.load(source, prefix=prefix)
        assert repr(prefix) in str(caught.value)


def test_prefixes_are_put_before_names(file):
    assert kv.load(file, prefix="").symbols == kv.load(file).symbols
    assert all(s.path.startswith("a/b/") for s in kv.load(file, prefix="a/b").symbols)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes here")
def test_special_files_are_refused(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe.urdf")
    (tmp_path / "circle.urdf").symlink_to(tmp_path / "circle.urdf")
    (tmp_path / "nowhere.urdf").symlink_to(tmp_path / "missing.urdf")
    (tmp_path / "zero.urdf").symlink_to("/dev/null")
    monkeypatch.chdir(tmp_path)
    for name in ("pipe.urdf", "circle.urdf", "nowhere.urdf", "zero.urdf"):
        for path in (tmp_path / name, f"./{name}", name):
            with pytest.raises(kv.errors.FormatError, match="is no regular file"):
                kv.load(path)
    with pytest.raises(kv.errors.UnknownNameError, match="There is no file"):
        kv.load("./missing.urdf")
    with pytest.raises(kv.errors.UnknownNameError, match="It is a folder"):
        kv.load(tmp_path)


TWICE = """<robot name="r"><link name="a"><inertial><mass value="1"/><mass value="2"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link><part_joint/></robot>"""


def test_warnings_are_emitted_at_every_load(tmp_path):
    path = tmp_path / "r.urdf"
    path.write_text(TWICE)
    heard = []
    for _ in range(2):
        with collect_warnings() as remarks:
            kv.load(path)
        heard.append(remarks)
    assert heard[0] == heard[1]
    assert heard[0]
    assert all(remark.startswith("r.urdf, line ") for remark in heard[0])
    assert any("<part_joint>" in remark for remark in heard[0])


def test_warnings_are_logged_and_collectors_nest(tmp_path, caplog):
    path = tmp_path / "r.urdf"
    path.write_text(TWICE)
    with (
        caplog.at_level(logging.INFO, "kineverse.formats"),
        collect_warnings() as outer,
        collect_warnings() as inner,
    ):
        kv.load(path)
    assert outer == inner == [record.getMessage() for record in caplog.records]
    with collect_warnings() as later:
        pass
    kv.load(path)
    assert later == []
