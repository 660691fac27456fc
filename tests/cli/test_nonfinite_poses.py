"""Frames with nonfinite poses are named in one line, and are never NaN in JSON."""

import json

import numpy as np
import pytest

import kineverse as kv
from kineverse.model.body import Body, Box, Shape

CUBE = Body(visuals=(Shape(Box((1.0, 1.0, 1.0))),))


@pytest.fixture
def garage(tmp_path):
    """Return a door whose pose is not finite beyond its limit."""
    model, a = kv.Model(), kv.position("garage/door")
    with model.edit() as edit:
        edit.add_frame(
            "garage/door", "world", kv.translation(0, 0, 2 - a) @ kv.rotation_y(np.arccos(a / 2)), CUBE
        )
        edit.constrain("garage/range", 0, a, 2)
    model.save(tmp_path / "home.kv.json")
    return tmp_path / "home.kv.json"


@pytest.fixture
def pole(tmp_path):
    """Return frames whose poses are not finite at the default state."""
    model, q = kv.Model(), kv.position("q")
    with model.edit() as edit:
        edit.add_frame("hook", "world", kv.translation(1 / q, 0, 0), CUBE)
        edit.add_frame("ring", "hook", kv.rotation_x(q), CUBE)
        edit.add_frame("post", "world", kv.translation(0, 0, 1), CUBE)
        edit.constrain("range", -2, q, 2)
    model.save(tmp_path / "pole.kv.json")
    return tmp_path / "pole.kv.json"


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_fk_says_that_the_pose_is_not_finite(run, garage, options):
    status, out, err = run("fk", garage, "garage/door", "--set", "garage/door=3", *options)
    assert (status, out) == (2, "")
    note, line = err.splitlines()
    assert "garage/door = 3 is beyond its limits [0, 2]" in note
    assert "'garage/door' in 'world' is not finite at garage/door=3" in line


def test_fk_of_a_finite_frame_is_printed(run, pole):
    status, out, err = run("fk", pole, "post", "--json")
    assert (status, err) == (0, "")
    assert json.loads(out)["position"] == [0, 0, 1]
    status, out, err = run("fk", pole, "ring")
    assert (status, out) == (2, "")
    assert "'ring' in 'world' is not finite at q=0" in err


def test_info_leaves_out_and_names_nonfinite_frames(run, pole):
    status, out, err = run("info", pole)
    assert (status, err) == (0, "")
    assert "1.00 x 1.00 x 1.00 m" in out
    assert "not finite at the default state: hook, ring" in out
    status, out, err = run("info", pole, "--json")
    assert (status, err) == (0, "")
    answer = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert answer["not_finite"] == ["hook", "ring"]
    assert answer["size"]["extent"] == [1, 1, 1]


def test_info_of_a_finite_model_lists_no_frame(run, garage):
    _, out, _ = run("info", garage)
    assert "not finite" not in out
    _, out, _ = run("info", garage, "--json")
    assert json.loads(out)["not_finite"] == []
