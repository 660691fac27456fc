"""``kineverse spheres``: covers of a model's shapes in a table, a picture and the cache."""

import json
from pathlib import Path

import numpy as np
import pytest

from kineverse.planning.spheres import object_covers

ROBOT = """<robot name="r">
<link name="base"><collision><geometry><box size=".2 .2 .1"/></geometry></collision>
<collision><origin xyz="0 0 .1"/><geometry><sphere radius=".05"/></geometry></collision></link>
<link name="arm"><visual><geometry><cylinder radius=".03" length=".2"/></geometry></visual></link>
<link name="bare"/>
{}
<joint name="a" type="fixed"><parent link="base"/><child link="arm"/></joint>
<joint name="b" type="fixed"><parent link="base"/><child link="bare"/></joint>
</robot>"""
BAD = """<link name="bad"><collision><geometry><mesh filename="nowhere.stl"/></geometry></collision></link>
<joint name="c" type="fixed"><parent link="base"/><child link="bad"/></joint>"""
BARE = '<robot name="r"><link name="bare"/></robot>'


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Create robots and a separate cache."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(tmp_path / "cache"))
    object_covers._in_memory.clear()
    Path("robot.urdf").write_text(ROBOT.format(""))
    Path("bad.urdf").write_text(ROBOT.format(BAD))
    Path("bare.urdf").write_text(BARE)
    return tmp_path


def test_the_table_has_all_links_and_their_sum(run):
    status, out, _ = run("spheres", "robot.urdf", "--protrusion", "2cm")
    assert status == 0
    rows = {line.split()[0]: line.split() for line in out.splitlines() if line}
    assert list(rows)[2:] == ["base", "arm", "total"]
    assert rows["base"][1] == "2"
    assert int(rows["total"][2]) == int(rows["base"][2]) + int(rows["arm"][2])
    assert float(rows["total"][3]) <= 20.0
    assert run("spheres", "robot.urdf", "--protrusion", "2cm")[1].count("cached") == 3


def test_json_has_the_spheres(run):
    status, out, _ = run("spheres", "robot.urdf", "--links", "base", "--most", 4, "--json")
    answer = json.loads(out)
    assert status == answer["status"] == 0
    (link,) = answer["links"]
    assert (link["shapes"], len(link["radii"]) <= 4) == (2, True)
    # The top of the ball, in the frame of the link.
    gaps = np.linalg.norm(np.array(link["centres"]) - [0.0, 0.0, 0.15], axis=1) - link["radii"]
    assert -0.1 < gaps.min() <= 0.0


def test_a_shape_that_cannot_be_covered_is_told(run):
    status, out, _ = run("spheres", "bad.urdf", "--protrusion", "4cm")
    assert status == 1
    assert "not covered" in out
    assert "nowhere.stl" in out
    assert "arm" in out


def test_a_picture_shows_model_and_spheres(run):
    status, _, err = run("spheres", "robot.urdf", "--protrusion", "4cm", "--picture", "r.png")
    assert status == 0
    assert Path("r.png").stat().st_size > 1000
    assert "r.png" in err


def test_the_cache_is_listed_and_emptied(run):
    assert "no covers" in run("spheres", "--list")[1]
    run("spheres", "robot.urdf", "--protrusion", "4cm")
    assert "base: box and 1 more" in run("spheres", "--list")[1]
    assert len(json.loads(run("spheres", "--list", "--json")[1])["covers"]) == 2
    assert run("spheres", "--clear")[1].startswith("2 removed")


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["robot.urdf", "--links", "bse"], "'base'"),
        (["robot.urdf", "--links", "bare"], "no link with shapes"),
        (["bare.urdf"], "no shapes"),
        (["robot.urdf", "--protrusion", "-1mm"], "positive"),
        (["robot.urdf", "--protrusion", "5deg"], "length"),
        (["robot.urdf", "--most", "0"], "1 to 1024"),
        ([], "Name a model"),
        (["--list", "--clear"], "give one of them"),
    ],
)
def test_wrong_requests_are_told(run, words, part):
    status, _, err = run("spheres", *words)
    assert status == 2
    assert part in err
