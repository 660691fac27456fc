"""Saving of models: files are written completely or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import kineverse as kv

ENDINGS = (".kv.json", ".urdf", ".xml", ".mjcf")
EVERY = (*ENDINGS, ".kv.msgpack", ".sdf", ".usda", ".usdc", ".usd")


@pytest.fixture
def model() -> kv.Model:
    result = kv.Model()
    with result.edit() as edit:
        edit.apply(kv.Revolute(name="q", parent="world", child="q", lower=0, upper=1))
    return result


@pytest.mark.parametrize("ending", EVERY)
def test_every_ending_is_read_back(ending: str, model: kv.Model, tmp_path: Path) -> None:
    report = model.save(tmp_path / f"m{ending}")
    assert report.path == tmp_path / f"m{ending}"
    assert kv.load(report.path).limits("q") == (0, 1)
    assert [p.name for p in tmp_path.iterdir()] == [f"m{ending}"]


def test_other_endings_are_refused_with_those_there_are(model: kv.Model, tmp_path: Path) -> None:
    with pytest.raises(kv.errors.FormatError) as info:
        model.save(tmp_path / "m.dae")
    assert all(ending in str(info.value) for ending in EVERY)


@pytest.mark.parametrize("ending", ENDINGS)
def test_failed_save_leaves_the_existing_file(ending: str, model: kv.Model, tmp_path: Path) -> None:
    file = tmp_path / f"m{ending}"
    file.write_text("before")
    if ending == ".kv.json":
        target: Path = tmp_path / "missing" / file.name
    else:
        with model.edit() as edit:
            edit.add_frame("curve", parent="q", transform=kv.rotation_x(kv.position("q") ** 5))
        target = file
    with pytest.raises(kv.errors.FormatError):
        model.save(target)
    assert file.read_text() == "before"
    assert [p.name for p in tmp_path.iterdir()] == [file.name]


@pytest.mark.parametrize("ending", ENDINGS)
def test_save_to_a_missing_folder_is_refused(ending: str, model: kv.Model, tmp_path: Path) -> None:
    with pytest.raises(
        kv.errors.FormatError, match=r"cannot be written: the folder .*nowhere does not exist"
    ):
        model.save(tmp_path / "nowhere" / f"m{ending}")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_save_to_a_read_only_folder_is_refused(model: kv.Model, tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(kv.errors.FormatError, match="cannot be written"):
        model.save(tmp_path / "m.urdf")


def test_save_to_no_path_is_refused(model: kv.Model) -> None:
    with pytest.raises(kv.errors.FormatError, match="is saved to the path of a file"):
        model.save(3)  # type: ignore[arg-type]
