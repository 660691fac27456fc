"""``kineverse convert``: conversion to files and to standard output."""

import json
import os
import re
import sys
from functools import partial

import pytest

import kineverse as kv
from kineverse.cli import main

LIMIT = '<limit lower="-1" upper="2" effort="1" velocity="1"/>'
HINGE = f'<joint name="j" type="revolute"><parent link="a"/><child link="b"/>{LIMIT}</joint>'


@pytest.fixture
def run(run):
    return partial(run, "convert")


@pytest.fixture
def robot(tmp_path, monkeypatch):
    """Write a robot into an empty folder, which becomes the current one."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "robot.urdf"
    path.write_text(f'<robot name="r"><link name="a"/><link name="b"/>{HINGE}<my_joint/></robot>')
    return path


def test_a_converted_document_equals_the_model_to_the_bit(run, robot, tmp_path):
    status, out, err = run("robot.urdf", "robot.kv.json")
    assert (status, err) == (0, "")
    size = (tmp_path / "robot.kv.json").stat().st_size
    assert out.splitlines() == [
        "robot.urdf → robot.kv.json",
        f"  2 frames, 1 DoF, 2 constraints, {size / 1024:.3g} KiB",
        "  remarks on reading",
        "    robot.urdf, line 1, <my_joint> is ignored: URDF does not know it.",
    ]
    assert kv.model.compare_models(kv.load("robot.urdf"), kv.load("robot.kv.json")).is_empty


@pytest.mark.parametrize("ending", [".kv.json", ".urdf"])
@pytest.mark.parametrize("source", ["robot.urdf", "shelf_door", "articulations/revolute"])
def test_a_converted_model_has_equal_behaviour(run, robot, source, ending):
    status, _, err = run(source, f"out{ending}")
    assert (status, err) == (0, "")
    assert main(["diff", "--values", source, f"out{ending}"]) == 0


def test_convert_lists_unsupported_constraints(run, robot):
    pytest.importorskip("mujoco")
    status, out, err = run("robot.urdf", "robot.xml")
    assert (status, err) == (0, "")
    remarks = out.partition("remarks on writing\n")[2]
    assert "elements of URDF that say nothing of motion are not written: 1 <my_joint>\n" in remarks
    assert "MuJoCo knows no limits of speeds" in remarks
    assert main(["diff", "--values", "robot.urdf", "robot.xml"]) == 0


def test_convert_adds_the_prefix_to_names(run, robot):
    assert run("robot.urdf", "left.kv.json", "--prefix", "left")[0] == 0
    assert list(kv.load("left.kv.json").frames) == ["left/a", "left/b"]


def test_json_is_one_object_and_nothing_else(run, robot):
    status, out, err = run("robot.urdf", "robot.kv.json", "--json")
    assert (status, err) == (0, "")
    answer = json.loads(out)
    assert answer["bytes"] == os.path.getsize("robot.kv.json")
    assert answer["counts"] == {"frames": 2, "dof": 1, "constraints": 2}
    assert len(answer["remarks"]["reading"]) == 1


def test_convert_to_a_dash_writes_to_standard_output(robot, tmp_path, capfdbinary):
    kv.load("robot.urdf").save("robot.kv.json")
    assert main(["convert", "robot.urdf", "-"]) == 0
    captured = capfdbinary.readouterr()
    assert captured.out == (tmp_path / "robot.kv.json").read_bytes()
    assert b"2 frames, 1 DoF" in captured.err
    for option in (["--json"], ["--leave-out", "j/position"], ["--tolerance", "0.1"], ["--strict"]):
        assert main(["convert", "robot.urdf", "-", *option]) == 2
        captured = capfdbinary.readouterr()
        assert captured.out == b""
        assert option[0].encode() in captured.err


def test_leave_out_removes_the_named_constraints_only(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = kv.Model()
    q, bolt = kv.position("door"), kv.position("bolt")
    with model.edit() as edit:
        edit.add_frame("door", parent="world", transform=kv.rotation_z(q))
        edit.constrain("range", 0, q, 1)
        edit.constrain("lock", -(bolt > 1), q.derivative(), bolt > 1)
    model.save("door.kv.json")
    status, out, err = run("door.kv.json", "door.urdf", "--strict")
    assert (status, out) == (2, "")
    assert "'lock' has bounds that depend on bolt" in err
    assert "leave constraints out with --leave-out NAME, or all of them without --strict." in err
    assert not (tmp_path / "door.urdf").exists()
    assert run("door.kv.json", "door.urdf", "--strict", "--leave-out", "lock")[0] == 0
    assert kv.load("door.urdf").limits("door") == (0.0, 1.0)
    status, out, err = run("door.kv.json", "default.urdf")
    assert status == 0
    assert err.splitlines() == [
        "default.urdf leaves out 1 thing that it cannot express; --strict refuses instead:",
        "  lock has bounds that depend on bolt",
    ]
    default, door = ((tmp_path / f"{name}.urdf").read_text() for name in ("default", "door"))
    assert default.partition("<link")[2] == door.partition("<link")[2]
    status, out, err = run("door.kv.json", "json.urdf", "--json")
    assert json.loads(out)["left_out"] == {"lock": "has bounds that depend on bolt"}
    status, _, err = run("door.kv.json", "again.urdf", "--leave-out", "lokc")
    assert status == 2
    assert "lock" in err


def test_convert_with_tolerance_approximates_curves_and_prints_the_error(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = "articulations/folding_door"
    status, out, err = run(source, "door.urdf")
    assert (status, out) == (2, "")
    assert "approximated with --tolerance" in err
    assert "--leave-out" not in err  # there is no constraint among what is refused
    assert "leave_out=" not in err
    status, out, err = run(source, "door.urdf", "--tolerance", "0.05", "--json")
    assert (status, err) == (0, "")
    answer, saved = json.loads(out), kv.load(source).save(tmp_path / "same.urdf", tolerance=0.05)
    assert answer["largest"] == {"distance": saved.error.position, "angle": saved.error.angle}
    told = {e["name"]: (e["distance"], e["angle"]) for e in answer["approximated"]}
    assert told == {name: (e.position, e.angle) for name, e in saved.errors.items()}
    furthest = answer["approximated"][0]
    assert furthest["distance"] == answer["largest"]["distance"] > 0
    out = run(source, "door.urdf", "--tolerance", "0.05", "--force")[1]
    assert f"{1000 * furthest['distance']:.3g} mm ({furthest['name']})" in out
    assert kv.load("door.urdf").degrees_of_freedom == kv.load(source).degrees_of_freedom
    status, _, err = run(source, "door.urdf", "--tolerance", "-1", "--force")
    assert (status, "positive number" in err) == (2, True)


@pytest.mark.parametrize("ending", ["urdf", "xml"])
@pytest.mark.parametrize("name", ["pr2", "fetch", "hsr", "kitchen", "shelf_door"])
@pytest.mark.sampled(2)
def test_shipped_models_are_converted(run, tmp_path, monkeypatch, name, ending):
    if ending == "xml":
        pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    status, out, err = run(name, f"{name}.{ending}")
    assert status == 0
    missing = {
        "pr2": "  pr2/base/speed is no multiple",
        "hsr": "  hsr/base/speed",
        "fetch": "  fetch/base moves",
    }
    assert (missing[name] in err) if name in missing else not err
    assert kv.load(f"{name}.{ending}").degrees_of_freedom == kv.load(name).degrees_of_freedom
    if name in missing:
        status, out, err = run(name, f"strict.{ending}", "--strict")
        assert (status, out) == (2, "")
        assert not (tmp_path / f"strict.{ending}").exists()


def test_a_file_is_replaced_only_by_force(run, robot, tmp_path):
    (tmp_path / "out.kv.json").write_text("precious")
    status, out, err = run("robot.urdf", "out.kv.json")
    assert (status, out) == (2, "")
    assert "--force" in err
    assert (tmp_path / "out.kv.json").read_text() == "precious"
    assert run("robot.urdf", "out.kv.json", "--force")[0] == 0
    assert len(kv.load("out.kv.json").frames) == 2


def test_a_file_is_not_converted_into_itself(run, robot, tmp_path):
    before = robot.read_bytes()
    (tmp_path / "link.urdf").symlink_to(robot)
    os.link(robot, tmp_path / "twin.urdf")
    for target in (robot, "./robot.urdf", "link.urdf", "twin.urdf"):
        status, out, err = run("robot.urdf", target, "--force")
        assert (status, out) == (2, "")
        assert "is the input" in err
    assert robot.read_bytes() == before


def test_names_in_any_script_are_kept(run, robot, tmp_path):
    (tmp_path / "机 器").mkdir()
    status, out, err = run("robot.urdf", "机 器/тело-ü.kv.json", "--prefix", "рука")
    assert (status, err) == (0, "")
    assert "机 器/тело-ü.kv.json" in out
    assert "рука/a" in kv.load("机 器/тело-ü.kv.json").frames


@pytest.mark.parametrize(
    ("target", "hint"),
    [
        ("out.txt", ".urdf, .xml"),
        ("out", ".urdf, .xml"),
        ("", "file to write is empty"),
        ("out.obj", ".urdf, .xml"),
        ("nowhere/out.kv.json", "the folder nowhere does not exist"),
        ("robot.urdf/out.kv.json", "the folder robot.urdf does not exist"),
        ("folder", "folder/robot.kv.json"),
        (".", "robot.kv.json"),
        ("folder.kv.json", "folder.kv.json/robot.kv.json"),
        ("pipe.kv.json", "no regular file"),
        ("dead.kv.json", "no regular file"),
    ],
)
def test_convert_refuses_unwritable_paths(run, robot, tmp_path, target, hint):
    for name in ("folder", "folder.kv.json"):
        (tmp_path / name).mkdir()
    os.mkfifo(tmp_path / "pipe.kv.json")
    (tmp_path / "dead.kv.json").symlink_to("nothing")
    before = sorted(os.listdir(tmp_path))
    status, out, err = run("robot.urdf", target, "--force")
    assert (status, out, len(err.splitlines())) == (2, "", 1)
    assert hint in err
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.parametrize("source", ["missing.urdf", ".", "noise.urdf", "notes.txt", ""])
def test_an_unreadable_file_writes_nothing(run, robot, tmp_path, source):
    (tmp_path / "noise.urdf").write_bytes(os.urandom(100))
    (tmp_path / "notes.txt").write_text("hello")
    status, out, err = run(source, "out.kv.json")
    assert (status, out, len(err.splitlines())) == (2, "", 1)
    assert not (tmp_path / "out.kv.json").exists()


def test_convert_to_a_read_only_folder_is_an_error(run, robot, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "replace", refuse)
    status, out, err = run("robot.urdf", "out.kv.json")
    assert (status, out, len(err.splitlines())) == (2, "", 1)
    assert "Permission denied" in err
    assert os.listdir(tmp_path) == ["robot.urdf"]


def test_a_check_by_the_engine_is_printed_and_in_the_json(run, robot):
    pytest.importorskip("pydrake")
    status, out, err = run("robot.urdf", "robot.sdf", "--check")
    assert (status, err) == (0, "")
    assert re.search(
        r"^  checked by drake [\d.]+: 100 states, 2 frames, largest difference .* rad", out, re.M
    )
    status, out, _ = run("robot.urdf", "robot.sdf", "--check", "--json", "--force")
    check = json.loads(out)["check"]
    assert {key: check[key] for key in ("engine", "states", "frames", "ok")} == {
        "engine": "drake",
        "states": 100,
        "frames": 2,
        "ok": True,
    }
    assert set(check["largest"]) >= {"distance", "angle", "frame"}
    assert "check" not in json.loads(run("robot.urdf", "robot.sdf", "--json", "--force")[1])


def test_a_file_that_moves_otherwise_gives_status_1_and_is_kept(run, robot, monkeypatch):
    pytest.importorskip("pydrake")
    write = kv.Model.save

    def wrong(model, path, **options):
        saved = write(model, path, **options)
        text = saved.path.read_text()
        saved.path.write_text(text.replace("<xyz>1 0 0</xyz>", "<xyz>0 1 0</xyz>"))
        return saved

    monkeypatch.setattr(kv.Model, "save", wrong)
    status, out, err = run("robot.urdf", "robot.sdf", "--check")
    assert status == 1
    assert "The first joint that differs is 'j'. robot.sdf is kept, for a look at it only." in err
    assert os.path.exists("robot.sdf")
    status, out, _ = run("robot.urdf", "robot.sdf", "--check", "--force", "--json")
    assert status == 1
    check = json.loads(out)["check"]
    assert (check["ok"], check["cause"], check["wrong"]) == (False, "j", ["b"])


def test_a_tolerance_shows_its_bound_beside_the_difference(run, robot):
    pytest.importorskip("mujoco")
    status, out, _ = run("articulations/pedal_bin", "bin.xml", "--check", "--tolerance", "0.01")
    assert status == 0
    assert re.search(r"largest difference .*\n    bound of the approximated frames 0 m and 0\.00\d+ rad", out)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("robot.kv.json", "robot.kv.json cannot be checked: no other engine reads it"),
        ("-", "--check and - exclude each other"),
    ],
)
def test_a_check_of_a_document_is_refused_before_anything_is_written(run, robot, target, message):
    status, out, err = run("robot.urdf", target, "--check")
    assert (status, out) == (2, "")
    assert message in err
    assert not os.path.exists("robot.kv.json")


def test_a_missing_engine_is_told_before_anything_is_written(run, robot, monkeypatch):
    monkeypatch.setitem(sys.modules, "pydrake", None)
    monkeypatch.setitem(sys.modules, "pydrake.multibody.plant", None)
    status, _, err = run("robot.urdf", "robot.sdf", "--check")
    assert status == 2
    assert "drake, which reads such a file, is not installed: " in err
    assert not os.path.exists("robot.sdf")
