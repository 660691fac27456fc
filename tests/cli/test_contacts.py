"""Contacts in ``info``, ``validate --contacts`` and ``view --picture --near``."""

import json
import sys

import numpy as np
import pytest

import kineverse as kv
from kineverse.cli import info

pytest.importorskip("coal", reason="distances need the extra 'geometry'")
imaging = pytest.importorskip("PIL.Image")

LINK = '<link name="{}"><collision><origin xyz="{} 0 0"/><geometry>{}</geometry></collision></link>'
SLIDE = (
    '<joint name="{1}_slide" type="prismatic"><parent link="{0}"/><child link="{1}"/><axis xyz="1 0 0"/>'
    '<limit lower="0" upper="1" effort="1" velocity="1"/></joint>'
)
BALL, MESH = '<sphere radius="0.5"/>', '<mesh filename="lost.stl"/>'


@pytest.fixture
def robot(tmp_path):
    """Write a chain of slides with a ball each, at places along x [m]; neighbours are joined."""

    def write(*places, shape=BALL):
        links = "".join(LINK.format(f"l{k}", x, shape if k == 1 else BALL) for k, x in enumerate(places))
        joints = "".join(SLIDE.format(f"l{k}", f"l{k + 1}") for k in range(len(places) - 1))
        file = tmp_path / "robot.urdf"
        file.write_text(f'<robot name="r">{links}{joints}</robot>')
        return file

    return write


def test_info_lists_contacts(run, robot):
    out = run("info", robot(0, 0.2, 0.9, 1.05))[1]
    assert "2 pairs of bodies touch at the default state, first l1 and l3, 0.15 m deep" in out
    out = run("info", robot(0, 5, 0.75))[1]
    assert "1 pair of bodies touches at the default state: l0 and l2, 0.25 m deep" in out
    assert "at the default state" not in run("info", robot(0, 0.2, 2))[1], "joined bodies are left alone"


def test_info_in_json_has_the_distances_or_null(run, robot, monkeypatch):
    file = robot(0, 5, 0.75)
    (pair,) = json.loads(run("info", file, "--json")[1])["touching"]
    assert (pair["a"], pair["b"]) == ("l0", "l2")
    assert pair["distance"] == pytest.approx(-0.25)
    assert json.loads(run("info", robot(0, 5, 10), "--json")[1])["touching"] == []
    monkeypatch.setattr(info, "is_installed", lambda: False)
    assert json.loads(run("info", file, "--json")[1])["touching"] is None


def test_info_lists_contacts_beside_unusable_bodies(run, robot):
    out = run("info", robot(0, 0.1, 0.75, shape=MESH))[1]
    assert "touches at the default state: l0 and l2, 0.25 m deep" in out


def test_contacts_are_problems_only_with_the_option(run, robot):
    file = robot(0, 5, 0.75)
    assert run("validate", file)[0] == 0
    status, out, _ = run("validate", file, "--contacts")
    assert status == 1
    assert "l0: in l2 by 0.25 m at the default state" in out
    assert run("validate", robot(0, 0.2, 2), "--contacts")[0] == 0
    assert run("validate", robot(0, 5, 1.0), "--contacts")[0] == 0, "what only touches is in nothing"


def test_validate_without_the_extra_names_it(run, robot, monkeypatch):
    monkeypatch.setitem(sys.modules, "coal", None)
    status, _, err = run("validate", robot(0, 5, 0.75), "--contacts")
    assert status == 2
    assert "[geometry]" in err


def test_view_writes_pictures_of_near_bodies(run, robot, tmp_path):
    file, path = robot(0, 5, 1.1), tmp_path / "near.png"
    images = []
    for words in ([], ["--near", "20cm"]):
        status, out, err = run("view", file, "--picture", path, *words)
        assert (status, err) == (0, "")
        assert f"picture: {path}" in out
        images.append(np.asarray(imaging.open(path)))
    plain, near = images
    assert (near != plain).any()


def test_view_names_the_limits_of_a_picture(run, robot, tmp_path):
    status, _, err = run(
        "view", robot(0, 5, 1.1, shape=MESH), "--picture", tmp_path / "p.png", "--near", "0.2"
    )
    assert status == 0
    assert "no distances to l1" in err


@pytest.mark.parametrize(("radius", "said"), [("-1", "radius"), ("wide", "not a length")])
def test_view_refuses_invalid_radii(run, robot, tmp_path, radius, said):
    status, _, err = run("view", robot(0, 5), "--picture", tmp_path / "p.png", f"--near={radius}")
    assert status == 2
    assert said in err
    assert not (tmp_path / "p.png").exists()


def test_shipped_models_have_no_penetrations():
    for name in kv.shipped_models():
        assert not any(pair.distance < -info.CONTACT_DEPTH for pair in info.find_contacts(kv.load(name)))
