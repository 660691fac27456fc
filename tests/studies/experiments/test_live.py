"""Experiment with a live system: what it counts, and how it tells."""

import json

import pytest

import kineverse as kv
from kineverse_studies.experiments import Options, reproduce
from kineverse_studies.experiments.live import RealTimeRun, make_live_report, make_object
from kineverse_studies.experiments.table1_open.programs import OBJECT, OBJECTS, PLACE


@pytest.mark.parametrize("name", OBJECTS)
def test_an_object_stands_at_its_place_with_its_handle(name):
    thing = OBJECTS[name]
    model = make_object(thing)
    assert f"{OBJECT}/{thing.coordinate}" in map(str, model.degrees_of_freedom)
    assert f"{OBJECT}/{thing.handle}" in model.frames
    roots = [f for f, frame in model.frames.items() if frame.parent == "world"]
    assert [model.fk(root)({}).tolist() for root in roots] == [PLACE({}).tolist()] * len(roots)


def test_a_report_has_each_run_and_what_failed():
    good = RealTimeRun("hsr", "drawer", done=6, wanted=6, seconds=[10.0, 12.0], factor=0.9999, late=0.001)
    bad = RealTimeRun("pr2", "drawer", wanted=6, reason="No server came.")
    report = make_live_report([good, bad], [], Options())
    (table,) = report.tables
    assert [row[2:4] for row in table.rows] == [("6", "6"), ("6", "0")]
    assert table.rows[1][-1] == "No server came."
    data = json.loads(json.dumps(report.numbers, allow_nan=False))
    assert data["runs"][0]["done"] == 6
    assert data["runs"][1]["real_time_factor"] is None


def test_a_robot_that_does_not_ship_is_refused():
    with pytest.raises(kv.errors.KineverseError, match="ur5"):
        reproduce("live", options=Options(robot=("ur5",)))


@pytest.mark.long
@pytest.mark.compiler
def test_a_drawer_is_opened_and_closed_by_processes():
    pytest.importorskip("mujoco")
    report = reproduce("live", options=Options(quick=True))
    (run,) = report.numbers["runs"]
    assert run["done"] == run["wanted"] == 2, run["reason"]
