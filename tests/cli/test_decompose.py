"""``kineverse decompose``: meshes of models and mesh files as convex hulls in the cache."""

import json
from pathlib import Path

import pytest

from fake_coacd import cube, ell, fake_coacd
from kineverse.cli import main

ROBOT = """<robot name="r">
<link name="base"><collision><geometry><mesh filename="ell.stl"/></geometry></collision></link>
<link name="arm"><collision><geometry><mesh filename="cube.stl" scale="1 -1 1"/></geometry></collision></link>
<link name="twin"><collision><geometry><mesh filename="cube.stl" scale="1 -1 1"/></geometry></collision></link>
<link name="seen"><visual><geometry><mesh filename="cube.stl"/></geometry></visual></link>
<link name="both">
<visual><geometry><mesh filename="nowhere.stl"/></geometry></visual>
<collision><geometry><box size="1 1 1"/></geometry></collision>
</link>
{}
<joint name="a" type="fixed"><parent link="base"/><child link="arm"/></joint>
<joint name="b" type="fixed"><parent link="base"/><child link="seen"/></joint>
<joint name="c" type="fixed"><parent link="base"/><child link="both"/></joint>
<joint name="d" type="fixed"><parent link="base"/><child link="twin"/></joint>
</robot>"""
BAD_LINK = """
<link name="bad"><collision><geometry><mesh filename="bad.stl"/></geometry></collision></link>
<joint name="e" type="fixed"><parent link="base"/><child link="bad"/></joint>"""


@pytest.fixture
def run(capfd):
    """Run the command in this process: status, standard output, standard error."""

    def call(*words):
        status = main(["decompose", *map(str, words)])
        captured = capfd.readouterr()
        return status, captured.out, captured.err

    return call


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Create two meshes and a robot, a separate cache, and a CoACD that returns the mesh."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr("kineverse.geometry.decomposition.accuracy.SAMPLES", 100)
    fake_coacd(tmp_path / "fake", monkeypatch, "return [(mesh.vertices, mesh.faces)]")
    cube().export("cube.stl")
    ell().export("ell.stl")
    Path("robot.urdf").write_text(ROBOT.format(""))
    Path("bad.urdf").write_text(ROBOT.format(BAD_LINK))
    Path("bad.stl").write_bytes(b"")
    return tmp_path


def test_decompose_reuses_the_cache(run):
    status, out, err = run("robot.urdf", "--jobs", 2)
    assert (status, err) == (0, "")
    assert "base: ell.stl" in out
    assert "arm and 1 more: cube.stl" in out
    assert "seen: cube.stl" in out
    assert "nowhere" not in out
    assert "cached" not in out
    status, out, _ = run("robot.urdf")
    assert status == 0
    assert out.count("cached") == 3
    assert "cached" not in run("robot.urdf", "--force")[1]


def test_json_is_one_object_and_nothing_else(run, folder):
    status, out, err = run("robot.urdf", "--json", "--links", "base", "--error", "2mm", "--max-hulls", 4)
    assert (status, err) == (0, "")
    (mesh,) = json.loads(out)["meshes"]
    assert mesh["file"] == str(folder / "ell.stl")
    assert (mesh["links"], mesh["hulls"], mesh["error"], mesh["max_hulls"]) == (["base"], 1, 0.002, 4)
    assert mesh["mesh_volume"] < mesh["volume"] <= mesh["hull_volume"] * (1 + 1e-9)
    assert 0.05 < mesh["excess"] < 0.076
    assert mesh["failure"] is None


def test_mesh_files_are_decomposed(run):
    status, out, err = run("cube.stl", "./cube.stl", "ell.stl")
    assert (status, err) == (0, "")
    assert [line.split()[0] for line in out.splitlines()[2:]] == ["cube.stl", "ell.stl"]


def test_one_bad_mesh_does_not_stop_the_others(run):
    status, out, err = run("bad.urdf", "cube.stl", "gone.stl")
    assert (status, err) == (1, "")
    for text in ("base: ell.stl", "seen: cube.stl", "bad: bad.stl: ", "gone.stl: "):
        assert text in out
    status, out, _ = run("bad.urdf", "--json")
    answer = json.loads(out)
    assert status == answer["status"] == 1
    (failed,) = (mesh for mesh in answer["meshes"] if mesh["failure"])
    assert failed["links"] == ["bad"]
    assert "bad.stl" in failed["failure"]


def test_a_model_that_cannot_be_read_does_not_stop_the_others(run):
    status, out, _ = run("gone.urdf", "cube.stl")
    assert status == 2
    assert "cannot be read\n  gone.urdf" in out
    assert "cube.stl" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "Name a model"),
        (("robot.urdf", "--links", "bsae"), "'base'"),
        (("cube.stl", "--links", "base"), "no link"),
        (("cube.stl", "--error", "0"), "positive length"),
        (("cube.stl", "--error", "small"), "not a length"),
        (("cube.stl", "--error", "2deg"), "not a length"),
        (("cube.stl", "--max-hulls", "0"), "at least one hull"),
        (("cube.stl", "--jobs", "0"), "--jobs"),
        (("cube.stl", "--timeout", "nan"), "--timeout"),
        (("cube.stl", "--memory", "-1"), "--memory"),
        (("cube.stl", "--list"), "whole cache"),
        (("--list", "--clear"), "give one of them"),
    ],
)
def test_decompose_refuses_invalid_arguments_in_one_line(run, words, message):
    status, out, err = run(*words)
    assert (status, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1


def test_decompose_accepts_a_model_without_meshes(run):
    assert run("shelf_door") == (0, "There are no meshes.\n", "")


def test_the_cache_is_listed_and_cleared(run):
    assert "no decompositions" in run("--list")[1]
    run("cube.stl")
    run("ell.stl", "--max-hulls", 3)
    status, out, _ = run("--list")
    assert status == 0
    assert [line.split()[0] for line in out.splitlines()[2:]] == ["cube.stl", "ell.stl"]
    assert len(json.loads(run("--list", "--json")[1])["decompositions"]) == 2
    assert json.loads(run("--clear", "--json")[1]) == {"removed": 2}
    assert "no decompositions" in run("--list")[1]
