"""Check of a written file by the engine of its format: right files pass, wrong ones name the joint."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import pytest
from round_trip import load_cached

import kineverse as kv
from kineverse.formats.engines import PoseEngine
from kineverse.model.registry import FrameDeviation

for package in ("pinocchio", "mujoco", "pydrake"):
    pytest.importorskip(package)

ENDINGS = ("urdf", "xml", "sdf")
ENGINES = {"urdf": "pinocchio", "xml": "mujoco", "sdf": "drake"}


def arm() -> kv.Model:
    """Return a model with a joint of each kind that all three formats have."""
    q = kv.position("turn")
    model = kv.Model()
    with model.edit() as edit:
        for joint in (
            kv.Revolute(name="turn", parent="world", child="a", axis=(0, 0, -1), lower=-1, upper=2),
            kv.Prismatic(name="slide", parent="a", child="b", axis=(1, 0, 0), lower=0, upper=0.5),
            kv.Revolute(name="follow", parent="b", child="c", axis=(0, 1, 0), position=-0.5 * q + 0.25),
            kv.Continuous(name="spin", parent="c", child="d", axis=(0, 0, 1)),
            kv.Floating(name="flight", parent="world", child="e"),
            kv.Floating(name="held", parent="d", child="f"),
            kv.Planar(name="flat", parent="world", child="g"),
        ):
            edit.apply(joint)
        edit.add_frame("tip", parent="d", transform=kv.translation(0.3, 0.1, 0))
    return model


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_right_file_passes(ending: str, tmp_path: Path) -> None:
    model, file = arm(), tmp_path / f"m.{ending}"
    model.save(file)
    check = kv.formats.check_conversion(model, file)
    assert check.ok
    assert (check.engine, check.states, check.frames) == (ENGINES[ending], 100, len(model.frames))
    assert re.match(r"\d+\.\d+", check.version)
    assert 0 < max(check.largest.position, check.largest.angle) < 1e-12
    assert check.frame in model.frames
    assert (check.wrong, check.cause, check.bounds) == ({}, "", FrameDeviation())


FACTORS = {
    "urdf": ('multiplier="-0.5"', 'multiplier="-0.5000001"'),
    "xml": ('polycoef="0.25 -0.5 ', 'polycoef="0.25 -0.5000001 '),
    "sdf": ("<multiplier>-0.5<", "<multiplier>-0.5000001<"),
}


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("cause", ["turn", "tip", "follow"])
def test_a_wrong_file_names_the_joint(cause: str, ending: str, tmp_path: Path) -> None:
    model, file = arm(), tmp_path / f"m.{ending}"
    model.save(file)
    changes = {"turn": ("0 0 -1", "0 1 0"), "tip": ("0.3 0.1 0", "0.3 0.1000001 0")}
    old, new = {**changes, "follow": FACTORS[ending]}[cause]
    text = file.read_text()
    assert text.count(old) == 1
    file.write_text(text.replace(old, new))
    check = kv.formats.check_conversion(model, file)
    assert not check.ok
    assert check.cause == cause
    assert max(check.largest.position, check.largest.angle) > 1e-9


def test_a_loop_that_does_not_close_is_named(tmp_path: Path) -> None:
    model, file = load_cached("articulations/four_bar"), tmp_path / "m.sdf"
    model.save(file)
    text = file.read_text()
    assert kv.formats.check_conversion(model, file).ok
    changed = re.sub(r"(<child>)four_bar/coupler_end(</child>)", r"\1four_bar/crank\2", text)
    assert changed != text
    file.write_text(changed)
    check = kv.formats.check_conversion(model, file)
    assert not check.ok
    assert check.cause == "four_bar/four_bar"


def test_planes_that_pinocchio_lacks_are_told(tmp_path: Path) -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Planar(name="wall", parent="world", child="a", axis=(1, 0, 0)))
        edit.apply(kv.Revolute(name="b", parent="a", child="b"))
        edit.apply(kv.Revolute(name="c", parent="world", child="c"))
    model.save(tmp_path / "m.urdf")
    check = kv.formats.check_conversion(model, tmp_path / "m.urdf")
    assert (check.ok, check.frames) == (True, 1)
    assert check.remarks == ("pinocchio has planes of x and y only: what 'wall' moves is not compared",)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("leader", ["ball/qx", "free/x", "flat/x"])
def test_followers_of_joints_with_several_coordinates_move_alike_or_are_refused(
    leader: str, ending: str, tmp_path: Path
) -> None:
    kinds = {"ball": kv.articulations.Ball, "free": kv.Floating, "flat": kv.Planar}
    name = leader.partition("/")[0]
    model, file = kv.Model(), tmp_path / f"m.{ending}"
    with model.edit() as edit:
        edit.apply(kinds[name](name=name, parent="world", child="a"))
        edit.apply(kv.Prismatic(name="f", parent="a", child="b", position=0.5 * kv.position(leader)))
    if leader == "ball/qx":
        with pytest.raises(kv.errors.FormatError, match="'f' follows 'ball/qx', which is the position of no"):
            model.save(file)
    elif (leader, ending) == ("free/x", "urdf"):
        with pytest.raises(kv.errors.FormatError, match="'free' turns by a quaternion"):
            model.save(file)
    else:
        model.save(file)
        assert kv.formats.check_conversion(model, file, states=20).ok
        assert kv.load(file).degrees_of_freedom == model.degrees_of_freedom


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_joint_that_the_model_lacks_and_a_missing_file_are_errors(ending: str, tmp_path: Path) -> None:
    model, file = arm(), tmp_path / f"m.{ending}"
    with pytest.raises(kv.errors.FormatError, match="there is no such file"):
        kv.formats.check_conversion(model, file)
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="more", parent="d", child="h"))
    model.save(file)
    with pytest.raises(kv.errors.FormatError, match=rf"m.{ending} has a joint with the coordinate 'more'"):
        kv.formats.check_conversion(arm(), file)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_broken_file_and_a_missing_frame_are_errors(ending: str, tmp_path: Path) -> None:
    model, file = arm(), tmp_path / f"m.{ending}"
    file.write_text("<nonsense/>")
    with pytest.raises(kv.errors.FormatError, match=r"^m\.\w+: "):
        kv.formats.check_conversion(model, file)
    model.save(file)
    with model.edit() as edit:
        edit.add_frame("new", parent="a", transform=kv.translation(0, 0, 1))
    with pytest.raises(kv.errors.FormatError, match="lacks frames of the model: 'new'"):
        kv.formats.check_conversion(model, file)


@pytest.mark.parametrize("states", [0, -1, 1.5, True, "many"])
def test_a_number_of_states_is_a_positive_integer(states: Any, tmp_path: Path) -> None:
    with pytest.raises(kv.errors.InvalidValueError, match="states= is an integer of at least 1"):
        kv.formats.check_conversion(kv.Model(), tmp_path / "m.urdf", states=states)


@pytest.mark.parametrize("name", ["m.kv.json", "m.obj", "m"])
def test_files_that_no_engine_reads_are_refused(name: str) -> None:
    with pytest.raises(kv.errors.InvalidValueError, match="cannot be checked: no other engine reads it"):
        kv.formats.check_conversion(kv.Model(), name)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_missing_engine_is_told_with_what_installs_it(
    ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = importlib.import_module

    def missing(name: str, *rest: Any) -> Any:
        if name.partition(".")[0] in ("pinocchio", "mujoco", "pydrake"):
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(kv.errors.MissingDependencyError, match=r"is not installed: .*\[check\]"):
        kv.formats.check_conversion(arm(), tmp_path / f"m.{ending}")


def test_an_engine_states_its_package() -> None:
    for one in kv.model.registry.list_formats():
        if one.engine:
            engine = kv.model.registry.import_entry(one.engine)
            assert issubclass(engine, PoseEngine)  # type: ignore[arg-type]
            assert engine.version()  # type: ignore[attr-defined]
