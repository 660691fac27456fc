"""Experiment on conversions: equal files, refused ones by the name of a joint, and wrong ones."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from kineverse.model.registry import FrameDeviation
from kineverse_studies.experiments import Options, reproduce
from kineverse_studies.experiments.conversion import (
    FORMATS,
    ConversionJob,
    _one_of_each,
    convert,
    engine_table,
    model_table,
)

for package in ("pinocchio", "mujoco", "pydrake"):
    pytest.importorskip(package)


def test_a_mechanism_is_equal_or_refused_by_the_name_of_a_joint() -> None:
    (found,) = convert(ConversionJob("articulations/four_bar", "four-bar", 5))
    assert found.refused == {"URDF": "four_bar/coupler"}
    assert {name: check.ok for name, check in found.checks.items()} == {"MJCF": True, "SDF": True}
    (row,) = model_table([found]).rows
    assert row == ("four-bar", 7, 1, "refused: four_bar/coupler", "equal", "equal")


def test_a_wrong_file_and_a_refusal_without_a_name_are_seen_in_the_tables() -> None:
    (found,) = convert(ConversionJob("shelf_door", "shelf", 2))
    off = FrameDeviation(0.5, 0.0)
    check = found.checks["SDF"].__class__(
        *(getattr(found.checks["SDF"], name) for name in ("engine", "version", "states", "frames")),
        off,
        "a",
        "j",
        {"a": off},
        "j",
        FrameDeviation(),
    )
    found.checks["SDF"] = check
    found.refused["URDF"] = ""
    (row,) = model_table([found]).rows
    assert row[3:] == ("refused: NO JOINT IS NAMED", "equal", "off by 0.5 m and 0 rad at j")
    assert [line[3] for line in engine_table([found]).rows] == ["yes", "yes", "no"]


def test_one_file_of_each_robot_is_taken(tmp_path: Path) -> None:
    for name in ("b/z.urdf", "b/y.urdf", "a/t.urdf", "c/only.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("<robot/>" if name == "b/y.urdf" else "<robot><link/></robot>")
    assert [path.name for path in _one_of_each(tmp_path)] == ["t.urdf", "z.urdf"]


def test_the_report_is_json() -> None:
    report = reproduce("conversion", options=Options(model="articulations/cam", processes=1))
    assert json.loads(json.dumps(report.numbers)) == {
        "models": {"articulations/cam": {name: {"refused": "cam/valve"} for name in FORMATS}}
    }
