"""``kineverse diff``: differences of two models as text, JSON and exit status."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

import kineverse as kv
from kineverse.cli.diff import format_value
from kineverse.model.body import Box, Cylinder


@pytest.fixture
def run(run):
    return partial(run, "diff")


def link(name, inside=""):
    return f'<link name="{name}">{inside}</link>'


def joint(name, parent, child, kind="revolute", inside=""):
    limit = '<limit lower="-1" upper="2" effort="10" velocity="3"/>' if kind != "fixed" else ""
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{inside or limit}</joint>'


INERTIA = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
ARM = {
    "base": link("base", f'<inertial><mass value="2"/>{INERTIA}</inertial>'),
    "upper": link("upper", '<visual><geometry><box size="1 1 1"/></geometry></visual>'),
    "tool": link("tool"),
    "shoulder": joint("shoulder", "base", "upper"),
    "flange": joint("flange", "upper", "tool", "fixed", '<origin xyz="0.3 0 0"/>'),
}


@pytest.fixture
def files(tmp_path):
    """Write the arm, and the arm with other parts; return both paths."""

    def write(**changed):
        paths = []
        for name, parts in (("one", ARM), ("two", {**ARM, **changed})):
            paths.append(tmp_path / f"{name}.urdf")
            paths[-1].write_text(f'<robot name="r">{"".join(parts.values())}</robot>')
        return paths

    return write


def test_equal_models_are_status_0(run, files, tmp_path):
    one, two = files()
    assert run(one, two) == (0, "equal within 1e-09: 3 frames, 1 DoF, 2 constraints\n", "")
    assert run(one, two, "--tolerance", 0)[1].startswith("equal to the bit")
    kv.load(one).save(tmp_path / "one.kv.json")
    assert run(one, tmp_path / "one.kv.json", "--tolerance", 0)[0] == 0
    assert run(one, two, "--values")[0] == 0
    assert json.loads(run(one, two, "--json")[1])["equal"] is True


def test_every_kind_of_difference_is_printed(run, files):
    one, two = files(
        base=link("base", f'<inertial><mass value="2.5"/>{INERTIA}</inertial>'),
        upper=link("upper", '<visual><geometry><box size="1 1 1.5"/></geometry></visual>'),
        shoulder=joint(
            "shoulder", "base", "upper", inside='<limit lower="-1" upper="2.5" effort="12" velocity="3"/>'
        ),
        flange=joint("flange", "upper", "tool", "fixed", '<origin xyz="0.31 0 0" rpy="0 0 0.1"/>'),
        camera=link("camera"),
        mount=joint("mount", "tool", "camera", "fixed"),
    )
    status, out, err = run(one, two)
    assert (status, err) == (1, "")
    lines = [" ".join(line.split()) for line in out.splitlines()]
    for line in (
        "~ tool 10 mm and 5.73 deg apart",
        "xyz 0.3 0 0 → 0.31 0 0",
        "rpy 0 0 0 → 0 0 0.1",
        "+ camera in tool",
        "~ shoulder/position upper 2 → 2.5",
        "~ base inertia.mass 2 → 2.5",
        "~ upper visuals[0].geometry.size 1 1 1 → 1 1 1.5",
        "~ shoulder dynamics[effort] 10 → 12",
        "+ joint mount",
        "~ joint flange",
        "7 differences: 2 added, 5 changed",
    ):
        assert line in lines
    _, out, _ = run(two, one)
    assert "- camera" in out
    assert "upper 2.5 → 2" in out


def test_json_is_one_object_with_numbers(run, files):
    one, two = files(flange=joint("flange", "upper", "tool", "fixed", '<origin xyz="0.31 0 0"/>'))
    status, out, err = run(one, two, "--json")
    assert (status, err) == (1, "")
    answer = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert answer["equal"] is False
    assert answer["operations"] == {"removed": [], "changed": ["joint flange"], "added": [], "moved": []}
    (changed,) = answer["frames"]["changed"]
    assert changed["name"] == "tool"
    (part,) = changed["parts"]
    assert part["distance"] == pytest.approx(0.01)
    assert np.array(part["after"])[0, 3] == 0.31
    assert answer["constraints"] == {"added": [], "removed": [], "changed": []}
    answer = json.loads(run(one, two, "--json", "--values")[1])
    assert answer["frames"]["changed"][0]["distance"] == pytest.approx(0.01)


def test_rounding_is_a_difference_only_with_tolerance_zero(run, files):
    one, two = files(flange=joint("flange", "upper", "tool", "fixed", '<origin xyz="0.3000000000001 0 0"/>'))
    status, out, _ = run(one, two)
    assert status == 0
    assert "1 value written or rounded in another way" in out
    status, out, _ = run(one, two, "--tolerance", 0)
    assert status == 1
    assert "~ joint flange" in out
    assert "xyz" not in out, "four digits show nothing"
    assert run(one, two, "--tolerance", 0, "--values")[0] == 1


def test_different_formats_are_compared_by_behaviour(run, files, tmp_path):
    one, _ = files()
    twin = tmp_path / "twin.sdf"
    twin.write_text(
        """<sdf version="1.9"><model name="r"><link name="base"/><link name="upper"/>
        <link name="tool"><pose relative_to="upper">0.3 0 0 0 0 0</pose></link>
        <joint name="root" type="fixed"><parent>world</parent><child>base</child></joint>
        <joint name="shoulder" type="revolute"><parent>base</parent><child>upper</child>
        <axis><xyz>1 0 0</xyz><limit><lower>-1</lower><upper>2</upper><velocity>3</velocity></limit></axis></joint>
        <joint name="flange" type="fixed"><parent>upper</parent><child>tool</child></joint></model></sdf>"""
    )
    status, out, err = run(one, twin, "--values")
    assert (status, err) == (0, "")
    assert "3 frames at the same places in 101 states" in out
    assert run(one, twin)[0] == 1
    twin.write_text(twin.read_text().replace("<upper>2<", "<upper>1<").replace("0.3 0 0", "0.3 0 0.1"))
    status, out, _ = run(one, twin, "--values")
    assert status == 1
    assert "~ tool  100 mm" in out
    assert "~ shoulder  [-1, 2] → [-1, 1]" in out


def test_operations_are_compared_where_most_have_a_counterpart(run, files):
    one, two = files()
    text = two.read_text().replace('name="', 'name="x_').replace('link="', 'link="x_')
    two.write_text(text)
    status, out, _ = run(one, two)
    assert status == 1
    assert "operations not compared" in out
    assert "no frame in common" in out
    assert "- joint shoulder" in run(one, two, "--operations", "yes")[1]


def test_a_frame_in_another_parent_is_compared_in_the_world(run, files):
    """The pose in the parent is not comparable if the parents differ."""
    one, two = files(flange=joint("flange", "base", "tool", "fixed", '<origin xyz="0.3 0 0"/>'))
    status, out, _ = run(one, two)
    assert status == 1
    assert "~ tool  parent upper → base" in out
    assert "in the world up to" in out, "the shoulder turns, and takes the tool along no more"
    assert "not at the default state" in out
    one, two = files(
        elbow=joint("elbow", "upper", "lower", "fixed"),
        lower=link("lower"),
        flange=joint("flange", "lower", "tool", "fixed", '<origin xyz="0.3 0 0"/>'),
    )
    _, out, _ = run(one, two)
    assert "~ tool   parent upper → lower" in out
    assert "in the world" not in out


def test_a_fixed_joint_with_equal_frames_is_no_difference(run, tmp_path):
    for name in ("one", "two"):
        model = kv.Model()
        origin = kv.model.Pose.from_matrix(kv.translation(1, 0, 0)())
        with model.edit() as edit:
            if name == "one":
                edit.add_frame("f", parent="world", transform=origin)
            else:
                edit.apply(kv.Fixed(name="f", parent="world", child="f", origin=origin))
        model.save(tmp_path / f"{name}.kv.json")
    words = tmp_path / "one.kv.json", tmp_path / "two.kv.json"
    assert run(*words)[0] == 0
    assert run(*words, "--operations", "yes")[0] == 1


def test_moved_operations_are_differences(run, tmp_path):
    q = kv.position("q")
    for name, order in (("one", "ab"), ("two", "ba")):
        model = kv.Model()
        with model.edit() as edit:
            edit.add_frame("f", parent="world", transform=kv.translation(q, 0, 0))
            for constraint in order:
                edit.constrain(constraint, 0, q, 1)
        model.save(tmp_path / f"{name}.kv.json")
    status, out, _ = run(tmp_path / "one.kv.json", tmp_path / "two.kv.json")
    assert status == 1
    assert "  > constraint" in out
    assert "in operations only" in out
    assert run(tmp_path / "one.kv.json", tmp_path / "two.kv.json", "--operations", "no")[0] == 0


def test_a_pose_that_exists_on_one_side_only_is_a_difference(run, tmp_path):
    q = kv.position("q")
    for name, root in (("one", q), ("two", q - 2)):
        model = kv.Model()
        with model.edit() as edit:
            edit.add_frame("f", parent="world", transform=kv.translation(np.sqrt(root), 0, 0))
            edit.constrain("range", 0, q, 1)
        model.save(tmp_path / f"{name}.kv.json")
    words = tmp_path / "one.kv.json", tmp_path / "two.kv.json"
    status, out, _ = run(*words)
    assert status == 1
    assert "somewhere on one side only" in out
    assert "x = sqrt(q) → sqrt(q - 2)" in out
    assert "somewhere on one side only" in run(*words, "--values")[1]
    for mode in ((), ("--values",)):
        answer = json.loads(run(*words, "--json", *mode)[1], parse_constant=pytest.fail)
        assert "null" in json.dumps(answer["frames"])


@dataclass(frozen=True)
class Crowd(kv.Operation):
    """Operation that adds 1 000 constraints."""

    upper: float

    def apply(self, model):
        symbols = [kv.position(f"q{i}") for i in range(100)]
        return kv.model.Writes(
            constraints={f"c{i}": (0, symbols[i % 100], self.upper + i) for i in range(1_000)}
        )


@pytest.fixture
def many_constraints(tmp_path):
    """Return two documents of 1 000 constraints each, all different."""
    paths = tmp_path / "one.kv.json", tmp_path / "two.kv.json"
    for upper, path in enumerate(paths, start=1):
        model = kv.Model()
        with model.edit() as edit:
            edit.apply(Crowd(upper))
        model.save(path)
    return paths


def test_a_thousand_differences_are_bounded(run, many_constraints):
    status, out, err = run(*many_constraints)
    assert (status, err) == (1, "")
    assert len(out.splitlines()) < 40
    assert "… and 980 more (--all)" in out
    assert "1000 differences: 1000 changed" in out
    assert len(json.loads(run(*many_constraints, "--json")[1])["constraints"]["changed"]) == 1_000


def test_all_prints_all_differences(run, files):
    parts = {f"l{i}": link(f"l{i}") + joint(f"j{i}", "base", f"l{i}", "fixed") for i in range(30)}
    one, two = files(**parts)
    assert "… and 10 more (--all)" in run(one, two)[1]
    _, out, _ = run(one, two, "--all")
    assert "more" not in out
    assert out.count("in base") == 30


def test_names_in_any_script_are_kept(run, tmp_path):
    for name, size in (("eins", 1), ("zwei", 2)):
        (tmp_path / f"{name}-ü.urdf").write_text(
            f'<robot name="r"><link name="тело 机"><visual><geometry><sphere radius="{size}"/></geometry></visual></link></robot>'
        )
    status, out, _ = run(tmp_path / "eins-ü.urdf", tmp_path / "zwei-ü.urdf")
    assert status == 1
    assert "тело 机  visuals[0].geometry.radius 1 → 2" in out


def test_the_prefix_applies_to_both_models(run, files):
    one, two = files()
    assert run(one, two, "--prefix", "arm")[0] == 0
    two.write_text(two.read_text().replace("0.3 0 0", "0.4 0 0"))
    assert "~ arm/tool" in run(one, two, "--prefix", "arm")[1]


class Screen:
    """Standard output that is a terminal."""

    def __init__(self, stream):
        self._stream = stream

    def __getattr__(self, name):
        return getattr(self._stream, name)

    def isatty(self):
        return True


def test_diff_is_coloured_on_a_terminal_only(run, files, monkeypatch):
    one, two = files(flange=joint("flange", "upper", "tool", "fixed", '<origin xyz="0.31 0 0"/>'))
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert "\033" not in run(one, two)[1]
    monkeypatch.setattr(sys, "stdout", Screen(sys.stdout))
    assert "\033[33m~\033[0m tool" in run(one, two)[1]
    monkeypatch.setenv("NO_COLOR", "1")
    assert "\033" not in run(one, two)[1]


@pytest.mark.parametrize(
    ("second", "hint"),
    [
        ("missing.urdf", "missing.urdf"),
        (".", "folder"),
        ("noise.urdf", "noise.urdf"),
        ("notes.txt", "notes.txt"),
    ],
)
def test_an_unreadable_file_is_status_2(run, files, tmp_path, monkeypatch, second, hint):
    monkeypatch.chdir(tmp_path)
    one, _ = files()
    (tmp_path / "noise.urdf").write_bytes(os.urandom(100))
    (tmp_path / "notes.txt").write_text("hello")
    status, out, err = run(one, second)
    assert (status, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert hint in err


@pytest.mark.parametrize("tolerance", ["nan", "inf", "-1"])
def test_diff_refuses_invalid_tolerances(run, files, tolerance):
    status, out, err = run(*files(), f"--tolerance={tolerance}")
    assert (status, out) == (2, "")
    assert "from 0 on" in err
    assert run(*files(), "--tolerance", "much")[0] == 2


@pytest.mark.parametrize("ending", ["urdf", "xml"])
def test_helper_frames_of_a_format_are_no_difference(run, tmp_path, ending):
    if ending == "xml":
        pytest.importorskip("mujoco")
    model, q = kv.Model(), kv.position("q")
    with model.edit() as edit:
        edit.add_frame("lift", parent="world", transform=kv.translation(0, 0, 0.2 * q))
        edit.add_frame("yoke", parent="lift", transform=kv.translation(0.3 * np.cos(q), 0, 0))
        edit.add_frame("cross", parent="yoke", transform=kv.rotation_x(q) @ kv.rotation_y(kv.position("p")))
    one, two = tmp_path / "one.kv.json", tmp_path / f"two.{ending}"
    model.save(one)
    model.save(two)
    assert len(kv.load(two).frames) > 3
    for files in ((one, two), (two, one)):
        status, out, _ = run(*files, "--values")
        assert status == 0
        assert "not counted, in between and without bodies: " in out
    answer = json.loads(run(one, two, "--values", "--json")[1])
    assert answer["equal"]
    assert set(answer["frames"]["helpers"]) == set(kv.load(two).frames) - set(model.frames)
    assert run(one, two)[0] == 1


def test_added_frames_are_a_difference(run, files, tmp_path):
    def added(name, parent, inside=""):
        return link(name, inside) + joint(f"{name}_mount", parent, name, "fixed", " ")

    upper = ARM["upper"]
    for more in (
        {"leaf": added("leaf", "upper")},
        {"between": link("between") + joint("m", "upper", "between", "fixed", " ")}
        | {"flange": joint("flange", "between", "tool", "fixed", '<origin xyz="0.3 0 0"/>')},
        {"seen": added("tool/seen", "upper", upper[upper.index("<visual") : upper.index("</link")])}
        | {"flange": joint("flange", "tool/seen", "tool", "fixed", '<origin xyz="0.3 0 0"/>')},
    ):
        status, out, _ = run(*files(**more), "--values")
        assert status == 1
        assert "not counted" not in out


def test_behaviour_is_compared_from_python_too():
    before, after = kv.load("shelf_door"), kv.load("shelf_door")
    assert kv.model.BehaviourComparison(before, after).equal
    with after.edit() as edit:
        edit.add_frame("shelf_door/mark", parent="shelf_door/door", transform=kv.translation(0, 0, 1))
    found = kv.model.BehaviourComparison(before, after)
    assert not found.apart
    assert found.frames["added"] == ["shelf_door/mark"] or found.helpers == ["shelf_door/mark"]


def test_geometries_are_described_by_their_sizes():
    assert format_value(Box((1.0, 2.0, 3.0))) == "box 1 2 3"
    assert format_value(kv.model.Shape(Cylinder(0.5, 2.0))) == "cylinder 0.5 2"
