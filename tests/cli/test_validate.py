"""``kineverse validate``: problems of files as text, JSON and exit status."""

import errno
import json
import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import kineverse as kv
from kineverse.formats.document import to_json
from kineverse.formats.validate import find_inertia_errors, find_problems

LIMIT = '<limit lower="-1" upper="2" effort="1" velocity="1"/>'


@pytest.fixture
def run(run):
    return partial(run, "validate")


def robot(*parts):
    return f'<robot name="r"><link name="a"/><link name="b"/>{"".join(parts)}</robot>'


def hinge(inside=LIMIT):
    return f'<joint name="j" type="revolute"><parent link="a"/><child link="b"/>{inside}</joint>'


@pytest.fixture
def good(tmp_path):
    path = tmp_path / "good.urdf"
    path.write_text(robot(hinge()))
    return path


def body(mass=1.0, moments=(1.0, 1.0, 1.0)):
    model = kv.Model()
    xx, yy, zz = moments
    with model.edit() as edit:
        inertia = kv.model.Inertia(mass, (xx, 0.0, 0.0, yy, 0.0, zz))
        edit.add_frame("a", parent="world", transform=np.eye(4), body=kv.model.Body(inertia=inertia))
    return model


def test_shipped_models_have_no_problems(run):
    status, out, err = run(*kv.shipped_models())
    assert (status, err) == (0, "")
    assert len(out.splitlines()) == 2 + len(kv.shipped_models())


def test_a_valid_file_as_text_and_as_json(run, good):
    assert run(good) == (0, f"{good}: URDF\n  2 frames, 1 DoF, 2 constraints, 0 bodies\n  no problems\n", "")
    status, out, err = run(good, "--json")
    assert (status, err) == (0, "")
    assert json.loads(out) == {
        "status": 0,
        "files": [
            {
                "file": str(good),
                "format": "URDF",
                "status": 0,
                "error": None,
                "counts": {"frames": 2, "dof": 1, "constraints": 2, "bodies": 0},
                "problems": [],
                "remarks": [],
            }
        ],
    }


def test_validate_prints_the_version_of_documents(run, tmp_path, good):
    path = tmp_path / "good.kv.json"
    kv.load(good).save(path)
    status, out, _ = run(path)
    assert status == 0
    assert f"{path}: document, version 2" in out
    written = json.loads(path.read_text())
    (file,) = json.loads(run(path, "--json")[1])["files"]
    assert file["version"] == written["version"]
    assert file.get("sha256") == written.get("sha256")


@pytest.mark.parametrize(
    ("name", "text", "language"),
    [
        ("a.sdf", '<sdf version="1.9"><model name="m"><link name="a"/></model></sdf>', "SDF"),
        ("a.world", '<sdf version="1.9"><world name="w"/></sdf>', "SDF"),
        ("a.xml", '<robot name="r"><link name="a"/></robot>', "URDF"),
        ("a.xml", "<mujoco><worldbody><body/></worldbody></mujoco>", "MJCF"),
        ("a.mjcf", "<mujoco><worldbody><body/></worldbody></mujoco>", "MJCF"),
    ],
)
def test_validate_prints_the_contents_of_a_file(run, tmp_path, name, text, language):
    if language == "MJCF":
        pytest.importorskip("mujoco")
    (tmp_path / name).write_text(text)
    status, out, err = run(tmp_path / name)
    assert (status, err) == (0, "")
    assert out.startswith(f"{tmp_path / name}: {language}\n")


def test_frozen_operations_are_remarks(run, tmp_path):
    four_bar().save(tmp_path / "loop.kv.json")
    status, out, _ = run(tmp_path / "loop.kv.json")
    assert status == 0
    assert "no problems, 1 remark" in out
    assert "operation 'loop four_bar' is frozen" in out


def test_remarks_are_problems_only_with_strict(run, good):
    good.write_text(robot(hinge(), "<my_joint/>"))
    status, out, _ = run(good)
    assert status == 0
    assert "no problems, 1 remark" in out
    assert "<my_joint> is ignored" in out
    status, out, _ = run(good)
    assert "<my_joint> is ignored" in out, "a file that was loaded before has the same remarks"
    assert run(good, "--strict")[0] == 1


def test_printed_remarks_are_limited(run, good):
    good.write_text(robot(hinge(), "\n<my_joint/>" * 100))
    _, out, _ = run(good)
    assert "… and 90 more (--all)" in out
    assert len(out.splitlines()) < 20
    assert run(good, "--all")[1].count("is ignored") == 100


def test_a_default_state_beyond_limits_is_a_problem(run, good):
    own = '<limit lower="1" upper="2" effort="1" velocity="1"/><mimic joint="k"/>'
    driver = hinge().replace('"b"', '"c"').replace('"j"', '"k"').replace('upper="2"', 'upper="0.5"')
    good.write_text(robot(hinge(own), '<link name="c"/>', driver))
    status, out, _ = run(good)
    assert status == 1
    assert "j/position: is broken at the default state: 0.5 is not in [1, 2]" in out


def test_contradictory_bounds_are_a_problem(run, tmp_path):
    model = kv.Model()
    q, room = kv.position("q"), kv.position("room")
    with model.edit() as edit:
        edit.add_frame("a", parent="world", transform=kv.translation(q, 0, 0))
        edit.constrain("upside_down", room + 1, q.derivative(), -room)
        edit.constrain("room", 0, room, 1)
    model.save(tmp_path / "m.kv.json")
    status, out, _ = run(tmp_path / "m.kv.json")
    assert status == 1
    assert "upside_down: leaves no value at the default state: lower 1, upper 0" in out


@pytest.mark.parametrize(
    ("bend", "text"),
    [
        (lambda q: np.sqrt(q - 3), "is not finite at the default state"),
        (lambda q: np.sqrt(1 - q), "states within the limits"),
    ],
)
def test_nonfinite_poses_are_a_problem(bend, text):
    model, q = kv.Model(), kv.position("q")
    with model.edit() as edit:
        edit.add_frame("a", parent="world", transform=kv.translation(bend(q), 0, 0))
        edit.add_frame("b", parent="world", transform=kv.translation(q, 0, 0))
        edit.constrain("range", 0, q, 2)
    (found,) = find_problems(model)
    assert (found.kind, found.where) == ("pose", "a")
    assert text in found.text


def test_states_forbidden_by_constraints_are_not_checked():
    model = kv.Model()
    q, r = kv.position("q"), kv.position("r")
    with model.edit() as edit:
        edit.add_frame("a", parent="world", transform=kv.translation(np.sqrt(1 - q - r), 0, 0))
        for s in (q, r):
            edit.constrain(f"{s}/range", 0, s, 1)
        edit.constrain("sum", 0, q + r, 1)
    assert list(find_problems(model)) == []


def four_bar(crank=0.3, within=()):
    """Return a linkage of ground 1, coupler 0.9 and rocker 0.5, closed within a range of its crank."""
    model = kv.Model()
    z = {"axis": (0, 0, 1), "velocity": 1, "lower": -3, "upper": 3}
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="crank", parent="world", child="crank", **z))
        origin = kv.model.Pose.from_matrix(kv.translation(crank, 0, 0)())
        edit.apply(kv.Revolute(name="coupler", parent="crank", child="coupler", origin=origin, **z))
        edit.add_frame("end", parent="coupler", transform=kv.translation(0.9, 0, 0))
        origin = kv.model.Pose.from_matrix(kv.translation(1, 0, 0)())
        edit.apply(kv.Revolute(name="rocker", parent="world", child="rocker", origin=origin, **z))
        edit.add_frame("pin", parent="rocker", transform=kv.translation(0.5, 0, 0))
        edit.apply(kv.CloseLoop(name="four_bar", frame="end", to="pin", mask=("x", "y"), within=within))
    return model


def test_loops_that_do_not_close_within_limits_are_a_problem(tmp_path):
    assert [f for f in find_problems(four_bar()) if f.kind == "loop"] == []
    # A crank as long as this passes points where the rocker is out of reach; it is closed in a part only.
    limited = four_bar(crank=0.9, within=(("crank", 0.5, 0.8),))
    assert [f for f in find_problems(limited) if f.kind == "loop"] == []
    # Somebody takes the limit out of the document by hand.
    given = json.loads(to_json(limited))
    del given["sha256"], given["operations"][-1]["writes"]["constraints"]
    path = tmp_path / "edited.kv.json"
    path.write_text(json.dumps(given))
    found = [f for f in find_problems(kv.load(path)) if f.kind == "loop"]
    assert [(f.where, f.text.split()[:3]) for f in found] == [("four_bar", ["does", "not", "close"])]


@pytest.mark.parametrize(
    ("mass", "moments", "text"),
    [
        (-1.0, (1.0, 1.0, 1.0), "a mass of -1 kg"),
        (np.nan, (1.0, 1.0, 1.0), "a mass of nan kg"),
        (1.0, (1.0, 1.0, 2.1), "exceeds the sum"),
        (1.0, (-0.1, 1.0, 1.0), "negative"),
        (1.0, (-1.0, -1.0, -1.0), "negative"),
        (0.0, (1.0, 1.0, 1.0), "without any mass"),
        (1.0, (1.0, np.inf, 1.0), "not finite"),
    ],
)
def test_impossible_inertia_is_a_problem(mass, moments, text):
    (found,) = find_problems(body(mass, moments))
    assert (found.kind, found.where) == ("inertia", "a")
    assert text in found.text


@given(st.lists(st.tuples(*[st.floats(-2, 2)] * 3, st.floats(0.01, 3)), min_size=1, max_size=8))
def test_inertia_of_point_masses_is_possible(points):
    tensor, mass = np.zeros((3, 3)), 0.0
    for *p, m in points:
        tensor += m * (np.dot(p, p) * np.eye(3) - np.outer(p, p))
        mass += m
    xx, xy, xz, _, yy, yz, _, _, zz = tensor.ravel().tolist()
    assert list(find_inertia_errors(kv.model.Inertia(mass, (xx, xy, xz, yy, yz, zz)))) == []


def test_missing_meshes_are_a_problem(run, good):
    mesh = '<link name="c"><visual><geometry><mesh filename="{}"/></geometry></visual></link>'
    joint = '<joint name="f" type="fixed"><parent link="a"/><child link="c"/></joint>'
    good.write_text(robot(hinge(), mesh.format("package://nowhere/a.stl"), joint))
    status, out, err = run(good)
    assert (status, err) == (1, "")
    assert 'c: "package://nowhere/a.stl": there is no package "nowhere".' in out
    assert run(good, "--no-meshes")[0] == 0
    (good.parent / "a.stl").write_text("solid a\nendsolid a\n")
    good.write_text(robot(hinge(), mesh.format("a.stl"), joint))
    assert run(good)[0] == 0


def test_several_files_are_a_table_and_the_worst_status(run, good, tmp_path):
    bad, broken = tmp_path / "bad.urdf", tmp_path / "broken.urdf"
    inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="9"/>'
    bad.write_text(
        robot(hinge()).replace(
            '<link name="b"/>', f'<link name="b"><inertial><mass value="1"/>{inertia}</inertial></link>'
        )
    )
    broken.write_text("<robot>")
    assert run(good, good)[0] == 0
    status, out, err = run(good, bad)
    assert (status, err) == (1, "")
    assert "b: principal moments 1, 1, 9 kg m²" in out
    status, out, err = run(good, bad, broken)
    assert (status, err) == (2, "")
    lines = out.splitlines()
    assert lines[0].split() == ["file", "format", "frames", "DoF", "constraints", "remarks", "problems"]
    assert [line.split()[0] for line in lines[2:5]] == [str(good), str(bad), str(broken)]
    assert lines[4].endswith("cannot be read")
    assert "broken.urdf, line 1" in out
    answer = json.loads(run(good, bad, broken, "--json")[1])
    assert answer["status"] == 2
    assert [file["status"] for file in answer["files"]] == [0, 1, 2]
    assert "line 1" in answer["files"][2]["error"]


@pytest.mark.parametrize(
    "name", ["missing.urdf", "folder", "noise.urdf", "noise.kv.json", "notes.txt", "тело 机.urdf"]
)
def test_an_unreadable_file_is_status_2(run, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    for noise in ("noise.urdf", "noise.kv.json"):
        (tmp_path / noise).write_bytes(os.urandom(200))
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "тело 机.urdf").write_text("<robot")
    status, out, err = run(name)
    assert (status, out, len(err.splitlines())) == (2, "", 1)
    assert name in err
    status, out, err = run(name, "--json")
    assert (status, err) == (2, "")
    assert json.loads(out)["files"][0]["error"]


def test_a_file_without_permission_is_status_2(run, good, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(good))

    monkeypatch.setattr(Path, "open", refuse)
    status, out, err = run(good)
    assert (status, out, len(err.splitlines())) == (2, "", 1)
    assert "Permission denied" in err


def test_a_file_is_validated_from_python_too(good):
    found = kv.formats.validate_file(good)
    assert (found.status, found.format, list(found.problems)) == (0, "URDF", [])
    seen = []
    kv.formats.validate_file(good, further=lambda model: seen.append(len(model.frames)) or ())
    assert seen == [len(found.model.frames)]
    missing = kv.formats.validate_file(good.with_name("nowhere.urdf"))
    assert (missing.status, missing.model) == (2, None)
    assert "nowhere.urdf" in missing.reason
