"""``kineverse demo``: objects, reports, page, picture and mistakes. How openings go is tested with these."""

import json
import urllib.request
from dataclasses import replace
from functools import partial

import pytest

from kineverse.errors import InvalidValueError
from kineverse.manipulation.outcome import Outcome
from kineverse.manipulation.robot_sources import SHIPPED, find_robot

pytest.importorskip("coal")
pytest.importorskip("daqp")

LOWER, UPPER = "shelf_drawers/lower_drawer", "shelf_drawers/upper_drawer"


@pytest.fixture
def fails():
    """Errors of the stand-in for the skill, by the number of the call."""
    return {}


@pytest.fixture
def asked(monkeypatch, fails):
    """Stand in for the skill: it puts the object where it is wanted. Returns what it was asked for."""
    calls = []
    monkeypatch.setattr("kineverse.cli.demo.KITCHEN", "shelf_drawers")  # a small kitchen
    away = replace(SHIPPED["hsr"], start={"base/x": -1.0})  # it would stand in the drawers
    monkeypatch.setattr("kineverse.cli.demo.find_robot", partial(find_robot, robots={"hsr": away}))

    def open_object(session, coordinate, *, target, hand, **options):
        calls.append((str(coordinate), target))
        if len(calls) in fails:
            raise fails[len(calls)]
        session.phase = "move"
        world, now = session.interface, session.time
        world.reset(world.state.updated({coordinate: target}))
        world._time = now  # in the same run
        session.refresh()
        for _ in range(2):
            session.stop()
        assert hand.hand == "hsr/hand_palm_link"
        measures = {"grasp_error": 1e-3, "target": target, "tolerance": 0.02}
        return Outcome(True, target, "as wanted", "kinematic", 0.04, 2, measures)

    monkeypatch.setattr("kineverse.manipulation.trials.open_object", open_object)
    return calls


def test_objects_are_opened_and_closed_on_a_page(run, asked, monkeypatch):
    pytest.importorskip("viser")
    seen = []

    def wait(page):
        with urllib.request.urlopen(page.address, timeout=30) as answer:
            seen.append(answer.status)

    monkeypatch.setattr("kineverse.view.viewer.Viewer.wait", wait)
    words = ["--what", UPPER, "*/lower_*", "--speed", "0", "--port", "0", "--no-browser"]
    status, out, err = run("demo", *words)
    assert (status, seen) == (0, [200])
    assert asked == [(UPPER, 0.22), (UPPER, 0.0), (LOWER, 0.22), (LOWER, 0.0)]
    lines = err.splitlines()
    assert lines[0].startswith(f"[1/2] {UPPER}: opened and closed")
    assert lines[1].startswith(f"[2/2] {LOWER}: opened and closed")
    assert "2 of 2 opened and closed by the hsr" in out
    row = next(line for line in out.splitlines() if line.startswith(LOWER))
    assert all(cell in row for cell in ("drawer", "0.22 m", "0.1 s", "1.00 mm"))


def test_failures_have_status_1_and_json_has_all_figures(run, asked, fails, tmp_path):
    fails[1] = InvalidValueError("no handle")
    words = ["--headless", "--what", LOWER, UPPER, "--noise", "none", "--json"]
    status, out, err = run("demo", *words, "--picture", tmp_path / "x.png")
    answer = json.loads(out)
    assert (status, answer["done"], answer["noise"], answer["world"]) == (1, False, "none", "kinematic")
    lower, upper = answer["objects"]
    assert (lower["kind"], lower["done"], lower["closed"], lower["grasp_error"]) == (
        "drawer",
        False,
        None,
        None,
    )
    assert "no handle" in lower["reason"]
    assert f"[1/2] {LOWER}: not opened, at 0 m" in err
    assert (upper["done"], upper["estimate_error"], upper["opened"]["value"]) == (True, 0.0, 0.22)
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")


def test_ctrl_c_prints_the_table_so_far(run, asked, fails, tmp_path):
    fails[2] = KeyboardInterrupt()
    status, out, _ = run("demo", "--headless", "--what", LOWER, "--picture", tmp_path / "x.png")
    assert (status, len(asked)) == (130, 2)
    assert out == "0 of 1 opened and closed by the hsr\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--robot", "hrs"], "'hsr'"),
        (["--what", "shelf_drawers/uper_drawer"], f"'{UPPER}'"),
        (["--what", "*_lid"], "*_lid"),
        (["--noise", "3furlongs"], "3furlongs"),
        (["--speed", "-1"], "--speed is between 0 and 100"),
        (["--seed", "-1"], "--seed is a number from 0 on"),
        (["--picture", "/nowhere/x.png"], "/nowhere"),
    ],
)
def test_mistakes_are_reported_in_one_line(run, asked, words, message):
    status, out, err = run("demo", "--headless", *words)
    assert (status, out, asked) == (2, "", [])
    assert message in err
    assert len(err.splitlines()) == 1
